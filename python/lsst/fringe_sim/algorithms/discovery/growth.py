"""Thickness that grows from where a whole model fits, blur included, into where it does not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, label, uniform_filter

from ...array_types import BoolArray, FloatArray
from .basis import SplineBasis
from .continuation import continued
from .fit import Fit, Problem, fit_model

KNOTS, TURNS = (8.0, 6.0), 3
"""Spacings of the spline that is fitted [cells], and how often each is tried: one may succeed where another fails."""

GAIN = 0.995  # Part of χ² to which a growth must lower it
SIDE = 3  # Side of the area in which the misfit is averaged [cells]
STEP, STEPS_ACROSS = 3, 32  # Cells that a round goes further, and rounds that cross a large sensor at least

GOOD, BAD, FEW_BAD = 1.7, 3.0, 0.001
"""Misfit over that of the better cells, up to which the model fits and from which it does not; the part of the cells
that may be so."""

BETTER_PART = 0.3  # Quantile of the misfit that stands for cells where the model fits
NO_DATA = 1e-9  # Part of the data of a cell and its neighbours that is nothing but rounding

CONTINUED_SIGMA_UM = 0.03
"""How far the thickness may move from a continuation with the least curvature, where that is new [µm]."""

ROUNDS, IDLE_ROUNDS, ROUND_GAIN = 60, 2, 1.003
"""Rounds of one growth, how many of them may add nearly nothing, and the growth that is more than that."""

CLIFF, FEWEST_CELLS = 0.4, 12
"""Step from one cell to the next that is none of the thickness [fringe orders], and the cells without one that are
believed together."""

VISIBLE, WIDE_SIDE = 2.0, 5
"""Power over that of noise from which on fringes are seen, and the side of the area of its mean [cells]."""


@dataclass(frozen=True, eq=False)
class Grown:
    """What has grown."""

    thickness_um: FloatArray  # (ny, nx): thickness of all cells
    settings: dict[str, float]  # effects that were fitted with it


def grown_thickness(problem: Problem, fit: Fit, thickness_um: FloatArray) -> Grown | None:
    """Thickness that does not lose a fringe order where a blur takes the fringes away.

    There single cells do not tell their thickness, and what lies beyond may be off by whole orders. The largest area
    in which the model with its effects fits is taken for right; it grows into its surroundings, which continue it
    with little curvature and are fitted together with it, effects included, as far as the model then fits there.

    ``thickness_um`` (ny, nx). Returns `None` if nothing fits better, or the model fits everywhere.
    """
    first = best = fitted_smooth(problem, fit, thickness_um, KNOTS[-1])
    bridged = _bridged(first, thickness_um)
    if bridged is not None and bridged.fit.chi2 < GAIN * first.fit.chi2:
        best, thickness_um = bridged, bridged.problem.basis.expand(bridged.fit.field)
    failed = 0
    for knots in KNOTS * TURNS:
        begin = fitted_smooth(problem, best.fit, thickness_um, knots)
        misfit = _misfit(begin.problem, begin.fit)
        if np.mean(misfit[~np.isnan(misfit)] > BAD * _unit(misfit)) < FEW_BAD:
            best = min(best, begin, key=lambda item: item.fit.chi2)
            break
        grown = _grown(begin.problem, begin.fit, misfit)
        if grown is not None and grown.chi2 < GAIN * best.fit.chi2:
            best, failed = SmoothFit(begin.problem, grown), 0
            thickness_um = best.problem.basis.expand(grown.field)
        else:
            failed += 1
        if failed == len(KNOTS):
            break
    if best.fit.chi2 > GAIN * first.fit.chi2:
        return None
    return Grown(best.problem.basis.expand(best.fit.field), dict(best.fit.settings))


@dataclass(frozen=True, eq=False)
class SmoothFit:
    """A fit with a smooth field, and the data and model that it was made to."""

    problem: Problem
    fit: Fit


def fitted_smooth(problem: Problem, fit: Fit, thickness_um: FloatArray, knots: float) -> SmoothFit:
    """Fit with a spline of so many cells from knot to knot."""
    rows, columns = problem.cells.shape[1:]
    basis = SplineBasis.of_grid((rows, columns), knots)
    stiff = replace(problem, basis=basis)
    start = basis.fit(thickness_um, problem.cells.seen.astype(float))
    return SmoothFit(stiff, fit_model(stiff, fit.coordinates, fit.position, start))


def _bridged(first: SmoothFit, thickness_um: FloatArray) -> SmoothFit | None:
    """Fit from a thickness that is continued with little curvature across where no fringes are seen.

    What is beyond may be in the right order all the same: every cell knows it where its fringes are clear.
    """
    problem = first.problem
    cells = _with_fringes(problem, _unit(_misfit(problem, first.fit)))
    for axis in (0, 1):
        cliff = np.abs(np.diff(thickness_um, axis=axis)) > CLIFF * problem.order_um
        for end in (0, thickness_um.shape[axis] - 1):  # the cells on both sides
            cells &= ~np.insert(cliff, end, False, axis=axis)
    parts, _ = label(cells)
    cells &= np.bincount(parts.ravel())[parts] >= FEWEST_CELLS
    if not cells.any() or cells.all():
        return None
    return fitted_smooth(problem, first.fit, continued(thickness_um, cells), KNOTS[-1])


def _grown(problem: Problem, fit: Fit, misfit: FloatArray) -> Fit | None:
    """Fit of all cells after growth from the largest area that the model fits.

    Cells without fringes fit wherever they are steep: they are grown through, and nothing is continued from them.
    """
    unit = _unit(misfit)
    known = _largest(binary_erosion(misfit < GOOD * unit))
    bright = _with_fringes(problem, unit)
    if not (known & bright).any():
        return None
    step = max(STEP, max(known.shape) // STEPS_ACROSS)
    idle = 0
    for _ in range(ROUNDS):
        centre = _centre(problem, fit, known & bright)
        reached = binary_dilation(known, iterations=step)
        part = replace(
            problem.with_cells(problem.cells.restricted(reached)),
            field_prior=CONTINUED_SIGMA_UM**-2,
            field_centre=centre,
        )
        fit = fit_model(part, fit.coordinates, fit.position, centre, fit.levels)
        larger = _largest(reached & ~(_misfit(problem, fit) > GOOD * unit))  # through cells without data
        idle = idle + 1 if larger.sum() <= ROUND_GAIN * known.sum() else 0
        if idle == IDLE_ROUNDS or not (larger & bright).any():
            break
        known = larger
    centre = _centre(problem, fit, known & bright)
    return fit_model(problem, fit.coordinates, fit.position, centre, fit.levels)


def _with_fringes(problem: Problem, unit: float) -> BoolArray:
    """Cells about which more is seen than noise: the others do not tell their thickness."""
    value, weight = problem.cells.value, problem.cells.weight
    level = (weight * value).sum(axis=(1, 2)) / np.maximum(weight.sum(axis=(1, 2)), 1e-300)
    square = weight * (value - level[:, np.newaxis, np.newaxis]) ** 2
    return np.asarray(_mean_around(square, problem, WIDE_SIDE) > VISIBLE * unit)


def _centre(problem: Problem, fit: Fit, known: BoolArray) -> FloatArray:
    """Coefficients of the field of a fit, continued from where it is known."""
    field = continued(problem.basis.expand(fit.field), known)
    return problem.basis.fit(field, np.ones(known.shape))


def _misfit(problem: Problem, fit: Fit) -> FloatArray:
    """Mean square of the whitened residuals of each cell and its neighbours; NaN where none of them has data."""
    expected = problem.expected_of(fit)
    residual = problem.whitener(expected)(problem.cells.value - expected)
    return _mean_around(residual**2, problem, SIDE)


def _mean_around(values: FloatArray, problem: Problem, side: int) -> FloatArray:
    """Mean over the data, 0 elsewhere, of each cell and those around it; NaN where none of them has data."""
    seen = uniform_filter((problem.cells.weight > 0).mean(axis=0), side)
    total = uniform_filter(values.mean(axis=0), side)
    return np.where(seen > NO_DATA, total / np.maximum(seen, NO_DATA), np.nan)


def _unit(misfit: FloatArray) -> float:
    """Misfit of cells where the model fits."""
    return float(np.nanquantile(misfit, BETTER_PART))


def _largest(area: BoolArray) -> BoolArray:
    """The largest part that hangs together."""
    parts, number = label(area)
    if number == 0:
        return area
    size = np.bincount(parts.ravel())
    size[0] = 0
    return np.asarray(parts == size.argmax())
