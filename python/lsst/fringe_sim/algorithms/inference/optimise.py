"""Gauss-Newton with the cells projected out, and what a fit becomes: a hypothesis with its log evidence."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from ...array_types import BoolArray, FloatArray
from ...errors import OutOfRangeError
from .coordinates import SECANT, Coordinate, log_evidence_of_parameters
from .marginal import Columns, Point, joined

MOST_STEP_UM = 0.05  # Farthest that a step moves the thickness of a cell [µm]: a sixth of a fringe order

MOST_JUMP_UM = 0.25
"""The same of a finite change of an effect, whose thickness may have to follow by most of an order."""

LEAST_LEFT = 0.3  # Part of the contrast that a step leaves at least

STRIDE_UM, MOST_STRIDES = 0.05, 16
"""Typical length of a stride of the thickness [µm], and how many of them are walked at most."""

SHIFTS = (0.0, -1.0 / 3.0, 1.0 / 3.0)
"""Moves of the thickness from which that of a cell is sought anew [orders]."""

RIDGE_SCALES = 10.0
"""Prior scales of the Gaussian that keeps parameters which the data do not see where they are."""

MOST_TURNS, PARTS = 2, (9, 5, 3, 1)
"""Whole orders by which cells are moved, and sides of the parts of a sensor that are moved together [cells]."""

PART_BACK = 5  # Side of the parts of a sensor that go back to the first thickness [cells]

LEAST_GAIN, LEAST_PART = 0.03, 0.01
"""Gain of log likelihood, and part of what a fit lacks of another, with which steps end."""

SHRINK = (1.0, 0.4, 0.12, 0.03)  # Parts of a step that are tried


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A set of effects at its best, and its log evidence."""

    effects: tuple[str, ...]
    items: tuple[Coordinate, ...]
    point: Point
    log_evidence: float
    covariance: FloatArray  # (K, K) of the parameters

    @property
    def values(self) -> FloatArray:
        """Values of the parameters, ``(K,)``."""
        return np.array([self.point.settings[item.key] for item in self.items])

    @property
    def chi2(self) -> float:
        """Chi square with response and thickness of the cells at the best."""
        return 2.0 * float(self.point.cell_energy.sum())


def effect_columns(point: Point, items: Sequence[Coordinate], secant: float = SECANT) -> Columns:
    """Derivatives with respect to parameters of effects; ``secant``: see `Coordinate.difference`.

    A difference is taken along the thickness of equal phase, and what that adds is put back: otherwise half of the
    step times the square of a phase of hundreds of radians per unit would look like a loss of contrast. Along a
    longer secant the thickness follows what an effect does to light, since fringes shift by a radian and more.
    """
    shape = (len(items), *point.value.shape)
    values, slopes, phases = np.empty(shape), np.empty(shape), np.empty(len(items))
    forward = point.problem.forward
    before = forward.log_phase(point.settings)
    for row, item in enumerate(items):
        now = point.settings.get(item.key, item.null)
        step = item.difference(now, secant)
        settings = {**point.settings, item.key: now + step}
        if forward.is_of_image(item.key):
            value, slope = forward.imaged(settings, point.light)
            values[row] = point.whitened((value - point.value) / step)
            slopes[row], phases[row] = point.whitened((slope - point.slope) / step), 0.0
            continue
        phase = forward.log_phase(settings) - before
        follows = bool(phase) and not item.step and secant == SECANT
        moved_um: FloatArray | float = point.thickness_um * math.expm1(-phase) if follows else 0.0
        if secant > SECANT and forward.effect_of(item.key).acts_on != "image":
            follows, moved_um = True, _following_um(point, settings)
        value, slope = forward.predict(settings, point.thickness_um + moved_um)
        values[row] = point.whitened((value - point.value) / step)
        slopes[row] = point.whitened((slope - point.slope) / step)
        if follows:
            up, down = (
                forward.predict(point.settings, point.thickness_um + sign * moved_um)[1]
                for sign in (1.0, -1.0)
            )
            values[row] -= point.steep * moved_um / step
            slopes[row] -= point.whitened((up - down) / (2.0 * step))
        phases[row] = phase / step
    return point.columns(values, slopes, phases)


