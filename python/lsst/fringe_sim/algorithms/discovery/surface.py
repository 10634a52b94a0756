"""A smooth surface through most of a field."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.ndimage import median_filter

from ...array_types import BoolArray, FloatArray
from ...compiled import kernel

ROUNDS = 8
MEDIAN_SIDE = 15
"""Rounds in which the surface forgets what lies far from it, and the side of the area in which it begins with the
median [cells]."""

STIFFNESS, RIDGE = 1e-6, 1e-8
"""Curvature along differences of neighbouring coefficients, which continue the surface evenly where it is not seen,
and of the coefficients themselves, over the largest of the data."""


def robust_surface(field: FloatArray, seen: BoolArray, spacing: float, order: float) -> FloatArray:
    """Spline through most cells of a field ``(ny, nx)``; those that lie orders away do not count.

    ``spacing``: distance of its knots [cells]. ``order``: fringe order in the unit of the field.
    """
    along_y, along_x = (_uniform_splines(size, spacing) for size in field.shape)
    surface = median_filter(field, MEDIAN_SIDE)
    for _ in range(ROUNDS):
        departure = (field - surface) / (0.3 * order)
        weight = seen.astype(float) / (1.0 + departure**2) ** 2
        middle = float(np.average(field, weights=weight)) if weight.any() else float(field.mean())
        right = along_y.T @ (weight * (field - middle)) @ along_x
        solved = cho_solve_banded((_factor(along_y, along_x, weight), True), right.ravel())
        surface = middle + along_y @ solved.reshape(right.shape) @ along_x.T
    return surface


def _factor(along_y: FloatArray, along_x: FloatArray, weight: FloatArray) -> FloatArray:
    """Factor of the banded normal matrix of the coefficients."""
    first_y, first_x = (np.argmax(basis != 0.0, axis=1) for basis in (along_y, along_x))
    band = _assemble(along_y, along_x, first_y, first_x, np.ascontiguousarray(weight))
    largest = max(float(band[0].max()), 1e-300)
    band[0] += RIDGE * largest
    rows, columns = along_y.shape[1], along_x.shape[1]
    number = np.arange(rows * columns).reshape(rows, columns)
    for first, distance in ((number[:, :-1].ravel(), 1), (number[:-1].ravel(), columns)):
        band[0, first] += STIFFNESS * largest
        band[0, first + distance] += STIFFNESS * largest
        band[distance, first] -= STIFFNESS * largest
    return np.asarray(cholesky_banded(band, lower=True, overwrite_ab=True))


def _uniform_splines(size: int, spacing: float) -> FloatArray:
    """Cubic splines at so many cells, ``(size, their number)``."""
    if size == 1:
        return np.ones((1, 1))
    intervals, degree = max(1, round((size - 1) / spacing)), min(3, size - 1)
    inner = np.linspace(0.0, size - 1.0, intervals + 1)
    step = inner[1] - inner[0]
    knots = inner[0] + step * np.arange(-degree, intervals + degree + 1)
    # Rounding may leave the last knot of the interior a little before the last cell.
    at = np.clip(np.arange(size, dtype=float), knots[degree], knots[-degree - 1])
    return np.asarray(BSpline.design_matrix(at, knots, degree).toarray())


@kernel
def _assemble(
    along_y: FloatArray,
    along_x: FloatArray,
    first_y: NDArray[np.int64],
    first_x: NDArray[np.int64],
    curvature: FloatArray,
) -> FloatArray:  # pragma: no cover - compiled
    """Lower band of the normal matrix; coefficients are numbered row by row."""
    ny, my = along_y.shape
    nx, mx = along_x.shape
    reach_y, reach_x = min(4, my), min(4, mx)
    bandwidth = (reach_y - 1) * mx + reach_x - 1
    band = np.zeros((bandwidth + 1, my * mx))
    row = np.zeros((mx, reach_x))
    for iy in range(ny):
        # Sum over the columns of one row of cells first: the y factors are common to it.
        row[:] = 0.0
        for ix in range(nx):
            h = curvature[iy, ix]
            if h == 0.0:
                continue
            fx = min(first_x[ix], mx - reach_x)
            for a in range(reach_x):
                wa = h * along_x[ix, fx + a]
                for b in range(a + 1):
                    row[fx + b, a - b] += wa * along_x[ix, fx + b]
        fy = min(first_y[iy], my - reach_y)
        for p in range(reach_y):
            for q in range(reach_y):
                wy = along_y[iy, fy + p] * along_y[iy, fy + q]
                if wy == 0.0:
                    continue
                for jx in range(mx):
                    for shift in range(min(reach_x, mx - jx)):
                        value = wy * row[jx, shift]
                        # element ((fy+p, jx+shift), (fy+q, jx)), kept once in the lower triangle
                        i = (fy + p) * mx + jx + shift
                        j = (fy + q) * mx + jx
                        if i >= j:
                            band[i - j, j] += value
                        if shift > 0:
                            i2 = (fy + p) * mx + jx
                            j2 = (fy + q) * mx + jx + shift
                            if i2 >= j2:
                                band[i2 - j2, j2] += value
    return band
