"""What effects promise where few data do not tell the fringe order: in each that is open, not only where a fit is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...errors import OutOfRangeError
from ..inference import Coordinate, Hypothesis, Point, free_columns, jumped
from .scores import Scored, Scorer


def scorer_at(point: Point, base: Hypothesis, sizes: Sequence[float], beside: Point | None = None) -> Scorer:
    """Scores beside a set at a point; ``sizes``: see `SearchOptions`, ``beside``: see `Scorer`."""
    return Scorer(point, free_columns(point, base.items), sizes, beside)


def best_of_orders(
    here: Scored | None,
    elsewhere: Sequence[Scorer],
    name: str,
    items: tuple[Coordinate, ...],
    base: Hypothesis,
) -> Scored | None:
    """The score of an effect beside a set, or that in another fringe order if it promises more in spite of that.

    ``here``: where the set is. ``elsewhere``: scores of the same set in other orders, in which it is farther from the
    data.
    """
    best = here
    for scorer in elsewhere:
        own = scorer.score(name, items)
        if own is None:
            continue
        gain = own.gain - (scorer.point.cost - base.point.cost)
        if best is None or gain > best.gain:
            try:
                values = [item.null + step for item, step in zip(items, own.step, strict=True)]
                best = replace(own, gain=gain, start=jumped(scorer.point, items, values))
            except OutOfRangeError:  # no layer is thinner than nothing
                continue
    return best
