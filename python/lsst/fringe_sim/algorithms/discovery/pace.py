"""How long fits take, and how many are wanted still."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Pace:
    """Times the fits of a search; ``left`` is how many the present round wants at most."""

    def __init__(self) -> None:
        self.left = 0
        self._number, self._spent_s = 0, 0.0

    @contextmanager
    def fit(self) -> Iterator[None]:
        """Around a fit."""
        begun = time.monotonic()
        yield
        self._number += 1
        self._spent_s += time.monotonic() - begun
        self.left = max(self.left - 1, 0)

    @property
    def text(self) -> str:
        """What the round takes still, for people; empty where it has no fit left."""
        if not self.left:
            return ""
        seconds = self.left * self._spent_s / max(self._number, 1)
        return f"; at most {self.left} more in this round, about {seconds:.0f} s"
