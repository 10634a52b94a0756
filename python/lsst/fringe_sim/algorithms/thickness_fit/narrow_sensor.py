"""Sensors, or parts of them, whose thickness spans less than a few fringe orders.

Flats are divided by their mean over the sensor, and the mean response depends on the thicknesses that are there. A
sensor of many orders has about the mean of all phases, whatever its thickness. One of few orders does not: a wrong
order comes with a mean response of its own, which hides part of the misfit, and the mean of all phases would be
wrong for every order. So each possible thickness is tried with the mean response that it implies,

    a_k(x) = R_k(d(x)) / <R_k(d)> - 1,

from starts all over the range, and the least chi-square decides. In the limit of a flat sensor only the ratios of
slopes between the wavelengths are left; the result says how little that is: a probability that another solution is
true, and the variance of the common thickness from the Fisher information of all cells together, mean included.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import Float32Array, FloatArray
from ...compiled import kernel, run_threaded, subkernel
from .cells import Cells
from .evidence import refine_row
from .templates import FlatTemplates, pad_wavelengths

_MOST_CELLS = 600  # Cells that are asked; more would only add certainty
_FEW_CELLS = 120  # Cells with which all starts are compared; only the best of these go on with more
_STARTS_PER_ORDER = 12
_FIRST_ROUNDS = 8
_KEPT = 120
_LEAST_KEPT = 12
"""Solutions that go on to settle: of all shapes together, and of each. Most true ones are not yet among the first."""
_COMPARED = 6
_JOINT_STEPS = 25
_LONGEST_STEP_UM = 0.02
_SIDES = (0.0, -0.125, 0.125, -0.25, 0.25, -0.375, 0.375)
"""Orders from its thickness at which a cell is looked for again."""
_SIDE_ROUNDS = 3
_SIDE_MOVE = 0.05  # Orders by which a cell must move before that is more than what the steps left over
_SAME_SOLUTION = 0.25  # Solutions whose common thickness agrees within this many orders are one
_FEW_ASTRAY = 0.01  # Share of cells that may have another order before two maps are told apart
_OWN_MEAN = 0.1
"""Mean amplitude, in rms amplitudes of the model, up to which flats have been divided by their own mean."""


@dataclass(frozen=True, eq=False)
class NarrowSensor:
    """What a sensor of few orders says about its common thickness."""

    templates: FlatTemplates  # the model with the mean response of the best solution
    range_um: tuple[float, float]  # least and largest thickness of the solution [µm]
    slip: float  # probability that another solution is true
    sigma_um: float  # uncertainty of the mean thickness of the sensor [µm]
    chi2: float  # chi-square of this solution, summed over the cells that were asked
    cell: NDArray[np.intp]  # which cells were asked, counted row by row, ``(n,)``
    cell_um: FloatArray  # their thickness [µm], ``(n,)``

    def agrees_with(self, thickness_um: Float32Array, order_um: float) -> bool:
        """Whether a map has the same orders where cells were asked, but for a few of them."""
        miss = np.abs(thickness_um.ravel()[self.cell] - self.cell_um)
        return bool(np.mean(miss < _SAME_SOLUTION * order_um) > 1.0 - _FEW_ASTRAY)


def is_own_mean(cells: Cells, templates: FlatTemplates) -> bool:
    """Whether the flats are over their mean over these very cells, not over a larger sensor they were cut from."""
    wavelengths = templates.n_wavelengths
    weight = cells.weight[..., :wavelengths] > 0.0
    number = weight.sum(axis=(0, 1))
    total = np.where(weight, cells.value[..., :wavelengths], 0.0).sum(axis=(0, 1), dtype=float)
    mean = np.abs(total[number > 0] / number[number > 0])
    return bool(mean.size and np.all(mean < _OWN_MEAN * templates.amplitude().std(axis=0)[number > 0]))


def settle_narrow_sensor(
    cells: Cells,
    templates: FlatTemplates,
    ideas_um: Sequence[Float32Array],
    order_um: float,
    *,
    range_um: tuple[float, float],
    temper: float,
    earlier: Sequence[NarrowSensor] = (),
    threads: int = 2,
) -> list[NarrowSensor]:
    """Find the common thickness of a sensor together with its mean response; the best solutions, best first.

    ``ideas_um``: ideas of the thickness [µm], of which the shape is used; NaN where a cell has no data. The shape
    that is true within half an order everywhere must be among them, or the result may be wrong, float32,
    ``(ncy, ncx)``; ``earlier``: solutions from other ideas, which compete with the new ones.
    """
    sample, shapes_um, middles_um = _Sample.of(cells, ideas_um, templates.n_wavelengths, _MOST_CELLS)
    stride = max(shapes_um.shape[1] // _FEW_CELLS, 1)
    few = sample.every(stride)
    spacing = order_um / _STARTS_PER_ORDER
    together = []
    for shape, middle in zip(shapes_um, middles_um, strict=True):
        # One of the starts is the idea as it is: in others, cells at the crest of a fringe may take its other side.
        starts = np.arange(range_um[0] + (middle - range_um[0]) % spacing, range_um[1], spacing)[:, None]
        tried = few.follow(templates, starts + shape[::stride], _FIRST_ROUNDS, threads)
        # Solutions of one shape compete only after they have settled: until then the mean hides what is wrong.
        kept = _distinct(tried, order_um, max(_KEPT // len(shapes_um), _LEAST_KEPT))
        together += [_settle_together(few, solution, templates) for solution in kept]
    hopeful = _distinct(together, order_um, 4 * _COMPARED)
    sided = [_settle_sides(few, solution, templates, order_um) for solution in hopeful]
    best = _distinct(sided, order_um, _COMPARED)
    again = np.concatenate([sample.starts(solution, shapes_um, stride) for solution in best])
    followed = sample.follow(templates, again, _FIRST_ROUNDS, threads)
    groups = zip(*[iter(followed)] * len(shapes_um), strict=True)
    likely = [_settle_together(sample, min(group, key=lambda s: s.chi2), templates) for group in groups]
    final = [_settle_sides(sample, solution, templates, order_um) for solution in likely]
    final += [
        _Solution(other.cell_um, other.templates.mean_response * sample.share, other.chi2)
        for other in earlier
        if np.array_equal(other.cell, sample.cell)
    ]
    low, high = range_um
    inside = [s for s in final if low - 0.1 * order_um < s.mean_um < high + 0.1 * order_um] or final
    ranked = _distinct(inside, order_um, _COMPARED)
    slip = _slip(ranked, temper, sample)
    return [
        NarrowSensor(
            replace(templates, mean_response=solution.mean_response / sample.share),
            (float(solution.thickness_um.min()), float(solution.thickness_um.max())),
            slip if rank == 0 else 1.0,
            _common_sigma(sample, solution, templates) / np.sqrt(temper),
            solution.chi2,
            sample.cell,
            solution.thickness_um,
        )
        for rank, solution in enumerate(ranked)
    ]


@dataclass(frozen=True, eq=False)
class _Solution:
    """Thickness of some cells and the mean response that goes with it."""

    thickness_um: FloatArray
    mean_response: FloatArray
    chi2: float

    @functools.cached_property
    def mean_um(self) -> float:
        """Common thickness [µm]."""
        return float(self.thickness_um.mean())


@dataclass(frozen=True, eq=False)
class _Sample:
    """Some cells: relative flats over their mean in these cells, their weights, that mean, and which cells they are.

    ``level`` and ``weight`` have shape ``(n, padded wavelengths)``, ``share`` has ``(n_wavelengths,)``. The mean of a
    few hundred cells differs from that of all by more than the noise of a pixel; only what both the flats and
    the model are divided by may be compared.
    """

    level: Float32Array
    weight: Float32Array
    share: FloatArray
    cell: NDArray[np.intp]

    @classmethod
    def of(
        cls, cells: Cells, ideas_um: Sequence[Float32Array], wavelengths: int, most: int
    ) -> tuple[_Sample, FloatArray, FloatArray]:
        """Cells at equal distances that have most wavelengths, their thickness about its middle, and that middle.

        The shapes of the ideas follow the shape of a flat sensor, shape ``(1 + n_ideas, n)``.
        """
        known = np.all(np.isfinite(ideas_um), axis=0)
        number = np.where(known, cells.n_wavelengths, 0)
        seen = np.flatnonzero(known & (number == number.max()))
        seen = seen[:: -(-seen.size // most)]
        depth = cells.value.shape[-1]
        value, weight = (part.reshape(-1, depth)[seen] for part in (cells.value, cells.weight))
        shapes = np.stack([idea.ravel()[seen].astype(float) for idea in ideas_um])
        shapes = np.concatenate([np.full_like(shapes[:1], np.median(shapes[0])), shapes])
        middle = np.median(shapes, axis=1)
        sample = cls(value + np.float32(1), weight, np.ones(wavelengths), seen)
        return sample.every(1), shapes - middle[:, None], middle

    def every(self, stride: int) -> _Sample:
        """One cell in so many."""
        level, weight = self.level[::stride], self.weight[::stride]
        used = weight > 0.0
        number = used.sum(axis=0)
        total = np.where(used, level, 0.0).sum(axis=0, dtype=float)
        mean = np.where(total > 0.0, total / np.maximum(number, 1), 1.0)
        share = mean.astype(np.float32)
        return _Sample(
            level / share, weight * share**2, self.share * mean[: self.share.size], self.cell[::stride]
        )

    def follow(
        self, templates: FlatTemplates, starts_um: FloatArray, rounds: int, threads: int
    ) -> list[_Solution]:
        """Refit and renormalise in turn, from each of some starts of shape ``(starts, n)``.

        ``R / m - 1`` against ``a`` with weight ``w`` is ``R`` against ``m (1 + a)`` with weight ``w / m²``: the
        mean response goes into the data, and the table stays as it is.
        """
        table = pad_wavelengths(templates.response)
        origin, step = templates.start_um, templates.step_um
        out = np.empty(starts_um.shape)
        mean = np.empty((len(starts_um), table.shape[1]))
        chi2 = np.empty(len(starts_um))

        def work(item: int) -> None:
            thickness = starts_um[item].astype(np.float32)
            chi2[item] = _follow(self.level, self.weight, table, origin, step, thickness, rounds, mean[item])
            out[item] = thickness

        run_threaded(work, len(starts_um), threads)
        wavelengths = templates.n_wavelengths
        return [_Solution(t, m[:wavelengths], float(c)) for t, m, c in zip(out, mean, chi2, strict=True)]

    def better_sides(self, solution: _Solution, templates: FlatTemplates, order_um: float) -> FloatArray:
        """Thickness of every cell at the least chi-square within half an order, the mean response being as it is."""
        table = pad_wavelengths(templates.response)
        origin, step = templates.start_um, templates.step_um
        level = np.ones(table.shape[1])
        level[: templates.n_wavelengths] = solution.mean_response
        scale = level.astype(np.float32)
        value, weight = self.level * scale, self.weight / scale**2
        tried, miss = [], []
        for side in _SIDES:
            start = (solution.thickness_um + side * order_um).astype(np.float32)
            found = np.full_like(start, np.nan)
            refine_row(value, weight, table, origin, step, start, found)
            difference = value - _interpolate(table, (found - origin) / step)
            tried.append(found.astype(float))
            miss.append((weight * difference**2).sum(axis=1))
        return np.asarray(np.take_along_axis(np.array(tried), np.argmin(miss, axis=0)[None], axis=0)[0])

    def starts(self, solution: _Solution, shapes_um: FloatArray, stride: int) -> FloatArray:
        """Starts for these cells from the solution of one in ``stride``: its common thickness with each shape."""
        middle = np.median(solution.thickness_um - shapes_um[:, ::stride], axis=1, keepdims=True)
        return middle + shapes_um


@kernel
def _follow(level, weight, table, origin, step, thickness, rounds, mean):  # type: ignore[no-untyped-def]
    """Refit and renormalise in turn, in place; returns chi-square."""
    value, spread, before = np.empty_like(level), np.empty_like(weight), np.empty_like(thickness)
    _mean_response(table, origin, step, thickness, mean)
    for _ in range(rounds):
        for c in range(level.shape[0]):
            for band in range(level.shape[1]):
                scale = np.float32(mean[band]) if mean[band] > 0.0 else np.float32(1.0)
                value[c, band] = level[c, band] * scale
                spread[c, band] = weight[c, band] / (scale * scale)
        before[:] = thickness
        refine_row(value, spread, table, origin, step, before, thickness)
        _mean_response(table, origin, step, thickness, mean)
        if np.abs(thickness - before).max() < 0.02 * step:
            break
    chi2 = 0.0
    for c in range(level.shape[0]):
        below, share = _place(table, (thickness[c] - origin) / step)
        for band in range(level.shape[1]):
            low = table[below, band]
            response = low + share * (table[below + 1, band] - low)
            miss = level[c, band] - response / (mean[band] if mean[band] > 0.0 else 1.0)
            chi2 += weight[c, band] * miss * miss
    return chi2


@subkernel
def _mean_response(table, origin, step, thickness, mean):  # type: ignore[no-untyped-def]
    mean[:] = 0.0
    for c in range(thickness.shape[0]):
        below, share = _place(table, (thickness[c] - origin) / step)
        for band in range(table.shape[1]):
            low = table[below, band]
            mean[band] += low + share * (table[below + 1, band] - low)
    mean /= thickness.shape[0]


@subkernel(expand=True)
def _place(table, place):  # type: ignore[no-untyped-def]
    """Node of the table below a place, and the share of the next."""
    inside = min(max(place, 0.0), table.shape[0] - 1.001)
    below = int(inside)
    return below, np.float32(inside - below)


def _interpolate(table: NDArray[Any], place: NDArray[np.floating]) -> NDArray[Any]:
    """Rows of a table between its nodes, in the precision of the table."""
    inside = np.clip(place, 0.0, len(table) - 1.001)
    below = inside.astype(np.intp)
    share = (inside - below).astype(table.dtype)[:, None]
    low = table[below]
    return np.asarray(low + share * (table[below + 1] - low))


def _distinct(solutions: list[_Solution], order_um: float, most: int) -> list[_Solution]:
    """The best so many, best first; of those with the same common thickness only the best."""
    found: list[_Solution] = []
    for solution in sorted(solutions, key=lambda solution: solution.chi2):
        if all(abs(solution.mean_um - other.mean_um) > _SAME_SOLUTION * order_um for other in found):
            found.append(solution)
            if len(found) == most:
                break
    return found


def _slip(ranked: list[_Solution], temper: float, sample: _Sample) -> float:
    """Probability of all solutions but the best."""
    freedom = max(int(np.count_nonzero(sample.weight > 0)) - len(sample.weight), 1)
    trust = temper / max(1.0, ranked[0].chi2 / freedom)
    excess = np.array([trust * (solution.chi2 - ranked[0].chi2) for solution in ranked])
    return float(1.0 - 1.0 / np.exp(-0.5 * excess.clip(0.0, 2000.0)).sum())


@dataclass(frozen=True, eq=False)
class _Together:
    """Normal equations of all cells and the mean that they share.

    With ``g = R' / <R>`` and ``r = R / <R>``, moving cell ``j`` changes the amplitude of cell ``i`` by
    ``g_ik δ_ij - r_ik g_jk / n``: by itself, and through the mean. The matrix of second derivatives is therefore
    diagonal but for two rows for each wavelength, ``D + W C W'`` with ``W = (g, w g r)``.
    """

    gradient: FloatArray
    diagonal: FloatArray
    factors: FloatArray
    coupling: FloatArray
    chi2: float

    @classmethod
    def of(cls, sample: _Sample, thickness_um: FloatArray, templates: FlatTemplates) -> _Together:
        """At a thickness of every cell; the mean is that of these thicknesses."""
        wavelengths, count, step = templates.n_wavelengths, len(sample.weight), templates.step_um
        place = (thickness_um - templates.start_um) / step
        parts = (_interpolate(templates.response, place + shift) for shift in (-1.0, 0.0, 1.0))
        behind, here, ahead = parts
        mean = here.mean(axis=0)
        slope, relative = (ahead - behind) / (2.0 * step * mean), here / mean
        weight = sample.weight[:, :wavelengths].astype(float)
        miss = sample.level[:, :wavelengths] - relative
        total = (weight * relative**2).sum(axis=0) / count**2
        once = -np.eye(wavelengths) / count
        through_mean = (weight * miss * relative).sum(axis=0) / count
        return cls(
            (weight * miss * slope).sum(axis=1) - slope @ through_mean,
            (weight * slope**2).sum(axis=1),
            np.hstack([slope, weight * slope * relative]),
            np.block([[np.diag(total), once], [once, np.zeros_like(once)]]),
            float((weight * miss**2).sum()),
        )

    def solve(self, right: FloatArray, added: FloatArray | float) -> FloatArray:
        """Solution for a right-hand side, something being added to the diagonal."""
        inverse = 1.0 / (self.diagonal + added + np.finfo(float).tiny)
        scaled = inverse[:, None] * self.factors
        inner = np.eye(len(self.coupling)) + self.coupling @ (self.factors.T @ scaled)
        share = self.coupling @ (scaled.T @ right)
        try:
            answer = np.linalg.solve(inner, share)
        except np.linalg.LinAlgError:
            answer = np.linalg.lstsq(inner, share, rcond=1e-14)[0]
        return np.asarray(inverse * right - scaled @ answer)


def _settle_together(sample: _Sample, solution: _Solution, templates: FlatTemplates) -> _Solution:
    """Levenberg-Marquardt steps of all cells at once: refitting and renormalising in turn crawls."""
    thickness, damping = solution.thickness_um.astype(float), 1e-6
    state = _Together.of(sample, thickness, templates)
    for _ in range(_JOINT_STEPS):
        step = state.solve(state.gradient, damping * state.diagonal)
        tried = thickness + np.clip(step, -_LONGEST_STEP_UM, _LONGEST_STEP_UM)
        after = _Together.of(sample, tried, templates)
        if after.chi2 < state.chi2:
            gained = state.chi2 - after.chi2
            thickness, state, damping = tried, after, 0.1 * damping
            if gained < 1e-4:
                break
        else:
            damping *= 30.0
    place = (thickness - templates.start_um) / templates.step_um
    return _Solution(thickness, _interpolate(templates.response, place).mean(axis=0), state.chi2)


def _settle_sides(
    sample: _Sample, solution: _Solution, templates: FlatTemplates, order_um: float
) -> _Solution:
    """Settle a solution again with the cells that had taken the wrong side of a crest on the other one.

    At neighbouring wavelengths the two sides of a crest look alike until the mean response is nearly right.
    """
    settled = solution
    for _ in range(_SIDE_ROUNDS):
        moved = sample.better_sides(settled, templates, order_um)
        if np.abs(moved - settled.thickness_um).max() < _SIDE_MOVE * order_um:
            break
        again = _settle_together(sample, replace(settled, thickness_um=moved), templates)
        if again.chi2 >= settled.chi2:
            break
        settled = again
    return settled


def _common_sigma(sample: _Sample, solution: _Solution, templates: FlatTemplates) -> float:
    """Standard uncertainty of the mean thickness of the sampled cells, as if they were the whole sensor [µm]."""
    together = _Together.of(sample, solution.thickness_um, templates)
    everywhere = np.ones(len(solution.thickness_um))
    # What is added keeps rounding from turning a direction that nothing decides into a certain one.
    variance = float(everywhere @ together.solve(everywhere, 1e-12 * float(together.diagonal.max())))
    return float(np.sqrt(max(variance, 0.0))) / everywhere.size
