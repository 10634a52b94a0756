"""What two effects promise together beside a set that lacks both, before any is fitted."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...inference import Columns, Point

__all__ = ["FEW", "Promised", "ScoredPair", "best_pairs"]

FloatArray = NDArray[np.float64]

FEW = 2
"""Parameters of an effect up to which it is scored with another one: more of them explain what many others do."""


@dataclass(frozen=True, eq=False)
class Promised:
    """One effect beside what is free at a point: its columns, and its score with all that is free projected out."""

    columns: Columns
    across: FloatArray  # (D, K): what the columns that are free make of it
    gradient: FloatArray  # (K,)
    scale: FloatArray  # (K,): of the priors
    side: FloatArray  # (K,): 1 or -1 where a parameter can depart to one side only, else 0


@dataclass(frozen=True, eq=False)
class ScoredPair:
    """Two effects that could be added together."""

    names: tuple[str, str]
    gain: float  # of log evidence
    step: FloatArray  # linear step of the parameters of both from null


def best_pairs(
    point: Point,
    free: Columns,
    single: dict[str, Promised],
    gain_of: Callable[[FloatArray, FloatArray, FloatArray], tuple[float, FloatArray]],
) -> list[ScoredPair]:
    """The pairs that promise more together than the better of both promises alone, best first.

    ``free``: columns that are free. ``single``: effects of few parameters. ``gain_of``: gain and step from
    information, score and scale of the priors.
    """
    if len(single) < 2:
        return []
    ends = np.cumsum([len(one.gradient) for one in single.values()])
    place = {
        name: np.arange(end - len(one.gradient), end)
        for (name, one), end in zip(single.items(), ends, strict=True)
    }
    matrix, gradient = _joint(point, free, list(single.values()))
    scale, side = (
        np.concatenate([getattr(one, what) for one in single.values()]) for what in ("scale", "side")
    )

    def gain(own: NDArray[np.int_]) -> tuple[float, FloatArray]:
        return gain_of(matrix[np.ix_(own, own)], gradient[own], scale[own])

    alone = {name: gain(own)[0] for name, own in place.items()}
    found: list[ScoredPair] = []
    for pair in itertools.combinations(single, 2):
        own = np.concatenate([place[name] for name in pair])
        least = max(0.0, *(alone[name] for name in pair))
        most = 0.5 * float(gradient[own] @ np.linalg.lstsq(matrix[np.ix_(own, own)], gradient[own])[0])
        if most <= least:
            continue
        both, step = gain(own)
        if both > least and (step * side[own] >= 0.0).all():
            found.append(ScoredPair((pair[0], pair[1]), both, step))
    return sorted(found, key=lambda one: -one.gain)


def _joint(point: Point, free: Columns, singles: list[Promised]) -> tuple[FloatArray, FloatArray]:
    """Information ``(K, K)`` and score of the parameters of all effects beside what is free."""
    every = Columns(
        np.concatenate([one.columns.value for one in singles]),
        np.concatenate([one.columns.cells for one in singles]),
        np.concatenate([one.columns.log_det for one in singles]),
    )
    across = np.concatenate([one.across for one in singles], axis=1)
    matrix = point.information(every, every) - point.information(every, free) @ across
    return 0.5 * (matrix + matrix.T), np.concatenate([one.gradient for one in singles])
