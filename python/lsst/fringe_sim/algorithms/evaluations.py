"""How often the forward model is asked, which is the cost of a search on any machine, and until when it may be."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


class OutOfTimeError(Exception):
    """The time that a caller gave is over."""


@dataclass
class EvaluationCount:
    """Evaluations of the forward model: all cells at one set of effects and one thickness field."""

    number: int = 0


_counting: ContextVar[EvaluationCount | None] = ContextVar("_counting", default=None)
_deadline: ContextVar[float] = ContextVar("_deadline", default=math.inf)


@contextmanager
def count_evaluations() -> Iterator[EvaluationCount]:
    """Count the evaluations inside the block."""
    count = EvaluationCount()
    token = _counting.set(count)
    try:
        yield count
    finally:
        _counting.reset(token)


@contextmanager
def time_limit(until: float) -> Iterator[None]:
    """Let the evaluations inside the block raise `OutOfTimeError` from an instant of `time.monotonic` on [s]."""
    token = _deadline.set(min(until, _deadline.get()))
    try:
        yield
    finally:
        _deadline.reset(token)


def note_evaluation() -> None:
    """Called by a forward model at every evaluation; raises `OutOfTimeError` after the limit."""
    if time.monotonic() > _deadline.get():
        raise OutOfTimeError
    count = _counting.get()
    if count is not None:
        count.number += 1
