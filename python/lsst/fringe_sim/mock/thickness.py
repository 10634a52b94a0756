"""Thickness of the adhesive as a function of position on the sensor: measured and random.

Every map is an array ``[y, x]`` in µm on the assembled, trimmed sensor, lower-left pixel first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.ndimage import map_coordinates

from ..errors import InputError, OutOfRangeError
from ..resources import read_table

__all__ = [
    "E2V_SHAPE",
    "PixelArea",
    "Sampling",
    "e2v_321",
    "fit_to_sensor",
    "random_field",
]

E2V_SHAPE = (4004, 4096)
"""Rows and columns of an assembled, trimmed E2V-CCD250."""

GAUSS_NODES = ((-0.5 * math.sqrt(0.6), 5.0 / 18.0), (0.0, 4.0 / 9.0), (0.5 * math.sqrt(0.6), 5.0 / 18.0))
"""Places along a side of a pixel [px] and their weights: exact to the fifth power."""

Sampling = Literal["resample", "window"]
"""How a large map becomes a small one: the whole of it on fewer pixels, or a part of it pixel by pixel."""


def e2v_321(
    shape: tuple[int, int] = E2V_SHAPE,
    *,
    sampling: Sampling = "resample",
    corner: tuple[int, int] = (0, 0),
) -> NDArray[np.float64]:
    """Adhesive of E2V-CCD250-321, as a smooth model of the map that Guo et al. (2022) fitted.

    A bicubic spline of 24 × 24 coefficients. It differs from the published map by 9.5 nm rms, which is the
    quantisation of that map. Range 14.03 to 22.01 µm.

    Parameters
    ----------
    shape : `tuple` [`int`, `int`], optional
        Rows and columns wanted.
    sampling : `str`, optional
        ``"resample"`` spreads the whole sensor over ``shape``; ``"window"`` takes the pixels from ``corner`` on.
    corner : `tuple` [`int`, `int`], optional
        First row and column of the window on the full sensor.

    Returns
    -------
    thickness_um : `numpy.ndarray`, ``shape``
        Thickness [µm].

    Raises
    ------
    InputError
        The window reaches over the edge of the sensor, or the shape is not positive.
    """
    table = read_table("laboratory", "thickness_e2v_321.ecsv")
    count, degree = int(table.meta["coefficients_per_axis"]), int(table.meta["degree"])
    size_y, size_x = table.meta["sensor_shape"]
    coefficients = np.zeros((count, count))
    coefficients[table["iy"], table["ix"]] = table["coefficient"].quantity.to_value("um")
    rows = _positions("rows", shape[0], size_y, sampling, corner[0])
    columns = _positions("columns", shape[1], size_x, sampling, corner[1])
    basis_y = _clamped_basis(rows, size_y, count, degree)
    basis_x = _clamped_basis(columns, size_x, count, degree)
    return basis_y @ coefficients @ basis_x.T


def fit_to_sensor(
    thickness_um: NDArray[np.float64],
    shape: tuple[int, int],
    *,
    sampling: Sampling = "resample",
    corner: tuple[int, int] = (0, 0),
) -> NDArray[np.float64]:
    """Bring any map to the shape of a sensor.

    Parameters
    ----------
    thickness_um : `numpy.ndarray`, (rows, columns)
        Thickness [µm].
    shape : `tuple` [`int`, `int`]
        Rows and columns wanted.
    sampling, corner
        As for `e2v_321`. Resampling is bicubic, from pixel centres to pixel centres.

    Returns
    -------
    thickness_um : `numpy.ndarray`, ``shape``
        Thickness [µm].

    Raises
    ------
    InputError
        The map is not two-dimensional, or the window reaches over its edge.
    """
    thickness = np.asarray(thickness_um, dtype=float)
    if thickness.ndim != 2:
        raise InputError("thickness map dimensions", thickness.ndim, "2")
    rows = _positions("rows", shape[0], thickness.shape[0], sampling, corner[0])
    columns = _positions("columns", shape[1], thickness.shape[1], sampling, corner[1])
    if sampling == "window" or thickness.shape == tuple(shape):
        return thickness[np.ix_(rows.astype(int), columns.astype(int))]
    grid = np.meshgrid(rows, columns, indexing="ij")
    return map_coordinates(thickness, grid, order=3, mode="nearest")


def random_field(
    shape: tuple[int, int],
    rng: np.random.Generator,
    mean: float = 17.0,
    span: float = 6.0,
    scale: float | None = None,
) -> NDArray[np.float64]:
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

    thickness_um: NDArray[np.float64]  # [y, x]: thickness at the centres of the pixels
    # slope_y, slope_x [y, x]: how the thickness rises within a pixel [µm per px]
    slope_y: NDArray[np.float64]
    slope_x: NDArray[np.float64]

    @classmethod
    def of(cls, thickness_um: NDArray[np.float64]) -> PixelArea:
        """Slopes from the neighbours; where the map has a step or a summit, a pixel does not reach beyond it."""
        slopes = [_limited_slope(thickness_um, axis) for axis in (0, 1)]
        return cls(thickness_um, slopes[0], slopes[1])

    @property
    def range_um(self) -> tuple[float, float]:
        """Thinnest and thickest place within any pixel [µm]."""
        reach = 0.5 * (np.abs(self.slope_y) + np.abs(self.slope_x))
        return float((self.thickness_um - reach).min()), float((self.thickness_um + reach).max())

    def average(self, signal: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> NDArray[np.float64]:
        """Mean over each pixel of what depends on the thickness, by 3 × 3 nodes of Gauss and Legendre."""
        return np.asarray(sum(weight * signal(thickness) for thickness, weight in self._nodes()))

    def _nodes(self) -> Iterator[tuple[NDArray[np.float64], float]]:
        for up, weight_y in GAUSS_NODES:
            for along, weight_x in GAUSS_NODES:
                yield self.thickness_um + up * self.slope_y + along * self.slope_x, weight_y * weight_x


def _limited_slope(field: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
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


def _positions(what: str, wanted: int, available: int, sampling: Sampling, first: int) -> NDArray[np.float64]:
    """Pixel coordinates on the large map of the ``wanted`` pixels of the small one."""
    if wanted < 1:
        raise InputError(f"number of {what}", wanted, "1 or more")
    if sampling == "resample":
        return (np.arange(wanted) + 0.5) * available / wanted - 0.5
    if sampling != "window":
        raise InputError("sampling", sampling, "'resample' or 'window'")
    if first < 0 or first + wanted > available:
        raise InputError(f"window of {what}", (first, first + wanted), f"within 0 to {available}")
    return np.arange(first, first + wanted, dtype=float)


def _clamped_basis(position: NDArray[np.float64], size: int, count: int, degree: int) -> NDArray[np.float64]:
    inner = np.linspace(0.0, size - 1.0, count - degree + 1)
    knots = np.concatenate([[0.0] * degree, inner, [size - 1.0] * degree])
    # Resampled onto more pixels than the sensor has, the outermost centres lie up to half a pixel outside.
    inside = np.clip(position, 0.0, size - 1.0)
    return BSpline.design_matrix(inside, knots, degree).toarray()


def _stretch(field: NDArray[np.float64], mean: float, span: float) -> NDArray[np.float64]:
    """Map the range of ``field`` linearly onto ``mean ± span / 2``."""
    low, high = float(field.min()), float(field.max())
    if not high > low:
        return np.full(field.shape, mean)
    return mean + span * ((field - low) / (high - low) - 0.5)
