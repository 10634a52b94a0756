"""Where an island lies: places and sizes about those of a fit, by the cells about it alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import binary_dilation

from ...array_types import BoolArray
from ...effects import Effect
from ...errors import OutOfRangeError
from ..inference import Coordinate, Hypothesis, Point, in_best_orders
from .window import Window

STRIDES = 1.0, 0.5, 0.25
"""Parts of a stride, one after the other: half a cell of a place, of a size a twelfth of what it repeats after."""

SIZES_PER_REPETITION = 12.0
REACH = 3  # Cells about an island that a move may cover
ROUNDS = 2  # Steps of the thickness after which places of an island are compared


def covered(
    effect: Effect, items: tuple[Coordinate, ...], settings: dict[str, float], point: Point
) -> BoolArray:
    """Cells ``(N,)`` in which a local effect is."""
    values = {item.parameter: settings[item.key] for item in items}
    return np.asarray(effect.coverage(values, point.problem.forward.geometry).ravel() > 0.0)


def in_best_place(
    effect: Effect, items: tuple[Coordinate, ...], found: Hypothesis, fitted: Callable[[Point], Hypothesis]
) -> Hypothesis:
    """A fit with a local effect, fitted again from better places as long as that helps; ``items``: of the effect."""
    while (start := moved_island(effect, items, found.point)) is not None:
        new = fitted(start)
        if new.log_evidence <= found.log_evidence:
            break
        found = new
    return found


def moved_island(effect: Effect, items: tuple[Coordinate, ...], point: Point) -> Point | None:
    """A better place and size of an island about those of a fit, with the thickness that goes with it, or nothing.

    The thickness on an island may lie anywhere within an order, so that a fit, which goes downhill, ends beside the
    place where it began. One parameter after the other is moved, in strides that become shorter.
    """
    own = covered(effect, items, point.settings, point)
    if not own.any():
        return None
    shape = point.problem.forward.geometry.sample_shape
    about = np.asarray(binary_dilation(own.reshape(shape), iterations=REACH)).ravel()
    window = Window.about(point, about)
    first = best = window.point
    cell_px = point.problem.forward.shape.cell_px
    for part in STRIDES:
        tried = True
        while tried:
            tried = False
            for item in items:
                whole = 0.5 * cell_px if item.place else (item.repeat or item.scale) / SIZES_PER_REPETITION
                for sign in (1.0, -1.0):
                    value = item.clipped(best.settings[item.key] + sign * part * whole)
                    other = _at(effect, items, best, {item.key: value}, own[window.inside])
                    if other is not None and other.cost < best.cost:
                        best, tried = other, True
                        break
    return None if best is first else window.joined(in_best_orders(best, about[window.inside]))


def _at(
    effect: Effect, items: tuple[Coordinate, ...], point: Point, change: dict[str, float], before: BoolArray
) -> Point | None:
    """The point with other values, the thickness on the island and where it was sought anew."""
    settings = {**point.settings, **change}
    if settings == point.settings:
        return None
    where = before | covered(effect, items, settings, point)
    try:
        return in_best_orders(point.moved(point.levels, point.thickness_um, settings), where, rounds=ROUNDS)
    except OutOfRangeError:
        return None
