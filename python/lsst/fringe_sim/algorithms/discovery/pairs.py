"""Pairs of effects that may stand in the place of one of many parameters."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...array_types import FloatArray
from ...errors import InputError
from .fit import Fit, FullColumns
from .selection import Hypothesis, Selector, bounded_minimum


@dataclass(frozen=True, eq=False)
class PairCandidate:
    """Score test of two effects together against a fit that lacks both."""

    names: tuple[str, str]
    starts: tuple[FloatArray, FloatArray]  # coordinates of each from which a fit should start
    gain: float  # expected fall of χ² if both are added


def likely_pairs(selector: Selector, fit: Fit, names: Sequence[str]) -> list[PairCandidate]:
    """Score test of every pair of effects with few parameters, most promising first.

    Neither of two effects that share what one of many parameters explains need be likely by itself. Derivatives at
    the fit are all that is used: what is far from linear, an effect of many parameters does not explain either.

    ``names``: effects of which pairs are made; what has many parameters, or a place that is not known, is left
    out.
    """
    state = selector.state(fit)
    columns: dict[str, FloatArray] = {}
    for name in names:
        if selector.has_many(name) or selector.is_sought(name) or selector.problem.forward.is_island(name):
            continue
        try:
            columns[name] = selector.features(state, fit, name)
        except InputError:  # it does not go with those of the fit
            continue
    if len(columns) < 2:
        return []
    score, information = state.design.project(
        FullColumns(np.concatenate(list(columns.values()))), state.residual
    )
    ends = np.cumsum([len(own) for own in columns.values()])
    place = {name: np.arange(end - len(columns[name]), end) for name, end in zip(columns, ends, strict=True)}
    found = []
    for pair in itertools.combinations(columns, 2):
        both = np.concatenate([place[name] for name in pair])
        coordinates = [item for name in pair for item in selector.coordinates[name]]
        start, gain, _ = bounded_minimum(score[both], information[np.ix_(both, both)], coordinates)
        first = len(place[pair[0]])
        found.append(PairCandidate(pair, (start[:first], start[first:]), gain))
    return sorted(found, key=lambda item: -item.gain)


def fitted_pair(selector: Selector, rest: Hypothesis, pair: PairCandidate) -> Hypothesis:
    """A set with both effects of a pair besides, fitted from where the pair promises most."""
    (first, second), (at_first, at_second) = pair.names, pair.starts
    one = selector.hypothesis((*rest.names, first), at_first, rest.fit)
    return selector.hypothesis((*one.names, second), at_second, one.fit)
