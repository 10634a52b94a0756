"""Random thickness as a function of position on the sensor, and the area of its pixels.

Every map is an array ``[y, x]`` in µm on the assembled, trimmed sensor, lower-left pixel first.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..array_types import FloatArray
from ..errors import OutOfRangeError
from ..instrument.measured_thickness import E2V_SHAPE, e2v_321, fit_to_sensor

__all__ = ["E2V_SHAPE", "PixelArea", "e2v_321", "fit_to_sensor", "random_field"]

GAUSS_NODES = ((-0.5 * math.sqrt(0.6), 5.0 / 18.0), (0.0, 4.0 / 9.0), (0.5 * math.sqrt(0.6), 5.0 / 18.0))
"""Places along a side of a pixel [px] and their weights: exact to the fifth power."""


def random_field(
    shape: tuple[int, int],
    rng: np.random.Generator,
    mean: float = 17.0,
    span: float = 6.0,
    scale: float | None = None,
) -> FloatArray:
    """Smooth Gaussian random field with a squared-exponential correlation.

    Random Fourier features: a sum of plane waves whose wave vectors are normally distributed.

    Parameters
    ----------
    shape : `tuple` [`int`, `int`]
        Rows and columns.
    rng : `numpy.random.Generator`
        Source of randomness.
    mean : `float`, optional
        Middle of the range of thickness [µm].
    span : `float`, optional
        Difference between the thickest and the thinnest pixel [µm].
    scale : `float`, optional
        Correlation length [px]; half the shorter side by default.

    Returns
    -------
    thickness_um : `numpy.ndarray`, ``shape``
        Thickness [µm], from ``mean - span / 2`` to ``mean + span / 2``.

    Raises
    ------
    OutOfRangeError
        The span or the scale is not positive, or the thinnest pixel would be thinner than nothing.
    """
    length = 0.5 * min(shape) if scale is None else float(scale)
    if not length > 0:
        raise OutOfRangeError("scale [px]", scale, "a positive number")
    if not 0 < span <= 2 * mean:
        raise OutOfRangeError("span [um]", span, f"above 0 and up to twice the mean, {2 * mean:g}")
    waves = 128
    ky, kx = rng.normal(scale=1.0 / length, size=(2, waves))
    phase = rng.uniform(0.0, 2.0 * np.pi, waves)
    along_y = np.exp(1j * (np.arange(shape[0])[:, np.newaxis] * ky + phase))
    along_x = np.exp(1j * (kx[:, np.newaxis] * np.arange(shape[1])))
    field = along_y.real @ along_x.real - along_y.imag @ along_x.imag
    return _stretch(field, mean, span)


@dataclass(frozen=True, eq=False)
class PixelArea:
    """A thickness map over the area of its pixels: each is a plane through its own thickness."""

    thickness_um: FloatArray  # [y, x]: thickness at the centres of the pixels
    # slope_y, slope_x [y, x]: how the thickness rises within a pixel [µm per px]
    slope_y: FloatArray
    slope_x: FloatArray

    @classmethod
    def of(cls, thickness_um: FloatArray) -> PixelArea:
        """Slopes from the neighbours; where the map has a step or a summit, a pixel does not reach beyond it."""
        slopes = [_limited_slope(thickness_um, axis) for axis in (0, 1)]
        return cls(thickness_um, slopes[0], slopes[1])

    @property
    def range_um(self) -> tuple[float, float]:
        """Thinnest and thickest place within any pixel [µm]."""
        reach = 0.5 * (np.abs(self.slope_y) + np.abs(self.slope_x))
        return float((self.thickness_um - reach).min()), float((self.thickness_um + reach).max())

    def average(self, signal: Callable[..., FloatArray], *others: PixelArea) -> FloatArray:
        """Mean over each pixel of what depends on its thickness, and on others, by 3 × 3 nodes of Gauss's rule.

        The signal may have axes before those of the map.
        """
        nodes = zip(*(area._nodes() for area in (self, *others)), strict=True)
        parts = (each[0][1] * signal(*(thickness for thickness, _ in each)) for each in nodes)
        return functools.reduce(np.add, parts)

    def in_squares(self, rows: NDArray[np.intp], columns: NDArray[np.intp], across: int) -> FloatArray:
        """Thickness in the middle of equal squares of some pixels, shape ``(N, across, across)``."""
        middle = (np.arange(across) + 0.5) / across - 0.5
        thickness, slope_y, slope_x = (
            values[rows, columns][:, np.newaxis, np.newaxis]
            for values in (self.thickness_um, self.slope_y, self.slope_x)
        )
        return np.asarray(thickness + slope_y * middle[:, np.newaxis] + slope_x * middle)

    def _nodes(self) -> Iterator[tuple[FloatArray, float]]:
        for up, weight_y in GAUSS_NODES:
            for along, weight_x in GAUSS_NODES:
                yield self.thickness_um + up * self.slope_y + along * self.slope_x, weight_y * weight_x


def _limited_slope(field: FloatArray, axis: int) -> FloatArray:
    """Harmonic mean of the differences to both neighbours, zero where they disagree (van Leer 1977)."""
    result = np.zeros(field.shape)
    size = field.shape[axis]
    if size < 2:
        return result
    own = result.swapaxes(0, axis)
    step = np.diff(field, axis=axis).swapaxes(0, axis)
    below, above = step[:-1], step[1:]
    product = below * above
    np.divide(2.0 * product, below + above, out=own[1:-1], where=product > 0.0)
    own[0], own[-1] = step[0], step[-1]
    return result


def _stretch(field: FloatArray, mean: float, span: float) -> FloatArray:
    """Map the range of ``field`` linearly onto ``mean ± span / 2``."""
    low, high = float(field.min()), float(field.max())
    if not high > low:
        return np.full(field.shape, mean)
    return mean + span * ((field - low) / (high - low) - 0.5)
