"""Response as a table over thickness, with a stated interpolation error, and whole frames made from it."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from ..array_types import Float32Array, FloatArray
from ..compiled import contiguous, kernel, run_shares
from ..errors import ConvergenceError, InputError, OutOfRangeError, named_units
from ..notebook import OneLine
from ..optics.illumination import Illumination
from ..optics.system import OpticalSystem

Sampler = Callable[[float, float, int], FloatArray]
"""``(start_um, step_um, count) -> response [W, count]`` on a uniform grid of thickness."""

DEFAULT_TOLERANCE = 1e-7
"""Interpolation error that is asked for by default: about the rounding of the float32 frames."""

MOST_POINTS = 4_000_000  # Points of one row; a table that wants more is refused
_LEAST_PIXELS = 20_000  # Pixels that are worth a thread
_REFINEMENTS = 6


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class ResponseTable(OneLine):
    """Response on a uniform grid of thickness, interpolated by a cubic spline.

    Attributes
    ----------
    start_um, step_um : `float`
        First thickness and spacing of the grid [µm].
    values : `numpy.ndarray`, shape ``(W, N)``
        Response of W exposures at N thicknesses.
    wavelength_nm : `numpy.ndarray`, shape ``(W,)``
        Nominal (or mean) wavelength of every exposure [nm].
    interpolation_error : `float`
        Largest absolute difference between the interpolated and the tabulated function.

    Raises
    ------
    InputError
        Fewer than four points, shapes that do not belong together, or a grid that is not increasing.
    """

    start_um: float
    step_um: float
    values: FloatArray
    wavelength_nm: FloatArray
    interpolation_error: float

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] < 4:
            raise InputError("shape of the table", self.values.shape, "(exposures, four or more thicknesses)")
        if self.wavelength_nm.shape != self.values.shape[:1]:
            raise InputError("wavelengths of the table", self.wavelength_nm.shape, f"{self.values.shape[:1]}")
        if not (math.isfinite(self.start_um) and 0.0 < self.step_um < math.inf):
            raise InputError("grid of the table [um]", (self.start_um, self.step_um), "finite, increasing")

    @property
    def stop_um(self) -> float:
        """Last thickness of the grid [µm]."""
        return self.start_um + self.step_um * (self.values.shape[1] - 1)

    @property
    def thickness_um(self) -> FloatArray:
        """Thicknesses of the grid [µm], shape ``(N,)``."""
        return np.asarray(self.start_um + self.step_um * np.arange(self.values.shape[1]), dtype=np.float64)

    @functools.cached_property
    def polynomials(self) -> FloatArray:
        """Coefficients ``(W, N-1, 4)`` of ``c0 + c1 t + c2 t² + c3 t³``, ``t`` from 0 to 1 in every cell."""
        spline = CubicSpline(np.arange(self.values.shape[1]), self.values, axis=1)
        return np.ascontiguousarray(np.moveaxis(spline.c[::-1], 0, -1).swapaxes(0, 1))

    @functools.cached_property
    def _packed(self) -> Float32Array:
        """Flat coefficients of every row, with one more cell for the last thickness itself."""
        end = np.zeros((len(self.values), 1, 4))
        end[:, 0, 0] = self.values[:, -1]
        cells = np.concatenate([self.polynomials, end], axis=1)
        return cells.astype(np.float32).reshape(len(self.values), -1)

    @named_units
    def lookup(self, thickness_um: ArrayLike) -> FloatArray:
        """Interpolated response.

        Parameters
        ----------
        thickness_um : array_like
            Thickness [µm], any shape; NaN gives NaN.

        Returns
        -------
        response : `numpy.ndarray`, float64, shape ``(W, *thickness.shape)``

        Raises
        ------
        OutOfRangeError
            A thickness outside the grid.
        """
        thickness = np.asarray(thickness_um, dtype=float)
        flat = np.ascontiguousarray(thickness).ravel()
        self._demand_inside(flat)
        out = self._interpolated(flat)
        return out.reshape(len(out), *thickness.shape)

    @named_units
    def frame(self, thickness_um: ArrayLike, row: int = 0, out: Float32Array | None = None) -> Float32Array:
        """Image of one exposure, in one pass over the thickness map with all processor cores.

        Parameters
        ----------
        thickness_um : array_like, shape ``(ny, nx)``
            Thickness [µm], float32 or float64; NaN gives NaN.
        row : `int`, optional
            Which exposure.
        out : `numpy.ndarray`, float32, optional
            Where to write; allocated if not given.

        Returns
        -------
        image : `numpy.ndarray`, float32, shape ``(ny, nx)``
            The same bits whatever the number of threads.

        Raises
        ------
        OutOfRangeError
            A thickness outside the grid, or a row that does not exist.
        InputError
            A map that is not two-dimensional, or ``out`` of another shape or type.
        """
        image = np.asarray(thickness_um)
        if image.dtype not in (np.float32, np.float64):
            image = image.astype(np.float64)
        if image.ndim != 2:
            raise InputError("shape of the thickness map", image.shape, "two axes (y, x)")
        if not 0 <= row < len(self.values):
            raise OutOfRangeError("row of the table", row, f"0 to {len(self.values) - 1}")
        if out is None:
            out = np.empty(image.shape, dtype=np.float32)
        elif out.shape != image.shape or out.dtype != np.float32:
            raise InputError("output image", (out.shape, str(out.dtype)), f"{image.shape}, float32")
        # One type of array each, so that the loop is compiled once.
        packed, image = contiguous(self._packed[row]), contiguous(image)
        filled = out if out.flags.c_contiguous else np.empty(image.shape, dtype=np.float32)
        outside = np.zeros(len(image), dtype=np.bool_)

        def work(first: int, last: int) -> None:
            _frame_kernel(packed, self.start_um, 1.0 / self.step_um, image, first, last, filled, outside)

        run_shares(work, len(image), _LEAST_PIXELS // max(image.shape[1], 1))
        if filled is not out:
            out[:] = filled
        if np.any(outside):
            self._demand_inside(np.asarray(image[int(np.argmax(outside))], dtype=float))
        return out

    def _interpolated(self, thickness: FloatArray) -> FloatArray:
        out = np.empty((len(self.values), thickness.size))
        polynomials = contiguous(self.polynomials)
        thickness = contiguous(thickness)

        def work(first: int, last: int) -> None:
            _lookup_kernel(polynomials, self.start_um, 1.0 / self.step_um, thickness, first, last, out)

        run_shares(work, thickness.size, _LEAST_PIXELS)
        return out

    def _demand_inside(self, thickness: FloatArray) -> None:
        # Written so that NaN passes. The margin is the rounding of (d - start) / step.
        margin = 1e-9 * self.step_um
        wrong = (thickness < self.start_um - margin) | (thickness > self.stop_um + margin)
        if np.any(wrong):
            allowed = f"{self.start_um:.6g} to {self.stop_um:.6g} (range of the table)"
            raise OutOfRangeError("thickness [um]", float(thickness[wrong][0]), allowed)


@named_units
def response_table(
    system: OpticalSystem,
    illumination: Illumination,
    thickness_range_um: tuple[float, float],
    *,
    wavelength_nm: ArrayLike | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
) -> ResponseTable:
    """Tabulate the response of an optical system.

    Parameters
    ----------
    system : `OpticalSystem`
        The sensor.
    illumination : `Illumination`
        The light of W exposures.
    thickness_range_um : `tuple` [`float`, `float`]
        Thicknesses that the table must cover [µm].
    wavelength_nm : array_like, shape ``(W,)``, optional
        Nominal wavelengths [nm], as labels; the mean wavelength if not given.
    tolerance : `float`, optional
        Largest interpolation error; bounded from the closed form, not only sampled.

    Returns
    -------
    table : `ResponseTable`

    Raises
    ------
    OutOfRangeError
        A negative, empty or infinite range.
    ConvergenceError
        The tolerance cannot be reached.
    """
    low, high = _checked_range(thickness_range_um)
    if wavelength_nm is None:
        wavelength = illumination.mean_wavelength_nm
    else:
        wavelength = np.atleast_1d(np.asarray(wavelength_nm, dtype=float))
    reduced = system.reduce(illumination)
    weight = illumination.weight
    return tabulate(
        functools.partial(reduced.averaged_on_grid, weight),
        (low, high),
        wavelength,
        fourth_derivative=float(reduced.derivative_bound(weight, 4, low).max()),
        tolerance=tolerance,
    )


@named_units
def tabulate(
    sample: Sampler,
    thickness_range_um: tuple[float, float],
    wavelength_nm: ArrayLike,
    *,
    fourth_derivative: float | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
) -> ResponseTable:
    """Tabulate any response that can be sampled on a uniform grid.

    Parameters
    ----------
    sample : callable
        ``(start_um, step_um, count) -> response [W, count]``.
    thickness_range_um : `tuple` [`float`, `float`]
        Thicknesses to cover [µm].
    wavelength_nm : array_like, shape ``(W,)``
        Labels of the exposures [nm].
    fourth_derivative : `float`, optional
        Upper bound of the fourth derivative with respect to thickness [1/µm⁴]. Without one it is taken from
        differences of the samples, and the stated error is an estimate.
    tolerance : `float`, optional
        Largest interpolation error.

    Notes
    -----
    In every cell the error vanishes at both ends, is measured at 1/3 and 2/3 (``e``), and its fourth derivative is
    that of the function, so that it cannot exceed ``9/8 max|e| + h⁴ max|f''''| / 1944``.
    """
    low, high = _checked_range(thickness_range_um)
    wavelength = np.atleast_1d(np.asarray(wavelength_nm, dtype=float))
    if fourth_derivative is None:
        fourth_derivative = _estimated_fourth_derivative(sample, low, high)
    # A spline far from its ends errs by h⁴ f''''/384.
    step = (384.0 * 0.5 * tolerance / max(fourth_derivative, 1e-300)) ** 0.25
    error = math.inf
    for _ in range(_REFINEMENTS):
        cells = max(8, math.ceil((high - low) / step))
        if cells > MOST_POINTS:
            break
        step = (high - low) / cells
        fine = sample(low, step / 3.0, 3 * cells + 1)
        table = ResponseTable(low, step, np.ascontiguousarray(fine[:, ::3]), wavelength, math.inf)
        measured = _third_point_error(table.polynomials, fine)
        error = 1.125 * measured + step**4 * fourth_derivative / 1944.0
        # Near 1e-14 only rounding is left, and a finer grid does not reduce it.
        if error <= max(tolerance, 1e-14):
            return ResponseTable(low, step, table.values, wavelength, error)
        step *= max(0.3, min(0.8, 0.9 * (tolerance / error) ** 0.25))
    raise ConvergenceError(
        f"response table over {low:g} to {high:g} um: interpolation error {error:.2g} at a step of "
        f"{step:.2g} um; asked for {tolerance:.2g}"
    )


