"""Effects of a set with their classes, and how probable it is that the cause is in them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..inference import Hypothesis
from .critics import spots_instead
from .outsiders import outsider_probability
from .set_search import SetSearch
from .verdict import NamedEffect, ParameterValue, probability_text


@dataclass(frozen=True, eq=False)
class EffectClass:
    """Effects that explain the data about as well in the place of one."""

    weights: dict[str, float]  # of the effect and of the others, that of the effect is 1
    rivals: dict[str, Hypothesis]  # the best set with another effect in its place

    @property
    def others(self) -> tuple[str, ...]:
        """The others, likeliest first."""
        return tuple(sorted(self.rivals, key=lambda one: -self.weights[one]))

    @property
    def values(self) -> dict[str, dict[str, float]]:
        """Fitted values of the others by parameter."""
        return {
            name: {item.parameter: one.point.settings[item.key] for item in one.items if item.effect == name}
            for name, one in self.rivals.items()
        }


@dataclass(frozen=True, eq=False)
class Naming:
    """Every effect of a set, strongest first, and what is too doubtful to be named."""

    effects: tuple[NamedEffect, ...]
    classes: dict[str, EffectClass]
    doubts: list[str]


def name_effects(sets: SetSearch, best: Hypothesis, explained: float, chance: float) -> Naming:
    """What is said of the effects of the best set.

    ``explained``: χ² that the set takes off the unchanged model. ``chance``: of noise in what it leaves.
    """
    options, pool = sets.options, list(sets.pool.values())
    top = sets.posterior(best)
    weights = np.exp(np.minimum([sets.posterior(one) - top for one in pool], 0.0))
    without = {name: sets.without(best, name) for name in best.effects}
    instead = spots_instead(best, without)
    outsider = outsider_probability(len(best.effects), chance, options.outsider_prior, explained, instead)
    named, doubts, classes = [], [], {}
    for name in best.effects:
        group = classes[name] = _class_of(sets, best, name)
        inside = np.array([bool(set(one.effects) & set(group.weights)) for one in pool])
        probability = float((weights * inside).sum() / weights.sum()) * (1.0 - outsider)
        if probability < options.least_probability:
            doubts.append(f"the class of {name} has probability {probability_text(probability)} only")
        named.append(
            NamedEffect(
                name, _parameters(best, name), probability, group.others, "", 1.0 / sum(group.weights.values()),
                math.sqrt(max(without[name].chi2 - best.chi2, 0.0)),
            )
        )  # fmt: skip
    return Naming(tuple(sorted(named, key=lambda one: -one.significance)), classes, doubts)


def _class_of(sets: SetSearch, best: Hypothesis, name: str) -> EffectClass:
    rest = frozenset(best.effects) - {name}
    weights, rivals = {name: 1.0}, {}
    for names, one in sets.pool.items():
        extra = names - rest - {name}
        if rest < names and len(extra) == 1 and len(names) == len(best.effects):
            behind = best.log_evidence - one.log_evidence
            if behind < sets.options.class_width:
                (other,) = extra
                weights[other], rivals[other] = math.exp(-max(behind, 0.0)), one
    return EffectClass(weights, rivals)


def _parameters(best: Hypothesis, name: str) -> dict[str, ParameterValue]:
    sigma = np.sqrt(np.maximum(np.diag(best.covariance), 0.0))
    return {
        item.parameter: ParameterValue(float(value), float(error), item.unit)
        for item, value, error in zip(best.items, best.values, sigma, strict=True)
        if item.effect == name
    }
