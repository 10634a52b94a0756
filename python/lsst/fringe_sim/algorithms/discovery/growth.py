"""Thickness that grows from where a whole model fits, blur included, into where it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, label, uniform_filter

from .basis import SplineBasis
from .continuation import continued
from .fit import Fit, Problem, fit_model

__all__ = ["grown_fit"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

KNOTS, SIDE = 6.0, 3
"""Spacing of the spline that is fitted [cells], and side of the area in which the misfit is averaged [cells]."""

STEP, STEPS_ACROSS = 3, 32
"""Cells that a round goes further, and rounds that cross a large sensor at least."""

GOOD, BAD, FEW_BAD = 1.7, 5.0, 0.005
"""Misfit over that of the better cells, up to which the model fits and from which it does not; the part of the cells
that may be so."""

BETTER_PART = 0.3
"""Quantile of the misfit that stands for cells where the model fits."""

CONTINUED_SIGMA_UM = 0.03
"""How far the thickness may move from a continuation with the least curvature, where that is new [µm]."""

ROUNDS, IDLE_ROUNDS, ROUND_GAIN = 60, 2, 1.003
PASSES, PASS_GAIN = 4, 0.98
"""Rounds of growth, how many of them may add nearly nothing; passes, and the part of χ² that one must save."""


def grown_fit(problem: Problem, fit: Fit, thickness_um: FloatArray) -> Fit | None:
    """Fit whose thickness does not lose a fringe order where a blur takes the fringes away.

    There single cells do not tell their thickness, and what lies beyond may be off by whole orders. The largest area
    in which the model with its effects fits is taken for right; it grows into its surroundings, which continue it
    with little curvature and are fitted together with it, effects included, as far as the model then fits there.

    Parameters
    ----------
    problem : `Problem`
        All data, without a map.
    fit : `Fit`
        Fit with the effects.
    thickness_um : `numpy.ndarray`, shape ``(ny, nx)``
        Thickness from which to begin.

    Returns
    -------
    fit : `Fit` or `None`
        Coefficients are those of `grown_basis`; `None` if nothing else fits better, or the model fits everywhere.
    """
    basis = grown_basis(problem)
    stiff = replace(problem, basis=basis)
    first = fit_model(
        stiff, fit.coordinates, fit.position, basis.fit(thickness_um, problem.cells.seen.astype(float))
    )
    best = first
    for _ in range(PASSES):
        misfit = _misfit(stiff, best)
        if np.mean(misfit > BAD * np.quantile(misfit, BETTER_PART)) < FEW_BAD:
            break
        grown = _grown(stiff, best, misfit)
        if grown is None or grown.chi2 > PASS_GAIN * best.chi2:
            break
        best = grown
    return None if best is first else best


def grown_basis(problem: Problem) -> SplineBasis:
    """Spline of a thickness that grows."""
    rows, columns = problem.cells.shape[1:]
    return SplineBasis.of_grid((rows, columns), KNOTS)


def _grown(problem: Problem, fit: Fit, misfit: FloatArray) -> Fit | None:
    """One pass: fit of all cells after growth from the largest area that the model fits."""
    unit = np.quantile(misfit, BETTER_PART)
    known = _largest(binary_erosion(misfit < GOOD * unit))
    if not known.any():
        return None
    step = max(STEP, max(known.shape) // STEPS_ACROSS)
    idle = 0
    for _ in range(ROUNDS):
        centre = problem.basis.fit(continued(problem.basis.expand(fit.field), known), np.ones(known.shape))
        reached = binary_dilation(known, iterations=step)
        part = replace(
            problem.with_cells(problem.cells.restricted(reached)),
            field_prior=CONTINUED_SIGMA_UM**-2,
            field_centre=centre,
        )
        fit = fit_model(part, fit.coordinates, fit.position, centre, fit.levels)
        larger = _largest(reached & (_misfit(problem, fit) < GOOD * unit))
        idle = idle + 1 if larger.sum() <= ROUND_GAIN * known.sum() else 0
        if idle == IDLE_ROUNDS or not larger.any():
            break
        known = larger
    centre = problem.basis.fit(continued(problem.basis.expand(fit.field), known), np.ones(known.shape))
    return fit_model(problem, fit.coordinates, fit.position, centre, fit.levels)


def _misfit(problem: Problem, fit: Fit) -> FloatArray:
    """Sum of squares of the whitened residuals of each cell and its neighbours."""
    expected = problem.expected_of(fit)
    residual = problem.whitener(expected)(problem.cells.value - expected)
    return np.asarray(uniform_filter((residual**2).sum(axis=0), SIDE))


def _largest(area: BoolArray) -> BoolArray:
    """The largest part that hangs together."""
    parts, number = label(area)
    if number == 0:
        return area
    size = np.bincount(parts.ravel())
    size[0] = 0
    return np.asarray(parts == size.argmax())
