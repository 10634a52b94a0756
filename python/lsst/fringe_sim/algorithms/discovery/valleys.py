"""Neighbouring valleys of a parameter whose fringes look nearly the same again after a repeat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...array_types import FloatArray
from ...errors import OutOfRangeError
from ..inference import Coordinate, Hypothesis, Point, free_columns, jumped, solved

REACH, STEPS, REFITTED = 12, 5, 4
"""Repeats on both sides that are looked at, places in each, and how many of them are fitted at most."""

WALKED = 8  # Valleys on each side of a fit that are followed at most


def in_deepest_valleys(found: Hypothesis, fitted: Callable[[Point], Hypothesis]) -> Hypothesis:
    """A set, or the better one in other valleys, as far as each is better than the one before.

    A fit goes downhill in the valley in which it began, which is that of the effects that were there at that time.
    The thickness on an island follows the gap by whole orders, so that islands are left to what moves them.
    ``fitted``: a fit of the set from a point.
    """
    for item in _that_repeat(found):
        new = _deeper(found, item, fitted)
        while new is not found:
            found, new = new, _deeper(new, item, fitted)
    return found


def over_valleys(found: Hypothesis, fitted: Callable[[Point], Hypothesis], behind: float) -> Hypothesis:
    """The set with a covariance over all valleys that the data allow, each by its evidence.

    Where fringes repeat, a parameter may be known to a hundredth of a repeat, and yet not which valley is right.
    ``behind``: log evidence that a valley lacks of the best from which on no farther one is followed.
    """
    every = [found]
    for item in _that_repeat(found):
        for side in (-1.0, 1.0):
            last = found
            for _ in range(WALKED):
                value = last.point.settings[item.key]
                try:
                    new = fitted(jumped(last.point, (item,), [value + side * item.repeat]))
                except OutOfRangeError:
                    break
                if side * (new.point.settings[item.key] - value) < 0.5 * item.repeat:
                    break  # an end of the range, or back in the same valley
                every.append(new)
                last = new
                if found.log_evidence - new.log_evidence > behind:
                    break
    evidence = np.array([one.log_evidence for one in every])
    share = np.exp(evidence - evidence.max())
    away = np.array([one.values - found.values for one in every])
    spread = np.einsum("v,vi,vj->ij", share, away, away) / share.sum()
    return replace(found, covariance=found.covariance + spread)


def _that_repeat(found: Hypothesis) -> list[Coordinate]:
    """Parameters of a set that have neighbouring valleys."""
    forward = found.point.problem.forward
    return [item for item in found.items if item.repeat and not forward.effect_of(item.key).local]


def _deeper(found: Hypothesis, item: Coordinate, fitted: Callable[[Point], Hypothesis]) -> Hypothesis:
    """The best of the valleys within reach that promise more than the set and bring it."""
    value = found.point.settings[item.key]
    steps = np.arange(-REACH * STEPS, REACH * STEPS + 1) * (item.repeat / STEPS)
    places = np.unique(np.clip(value + steps, item.low, item.high))
    gains = _gains(found, item, places)
    elsewhere = np.abs(places - value) > 0.5 * item.repeat
    around = np.pad(gains, 1, constant_values=-np.inf)
    peaks = np.flatnonzero(elsewhere & (gains >= around[:-2]) & (gains >= around[2:]) & (gains > 0.0))
    best = found
    for index in peaks[np.argsort(-gains[peaks])][:REFITTED]:
        if gains[index] <= best.log_evidence - found.log_evidence:
            break
        try:
            new = fitted(jumped(found.point, (item,), [float(places[index])]))
        except OutOfRangeError:  # no layer is thinner than nothing
            continue
        moved = abs(new.point.settings[item.key] - value) > 0.5 * item.repeat
        best = new if moved and new.log_evidence > best.log_evidence else best
    return best


def _gains(found: Hypothesis, item: Coordinate, places: FloatArray) -> FloatArray:
    """Log likelihood that other values of a parameter bring if all else that is free follows in proportion."""
    point = found.point
    free = free_columns(point, [one for one in found.items if one is not item])
    base, score = point.information(free, free), point.score(free)
    gains = np.full(len(places), -np.inf)
    for index, place in enumerate(places):
        try:
            settings = {**point.settings, item.key: float(place)}
            value, _ = point.problem.forward.predict(settings, point.thickness_um)
        except OutOfRangeError:
            continue
        own = point.bare_columns(point.whitened(value - point.value)[np.newaxis])
        across = solved(base, point.information(free, own))
        information = point.information(own, own) - point.information(own, free) @ across
        gains[index] = float((point.score(own) - across.T @ score)[0] - 0.5 * information[0, 0])
    return gains