def _checked_range(thickness_range_um: tuple[float, float]) -> tuple[float, float]:
    low, high = (float(value) for value in thickness_range_um)
    if not 0.0 <= low < high < math.inf:
        raise OutOfRangeError("thickness range [um]", (low, high), "two increasing, not negative numbers")
    return low, high


def _third_point_error(polynomials: FloatArray, fine: FloatArray) -> float:
    worst = 0.0
    for part in (1, 2):
        t = part / 3.0
        value = polynomials @ np.array([1.0, t, t**2, t**3])
        worst = max(worst, float(np.abs(value - fine[:, part::3]).max()))
    return worst


def _estimated_fourth_derivative(sample: Sampler, low: float, high: float) -> float:
    """Largest fourth difference over the fourth power of the step, at a step that resolves it."""
    count = 1024
    estimate = 0.0
    for _ in range(8):
        step = (high - low) / count
        previous, estimate = estimate, float(np.abs(np.diff(sample(low, step, count + 1), 4)).max()) / step**4
        if abs(estimate - previous) < 0.1 * estimate:
            break
        count *= 2
    return 1.2 * estimate


@kernel
def _lookup_kernel(
    polynomials: NDArray,
    start: float,
    per_step: float,
    thickness: NDArray,
    first: int,
    last: int,
    out: NDArray,
) -> None:  # pragma: no cover - compiled
    rows, cells, _ = polynomials.shape
    for i in range(first, last):
        position = (thickness[i] - start) * per_step
        if position != position:  # NaN
            for row in range(rows):
                out[row, i] = np.nan
            continue
        cell = min(max(int(position), 0), cells - 1)
        t = position - cell
        for row in range(rows):
            c = polynomials[row, cell]
            out[row, i] = c[0] + t * (c[1] + t * (c[2] + t * c[3]))


@kernel(relaxed=True)
def _frame_kernel(
    polynomials: NDArray,
    start: float,
    per_step: float,
    thickness: NDArray,
    first: int,
    last: int,
    out: NDArray,
    outside: NDArray,
) -> None:  # pragma: no cover - compiled
    """Fill rows of ``out`` from flat coefficients, four per cell; marks those in which a thickness lies outside."""
    width = thickness.shape[1]
    # The last cell only serves its left end.
    end = polynomials.size // 4 - 1 + 1e-9
    # Unsigned indices spare the test for negative ones.
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    for y in range(first, last):
        wrong = False
        for x in range(width):
            position = (float(thickness[y, x]) - start) * per_step
            if position >= -1e-9 and position <= end:
                cell = np.int32(position)
                t = np.float32(position - cell)
                k = np.uint64(np.uint32(4 * cell))
                c0, c1 = polynomials[k], polynomials[k + one]
                c2, c3 = polynomials[k + two], polynomials[k + three]
                out[y, x] = c0 + t * (c1 + t * (c2 + t * c3))
            else:
                out[y, x] = np.nan
                wrong |= position == position  # NaN is not "outside"
        outside[y] = wrong
