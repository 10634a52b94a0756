"""What two effects promise together beside a set that lacks both, before any is fitted."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...array_types import FloatArray
from ..inference import Columns, Coordinate, Point

FEW = 2
"""Parameters of an effect up to which it is scored with another one: more of them explain what many others do."""


@dataclass(frozen=True, eq=False)
class Promised:
    """One effect beside what is free at a point: its columns, and its score with all that is free projected out."""

    items: tuple[Coordinate, ...]
    columns: Columns
    across: FloatArray  # (D, K): what the columns that are free make of it
    gradient: FloatArray  # (K,)


@dataclass(frozen=True, eq=False)
class ScoredPair:
    """Two effects that could be added together."""

    names: tuple[str, str]
    gain: float  # of log evidence
    step: FloatArray  # linear step of the parameters of both from null

    def is_twin_of(self, other: ScoredPair, signatures: dict[str, FloatArray], least: float) -> bool:
        """Whether it has one effect of another pair, and a twin of the other one, by their cosine."""
        own, its = set(self.names) - set(other.names), set(other.names) - set(self.names)
        if len(own) != 1 or len(its) != 1:
            return False
        (mine,), (theirs,) = own, its
        return abs(float(signatures[mine] @ signatures[theirs])) > least


@dataclass(frozen=True, eq=False)
class Joint:
    """Score and information of all effects of few parameters beside what is free."""

    place: dict[str, NDArray[np.int_]]  # where the parameters of an effect stand
    items: tuple[Coordinate, ...]
    information: FloatArray  # (K, K)
    gradient: FloatArray  # (K,)
    behind: float = 0.0  # log likelihood that the point lacks of the one to which effects are added

    @classmethod
    def of(cls, point: Point, free: Columns, single: dict[str, Promised], behind: float = 0.0) -> Joint:
        """From the effects one by one; ``free``: columns that are free."""
        items = tuple(item for one in single.values() for item in one.items)
        if not items:
            return cls({}, (), np.zeros((0, 0)), np.zeros(0))
        ends = np.cumsum([len(one.items) for one in single.values()])
        place = {
            name: np.arange(end - len(one.items), end)
            for (name, one), end in zip(single.items(), ends, strict=True)
        }
        own = [one.columns for one in single.values()]
        every = Columns(
            np.concatenate([one.value for one in own]),
            np.concatenate([one.cells for one in own]),
            np.concatenate([one.log_det for one in own]),
        )
        across = np.concatenate([one.across for one in single.values()], axis=1)
        matrix = point.information(every, every) - point.information(every, free) @ across
        gradient = np.concatenate([one.gradient for one in single.values()])
        return cls(place, items, 0.5 * (matrix + matrix.T), gradient, behind)

    def best_pairs(
        self,
        gain_of: Callable[[FloatArray, FloatArray, FloatArray], tuple[float, FloatArray]],
        least: float,
        without: Sequence[str] = (),
    ) -> list[ScoredPair]:
        """Pairs that promise more than a least gain together, best first.

        ``gain_of``: gain and step from information, score and scale of the priors. ``without``: effects of which no
        pairs are made.
        """
        found = []
        for pair in itertools.combinations([name for name in self.place if name not in without], 2):
            own = np.concatenate([self.place[name] for name in pair])
            matrix, gradient = self.information[np.ix_(own, own)], self.gradient[own]
            if 0.5 * float(gradient @ np.linalg.lstsq(matrix, gradient)[0]) - self.behind <= least:
                continue
            gain, step = gain_of(matrix, gradient, np.array([self.items[k].scale for k in own]))
            gain -= self.behind
            if gain > least and all(self.items[k].side * x >= 0.0 for k, x in zip(own, step, strict=True)):
                found.append(ScoredPair((pair[0], pair[1]), gain, step))
        return sorted(found, key=lambda one: -one.gain)