def free_columns(point: Point, items: Sequence[Coordinate]) -> Columns:
    """Derivatives with respect to the levels, and to the parameters of effects if there are any."""
    return joined(point.level_columns, effect_columns(point, items)) if items else point.level_columns


def _following_um(point: Point, settings: dict[str, float], rounds: int = 2) -> FloatArray:
    """Move of the thickness of every cell with which other settings differ least from a point [µm]."""
    moved = np.zeros_like(point.thickness_um)
    for _ in range(rounds):
        value, _ = point.problem.forward.predict(settings, point.thickness_um + moved)
        step = point.following_um(point.whitened(value - point.value))
        moved = moved + np.clip(step, -MOST_JUMP_UM, MOST_JUMP_UM)
    return moved


def relaxed(point: Point, rounds: int = 3, tolerance: float = 0.02) -> Point:
    """Levels and thickness at the best for these effects."""
    for _ in range(rounds):
        columns = point.level_columns
        gradient = point.score(columns) - columns.log_det
        step = np.asarray(np.linalg.solve(point.information(columns, columns), gradient))
        moved = np.clip(point.followed_um(step, columns), -MOST_STEP_UM, MOST_STEP_UM)
        for part in SHRINK[:2]:
            new = point.moved(point.levels_after(part * step), point.thickness_um + part * moved)
            if new.cost < point.cost:
                break
        else:
            return point
        gain, point = point.cost - new.cost, new
        if gain < tolerance:
            break
    return point


def with_free_contrast(point: Point, rounds: int = 8, tolerance: float = 0.02) -> Point:
    """Levels, thickness and the contrast of the fringes at the best for these effects.

    The contrast is part of the model of the point that is returned. Where fringes are weaker than the model has them,
    a thickness that is fitted with its contrast goes to where the model has the weakest ones.
    """
    for _ in range(rounds):
        forward = point.problem.forward
        fringes = point.whitened((point.value - 1.0) / forward.contrast)
        own = point.columns(fringes[np.newaxis], point.steep[np.newaxis] / forward.contrast)
        columns = joined(point.level_columns, own)
        gradient = point.score(columns) - columns.log_det
        step = np.asarray(np.linalg.solve(point.information(columns, columns), gradient), dtype=float)
        moved = np.clip(point.followed_um(step, columns), -MOST_STEP_UM, MOST_STEP_UM)
        for part in SHRINK:
            contrast = max(forward.contrast + part * float(step[-1]), LEAST_LEFT * forward.contrast)
            problem = replace(point.problem, forward=replace(forward, contrast=contrast))
            new = problem.at(
                point.settings, point.levels_after(part * step[:-1]), point.thickness_um + part * moved
            )
            if new.cost < point.cost:
                break
        else:
            return point
        gain, point = point.cost - new.cost, new
        if gain < tolerance:
            break
    return point


def jumped(point: Point, items: Sequence[Coordinate], values: Sequence[float]) -> Point:
    """Another value of some parameters, with the thickness that goes with it, and relaxed.

    The thickness follows in strides that are short beside a fringe order; a longer one ends in a wrong order.
    One that is known is where it was measured.
    """
    if point.problem.known:
        settings = {**point.settings, **{i.key: i.clipped(v) for i, v in zip(items, values, strict=True)}}
        return relaxed(point.moved(point.levels, point.problem.thickness_um, settings), rounds=2)
    begin = np.array([point.settings.get(item.key, item.null) for item in items])
    change = np.array([i.clipped(v) for i, v in zip(items, values, strict=True)]) - begin

    def followed(part: float) -> tuple[dict[str, float], FloatArray]:
        own = begin + part * change
        settings = {**point.settings, **{i.key: float(v) for i, v in zip(items, own, strict=True)}}
        value, _ = point.problem.forward.predict(settings, point.thickness_um)
        column = point.columns(point.whitened(value - point.value)[np.newaxis], np.zeros((1, *value.shape)))
        return settings, point.followed_um(np.ones(1), column)

    _, first = followed(1.0 / MOST_STRIDES)
    far = MOST_STRIDES * _typical_um(
        point, first - point.followed_um(np.zeros(point.problem.free_levels), point.level_columns)
    )
    strides = min(max(math.ceil(far / STRIDE_UM), 1), MOST_STRIDES)
    for number in range(1, strides + 1):
        settings, moved = followed(number / strides)
        moved = np.clip(moved, -MOST_JUMP_UM, MOST_JUMP_UM)
        point = point.moved(point.levels, point.thickness_um + moved, settings)
    return relaxed(point, rounds=2)


