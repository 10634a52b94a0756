"""Where fits of a set with further effects begin."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ...array_types import FloatArray
from ...errors import OutOfRangeError
from ..inference import Coordinate, Hypothesis, Point, jumped

PARTS = 1.0, 0.3
"""Parts of a linear step of several parameters from which they are fitted: the whole may lead too far."""


def best_start(base: Hypothesis, items: tuple[Coordinate, ...], tried: Sequence[FloatArray]) -> Point | None:
    """The best of other values that is better than none, or nothing."""
    best = None
    for values in tried:
        try:
            start = jumped(base.point, items, list(values))
        except OutOfRangeError:  # no layer is thinner than nothing
            continue
        if start.cost < (base.point if best is None else best).cost:
            best = start
    return best


def linear_start(base: Hypothesis, items: tuple[Coordinate, ...], step: FloatArray) -> Point | None:
    """Where a linear step of parameters from null leads, or nothing if that is not better."""
    parts = PARTS[:1] if len(items) == 1 else PARTS
    null = np.array([item.null for item in items])
    return best_start(base, items, [null + part * step for part in parts])


def fitted_elsewhere(
    base: Hypothesis,
    found: Hypothesis,
    item: Coordinate,
    fitted: Callable[[Point], Hypothesis],
    sizes: Sequence[float],
    turns: int,
) -> Hypothesis:
    """The fit of an effect of one parameter, or the better one from elsewhere.

    ``sizes``: departures from null that are tried, in prior scales. ``turns``: repeats by which the fit goes on, as
    long as each brings more.
    """
    sides = (item.side,) if item.side else (1.0, -1.0)
    tried = [np.array([item.null + side * size * item.scale]) for side in sides for size in sizes]
    for _ in range(turns if item.repeat else 1):
        if item.repeat:
            value = found.point.settings[item.key]
            tried += [np.array([value + turn * item.repeat]) for turn in (-1.0, 1.0)]
        other = best_start(base, (item,), tried)
        new = found if other is None else fitted(other)
        if new.log_evidence <= found.log_evidence:
            break
        found, tried = new, []
    return found


def without_keys(point: Point, keys: set[str]) -> Point:
    """A point without some settings."""
    settings = {key: value for key, value in point.settings.items() if key not in keys}
    return point.moved(point.levels, point.thickness_um, settings)
