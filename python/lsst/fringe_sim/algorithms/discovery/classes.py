"""Effects that explain the same data about as well, and how likely it is that one of them is the cause."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import islice

from .fit import Fit
from .selection import MOST_OF_PROMISE, Hypothesis, Selector, similarity

MIMICKED = 0.05
"""Part of the causes outside the catalogue that effects in it can mimic, however strong they are."""

HIDDEN_CHI2 = 25.0
"""χ² that a residual may hold and still look like noise to tests that share their power among many patterns."""

DECADES_OF_CHANCE, CHI2_PER_DECADE = 200.0, 14.0
"""Powers of ten by which a residual of signal to noise 30 is improbable; and what effects take off χ², of a cause
outside the catalogue, for each power of ten by which what they leave is improbable. It is 17 to 36 where they take
off 500 to 5000, for seven ghost images and stains of other seeds than the recorded ones."""

RIVALS_REFITTED = 3
MUCH_OF_IT = 0.9
"""Best replacements of an effect that are fitted again, and the part of the log evidence that it brings from which on
as many that shift the phase are looked for at other sizes and in other orders."""

LEAST_PROMISE = 4.0
ALIKE = 0.8  # Fall of χ² and cosine of signatures from which on a replacement is fitted

AS_MUCH, AS_MUCH_TRIED = 0.8, 5
"""Part of what an effect brings that others must promise to be fitted however they look, and how many of them: the
signature of a size that goes through many fringes is not the derivative."""

WIDTHS_BEHIND = 3.0
"""How far a rival may be behind in the part of the data that is searched and still be compared in all data."""

CHI2_PER_PARAMETER = 6.0  # Fall of χ² that a further parameter must bring, for a fit to be as good as another


@dataclass(frozen=True)
class EffectClass:
    """Effects any of which may be the one that was found."""

    members: dict[str, float]  # share of each effect among all replacements, by name
    probability: float  # sum of the shares
    values: dict[str, dict[str, float]]  # fitted parameters of each member
    significance: float  # signal to noise of what the effect explains
    best: Hypothesis  # the likeliest set of all, with this effect or with another in its place
    # Every set that was compared with the first, by the effect in this one's place
    rivals: dict[str, Hypothesis]


def classes_of(selector: Selector, chosen: Hypothesis, width: float) -> dict[str, EffectClass]:
    """Class of each effect of a set.

    ``width``: difference in log evidence within which effects are one class.
    """
    return {name: _class_of(selector, chosen, name, width) for name in chosen.names}


def _class_of(selector: Selector, chosen: Hypothesis, name: str, width: float) -> EffectClass:
    rest = tuple(other for other in chosen.names if other != name)
    without = selector.improved(rest, chosen.fit)
    found = {name: chosen, **_replacements(selector, chosen, name, without)}
    _refit_rivals(selector, chosen, without, found, width)
    significance = math.sqrt(max(without.fit.chi2 - chosen.fit.chi2, 0.0))
    return _compared(name, found, width, significance)


def _compared(name: str, found: dict[str, Hypothesis], width: float, significance: float) -> EffectClass:
    """Class of an effect among sets with it and with others in its place."""
    chosen, best = found[name], max(found.values(), key=lambda other: other.log_evidence)
    top = best.log_evidence
    weight = {n: math.exp(max(other.log_evidence - top, -700.0)) for n, other in found.items()}
    total = sum(weight.values())
    members = {
        n: weight[n] / total
        for n, other in found.items()
        if n == name or _is_alike(other, chosen, top, width)
    }
    values = {n: _values_of(n, found[n].fit) for n in members}
    rivals = {n: other for n, other in found.items() if n != name}
    return EffectClass(members, sum(members.values()), values, significance, best, rivals)


def classes_in_all_data(
    classes: Mapping[str, EffectClass],
    chosen: Hypothesis,
    final: Hypothesis,
    fitted_to_all: Callable[[Hypothesis], Hypothesis],
    width: float,
) -> dict[str, EffectClass]:
    """Classes as all data see them: a rival that the part searched all but excludes may be the likelier one in all.

    ``classes``: classes of the effects in the part that was searched. ``chosen``, ``final``: the set fitted to
    that part, and to all data. ``fitted_to_all``: fits a set to all data, from its fit to the part. ``width``:
    difference in log evidence within which effects are one class.
    """
    least = chosen.log_evidence - WIDTHS_BEHIND * width
    found = {}
    for name, group in classes.items():
        near = {n: fitted_to_all(h) for n, h in group.rivals.items() if h.log_evidence > least}
        found[name] = group
        if near:
            seen = _compared(name, {name: final, **near}, width, group.significance)
            # All data widen a class; that does not make it likelier than the part that chose it does.
            found[name] = replace(seen, probability=min(seen.probability, group.probability))
    return found


def _refit_rivals(
    selector: Selector, chosen: Hypothesis, without: Hypothesis, found: dict[str, Hypothesis], width: float
) -> None:
    """Fit the best replacements again from where the set itself has come: it may have found a deeper valley since.

    Those that shift the phase are looked for at other sizes and in other orders too.
    """
    behind = {
        n: h for n, h in found.items() if h is not chosen and h.log_evidence < chosen.log_evidence - width
    }
    ranked = sorted(behind, key=lambda n: -behind[n].log_evidence)
    brought = chosen.log_evidence - without.log_evidence
    much = (n for n in ranked if behind[n].log_evidence > chosen.log_evidence - (1.0 - MUCH_OF_IT) * brought)
    shifting = list(islice((n for n in much if selector.shifts_phase(behind[n])), RIVALS_REFITTED))
    for name in dict.fromkeys((*ranked[:RIVALS_REFITTED], *shifting)):
        found[name] = selector.improved(behind[name].names, chosen.fit, scan=name in shifting)


def _replacements(
    selector: Selector, chosen: Hypothesis, name: str, without: Hypothesis
) -> dict[str, Hypothesis]:
    """Sets with another effect in the place of one: they were fitted before, look like it, or promise as much."""
    own = selector.features(selector.state(chosen.fit), chosen.fit, name)
    bare = selector.state(without.fit)
    much = AS_MUCH * (without.fit.chi2 - chosen.fit.chi2)
    found = {}
    for number, candidate in enumerate(selector.score(without.fit, selector.others(chosen), scan=True)):
        as_much = number < AS_MUCH_TRIED and candidate.promise > max(much, LEAST_PROMISE)
        alike = 0.0
        if candidate.promise > LEAST_PROMISE:
            features = selector.features(bare, without.fit, candidate.name)
            alike = similarity(bare.design, own, features)
        names = (*without.names, candidate.name)
        if frozenset(names) in selector.fitted or alike > ALIKE or as_much:
            rival = selector.hypothesis(names, candidate.start, without.fit)
            # What was fitted before may be in another order, which promises nothing more here.
            if without.fit.chi2 - rival.fit.chi2 < MOST_OF_PROMISE * candidate.promise:
                rival = selector.improved(names, without.fit)
            found[candidate.name] = rival
    return found


def _is_alike(other: Hypothesis, chosen: Hypothesis, top: float, width: float) -> bool:
    """Whether a replacement explains the data about as well, by evidence or by likelihood.

    The evidence of weak effects leans on the scales of the priors; a fit as good with no more parameters is an
    alternative whatever those are.
    """
    if other.log_evidence > top - width:
        return True
    extra = max(len(other.fit.coordinates) - len(chosen.fit.coordinates), 0)
    return 0.5 * (other.fit.chi2 - chosen.fit.chi2 + CHI2_PER_PARAMETER * extra) < width


def _values_of(name: str, fit: Fit) -> dict[str, float]:
    return {
        key.partition(".")[2]: value for key, value in fit.settings.items() if key.partition(".")[0] == name
    }


def outsider_probability(
    hypothesis: Hypothesis, prior: float, explained: float, spots: float = -math.inf
) -> float:
    """Probability of a cause outside the catalogue, from the chance of noise in what is left.

    An effect of the catalogue leaves noise: any chance is as likely as any other. A cause outside it either is
    mimicked, and leaves noise as well, or leaves a residual whose chance may lie anywhere down to that of a signal to
    noise of 30, or of a third of what is explained, each power of ten as likely as the other. What share of it
    effects cannot mimic may be anything, and is seen if it is not too weak: nearly nothing is known of the cause of a
    signal to noise of 5.

    The more effects a set has, the likelier is one cause outside the catalogue in their place; see
    `outsiders_for_one`.

    ``prior``: probability that a cause is outside the catalogue before the data are seen. ``explained``: χ² that the
    set takes off the unchanged model. ``spots``: log evidence of spots, which no effect is, in the place of an
    effect, over that of the effect.
    """
    number = max(len(hypothesis.names), 1)
    hidden = HIDDEN_CHI2 / max(explained, 1e-300)
    mimicked = min(max(MIMICKED, hidden), 1.0)
    p = min(max(hypothesis.probability_of_noise, 1e-100), 1.0)
    decades = max(DECADES_OF_CHANCE, explained / CHI2_PER_DECADE)
    density = mimicked + (1.0 - mimicked) / (p * math.log(10.0) * decades)
    # Spots stand in the place of one of the effects, with n! / (n - 1)! of the sum.
    instead = outsiders_for_one(number) * density + number * math.exp(min(spots, 100.0))
    odds = prior / (1.0 - prior) * instead
    return odds / (1.0 + odds)


def outsiders_for_one(number: int) -> int:
    """Factor on the prior odds of a cause outside the catalogue against a set of so many effects.

    The number of causes is Poisson distributed with mean 1, so that ``m`` causes have probability ``exp(-1) / m!``.
    That all of them are in the set, and these are ``n`` effects, has ``exp(-1) / n!``. In the place of ``n - k`` of
    the effects there may be one cause outside the catalogue, which explains what they explain: this is one of
    ``k + 1`` causes, any of which may be the one outside, with ``exp(-1) (k + 1) / (k + 1)! = exp(-1) / k!``. The
    sum of these over ``k < n`` over the probability of the set is ``n! Σ 1 / k!``: 1, 4 and 15 for one, two and three
    effects. The odds of one cause inside against outside, and how much of it effects mimic, are the same for every
    ``k`` and stand beside this factor.
    """
    return sum(math.perm(number, replaced) for replaced in range(1, number + 1))
