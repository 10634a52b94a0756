"""How often the forward model is asked: the cost of a search that does not depend on the machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

__all__ = ["EvaluationCount", "count_evaluations", "note_evaluation"]


@dataclass
class EvaluationCount:
    """Evaluations of the forward model: all cells at one set of effects and one thickness field."""

    number: int = 0


_counting: ContextVar[EvaluationCount | None] = ContextVar("_counting", default=None)


@contextmanager
def count_evaluations() -> Iterator[EvaluationCount]:
    """Count the evaluations inside the block."""
    count = EvaluationCount()
    token = _counting.set(count)
    try:
        yield count
    finally:
        _counting.reset(token)


def note_evaluation() -> None:
    """Called by a forward model at every evaluation."""
    count = _counting.get()
    if count is not None:
        count.number += 1
