"""Thickness maps for sensors that nobody has measured: random fields with the statistics of measured ones.

A stand-in says how strong the fringes of such a sensor are and how they vary over the focal plane, not where its
bright and dark bands lie. It is the same in every process: its seed is the number of the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..array_types import Float32Array, FloatArray
from ..errors import InputError, OutOfRangeError, UnknownNameError
from ..instrument.detector import Detector
from ..model import Setup
from ..products import ThicknessMap
from ..resources import read_yaml

_PERIOD = 1.5  # Sides of the sensor after which the cosines of the field have no slope: beyond its edge

_HIGHEST = 4.0
"""Wave number, in units of the inverse correlation length, beyond which the field has nothing left (exp(-8))."""

_RANGE_SAMPLES = 96


@dataclass(frozen=True)
class ThicknessField:
    """Statistics of the thickness of a layer."""

    layer: str  # name of the layer
    mean_um: float  # middle of the range of thickness on a sensor
    # Smallest and largest difference between the thickest and the thinnest place of a sensor
    span_um: tuple[float, float]
    scale_mm: float

    def __post_init__(self) -> None:
        low, high = self.span_um
        if not 0.0 < low <= high < 2.0 * self.mean_um < math.inf:
            raise OutOfRangeError(
                "span of the thickness [um]", self.span_um, "positive, less than twice the mean"
            )
        if not 0.0 < self.scale_mm < math.inf:
            raise OutOfRangeError("correlation length [mm]", self.scale_mm, "positive")

    @classmethod
    def of(cls, setup: Setup) -> ThicknessField:
        """Statistics of the varying layer of a set-up."""
        fields = read_yaml("laboratory", "thickness_fields.yaml")["fields"]
        stack, layer = setup.stack.name, setup.varying
        if layer not in fields.get(stack, {}):
            known = [f"{name}: {varying}" for name, layers in fields.items() for varying in layers]
            raise UnknownNameError("statistics of the thickness", f"{stack}: {layer}", known)
        entry = fields[stack][layer]
        low, high = entry["span_um"]
        return cls(layer, float(entry["mean_um"]), (float(low), float(high)), float(entry["scale_mm"]))

    def draw(
        self, shape: tuple[int, int], size_mm: tuple[float, float], rng: np.random.Generator
    ) -> Float32Array:
        """Thickness of one sensor.

        ``shape``: rows and columns of the map. The field does not depend on them, only where it is sampled.
        """
        if min(shape) < 1:
            raise InputError("shape of the thickness map", shape, "positive")
        waves = [_wave_numbers(side, self.scale_mm) for side in size_mm]
        power = [np.exp(-0.25 * (wave * self.scale_mm) ** 2) for wave in waves]
        amplitude = rng.standard_normal((waves[0].size, waves[1].size)) * np.outer(*power)
        span = rng.uniform(*self.span_um)

        def field(rows: int, columns: int) -> FloatArray:
            along_y, along_x = (
                np.cos(np.outer((np.arange(count) + 0.5) * (side / count), wave))
                for count, side, wave in zip((rows, columns), size_mm, waves, strict=True)
            )
            return np.asarray(along_y @ amplitude @ along_x.T)

        coarse = field(_RANGE_SAMPLES, _RANGE_SAMPLES)
        low, high = float(coarse.min()), float(coarse.max())
        scaled = (field(*shape) - 0.5 * (low + high)) * (span / (high - low))
        return (self.mean_um + scaled).astype(np.float32)


def stand_in_thickness(
    setup: Setup, detector: Detector, seed: int = 0, shape: tuple[int, int] | None = None
) -> ThicknessMap:
    """Map that stands for the unknown thickness of a sensor.

    ``detector``: the sensor; its number is part of the seed. ``seed``: another seed gives other stand-ins for
    all sensors. ``shape``: rows and columns of the map, which covers the whole sensor; those of the sensor by
    default. The header of the map states ``STANDIN``; its uncertainty is that of not knowing: the standard
    deviation of the field.
    """
    field = ThicknessField.of(setup)
    rows, columns = detector.shape
    size_mm = 1e-3 * detector.pixel_um * rows, 1e-3 * detector.pixel_um * columns
    value = field.draw(shape or detector.shape, size_mm, np.random.default_rng([seed, detector.id]))
    zero = np.zeros(value.shape, dtype=np.float32)
    return ThicknessMap(
        value=value,
        sigma=np.full(value.shape, value.std(), dtype=np.float32),
        chi2=zero,
        slip_probability=zero,
        mask=np.zeros(value.shape, dtype=np.int32),
        layer=field.layer,
        metadata={"STANDIN": True, "STANDSD": seed},
        detector=detector.name,
    )


def _wave_numbers(side_mm: float, scale_mm: float) -> FloatArray:
    """Wave numbers of the cosines [rad/mm]."""
    step = math.pi / (_PERIOD * side_mm)
    return np.asarray(step * np.arange(1 + math.ceil(_HIGHEST / (step * scale_mm))), dtype=float)
