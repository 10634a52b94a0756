"""A smooth surface through most of a field."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.ndimage import median_filter

from ...array_types import BoolArray, FloatArray
from .continuation import differences, factorised

ROUNDS = 8
MEDIAN_SIDE = 15
"""Rounds in which the surface forgets what lies far from it, and the side of the area in which it begins with the
median [cells]."""

STIFFNESS, RIDGE = 1e-6, 1e-8
"""Weight of differences of neighbouring coefficients, which continue the surface evenly where it is not seen, and of
the coefficients themselves, over the largest of the data."""


def robust_surface(field: FloatArray, seen: BoolArray, spacing: float, order: float) -> FloatArray:
    """Spline through most cells of a field ``(ny, nx)``; those that lie orders away do not count.

    ``spacing``: distance of its knots [cells]. ``order``: fringe order in the unit of the field.
    """
    along = [_uniform_splines(size, spacing) for size in field.shape]
    basis = sparse.kron(*along, format="csr")
    counts = [part.shape[1] for part in along]
    even = sum(
        bend.T @ bend
        for bend in (
            sparse.kron(differences(counts[0], 1), sparse.identity(counts[1])),
            sparse.kron(sparse.identity(counts[0]), differences(counts[1], 1)),
        )
    )
    surface = median_filter(field, MEDIAN_SIDE).ravel()
    for _ in range(ROUNDS):
        departure = (field.ravel() - surface) / (0.3 * order)
        weight = seen.ravel() / (1.0 + departure**2) ** 2
        normal = basis.T @ sparse.diags(weight) @ basis
        largest = max(float(normal.diagonal().max()), 1e-300)
        normal = normal + largest * (STIFFNESS * even + RIDGE * sparse.identity(normal.shape[0]))
        middle = float(np.average(field.ravel(), weights=weight)) if weight.any() else float(field.mean())
        surface = middle + basis @ factorised(normal).solve(basis.T @ (weight * (field.ravel() - middle)))
    return np.asarray(surface.reshape(field.shape))


def _uniform_splines(size: int, spacing: float) -> sparse.csr_array:
    """Cubic splines at so many cells, ``(size, their number)``."""
    if size == 1:
        return sparse.csr_array(np.ones((1, 1)))
    intervals, degree = max(1, round((size - 1) / spacing)), min(3, size - 1)
    step = (size - 1.0) / intervals
    knots = step * np.arange(-degree, intervals + degree + 1)
    # Rounding may leave the last knot of the interior a little before the last cell.
    at = np.clip(np.arange(size, dtype=float), knots[degree], knots[-degree - 1])
    return BSpline.design_matrix(at, knots, degree)