def in_best_orders(point: Point, where: BoolArray | None = None, rounds: int = 4) -> Point:
    """The thickness of every cell where it is best of all within half an order, at these levels.

    ``where`` (N,): cells that may move; the others stay.
    """
    order_um = point.problem.forward.order_um
    moves = np.ones(len(point.thickness_um)) if where is None else where.astype(float)
    best, energy = point.thickness_um.copy(), point.cell_energy.copy()
    for shift in SHIFTS:
        own = point.moved(point.levels, point.thickness_um + shift * order_um * moves) if shift else point
        for number in range(rounds + 1):
            better = own.cell_energy < energy
            best[better], energy[better] = own.thickness_um[better], own.cell_energy[better]
            if number < rounds:
                step = np.clip(own.wanted_um, -MOST_STEP_UM, MOST_STEP_UM)
                own = own.moved(own.levels, own.thickness_um + step * moves)
    return point.moved(point.levels, best)


def in_whole_orders(point: Point, odds: float, rounds: int = 2) -> Point:
    """All of the sensor, then parts of it, in the fringe orders in which the cells together are the likeliest.

    A part is a cell with its neighbours, or alone if it is sure. ``odds``: logarithm of those for which a part is
    moved; that it is one of so many parts which is in another order is the less likely, the more parts there are.
    Cells that sit in another minimum between two orders then go where those about them would have them. A thickness
    that is known stays.
    """
    if point.problem.known:
        return point
    return _with_sure_cells(_in_orders(point, odds, rounds))


def _in_orders(point: Point, odds: float, rounds: int) -> Point:
    """The same by whole orders alone."""
    shape, order_um = point.problem.forward.geometry.sample_shape, point.problem.forward.order_um
    turns = np.arange(-MOST_TURNS, MOST_TURNS + 1)
    found = []
    for turn in turns:
        own = point.moved(point.levels, point.thickness_um + turn * order_um)
        for _ in range(rounds if turn else 0):
            step = np.clip(own.wanted_um, -MOST_STEP_UM, MOST_STEP_UM)
            own = own.moved(own.levels, own.thickness_um + step)
        found.append((own.cell_energy, own.thickness_um))
    energy, thickness = (np.stack(part) for part in zip(*found, strict=True))
    best = np.full(energy.shape[1], int(energy.sum(axis=1).argmin()))
    cells = np.arange(len(best))
    for side in PARTS:
        around = np.stack(
            [uniform_filter(one.reshape(shape), side, mode="constant").ravel() for one in energy]
        )
        likelier = around.argmin(axis=0)
        gained = around[best, cells] - around[likelier, cells]
        price = odds + math.log(max(len(best) / side**2, 1.0))
        best = np.where(side**2 * gained > price, likelier, best)
    return point if (turns[best] == 0).all() else point.moved(point.levels, thickness[best, cells])


def _with_sure_cells(point: Point, rounds: int = 4) -> Point:
    """Every cell where the surer half of those about it would have it, if it is likelier there.

    A cell that began half an order off sits in a minimum that is no whole order from the right one, at a place where
    it may be as sure of itself as any other.
    """
    own = point.moved(point.levels, np.clip(_by_neighbours(point), *point.problem.forward.range_um))
    for _ in range(rounds):
        own = own.moved(own.levels, own.thickness_um + np.clip(own.wanted_um, -MOST_STEP_UM, MOST_STEP_UM))
    better = own.cell_evidence > point.cell_evidence
    elsewhere = np.abs(own.thickness_um - point.thickness_um) > MOST_STEP_UM  # not the same minimum again
    if not (better & elsewhere).any():
        return point
    return point.moved(point.levels, np.where(better & elsewhere, own.thickness_um, point.thickness_um))


