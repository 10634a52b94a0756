"""Response as a table over the thickness of two layers, and whole frames made from it."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import spline_filter1d

from ..compiled import kernel
from ..errors import ConvergenceError, InputError, OutOfRangeError, named_units
from ..optics.illumination import Illumination
from ..optics.system import OpticalSystem
from ..optics.two_phase_response import ThicknessGrid, TwoPhaseResponse
from .response_table import FloatArray

__all__ = ["TwoLayerTable", "two_layer_table"]

_MARGIN = 14
"""Grid points beyond each end: what the spline does there has decayed by 0.268^14 = 1e-8 inside the range."""

_SAFETY = 1.3
"""The error in the middle of the cells, where it peaks, is multiplied by this."""


@named_units
@dataclass(frozen=True, eq=False)
class TwoLayerTable:
    """Response on a grid of two thicknesses, interpolated by a bicubic spline.

    Attributes
    ----------
    start_um, step_um : `numpy.ndarray`, shape ``(2,)``
        First grid point and spacing of the lower and the upper layer [µm], the margin included.
    values : `numpy.ndarray`, shape ``(W, N, M)``
        Response of W exposures at N thicknesses of the lower and M of the upper layer.
    wavelength_nm : `numpy.ndarray`, shape ``(W,)``
        Mean wavelength of every exposure [nm].
    interpolation_error : `float`
        Largest absolute error, measured in the middle of every cell, times 1.3.
    """

    start_um: FloatArray
    step_um: FloatArray
    values: FloatArray
    wavelength_nm: FloatArray
    interpolation_error: float

    def __post_init__(self) -> None:
        if self.values.ndim != 3 or min(self.values.shape[1:]) < 2 * _MARGIN + 2:
            raise InputError(
                "shape of the table", self.values.shape, "(exposures, lower, upper) with margins"
            )
        if self.wavelength_nm.shape != self.values.shape[:1]:
            raise InputError("wavelengths of the table", self.wavelength_nm.shape, f"{self.values.shape[:1]}")

    @property
    def range_um(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Thicknesses of the lower and of the upper layer that may be looked up [µm]."""
        low = self.start_um + _MARGIN * self.step_um
        high = self.start_um + self.step_um * (np.array(self.values.shape[1:]) - 1 - _MARGIN)
        return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))

    @functools.cached_property
    def _coefficients(self) -> NDArray[np.float32]:
        filtered = spline_filter1d(self.values, 3, axis=1, mode="mirror")
        return spline_filter1d(filtered, 3, axis=2, mode="mirror").astype(np.float32)

    @named_units
    def frame(
        self,
        lower_um: ArrayLike,
        upper_um: ArrayLike,
        row: int = 0,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Image of one exposure, in one pass over both thickness maps with all processor cores.

        Parameters
        ----------
        lower_um, upper_um : array_like, shape ``(ny, nx)``
            Thickness maps [µm]; NaN in either gives NaN.
        row : `int`, optional
            Which exposure.
        out : `numpy.ndarray`, float32, optional
            Where to write.

        Returns
        -------
        image : `numpy.ndarray`, float32, shape ``(ny, nx)``
            The same bits whatever the number of threads.

        Raises
        ------
        OutOfRangeError
            A thickness outside the table, or a row that does not exist.
        InputError
            Maps of different shapes, or ``out`` of another shape or type.
        """
        lower, upper = np.asarray(lower_um), np.asarray(upper_um)
        if lower.ndim != 2 or lower.shape != upper.shape:
            raise InputError("thickness maps", (lower.shape, upper.shape), "two maps of one shape (y, x)")
        if not 0 <= row < len(self.values):
            raise OutOfRangeError("row of the table", row, f"0 to {len(self.values) - 1}")
        if out is None:
            out = np.empty(lower.shape, dtype=np.float32)
        elif out.shape != lower.shape or out.dtype != np.float32:
            raise InputError("output image", (out.shape, str(out.dtype)), f"{lower.shape}, float32")
        kind = np.result_type(lower, upper, np.float32)
        lower, upper = lower.astype(kind, copy=False), upper.astype(kind, copy=False)
        limits = np.array(self.range_um) + 1e-9 * np.outer(self.step_um, [-1.0, 1.0])
        outside = _frame_kernel(
            self._coefficients[row].ravel(),
            self.values.shape[2],
            self.start_um,
            1.0 / self.step_um,
            limits,
            lower,
            upper,
            out,
        )
        if np.any(outside):
            self._complain(lower[int(np.argmax(outside))], upper[int(np.argmax(outside))])
        return out

    def _complain(self, lower: FloatArray, upper: FloatArray) -> None:
        for name, values, (low, high) in zip(("lower", "upper"), (lower, upper), self.range_um, strict=True):
            wrong = (values < low) | (values > high)
            if np.any(wrong):
                raise OutOfRangeError(
                    f"thickness of the {name} layer [um]", float(values[wrong][0]), f"{low:.6g} to {high:.6g}"
                )


@named_units
def two_layer_table(
    system: OpticalSystem,
    illumination: Illumination,
    lower_range_um: tuple[float, float],
    upper_range_um: tuple[float, float],
    *,
    tolerance: float = 1e-6,
) -> TwoLayerTable:
    """Tabulate the response over the thickness of the varying layer and of the detection layer above it.

    Parameters
    ----------
    system : `OpticalSystem`
        The sensor.
    illumination : `Illumination`
        The light of W exposures.
    lower_range_um, upper_range_um : `tuple` [`float`, `float`]
        Thicknesses of the varying and of the detection layer to cover [µm].
    tolerance : `float`, optional
        Largest interpolation error.

    Raises
    ------
    OutOfRangeError
        An empty range, or one so near zero that no margin is left.
    ConvergenceError
        The tolerance cannot be reached.
    """
    ranges = np.array([lower_range_um, upper_range_um], dtype=float)
    if not (np.all(np.isfinite(ranges)) and np.all(ranges[:, 0] < ranges[:, 1]) and np.all(ranges >= 0.0)):
        raise OutOfRangeError("thickness ranges [um]", ranges.tolist(), "two increasing pairs, not negative")
    return _build(system.reduce_two_layers(illumination), illumination, ranges, tolerance)


def _build(
    reduced: TwoPhaseResponse,
    illumination: Illumination,
    ranges: FloatArray,
    tolerance: float,
) -> TwoLayerTable:
    phase = np.array([np.abs(reduced.kappa_lower.real).max(), np.abs(reduced.kappa_upper.real).max()])
    # A wave of 0.1 and its overtones, spline error (kappa h)^4 / 384 each, one half of it per axis.
    step = (384.0 * 0.5 * tolerance / 0.2) ** 0.25 / phase
    error = math.inf
    for _ in range(4):
        cells = np.maximum(2 * _MARGIN, np.ceil((ranges[:, 1] - ranges[:, 0]) / step)).astype(int)
        step = (ranges[:, 1] - ranges[:, 0]) / cells
        start = ranges[:, 0] - _MARGIN * step
        if np.any(start < 0.0):
            raise OutOfRangeError(
                "start of a thickness range [um]", ranges[:, 0].tolist(), f"at least {_MARGIN * step}"
            )
        nodes = [ThicknessGrid(start[i], step[i], int(cells[i]) + 2 * _MARGIN + 1) for i in range(2)]
        middles = [ThicknessGrid(ranges[i, 0] + 0.5 * step[i], step[i], int(cells[i])) for i in range(2)]
        values = reduced.averaged_on_grid(illumination.weight, *nodes)
        table = TwoLayerTable(start, step, values, illumination.mean_wavelength_nm, math.nan)
        exact = reduced.averaged_on_grid(illumination.weight, *middles)
        error = _SAFETY * _middle_error(table, exact)
        if error <= tolerance:
            return TwoLayerTable(start, step, values, table.wavelength_nm, error)
        step = step * max(0.3, min(0.8, 0.9 * (tolerance / error) ** 0.25))
    raise ConvergenceError(f"table of two layers: interpolation error {error:.2g}; asked for {tolerance:.2g}")


def _middle_error(table: TwoLayerTable, exact: FloatArray) -> float:
    weight = np.array([1.0, 23.0, 23.0, 1.0]) / 48.0
    filtered = spline_filter1d(table.values, 3, axis=1, mode="mirror")
    filtered = spline_filter1d(filtered, 3, axis=2, mode="mirror")
    first = _MARGIN - 1
    _, rows, columns = exact.shape
    along = sum(weight[k] * filtered[:, first + k : first + k + rows] for k in range(4))
    middle = sum(weight[k] * along[:, :, first + k : first + k + columns] for k in range(4))
    return float(np.abs(middle - exact).max())


@numba.njit(error_model="numpy", inline="always")
def _weights(t: np.float32) -> tuple[Any, Any, Any, Any]:  # pragma: no cover - compiled
    """Cubic B-spline at distances 1 + t, t, 1 - t, 2 - t, in single precision."""
    sixth, half, two_thirds = np.float32(1.0 / 6.0), np.float32(0.5), np.float32(2.0 / 3.0)
    one = np.float32(1.0)
    s = one - t
    ss, tt = s * s, t * t
    return (
        sixth * ss * s,
        two_thirds - half * tt * (one + s),
        two_thirds - half * ss * (one + t),
        sixth * tt * t,
    )


@kernel(relaxed={"contract", "reassoc"}, parallel=True)
def _frame_kernel(
    coefficients: NDArray,
    columns: int,
    start: NDArray,
    per_step: NDArray,
    limits: NDArray,
    lower: NDArray,
    upper: NDArray,
    out: NDArray,
) -> NDArray:  # pragma: no cover - compiled
    """Fill ``out`` from flat coefficients; returns the rows in which a thickness lies outside."""
    height, width = lower.shape
    outside = np.zeros(height, dtype=np.bool_)
    s0, s1, f0, f1 = start[0], start[1], per_step[0], per_step[1]
    a0, a1, b0, b1 = limits[0, 0], limits[0, 1], limits[1, 0], limits[1, 1]
    one, two, three, line = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(columns)
    for y in numba.prange(height):
        wrong = False
        for x in range(width):
            a, b = float(lower[y, x]), float(upper[y, x])
            if a >= a0 and a <= a1 and b >= b0 and b <= b1:
                u, v = (a - s0) * f0, (b - s1) * f1
                i, j = np.int32(u), np.int32(v)
                w0, w1, w2, w3 = _weights(np.float32(u - i))
                h0, h1, h2, h3 = _weights(np.float32(v - j))
                # The margins keep every neighbour inside.
                k = np.uint64(np.uint32(i - 1)) * line + np.uint64(np.uint32(j - 1))
                m, n, o = k + line, k + two * line, k + three * line
                c = coefficients
                out[y, x] = (
                    w0 * (h0 * c[k] + h1 * c[k + one] + h2 * c[k + two] + h3 * c[k + three])
                    + w1 * (h0 * c[m] + h1 * c[m + one] + h2 * c[m + two] + h3 * c[m + three])
                    + w2 * (h0 * c[n] + h1 * c[n + one] + h2 * c[n + two] + h3 * c[n + three])
                    + w3 * (h0 * c[o] + h1 * c[o + one] + h2 * c[o + two] + h3 * c[o + three])
                )
            else:
                out[y, x] = np.nan
                wrong |= (a < a0) | (a > a1) | (b < b0) | (b > b1)  # NaN is no complaint
        outside[y] = wrong
    return outside
