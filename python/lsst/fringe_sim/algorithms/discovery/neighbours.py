"""What a cause outside the catalogue is like: effects that no correction replaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

Found = TypeVar("Found")


def not_replaced(
    found: Found,
    smaller: Callable[[Found], Sequence[Found]],
    evidence: Callable[[Found], float],
    least: float,
) -> Found:
    """The part of a set of effects that is not the cause, and which no correction can replace.

    Without each of its effects, the others with the best correction beside them have less log evidence.

    ``smaller``: the sets without one effect each; none of the empty set. ``evidence``: log evidence of a set with the
    best correction beside it. ``least``: log evidence that an effect must bring.
    """
    sets = smaller(found)
    reached = evidence(found) if sets else 0.0
    while sets:
        left, best = max(((evidence(one), one) for one in sets), key=lambda pair: pair[0])
        if left < reached - least:
            break
        found, reached = best, left
        sets = smaller(found)
    return found