def _by_neighbours(point: Point) -> FloatArray:
    """Median of where the cells about every cell would have its thickness by their slope, each as sure as it is [µm].

    A cell about which there are no others with data stays.
    """
    forward = point.problem.forward
    shape = forward.geometry.sample_shape
    field, down, along = (
        np.pad(part.reshape(shape), 1, mode="edge") for part in (point.thickness_um, *forward.shape.gradient)
    )
    sure = np.where(point.problem.data.seen, point.thickness_sigma_um**-2.0, 0.0).reshape(shape)
    wanted, weight = [], []
    for y, x in itertools.product((-1, 0, 1), repeat=2):
        if y or x:
            there = (slice(1 + y, 1 + y + shape[0]), slice(1 + x, 1 + x + shape[1]))
            wanted.append(field[there] - forward.shape.cell_px * (y * down[there] + x * along[there]))
            weight.append(np.pad(sure, 1)[there])
    order = np.argsort(wanted, axis=0)
    values, summed = (np.take_along_axis(np.stack(each), order, axis=0) for each in (wanted, weight))
    summed = np.cumsum(summed, axis=0)
    middle = (summed < 0.5 * summed[-1]).sum(axis=0)
    found = np.take_along_axis(values, middle[np.newaxis], axis=0)[0]
    return np.where(summed[-1] > 0.0, found, point.thickness_um.reshape(shape)).ravel()


def _typical_um(point: Point, moved_um: FloatArray) -> float:
    """Median distance that cells with data are moved [µm]."""
    return float(np.median(np.abs(moved_um[point.problem.data.seen])))


def fit(
    effects: Sequence[str],
    items: Sequence[Coordinate],
    start: Point,
    *,
    rounds: int = 12,
    aim: float = math.inf,
    tolerance: float = LEAST_GAIN,
) -> Hypothesis:
    """The best parameters, levels and thickness from a start, by steps that lower the cost.

    Parts may go back to the first thickness: on the way from other effects some are left in other minima. ``aim``:
    cost that others have reached; a fit that is far behind ends when its steps are short beside what it lacks, and
    any fit when a step gains less than ``tolerance``.
    """
    point = _walked(items, _started(items, start), rounds, aim, tolerance)
    back = _gone_back(point)
    if point.cost - back.cost > _tolerance(back, aim, tolerance):
        point = _walked(items, back, rounds, aim, tolerance)
    for start in in_open_orders(point):
        other = _walked(items, start, rounds, min(aim, point.cost), tolerance)
        point = min(point, other, key=lambda one: _target(one, items))
    return _hypothesis(effects, items, point)


def in_open_orders(point: Point) -> list[Point]:
    """The point with all cells in each of the other fringe orders that are open, as far as the tables reach."""
    forward, found = point.problem.forward, []
    low, high = forward.range_um
    for turn in range(-point.problem.orders, point.problem.orders + 1):
        thickness = point.thickness_um + turn * forward.order_um
        if turn and low < thickness.min() and thickness.max() < high:
            found.append(relaxed(point.moved(point.levels, thickness)))
    return found


def _gone_back(point: Point, rounds: int = 4) -> Point:
    """The thickness at the best to which the first one leads, where cells and their neighbours are likelier there.

    A cell alone would follow its noise to another order.
    """
    own = point.moved(point.levels, point.problem.thickness_um)
    for _ in range(rounds):
        own = own.moved(own.levels, own.thickness_um + np.clip(own.wanted_um, -MOST_STEP_UM, MOST_STEP_UM))
    gained = (point.cell_energy - own.cell_energy).reshape(point.problem.forward.geometry.sample_shape)
    better = uniform_filter(gained, PART_BACK, mode="constant").ravel() > 0.0
    return point.moved(point.levels, np.where(better, own.thickness_um, point.thickness_um))


def _tolerance(point: Point, aim: float, least: float) -> float:
    """Gain of a step with which a fit ends."""
    return max(least, LEAST_PART * (point.cost - aim))


