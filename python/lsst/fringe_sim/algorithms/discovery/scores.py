"""What effects promise beside a set, before any is fitted: by derivatives, secants, or what they propose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...array_types import BoolArray, FloatArray
from ...effects import Effect, Residuals
from ...errors import OutOfRangeError
from ..inference import (
    Columns,
    Coordinate,
    Hypothesis,
    Point,
    effect_columns,
    in_best_orders,
    jumped,
    kept,
    solved,
)
from ..inference.coordinates import SECANT
from .island_places import ROUNDS, covered
from .options import SearchOptions
from .pairs import FEW, Joint, Promised
from .smooth import beside_smooth
from .window import Window

WIDTHS = np.geomspace(0.03, 30.0, 13)
"""Widths of the prior, in its scales, over which a score is the best: departures may be of any size."""


@dataclass(frozen=True, eq=False)
class Scored:
    """An effect that could be added, by one derivative."""

    name: str
    gain: float  # of log evidence
    degrees: int
    step: FloatArray  # linear step of its parameters from null
    signature: FloatArray  # (W * N,): what that step does beside all that is free, of unit length
    start: Point | None = None  # what the effect itself proposes
    fall: float = 0.0  # of χ² by that step; 0 where it would rise


class Scorer:
    """Scores of effects beside what is free at a point.

    ``beside``: the point to which effects are added, by default the same one. What they bring counts from there.
    """

    def __init__(
        self, point: Point, columns: Columns, sizes: Sequence[float], beside: Point | None = None
    ) -> None:
        self.point, self.columns, self.sizes = point, columns, sizes
        self.base = point.information(columns, columns)
        self.gradient = point.score(columns) - columns.log_det
        self.single: dict[str, Promised] = {}
        self.behind = 0.0 if beside is None or beside is point else self._behind(beside)

    def _behind(self, beside: Point) -> float:
        """Log likelihood that a thickness which was led away from its map costs, at the best of the linear model."""
        free = 0.5 * float(self.gradient @ solved(self.base, self.gradient))
        return max(self.point.linear_cost - free - beside.linear_cost, 0.0)

    def joint(self) -> Joint:
        """What the effects that were scored say of each other."""
        return Joint.of(self.point, self.columns, self.single, self.behind)

    def score(self, name: str, items: tuple[Coordinate, ...]) -> Scored | None:
        """What an effect promises by its derivatives; by the best of several secants where they may vanish."""
        every = [self._with_secant(name, items, SECANT)]
        if len(items) == 1 and items[0].side and not items[0].step:
            every = [self._with_secant(name, items, size) for size in self.sizes]
        elif len(items) == 1 and items[0].repeat:
            every += [self._with_secant(name, far, SECANT) for far in self._repeated(items[0])]
        return max((one for one in every if one is not None), key=lambda one: one.gain, default=None)

    def _repeated(self, item: Coordinate) -> list[tuple[Coordinate]]:
        """A parameter by secants over whole repeats, which see what does not repeat."""
        turns = {max(round(size * item.scale / item.repeat), 1) for size in self.sizes}
        return [(replace(item, step=turn * item.repeat),) for turn in sorted(turns)]

    def _with_secant(self, name: str, items: tuple[Coordinate, ...], secant: float) -> Scored | None:
        try:
            own = effect_columns(self.point, items, secant)
        except OutOfRangeError:
            return None
        across = solved(self.base, self.point.information(self.columns, own))
        matrix = self.point.information(own, own) - self.point.information(own, self.columns) @ across
        gradient = self.point.score(own) - own.log_det - across.T @ self.gradient
        scale = np.array([item.scale for item in items])
        if len(items) <= FEW and secant == SECANT:
            self.single.setdefault(name, Promised(items, own, across, gradient))
        best, step, degrees = -math.inf, np.zeros(len(items)), 0
        for highest in sorted({item.refinement for item in items}):
            few = np.array([item.refinement <= highest for item in items])
            gain, part = best_gain(matrix[np.ix_(few, few)], gradient[few], scale[few])
            if gain > best:
                best, step = gain, np.zeros(len(items))
                step[few] = part
                degrees = int(few.sum())
        best -= self.behind
        if len(items) == 1 and items[0].side * step[0] < 0.0:
            best, step = -1.0, -step
        signature = own.combined(step) - self.columns.combined(across @ step)
        flat = self.point.projected(signature).ravel()
        fall = 2.0 * float(gradient @ step) - float(step @ matrix @ step) - 2.0 * self.behind
        unit = flat / max(float(np.linalg.norm(flat)), 1e-300)
        return Scored(name, best, degrees, step, unit, fall=max(fall, 0.0))


def grouped(scored: Sequence[Scored], options: SearchOptions) -> list[list[Scored]]:
    """Twins together, the best first."""
    groups: list[list[Scored]] = []
    for one in scored:
        if one.gain <= 0.0 and len(groups) >= options.fewest_refits:
            break
        for group in groups:
            if abs(float(group[0].signature @ one.signature)) > options.twin_cosine:
                group.append(one)
                break
        else:
            groups.append([one])
    return groups


def best_gain(matrix: FloatArray, gradient: FloatArray, scale: FloatArray) -> tuple[float, FloatArray]:
    """Largest gain of log evidence over the width of the prior, and its step."""
    best, step = -math.inf, scale * 0.0
    for width in WIDTHS:
        prior = np.diag((width * scale) ** -2.0)
        part = np.linalg.solve(matrix + prior, gradient)
        inflated = np.eye(len(scale)) + matrix * (width * scale) ** 2
        gain = 0.5 * float(gradient @ part) - 0.5 * float(np.linalg.slogdet(inflated)[1])
        if gain > best:
            best, step = gain, np.asarray(part, dtype=float)
    return best, step


@kept(2)
def residuals_of(point: Point) -> Residuals:
    """What a point leaves of the data, and of the thickness beside a smooth one."""
    geometry = point.problem.forward.geometry
    shape = (len(point.levels), *geometry.sample_shape)
    left = (point.problem.data.value - point.value * point.levels[:, np.newaxis]).reshape(shape)
    weight = point.problem.data.weight.reshape(shape)
    return Residuals(np.where(weight > 0.0, left, 0.0), weight, geometry, *beside_smooth(point))


def proposed(effect: Effect, items: tuple[Coordinate, ...], base: Hypothesis) -> Scored | None:
    """What an effect that is sought proposes itself, or nothing."""
    point = base.point
    values = effect.propose(residuals_of(point))
    best = _best_island(effect, items, values, point) if effect.local else _best_of(items, values, point)
    if best is None:
        return None
    step = np.array([best.settings[item.key] - item.null for item in items])
    change = point.projected(best.whitened(best.value) - point.whitened(point.value)).ravel()
    unit = change / max(float(np.linalg.norm(change)), 1e-300)
    gain = point.cost - best.cost
    return Scored(effect.name, gain, len(items), step, unit, best, max(2.0 * gain, 0.0))


def _best_of(
    items: tuple[Coordinate, ...], proposals: Sequence[dict[str, float]], point: Point
) -> Point | None:
    """The best proposal, with the thickness that goes with it."""
    best = None
    for values in proposals:
        try:
            start = jumped(point, items, [values[item.parameter] for item in items])
        except OutOfRangeError:
            continue
        if best is None or start.cost < best.cost:
            best = start
    return best


def _best_island(
    effect: Effect, items: tuple[Coordinate, ...], proposals: Sequence[dict[str, float]], point: Point
) -> Point | None:
    """The same of a local effect: the thickness on an island may lie anywhere within an order.

    No cell beyond it changes, so that only those about it are compared.
    """
    windows: dict[bytes, Window] = {}
    best: tuple[float, Window, Point, BoolArray] | None = None
    for values in proposals:
        settings = {**point.settings, **{item.key: item.clipped(values[item.parameter]) for item in items}}
        on = covered(effect, items, settings, point)
        if not on.any():
            continue
        window = windows.setdefault(on.tobytes(), Window.about(point, on))
        part, where = window.point, on[window.inside]
        try:
            start = in_best_orders(part.moved(part.levels, part.thickness_um, settings), where, rounds=ROUNDS)
        except OutOfRangeError:
            continue
        gain = part.cost - start.cost
        if best is None or gain > best[0]:
            best = gain, window, start, where
    return None if best is None else best[1].joined(in_best_orders(best[2], best[3]))
