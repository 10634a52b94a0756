"""How well data are predicted that took no part in the search, and how far from the model data are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.special import chdtri

from .continuation import continued
from .fit import Fit, Problem, fit_model
from .islands import ANOTHER_ORDER, thickness_on_islands
from .verdict import CONFIDENCE

__all__ = [
    "HeldOut",
    "continued_thickness",
    "degrees_of_freedom",
    "held_out_blocks",
    "misfit_rms",
    "thickness_starts",
    "validate",
    "whole_thickness",
]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

BLOCKS_ACROSS = 8
FEWEST_ROWS = 12
"""Blocks along a side of the sensor that are held out or not, and the rows of cells from which on there are any."""

MUCH_WORSE = 4.0
"""χ² of the cells held out over that of the others, from which on their thickness may be another."""

NEAR_ISLAND = 8
"""Cells about an island into which a smooth thickness may be bent."""

FEWEST_WAVELENGTHS = 8
"""Wavelengths from which on every fourth is left out at once."""


@dataclass(frozen=True)
class HeldOut:
    """Unchanged model against effects, on data that took no part in fitting them."""

    # blocks, wavelengths: fall of χ² on parts of the sensor, and on wavelengths; 0 where there are too
    # few
    blocks: float
    wavelengths: float
    # before_rms, after_rms: rms of data minus model without and with the effects
    before_rms: float
    after_rms: float

    @property
    def better(self) -> bool:
        """Whether the data held out are predicted better, and nowhere much worse."""
        return self.blocks + self.wavelengths > 0.0 and min(self.blocks, self.wavelengths) >= -9.0


def held_out_blocks(shape: tuple[int, int], fraction: float, rng: np.random.Generator) -> BoolArray:
    """Blocks of cells that no selection sees, scattered over the sensor; none where there are few cells.

    ``fraction``: part of the sensor that is held out. Returns (ny, nx).
    """
    if min(shape) < FEWEST_ROWS:
        return np.zeros(shape, dtype=bool)
    side = min(BLOCKS_ACROSS, min(shape) // 3)
    blocks = rng.permutation(side * side).reshape(side, side) < round(fraction * side * side)
    rows = np.arange(shape[0]) * side // shape[0]
    columns = np.arange(shape[1]) * side // shape[1]
    return blocks[np.ix_(rows, columns)]


def whole_thickness(problem: Problem, null: Fit, fit: Fit, held_out: BoolArray) -> FloatArray:
    """Thickness of all cells from a fit to a part of them.

    What the part moved by, as a function of thickness, is added everywhere; where the unchanged model has another
    order, that does not suit the rest, and the part is continued with little curvature.
    """
    moved = problem.basis.expand(fit.field)
    if not held_out.any():
        return moved
    rest = problem.with_cells(problem.cells.restricted(held_out))
    on_islands = problem.forward.on_islands(fit.settings)
    everywhere = _moved_everywhere(problem, null, moved, held_out, on_islands)
    if on_islands.any():
        # A smooth thickness is bent about an island without the effect.
        beyond = continued_thickness(problem, fit, held_out)
        near = np.where(binary_dilation(on_islands, iterations=NEAR_ISLAND), beyond, everywhere)
        trials = [thickness_on_islands(problem, fit, first, held_out) for first in (everywhere, near, beyond)]
        return min(trials, key=lambda thickness: rest.chi2_at(fit.settings, thickness))
    ratio = rest.cells.n_values / max(problem.cells.n_values - rest.cells.n_values, 1)
    chi2 = rest.chi2_at(fit.settings, everywhere)
    if chi2 < MUCH_WORSE * ratio * fit.chi2:
        return everywhere
    beyond = continued_thickness(problem, fit, held_out)
    return beyond if rest.chi2_at(fit.settings, beyond) < chi2 else everywhere


def thickness_starts(problem: Problem, null: Fit, fit: Fit, held_out: BoolArray) -> list[FloatArray]:
    """Thicknesses of all cells from which a fit to all of them may begin, after one to a part of them.

    The first is `whole_thickness`. Where the part, continued with little curvature, comes to another fringe order in
    some of the rest, that is the second: weak fringes hardly tell which is right before both are fitted.
    """
    first = whole_thickness(problem, null, fit, held_out)
    rest = held_out & problem.cells.seen
    if not rest.any() or problem.field_prior:
        return [first]
    beyond = continued_thickness(problem, fit, held_out)
    order = problem.order_um
    return [first, beyond] if np.abs(beyond - first)[rest].max() > ANOTHER_ORDER * order else [first]


def continued_thickness(problem: Problem, fit: Fit, held_out: BoolArray) -> FloatArray:
    """Thickness of a fit to a part of the cells, continued into those held out."""
    thickness_um = problem.basis.expand(fit.field)
    return np.where(held_out, continued(thickness_um, ~held_out & problem.cells.seen), thickness_um)


def _moved_everywhere(
    problem: Problem, null: Fit, moved: FloatArray, held_out: BoolArray, on_islands: BoolArray
) -> FloatArray:
    """Thickness without effects, moved in all cells as a function of itself as a fit moved it in a part."""
    before = problem.basis.expand(null.field)
    # An island has a thickness of its own for the same fringes.
    seen = ~held_out & problem.cells.seen & ~on_islands
    middle, half = before.mean(), max(0.5 * float(np.ptp(before)), 1e-6)
    depth = (before - middle) / half
    columns = np.stack([depth**power for power in range(3)], axis=-1)
    solution = np.linalg.lstsq(columns[seen], (moved - before)[seen], rcond=None)[0]
    known = on_islands & ~held_out & problem.cells.seen
    there = float(np.median((moved - before)[known])) if known.any() else 0.0
    return np.asarray(before + np.where(on_islands, there, columns @ solution))


def validate(problem: Problem, null: Fit, final: Fit, held_out: BoolArray, *, rich: bool) -> HeldOut:
    """Fit the effects without a part of the data, and compare what is predicted for that part.

    ``null``, ``final``: fits of the unchanged model and of the effects to all data. ``held_out`` (ny, nx).
    ``rich``: whether there are enough cells for levels to be free; if not, wavelengths are left out one by one.
    """
    if not rich:
        return _without_single_wavelengths(problem, null, final)
    blocks, before, after = _without_blocks(problem, null, final, held_out)
    return HeldOut(blocks, _without_wavelengths(problem, null, final), before, after)


def _without_blocks(
    problem: Problem, null: Fit, final: Fit, held_out: BoolArray
) -> tuple[float, float, float]:
    if not held_out.any():
        return 0.0, misfit_rms(problem, null), misfit_rms(problem, final)
    seen = problem.without_cells(held_out)
    fitted = fit_model(seen, final.coordinates, final.position, final.field, final.levels)
    unseen = problem.with_cells(problem.cells.restricted(held_out))
    before = fit_model(unseen, (), np.zeros(0), null.field, null.levels)
    starts = thickness_starts(problem, null, fitted, held_out)
    fields = [problem.basis.fit(thickness, np.ones(held_out.shape)) for thickness in starts]
    ends = [fit_model(unseen, (), np.zeros(0), field, fitted.levels, fitted.settings) for field in fields]
    after = min(ends, key=lambda fit: fit.chi2)
    return before.chi2 - after.chi2, misfit_rms(unseen, before), misfit_rms(unseen, after)


def _without_wavelengths(problem: Problem, null: Fit, final: Fit) -> float:
    """Fall of χ² at every fourth wavelength, which takes no part in the fit.

    0 where other exposures say nothing of those left out.
    """
    waves = problem.cells.shape[0]
    if waves < FEWEST_WAVELENGTHS or any(item.of_one_exposure for item in final.coordinates):
        return 0.0
    out = np.zeros((waves, 1, 1), dtype=bool)
    out[2::4] = True
    seen = problem.with_cells(problem.cells.restricted(~out))
    unseen = problem.with_cells(problem.cells.restricted(out))
    before, after = (
        _predicted_chi2(
            unseen, fit_model(seen, fit.coordinates, fit.position, fit.field, fit.levels, fit.settings)
        )
        for fit in (null, final)
    )
    return before - after


def _without_single_wavelengths(problem: Problem, null: Fit, final: Fit) -> HeldOut:
    """Fall of χ² at wavelengths that are left out one by one, of a few pixels whose levels are known."""
    cells, waves = problem.cells, problem.cells.shape[0]
    if waves < 4:
        return HeldOut(0.0, 0.0, misfit_rms(problem, null), misfit_rms(problem, final))
    total, square = np.zeros(2), np.zeros((2, waves))
    for wave in range(waves):
        out = (np.arange(waves) == wave)[:, None, None]
        seen = problem.with_cells(cells.restricted(~out))
        for side, fit in enumerate((null, final)):
            fitted = fit_model(seen, fit.coordinates, fit.position, fit.field, fit.levels, fit.settings)
            miss = (cells.value - problem.expected_of(fitted))[wave]
            total[side] += float((cells.weight[wave] * miss**2).sum())
            square[side, wave] = float(np.mean(miss**2))
    before, after = np.sqrt(square.mean(axis=1))
    return HeldOut(0.0, float(total[0] - total[1]), float(before), float(after))


def misfit_rms(problem: Problem, fit: Fit) -> float:
    """Rms of data minus model, corrected for the freedom of the nuisances."""
    return problem.cells.noise_rms * math.sqrt(fit.chi2 / degrees_of_freedom(problem, fit))


def degrees_of_freedom(problem: Problem, fit: Fit) -> int:
    """Values that are left when the nuisances are fitted."""
    free = _field_freedom(problem) + problem.level_basis.shape[1] + len(fit.coordinates)
    return max(problem.cells.n_values - free, 1)


def disagreement_size(problem: Problem, fit: Fit) -> dict[str, float]:
    """Size of what a fit leaves beyond noise, as `Verdict.size` states it.

    Noise of single exposures and noise that all of them share, the scatter of the response of the cells, are compared
    with what is left of each: what all exposures share is lost in χ² where the response scatters. The limit takes
    the sum for a multiple of one chi-square (Satterthwaite 1946, doi 10.2307/3002019). Noise that happens to be small
    gives no limit below that of mean noise: power-constrained limits of Cowan et al. 2011.
    """
    variance, chi2, freedom = np.array(_noise_and_misfit(problem, fit)).T
    noise, left = float(variance.sum()), float((variance * chi2 / freedom).sum())
    degrees = noise**2 / float((variance**2 / freedom).sum())
    counts = math.sqrt(max(left - noise, 0.0))
    most = math.sqrt(max(max(left, noise) * degrees / float(chdtri(degrees, CONFIDENCE)) - noise, 0.0))
    level, _ = problem.amplitudes(fit.levels)
    pattern = (problem.expected_of(fit) / level - 1.0)[:, problem.cells.seen]
    fringes = math.sqrt(float(pattern.var(axis=1).mean())) if pattern.size else 0.0
    return {
        "of_counts": counts,
        "of_fringes": counts / fringes if fringes > 0.0 else math.nan,
        "of_fringes_at_most": most / fringes if fringes > 0.0 else math.nan,
    }


def _noise_and_misfit(problem: Problem, fit: Fit) -> list[tuple[float, float, float]]:
    """Variance of a value by noise, χ² and degrees of freedom: of single exposures, and of what all of them share."""
    cells, degrees = problem.cells, float(degrees_of_freedom(problem, fit))
    if cells.response_scatter == 0.0:
        return [(cells.noise_rms**2, fit.chi2, degrees)]
    expected = problem.expected_of(fit)
    whiten = problem.whitener(expected)
    residual = whiten(np.where(cells.weight > 0.0, cells.value - expected, 0.0))
    square = (whiten.direction**2).sum(axis=0)[cells.seen]
    shared = float((((whiten.direction * residual).sum(axis=0)[cells.seen]) ** 2 / square).sum())
    variance = float((1.0 / square).mean()) + cells.response_scatter**2
    freedom = degrees * square.size / cells.n_values
    return [
        (cells.noise_rms**2 - variance, fit.chi2 - shared, degrees - freedom),
        (variance, shared, freedom),
    ]


def _field_freedom(problem: Problem) -> int:
    """Coefficients of the field that the data reach."""
    if problem.field_prior:
        return 0
    seen = problem.cells.seen.astype(float)
    return int((problem.basis.gather(seen[np.newaxis])[:, 0] > 1e-3).sum())


def _predicted_chi2(problem: Problem, fit: Fit) -> float:
    """χ² of data that took no part in a fit, with their levels adjusted."""
    return problem.chi2_at(fit.settings, problem.basis.expand(fit.field))