def _walked(items: Sequence[Coordinate], point: Point, rounds: int, aim: float, least: float) -> Point:
    """The same without going back."""
    for _ in range(rounds):
        columns = free_columns(point, items)
        step = _step(point, items, columns, point.information(columns, columns))
        new = _best_of_parts(point, items, step, point.followed_um(step, columns))
        if new is None:
            break
        gain, point = _target(point, items) - _target(new, items), new
        if gain < _tolerance(point, aim, least):
            break
    return point


def _started(items: Sequence[Coordinate], start: Point) -> Point:
    """The start with a value for every parameter, none of them where nothing leads away from."""
    settings = {item.key: start.settings.get(item.key, item.null) for item in items}
    if settings == start.settings:
        return start
    return start.moved(start.levels, start.thickness_um, settings)


def _target(point: Point, items: Sequence[Coordinate]) -> float:
    ridge = sum(
        ((point.settings[i.key] - i.null) / (RIDGE_SCALES * i.scale)) ** 2 for i in items if not i.place
    )
    return point.cost + 0.5 * float(ridge)


def _step(point: Point, items: Sequence[Coordinate], columns: Columns, information: FloatArray) -> FloatArray:
    """Gauss-Newton step of levels and parameters; those at a bound that want to leave it stay."""
    waves = point.problem.free_levels
    gradient = point.score(columns) - columns.log_det
    matrix = information.copy()
    for row, item in enumerate(items, start=waves):
        precision = 0.0 if item.place else (RIDGE_SCALES * item.scale) ** -2.0
        # A place at which nothing is may be anywhere.
        nowhere = (item.high - item.low) ** -2.0 if item.place else 0.0
        matrix[row, row] += precision + nowhere + 1e-12 * information[row, row]
        gradient[row] -= precision * (point.settings[item.key] - item.null)
    step: FloatArray = np.asarray(np.linalg.solve(matrix, gradient))
    free = np.ones(len(gradient), dtype=bool)
    for row, item in enumerate(items, start=waves):
        value = point.settings[item.key]
        free[row] = not (value <= item.low and step[row] < 0.0) and not (
            value >= item.high and step[row] > 0.0
        )
    if not free.all():
        step = np.zeros(len(gradient))
        step[free] = np.linalg.solve(matrix[np.ix_(free, free)], gradient[free])
    return step


def _best_of_parts(
    point: Point, items: Sequence[Coordinate], step: FloatArray, moved_um: FloatArray
) -> Point | None:
    """The point of the longest part of a step that is better, or nothing."""
    waves, now = point.problem.free_levels, _target(point, items)
    longest = min(1.0, STRIDE_UM / max(_typical_um(point, moved_um), 1e-12))
    moved_um = np.clip(moved_um, -MOST_STEP_UM / longest, MOST_STEP_UM / longest)
    for part in longest * np.array(SHRINK):
        settings = {
            item.key: item.clipped(point.settings[item.key] + part * change)
            for item, change in zip(items, step[waves:], strict=True)
        }
        try:
            new = point.moved(point.levels_after(part * step), point.thickness_um + part * moved_um, settings)
        except OutOfRangeError:  # no layer is thinner than nothing
            continue
        if not math.isfinite(new.cost):
            continue
        if _target(new, items) >= now:
            new = relaxed(new, rounds=1)
        if _target(new, items) < now:
            return new
    return None


def _hypothesis(effects: Sequence[str], items: Sequence[Coordinate], point: Point) -> Hypothesis:
    """The log evidence of a fit: levels and parameters leave as a Gaussian."""
    waves, columns = point.problem.free_levels, free_columns(point, items)
    information = point.information(columns, columns)
    levels = information[:waves, :waves]
    across = information[:waves, waves:]
    own = information[waves:, waves:] - across.T @ np.linalg.solve(levels, across)
    own = np.asarray(0.5 * (own + own.T), dtype=float)
    values = np.array([point.settings[item.key] for item in items])
    evidence = -point.cost - 0.5 * float(np.linalg.slogdet(levels)[1])
    evidence += log_evidence_of_parameters(items, values, own)
    covariance = np.zeros((len(items), len(items)))
    if items:
        covariance[:] = np.linalg.pinv(own, hermitian=True)
    return Hypothesis(tuple(effects), tuple(items), point, evidence, covariance)
