"""Parameters of effects as a fit moves them, with what is believed of them before the data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ...array_types import FloatArray
from ...effects import Effect
from .forward import Forward

WIDTHS = np.geomspace(1e-3, 30.0, 81)
"""Widths of the distribution of exchangeable parameters, in prior scales, over which the evidence is integrated."""

SECANT, STEP = 0.3, 1e-3
"""Departures from null at which one-sided parameters are differentiated, and steps of others [prior scales]: the
signature of the former may begin with their square."""


@dataclass(frozen=True)
class Coordinate:
    """One parameter of one effect."""

    effect: str
    parameter: str
    null: float
    low: float
    high: float
    scale: float
    unit: str = ""
    repeat: float = 0.0
    place: bool = False
    step: float = 0.0
    refinement: int = 0
    exchangeable: bool = False

    @property
    def key(self) -> str:
        """Name of the setting."""
        return f"{self.effect}.{self.parameter}"

    @property
    def side(self) -> float:
        """1 or -1 where the parameter can depart from null to one side only, else 0."""
        return float(self.null <= self.low) - float(self.null >= self.high)

    def clipped(self, value: float) -> float:
        """The nearest value within the bounds."""
        return float(min(max(value, self.low), self.high))

    def difference(self, value: float, secant: float = SECANT) -> float:
        """Step with which the model is differentiated at a value; at null ``secant`` scales if it is one-sided."""
        step = self.step or STEP * self.scale
        away = abs(value - self.null)
        if self.side and not self.place:
            step = self.side * (secant * self.scale if away < 1e-6 * self.scale else min(step, 0.1 * away))
        return step if self.low <= value + step <= self.high else -step


def coordinates_of(effect: Effect, forward: Forward) -> tuple[Coordinate, ...]:
    """Coordinates of all parameters of an effect that the exposures see.

    Raises `InputError`: the effect cannot be looked for on these samples.
    """
    effect.check_search(forward.geometry)
    nulls, hints = effect.null_values(forward.model.base_system), effect.search
    known = forward.model.effect_settings
    found = []
    for item in effect.seen_parameters(forward.geometry):
        low, high = effect.bounds_on(item, forward.geometry)
        name = item.name
        found.append(
            Coordinate(
                effect.name, name, known.get(f"{effect.name}.{name}", nulls[name]), low, high, item.prior_scale,
                item.unit, hints.repeats_after.get(name, 0.0), name in hints.places, hints.steps.get(name, 0.0),
                hints.refinements.get(name, 0), hints.exchangeable,
            )
        )  # fmt: skip
    return tuple(found)


def log_evidence_of_parameters(
    items: Sequence[Coordinate], values: FloatArray, information: FloatArray
) -> float:
    """What the parameters of a fit add to its log likelihood: Laplace's integral over their priors.

    A parameter has a Cauchy prior of the catalogue's scale; exchangeable ones of an effect are draws from a Gaussian,
    the width of which has a half-Cauchy prior; a place may be anywhere within its bounds. Refinements may be absent:
    the evidence is the mean over their numbers, by the ratio of Savage and Dickey.

    ``information`` (K, K): Fisher matrix at the best ``values``, all else integrated.
    """
    if not items:
        return 0.0
    away = values - [item.null for item in items]
    density = np.array([_log_prior(item, x) for item, x in zip(items, away, strict=True)])
    precision = np.array([_precision(item, x) for item, x in zip(items, away, strict=True)])
    widths, pull = 0.0, np.zeros(len(items))
    for name in sorted({item.effect for item in items if item.exchangeable}):
        group = np.array([index for index, item in enumerate(items) if item.effect == name])
        best, gain = _best_width(information, away, group, items[group[0]].scale)
        precision[group] = best**-2
        density[group] = -0.5 * (away[group] / best) ** 2 - math.log(best) - 0.5 * math.log(2.0 * math.pi)
        pull[group] = precision[group] * away[group]
        widths += gain
    total = information + np.diag(precision)
    volume = 0.5 * len(items) * math.log(2.0 * math.pi) - 0.5 * float(np.linalg.slogdet(total)[1])
    # The prior of exchangeable parameters may draw them far from where they fit best.
    drawn = 0.5 * float(pull @ np.linalg.solve(total, pull))
    refined = _without_refinements(items, away, total, density)
    return float(density.sum()) + volume + drawn + widths + refined


def _log_prior(item: Coordinate, away: float) -> float:
    if item.place:
        return -math.log(item.high - item.low)
    one_sided = math.log(2.0) if item.side else 0.0
    return one_sided - math.log(math.pi * item.scale * (1.0 + (away / item.scale) ** 2))


def _precision(item: Coordinate, away: float) -> float:
    """Of the Gaussian that has the prior's slope."""
    if item.place:
        return (item.high - item.low) ** -2.0
    return 2.0 / (item.scale**2 + away**2)


def _best_width(
    information: FloatArray, away: FloatArray, group: NDArray[np.int_], scale: float
) -> tuple[float, float]:
    """Likeliest width of exchangeable parameters, and what the evidence gains from all others."""
    own = information[np.ix_(group, group)]
    x, unit = away[group], np.eye(len(group))
    curve = np.array([
        -0.5 * float(x @ own @ np.linalg.solve(own + unit / width**2, x / width**2))
        - 0.5 * float(np.linalg.slogdet(unit + width**2 * own)[1])
        for width in scale * WIDTHS
    ])  # fmt: skip
    best = int(np.argmax(curve))
    prior = np.log(2.0 / math.pi * WIDTHS / (1.0 + WIDTHS**2) * np.gradient(np.log(WIDTHS)))
    return float(scale * WIDTHS[best]), float(logsumexp(curve + prior) - curve[best])


def _without_refinements(
    items: Sequence[Coordinate], away: FloatArray, information: FloatArray, density: FloatArray
) -> float:
    """What the mean over the refinements of the effects adds to the evidence with all parameters."""
    covariance = np.linalg.pinv(information, hermitian=True)
    gain = 0.0
    for name in sorted({item.effect for item in items}):
        own = np.array([item.refinement if item.effect == name else -1 for item in items])
        ratios = [0.0]
        for highest in range(int(own.max())):
            absent = np.flatnonzero(own > highest)
            known = np.linalg.pinv(covariance[np.ix_(absent, absent)], hermitian=True)
            after = -0.5 * float(away[absent] @ known @ away[absent])
            after += 0.5 * float(np.linalg.slogdet(known)[1]) - 0.5 * len(absent) * math.log(2.0 * math.pi)
            ratios.append(after - math.fsum(_log_prior(items[int(k)], 0.0) for k in absent))
        gain += float(logsumexp(ratios)) - math.log(len(ratios))
    return gain
