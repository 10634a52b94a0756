"""Blemishes of a simulated sensor: columns, pixels and response that are not as they should be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..array_types import BoolArray, Float32Array
from ..errors import OutOfRangeError
from ..instrument.detector import Detector

BRIGHT_COLUMN_E = 2_000.0  # Charge that a bright column adds to a flat [electrons]
DEAD_COLUMN_RESPONSE = 0.4  # Response of a dead column
HOT_PIXEL_E = (4_000.0, 30_000.0)  # Range of the charge that a hot pixel adds to a flat [electrons]


@dataclass(frozen=True)
class Defects:
    """Blemishes of the sensor.

    Attributes
    ----------
    bad_columns : `int`
        Columns of an amplifier that are dead or bright from some row on; half of either kind.
    hot_pixels : `int`
        Single pixels with 4000 to 30 000 electrons too many in every flat.
    prnu_rms : `float`
        Rms of the pixel-to-pixel response.
    """

    bad_columns: int = 0
    hot_pixels: int = 0
    prnu_rms: float = 0.0

    def __post_init__(self) -> None:
        for name in ("bad_columns", "hot_pixels", "prnu_rms"):
            if not getattr(self, name) >= 0:
                raise OutOfRangeError(name, getattr(self, name), "zero or more")


def draw_defects(
    sensor: Detector, defects: Defects, rng: np.random.Generator
) -> tuple[Float32Array, Float32Array, BoolArray]:
    """Response, added charge [electrons] and place of the blemishes of a sensor."""
    shape = sensor.shape
    response = np.ones(shape, dtype=np.float32)
    if defects.prnu_rms > 0:
        response += np.float32(defects.prnu_rms) * rng.standard_normal(shape, dtype=np.float32)
    excess = np.zeros(shape, dtype=np.float32)
    defective = np.zeros(shape, dtype=bool)
    for number in range(defects.bad_columns):
        amp = sensor.amplifiers[rng.integers(len(sensor.amplifiers))]
        column = amp.x0 + int(rng.integers(amp.width))
        # A column is bad from the defect away from the register, which lies at the outer edge.
        first = int(rng.integers(amp.height // 2))
        rows = slice(amp.y0, amp.y0 + amp.height - first)
        if not amp.flip_y:
            rows = slice(amp.y0 + first, amp.y0 + amp.height)
        if number % 2:
            excess[rows, column] += BRIGHT_COLUMN_E
        else:
            response[rows, column] *= DEAD_COLUMN_RESPONSE
        defective[rows, column] = True
    for _ in range(defects.hot_pixels):
        y, x = int(rng.integers(shape[0])), int(rng.integers(shape[1]))
        excess[y, x] += rng.uniform(*HOT_PIXEL_E)
        defective[y, x] = True
    return response, excess, defective
