"""Which set of effects: grown, swapped and pruned on the part of the data that is searched."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from .classes import EffectClass, classes_of
from .options import SearchOptions
from .pairs import fitted_pair, likely_pairs
from .selection import IMPRECISION, Candidate, Hypothesis, Selector, chance_of, similarity
from .validation import misfit_rms
from .verdict import Step

SURELY = 1e-7  # Chance of noise below which an effect is added to a set that leaves nothing else to see
WORTH_FITTING = 9.0  # Fall of χ² that an effect must promise to be fitted

MORE_THAN_PROMISED, PROMISE_KEPT = 3.0, 1.5
"""By how much a fit may bring more than its score promised: where all effects are asked whether they can explain what
is left, and beside a set that leaves noise. Of 140 fits to flats with one and two effects the most was 1.18."""

MUCH_LEFT = 0.05  # χ² above that of noise, over the number of values, that is surely no error of the noise

HARDLY_LESS = 0.5
"""Part of that excess which one effect must take off, or further ones promise, for sets of several to be tried."""

MUCH_OF_THE_BEST = 0.3
"""Part of what the best single effect explains that one must which may take narrow fringes away."""

SCANNED_PARENTS = 2
"""Sets, best first, to which effects are added by finite signatures, and not by derivatives at the first alone."""

SHIFTING_EFFECTS = 3
"""Effects that are looked for in other fringe orders, each with the set with which it is likeliest."""

CONTAINED = 0.9
"""Cosine of the signatures from which on an effect may be hidden in another of many parameters."""

MOST_OF_MANY = 0.8
"""Part of what an effect of many parameters brings that two others must promise to be fitted in its place."""


class SetSearch:
    """Looks for the most credible set of effects.

    ``say``: called with a line of text at every fit; ``rescued``: fits a set again from its fit to all data, where
    that leaves noise and the part does not; ``order_open``: whether the fringe order is not known, so that scores
    in one of them say nothing.
    """

    def __init__(
        self,
        selector: Selector,
        options: SearchOptions,
        say: Callable[[str], None],
        rescued: Callable[[Hypothesis], Hypothesis],
        *,
        order_open: bool = False,
    ) -> None:
        self.selector, self.options, self.say, self.rescued = selector, options, say, rescued
        self.order_open = order_open
        self._reached: tuple[Hypothesis, list[Step]] | None = None

    def best_so_far(self) -> tuple[Hypothesis, list[Step]]:
        """The set that was reached, or the likeliest single effect of those that were fitted."""
        if self._reached is not None:
            return self._reached
        singles = self.selector.known(1)
        if not singles or singles[0].log_evidence < self.options.least_evidence:
            return self.selector.null, []
        best = self.selector.with_channels(singles[0])
        return best, [self.step(self.selector.null, best)]

    def refits(self, base: Hypothesis, rival: Hypothesis | None = None) -> list[Hypothesis]:
        """Refits of the best-scored additions to a set, likeliest first; none that cannot come near a rival.

        One that leaves about noise is a rival of those that promise less.
        """
        scores = self.selector.score(base.fit, self.selector.others(base), scan=True)
        goal = rival.fit.chi2 if rival else math.inf
        refitted: list[Hypothesis] = []
        for candidate in scores:
            # A score in the wrong order says nothing.
            if not self.order_open and (
                candidate.promise <= WORTH_FITTING
                or len(refitted) == self.options.refits
                or not _may_reach(goal, base, candidate)
            ):
                continue
            found = self.selector.with_candidate(base, candidate)
            self._say_refit(base, found)
            refitted.append(found)
            if not self._leaves_much(found):
                goal = min(goal, found.fit.chi2)
        return sorted(refitted, key=lambda item: -item.log_evidence)

    def first(self, singles: list[Hypothesis]) -> tuple[Hypothesis, list[Step]]:
        """The most credible single effect, if there is one that helps."""
        if not singles or singles[0].log_evidence < self.options.least_evidence:
            return self.selector.null, []
        best = self._most_credible(singles)
        if not self.options.is_noise(best):
            best = self._most_credible(self._searched_harder(singles))
        elif self.selector.shifts_phase(best):  # few data see only noise in a wrong order too
            best = self.selector.with_channels(
                self.selector.improved(best.names, self.selector.null.fit, scan=True)
            )
        best = self.rescued(best)
        self._reached = best, [self.step(self.selector.null, best)]
        return self._reached

    def to_judge_with(self, singles: list[Hypothesis]) -> Hypothesis:
        """The single effect with which field and noise are judged again.

        Where all leave much, those that shift the phase are looked for in other fringe orders first: what is likely
        in the wrong one would tear the thickness to where it suits.
        """
        if not self._may_be_in_another_order(singles[0]):
            return singles[0]
        elsewhere = (
            self.selector.improved(single.names, self.selector.null.fit, scan=True)
            for single in singles
            if self.selector.shifts_phase(single)
        )
        return max((*singles, *elsewhere), key=lambda item: item.log_evidence)

    def that_may_hide_fringes(self, singles: list[Hypothesis]) -> list[Hypothesis]:
        """Single effects that blur, and explain much though not most, where all leave much."""
        best = singles[0]
        if self.order_open or not self._may_be_in_another_order(best):
            return []
        blurs = [
            self.selector.hypothesis((name,))
            for name in self.selector.coordinates
            if self.selector.effects[name].search.hides_fringes
        ]
        explained = self.selector.null.fit.chi2 - best.fit.chi2
        return [
            blur
            for blur in blurs
            if blur.names != best.names
            and self.selector.null.fit.chi2 - blur.fit.chi2 > MUCH_OF_THE_BEST * explained
        ]

    def _may_be_in_another_order(self, hypothesis: Hypothesis) -> bool:
        """Whether much is left that another thickness may explain, whatever pixels do by themselves."""
        if not self._leaves_much(hypothesis):
            return False
        forward = self.selector.problem.forward
        of_pixels = [
            name
            for name in self.selector.others(hypothesis)
            if forward.is_image_effect(name) and not forward.couples_pixels(name)
        ]
        scores = self.selector.score(hypothesis.fit, of_pixels)
        # A score is no fit: beside a thickness in the wrong order, it may promise all that is left.
        if not scores:
            return True
        names = (*hypothesis.names, scores[0].name)
        return self._leaves_much(self.selector.hypothesis(names, scores[0].start, hypothesis.fit))

    def _leaves_much(self, hypothesis: Hypothesis) -> bool:
        noise = self.selector.problem.cells.n_values
        return hypothesis.fit.chi2 - noise > MUCH_LEFT * noise

    def enlarged(self, current: Hypothesis, steps: list[Step], most: int) -> Hypothesis:
        """Add effects, up to so many, while a residual remains and they help."""
        while steps and not steps[-1].consistent and len(current.names) < most:
            larger = self.one_more(current)
            if larger is None:
                break
            larger = self.rescued(larger)
            steps.append(self.step(current, larger))
            current = larger
            self._reached = current, steps
        return current

    def finished(self, current: Hypothesis, steps: list[Step]) -> Hypothesis:
        """The set with what noise surely does not explain, and without members that bring nothing."""
        if not steps:
            return current
        while self.options.is_noise(current) and len(current.names) < self.options.most_effects:
            better = self._surely_better(current)
            if better is None:
                break
            other = self._other_member(current, steps)
            if other is None:
                steps.append(self.step(current, better))
            current = other or better
        other = self._pair_instead(current)
        if other is not current:
            steps.append(self.step(current, other))
            current = other
        complete = self.selector.with_channels(self._completed(current))
        if complete.names != current.names:
            steps.append(self.step(current, complete))
        return self.pruned(complete)

    def _other_member(self, current: Hypothesis, steps: list[Step]) -> Hypothesis | None:
        """The set with another effect in the place of one, if that is clearly likelier and leaves noise as well.

        What a wrong effect leaves is another form, which two or three more make up for.
        """
        taken = list(steps)
        likelier = self.selector.with_channels(self.classified(current, taken)[0])
        if likelier.names == current.names or not self.options.is_noise(likelier):
            return None
        steps[:] = taken
        return likelier

    def _pair_instead(self, current: Hypothesis) -> Hypothesis:
        """The set with two effects in the place of one of many parameters, where they are likelier and leave noise.

        Errors of all wavelengths take in what an absorbing silicon and a wider line do together, neither of which is
        likely by itself.
        """
        best = current
        if not self.options.is_noise(current) or len(current.names) >= self.options.most_effects:
            return best
        for name in filter(self.selector.has_many, current.names):
            left = tuple(other for other in current.names if other != name)
            rest = self.selector.improved(left, current.fit) if left else self.selector.null
            least = MOST_OF_MANY * (rest.fit.chi2 - current.fit.chi2)
            pairs = likely_pairs(self.selector, rest.fit, self.selector.others(current))
            worth = [pair for pair in pairs if pair.gain > max(least, WORTH_FITTING)]
            for pair in worth[: self.options.refits]:
                found = fitted_pair(self.selector, rest, pair)
                self._say_refit(rest, found)
                likelier = found.log_evidence > best.log_evidence + self.options.least_evidence
                if likelier and self.options.is_noise(self.selector.with_channels(found)):
                    best = self.selector.with_channels(found)
        return best

    def one_more(self, current: Hypothesis) -> Hypothesis | None:
        """The most credible set with one effect more, if it is likelier."""
        larger = self._larger_sets(current)
        if not larger:
            return None
        best = self._most_credible(larger)
        if not self.options.is_noise(best) and (
            not self._leaves_much(best) or self._may_be_in_another_order(best)
        ):
            best = self._most_credible(self._in_other_orders(larger))
        if best.log_evidence < current.log_evidence + self.options.least_evidence:
            return None
        return best if self.options.is_noise(best) else self._swapped(best)

    def _surely_better(self, current: Hypothesis) -> Hypothesis | None:
        """The set with one effect more that no noise explains, though the tests without a catalogue see only noise.

        Those tests share their power among many patterns; one effect has a single one. What it brings may be no more
        than what is wrong with the form of the others: then nothing else may be left, though nothing is allowed for
        that.
        """
        wrong = IMPRECISION**2 * self._explained_by_guesses(current)
        worth = [
            candidate
            for candidate in self.selector.score(current.fit, self.selector.others(current))
            if _surely_gains(self.selector, candidate)
        ]
        found = []
        for candidate in worth[: self.options.parents]:
            larger = self.selector.hypothesis((*current.names, candidate.name), candidate.start, current.fit)
            self._say_refit(current, larger)
            if _surely_gains(self.selector, candidate, wrong) or self._is_all(larger):
                found.append(larger)
        best = max(found, key=lambda item: item.log_evidence, default=None)
        if best is None or best.log_evidence < current.log_evidence + self.options.least_evidence:
            return None
        return self.selector.with_channels(best)

    def _is_all(self, hypothesis: Hypothesis) -> bool:
        """Whether a set leaves noise though the form of its effects is taken for exact."""
        return self.options.is_noise(self.taken_for_exact(hypothesis))

    def taken_for_exact(self, hypothesis: Hypothesis) -> Hypothesis:
        """The set tested with nothing allowed for what the form of its effects may lack."""
        return replace(hypothesis, channels=self.selector.criticise(hypothesis.fit, imprecision=0.0))

    def _explained_by_guesses(self, current: Hypothesis) -> float:
        """χ² that the effects of a set explain whose form may be wrong."""
        exact = tuple(name for name in current.names if self.selector.effects[name].search.exact)
        if exact == current.names:
            return 0.0
        without = self.selector.hypothesis(exact, None, current.fit) if exact else self.selector.null
        return max(without.fit.chi2 - current.fit.chi2, 0.0)

    def _completed(self, current: Hypothesis) -> Hypothesis:
        """The set with an effect beside one of many parameters that can play its part, where that is likelier.

        Sixteen offsets of the amplifiers take in a pedestal, and the residual is noise without it; that all of them
        lie far on one side of zero is likelier with both.
        """
        best = current
        if len(current.names) >= self.options.most_effects:
            return best
        for name in current.names:
            if (
                not self.selector.has_many(name)
                or self.selector.prior_cost(current, name) < self.options.least_evidence
            ):
                continue
            rest = self.selector.hypothesis(tuple(n for n in current.names if n != name), None, current.fit)
            state = self.selector.state(rest.fit)
            own = self.selector.features(state, rest.fit, name)
            alike = []
            for candidate in self.selector.score(rest.fit, self.selector.others(current)):
                smaller = len(self.selector.coordinates[candidate.name]) < len(own)
                if candidate.promise > WORTH_FITTING and smaller:
                    features = self.selector.features(state, rest.fit, candidate.name)
                    alike.append((similarity(state.design, own, features), candidate))
            for cosine, candidate in sorted(alike, key=lambda pair: -pair[0])[: self.options.parents]:
                if cosine > CONTAINED:
                    larger = self.selector.hypothesis(
                        (*current.names, candidate.name), candidate.start, current.fit
                    )
                    self._say_refit(current, larger)
                    best = max(best, larger, key=lambda item: item.log_evidence)
        return best if best.log_evidence > current.log_evidence + self.options.least_evidence else current

    def is_hopeless(self, chosen: Hypothesis) -> bool:
        """Whether so much is left, and so little of it promised by all effects, that no set leaves noise."""
        noise = self.selector.problem.cells.n_values
        before, excess = self.selector.null.fit.chi2 - noise, chosen.fit.chi2 - noise
        if self.order_open or excess < max(MUCH_LEFT * noise, HARDLY_LESS * before):
            return False
        scores = self.selector.score(chosen.fit, self.selector.others(chosen), scan=True)
        best = sorted((candidate.promise for candidate in scores), reverse=True)[: self.options.most_effects]
        return MORE_THAN_PROMISED * sum(best) < HARDLY_LESS * excess

    def _larger_sets(self, current: Hypothesis) -> list[Hypothesis]:
        """Refits of the most promising sets with one effect more.

        The best set need not hold the best smaller one: every set nearly as good is scored, and what all of them
        promise is compared. Once one leaves noise, those that promise far too little to come near it are not fitted.
        """
        promised: dict[frozenset[str], tuple[float, Hypothesis, Candidate]] = {}
        parents = self._nearly_as_good(current)
        first, rest = parents[:SCANNED_PARENTS], parents[SCANNED_PARENTS:]
        scores = [
            self.selector.score(parent.fit, self.selector.others(parent), scan=True) for parent in first
        ]
        if rest:
            scores += self.selector.score_alike(first[0].fit, rest)
        for parent, candidates in zip(parents, scores, strict=True):
            for candidate in candidates:
                key = frozenset((*parent.names, candidate.name))
                left = parent.fit.chi2 - candidate.promise
                if candidate.promise > WORTH_FITTING and left < promised.get(key, (math.inf,))[0]:
                    promised[key] = (left, parent, candidate)
        best = sorted(promised.values(), key=lambda item: item[0])[: 2 * self.options.refits]
        found: list[Hypothesis] = []
        least = reached = math.inf
        for _, parent, candidate in best:
            if not _may_reach(reached, parent, candidate):
                continue
            larger = self.selector.with_candidate(parent, candidate)
            self._say_refit(parent, larger)
            found.append(larger)
            if larger.fit.chi2 < least:
                least = larger.fit.chi2
                if self.options.is_noise(self.selector.with_channels(larger)):
                    reached = least
        return found

    def _nearly_as_good(self, current: Hypothesis) -> list[Hypothesis]:
        """Sets that may become the best with one effect more: single effects that were fitted, the best larger sets.

        By themselves many single effects explain most of what two do together, and the right one may come last.
        """
        near = 0.3 * max(current.log_evidence, 100.0)
        known = self.selector.known(len(current.names))
        most = self.options.refits if len(current.names) == 1 else self.options.parents
        return [found for found in known if found.log_evidence > current.log_evidence - near][:most]

    def _say_refit(self, before: Hypothesis, after: Hypothesis) -> None:
        self.say(
            f"  with {', '.join(after.names)}: chi2 falls by {before.fit.chi2 - after.fit.chi2:.1f}, "
            f"log evidence {after.log_evidence:.1f}"
        )

    def _swapped(self, current: Hypothesis, rounds: int = 3) -> Hypothesis:
        """Replace members one at a time while that helps: the best set need not hold the best single effect."""
        for _ in range(rounds):
            before = current
            for name in current.names:
                rest = tuple(other for other in current.names if other != name)
                best = max(
                    self.refits(self.selector.improved(rest, current.fit), current),
                    key=lambda item: item.log_evidence,
                    default=current,
                )
                if best.log_evidence > current.log_evidence + 1.0:
                    current = best
                    break
            if current is before:
                break
        return self.selector.with_channels(current)

    def _searched_harder(self, singles: list[Hypothesis]) -> list[Hypothesis]:
        """The nearly best single effects, and those that shift the phase, tried at other sizes too."""
        if self._leaves_much(singles[0]) and not self._may_be_in_another_order(singles[0]):
            return singles
        near = [h for h in singles if h.log_evidence > 0.7 * singles[0].log_evidence][:4]
        near += [h for h in singles if h not in near and self.selector.shifts_phase(h)]
        return [self.selector.improved(h.names, self.selector.null.fit, scan=True) for h in near]

    def _in_other_orders(self, found: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The sets, the best with each of some effects that shift the phase looked for in other fringe orders too.

        Where an effect is found with one set, it may be with the others as well.
        """
        ranked = sorted(found, key=lambda h: -h.log_evidence)
        looked: dict[str, Hypothesis] = {}
        for item in ranked:
            if len(looked) == SHIFTING_EFFECTS:
                break
            if item.names[-1] not in looked and self.selector.shifts_phase(item):
                looked[item.names[-1]] = self.selector.improved(item.names, item.fit, scan=True)
        for item in ranked:
            other = looked.get(item.names[-1])
            if other is not None and other.names != item.names:
                self.selector.improved(item.names, other.fit)
        return [self.selector.hypothesis(item.names) for item in ranked]

    def _most_credible(self, found: Sequence[Hypothesis]) -> Hypothesis:
        """Best of some sets by their evidence and by what they leave: a residual that is no noise speaks against."""
        top = max(item.log_evidence for item in found)
        near = [
            self.selector.with_channels(item)
            for item in found
            if item.log_evidence > top - self.options.credit
        ]

        def credibility(item: Hypothesis) -> float:
            chance = max(item.probability_of_noise, 1e-300) / self.options.consistency
            return item.log_evidence + max(min(math.log(chance), 0.0), -self.options.credit)

        return max(near, key=credibility)

    def pruned(self, hypothesis: Hypothesis) -> Hypothesis:
        """Leave out members that bring nothing."""
        for name in hypothesis.names:
            rest = tuple(other for other in hypothesis.names if other != name)
            if not rest:
                continue
            smaller = self.selector.with_channels(self.selector.improved(rest, hypothesis.fit))
            if smaller.log_evidence > hypothesis.log_evidence - 3.0 and self.options.is_noise(smaller):
                return self.pruned(smaller)
        return hypothesis

    def step(self, before: Hypothesis, after: Hypothesis) -> Step:
        """What a set brings over another, for the verdict."""
        return Step(
            tuple(name for name in after.names if name not in before.names),
            after.log_evidence - before.log_evidence,
            before.fit.chi2 - after.fit.chi2,
            misfit_rms(self.selector.problem, before.fit),
            misfit_rms(self.selector.problem, after.fit),
            self.options.is_noise(after),
        )

    def classified(self, chosen: Hypothesis, steps: list[Step]) -> tuple[Hypothesis, dict[str, EffectClass]]:
        """Class of each effect of a set, with a rival in the place of one that is clearly likelier.

        Members that bring nothing there are left out.
        """
        classes = classes_of(self.selector, chosen, self.options.class_width)
        for _ in range(self.options.most_effects):
            best = max((group.best for group in classes.values()), key=lambda item: item.log_evidence)
            if best.log_evidence < chosen.log_evidence + self.options.class_width:
                break
            likelier = self._most_credible([chosen, best])
            if likelier.names == chosen.names:
                break
            steps.append(self.step(chosen, likelier))
            chosen, classes = likelier, classes_of(self.selector, likelier, self.options.class_width)
        # A rival may have led to a minimum in which a member brings less than an effect must.
        if any(group.significance**2 < 2.0 * self.options.least_evidence for group in classes.values()):
            smaller = self.pruned(chosen)
            if smaller.names != chosen.names:
                steps.append(self.step(chosen, smaller))
                return self.classified(smaller, steps)
        return chosen, classes


def _may_reach(chi2: float, base: Hypothesis, candidate: Candidate) -> bool:
    """Whether a set may come down to a χ² with an effect more, which may bring more than it promises."""
    return PROMISE_KEPT * candidate.promise > base.fit.chi2 - chi2


def _surely_gains(selector: Selector, candidate: Candidate, wrong: float = 0.0) -> bool:
    """Whether an effect gains more than noise, what the description of the fringes lacks, and ``wrong``."""
    undescribed = selector.undescribed(candidate.name)
    return chance_of(candidate.gain - wrong, candidate.degrees, undescribed) < SURELY
