"""Beam search over sets of effects: score all, refit the best of each group of twins, grow, prune, swap."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from ..inference import Coordinate, Hypothesis, fit, in_open_orders, in_whole_orders, jumped, led
from ..inference.marginal import Point
from .catalogue import Catalogue
from .island_places import in_best_place
from .open_orders import best_of_orders, scorer_at
from .options import SearchOptions
from .pace import Pace
from .pairs import Joint, ScoredPair
from .scores import Scored, best_gain, grouped, proposed
from .starts import fitted_elsewhere, linear_start, without_keys
from .valleys import in_deepest_valleys, over_valleys


@dataclass(eq=False)
class SetSearch:
    """Hypotheses of one problem; each is fitted once from its best parent."""

    catalogue: Catalogue
    null: Hypothesis
    rules: SearchOptions
    say: Callable[[str], None]
    leaves_noise: Callable[[Hypothesis], bool]  # what the critics say
    pool: dict[frozenset[str], Hypothesis] = field(default_factory=dict)
    pace: Pace = field(default_factory=Pace)

    def __post_init__(self) -> None:
        self.pool[frozenset()] = self.null
        self._scores: dict[frozenset[str], list[Scored]] = {}
        self._joints: dict[frozenset[str], list[Joint]] = {}
        self._added_before: set[tuple[frozenset[str], str]] = set()
        self._short: set[tuple[frozenset[str], str]] = set()  # fits that came far behind before
        self._brought: dict[str, float] = {}  # largest part of its promise that an effect brought in a fit
        self._deepest: set[Hypothesis] = set()  # sets in the best of their valleys
        self._exchanged: set[frozenset[str]] = set()  # sets whose members were left out and exchanged

    def posterior(self, found: Hypothesis) -> float:
        """Log evidence less the price of the effects."""
        return found.log_evidence - self.catalogue.price * len(found.effects)

    def larger(self, best: Hypothesis) -> Hypothesis:
        """The best set with one effect more, or the same where none is surely better."""
        size = len(best.effects) + 1
        beam = self.best_of(size - 1) if best.effects else [self.null]
        self._grow(beam[0])
        for name in best.effects:
            self._exchange_for_two(best, name)
        if best.effects and self._is_enough(beam[0]) and not self._is_beaten(best):
            return best
        for parent in beam[1:]:
            self._grow(parent, most=self.rules.refits // 2)
        grown = self._in_orders(size)
        if not grown:
            return best
        top = self._settled(grown[0]) if size > 1 else grown[0]
        gained = top.log_evidence - self.null.log_evidence
        self.say(f"best of {size}: {', '.join(top.effects)} (log evidence {gained:.1f})")
        return self._surely(top, best)

    def settled(self, before: Hypothesis) -> Hypothesis:
        """The best set of as many effects at most as one that was settled before the problem was judged again.

        Members are left out and exchanged anew if another set is the best now.
        """
        size = len(before.effects)
        if size == 1:
            return self.larger(self.null)
        best = self._of_size(size)[0]
        if set(best.effects) != set(before.effects):
            best = self._settled(best)
        smaller = max(
            (one for one in self.pool.values() if len(one.effects) < len(best.effects)), key=self.posterior
        )
        return self._surely(best, smaller)

    def _surely(self, larger: Hypothesis, smaller: Hypothesis) -> Hypothesis:
        """A larger set if it is surely better, also than smaller ones that are fitted from its thickness.

        What it brings else is that cells or parameters lie in other minima, which they may without it.
        """
        larger = self._in_deepest_valleys(larger)
        if smaller.effects and self._is_surely_better(larger, smaller):
            others = [self._from_thickness(smaller, larger)]
            others += [
                self._left_out(larger, name)
                for name in larger.effects
                if self.catalogue.may_leave((name,), larger.effects)
            ]
            smaller = max([smaller, *map(self._keep, others)], key=self.posterior)
            if len(smaller.effects) > 1 and not self._is_surely_better(larger, smaller):
                # It may be what is left of a larger one, with twins that are not fitted.
                smaller = self._settled(smaller)
        return larger if self._is_surely_better(larger, smaller) else smaller

    def _in_deepest_valleys(self, found: Hypothesis) -> Hypothesis:
        """A set with its parameters that repeat where they are the best beside all of its effects."""
        if found not in self._deepest:
            found = self._keep(in_deepest_valleys(found, partial(self._fit, found.effects, found.items)))
            self._deepest.add(found)
        return found

    def over_valleys(self, found: Hypothesis) -> Hypothesis:
        """A set with the errors of its parameters over all valleys that the data allow."""
        return over_valleys(found, partial(self._fit, found.effects, found.items), self.rules.class_width)

    def _from_thickness(self, found: Hypothesis, other: Hypothesis) -> Hypothesis:
        """A set fitted anew from the thickness of another one."""
        at = found.point.moved(found.point.levels, other.point.thickness_um)
        return self._fit(found.effects, found.items, at)

    def alike(self, best: Hypothesis) -> Hypothesis:
        """The best set after others of its size were fitted from its thickness, as far as they may be of its class.

        Some cells of weak fringes lie in another minimum for every set, which says nothing about the sets.
        """
        for one in self._of_size(len(best.effects))[: self.rules.refits]:
            behind = self.posterior(best) - self.posterior(one)
            if one is not best and behind < self.rules.refits * self.rules.class_width:
                self._keep(self._from_thickness(one, best))
        return self._of_size(len(best.effects))[0]

    def best_so_far(self) -> Hypothesis:
        """The best set that is known, none larger than what is surely better."""
        best = self.null
        for size in range(1, self.rules.most_effects + 1):
            for larger in self._of_size(size)[:1]:
                best = larger if self._is_surely_better(larger, best) else best
        return best

    def on(self, null: Hypothesis) -> SetSearch:
        """The same search of a problem that was judged again; the best sets are fitted from where they are."""
        again = SetSearch(self.catalogue, null, self.rules, self.say, self.leaves_noise, pace=self.pace)
        again._brought.update(self._brought)
        again._exchanged.update(self._exchanged)
        known = sorted(self.pool.values(), key=self.posterior, reverse=True)
        top = known[0].log_evidence - self.null.log_evidence
        # With one effect of several the noise is still that of a wrong model.
        doubt = 1.0 - self.rules.least_of_promise if len(known[0].effects) < 2 else self.rules.imprecision
        least = (1.0 - doubt) * top - self.rules.class_width
        for number, one in enumerate(known):
            if not one.effects:
                continue
            steps = {(frozenset(one.effects) - {name}, name) for name in one.effects}
            if one.log_evidence - self.null.log_evidence <= least:
                again._short |= steps
            elif number < 2 * self.rules.refits:
                at = one.point
                start = null.point.problem.at(at.settings, at.levels, at.thickness_um)
                again._keep(again._fit(one.effects, one.items, start))
                again._added_before |= steps
        return again

    def _is_surely_better(self, larger: Hypothesis, smaller: Hypothesis) -> bool:
        """Whether a larger set is as probable beside a smaller one as what is named has to be."""
        return self.posterior(larger) - self.posterior(smaller) > self.rules.sure

    def _is_enough(self, found: Hypothesis) -> bool:
        """Whether a set leaves noise, and no effect promises to be worth its price beside it."""
        promised = max((one.gain for one in self.scores(found)), default=0.0)
        return promised < self.catalogue.price and self.leaves_noise(found)

    def best_of(self, size: int) -> list[Hypothesis]:
        """The sets of a size that are enlarged, best first; there is one of every size below that of the best."""
        return self._of_size(size)[: self.rules.beam]

    def hoped(self, one: Scored) -> float:
        """What an effect may bring: all that it promises and little more, no larger part than where it was fitted."""
        most = 1.0 / self.rules.least_of_promise
        return max(one.gain, 0.0) * min(most, self._brought.get(one.name, most))

    def _is_beaten(self, best: Hypothesis) -> bool:
        """Whether a set of one effect more is surely better."""
        return any(self._is_surely_better(one, best) for one in self._of_size(len(best.effects) + 1)[:1])

    def _exchange_for_two(self, found: Hypothesis, name: str) -> None:
        """Fit pairs in the place of one member, as far as they promise to come near the best set.

        Where one is better than the set, those with a twin in the place of one of its effects are fitted too.
        """
        if not self.catalogue.may_leave((name,), found.effects):
            return
        base = self.without(found, name)
        signatures, least = {one.name: one.signature for one in self.scores(base)}, self._least_gain(base, 2)
        joints = self._joints[frozenset(base.effects)]
        pairs = [pair for joint in joints for pair in joint.best_pairs(best_gain, least, (name,))]
        better: list[ScoredPair] = []
        for number, pair in enumerate(sorted(pairs, key=lambda one: -one.gain)):
            names = (*base.effects, *pair.names)
            wanted = number < self.rules.fewest_refits or any(
                pair.is_twin_of(one, signatures, self.rules.twin_cosine) for one in better
            )
            if not wanted or frozenset(names) in self.pool:
                continue
            both = self._pair_added(base, pair, names)
            if self.posterior(both) > self.posterior(found):
                better.append(pair)

    def _pair_added(self, base: Hypothesis, pair: ScoredPair, names: tuple[str, ...]) -> Hypothesis:
        """The set with two effects more."""
        items = tuple(item for one in pair.names for item in self.catalogue.items[one])
        start = linear_start(base, items, pair.step)
        both = self._fit(names, (*base.items, *items), base.point if start is None else start)
        brings = both.log_evidence - base.log_evidence
        self.say(f"  {'+'.join(names)}: promised {pair.gain:.1f} together, brings {brings:.1f}")
        return self._keep(both)

    def _of_size(self, size: int) -> list[Hypothesis]:
        """All sets of so many effects, best first."""
        return sorted(
            (h for h in self.pool.values() if len(h.effects) == size), key=self.posterior, reverse=True
        )

    def _in_orders(self, size: int) -> list[Hypothesis]:
        """All sets of so many effects, the best of them in other fringe orders too where none leaves noise."""
        grown = self._of_size(size)
        problem = self.null.point.problem
        if not grown or problem.known or problem.orders or self.leaves_noise(grown[0]):
            return grown
        for found in grown[: self.rules.beam]:
            point, order_um = found.point, found.point.problem.forward.order_um
            starts = [in_whole_orders(point, self.rules.class_width)]
            starts += [point.moved(point.levels, point.thickness_um + t * order_um) for t in (-1.0, 1.0)]
            for start in starts:
                if start is not point:
                    self._keep(self._fit(found.effects, found.items, start))
        return self._of_size(size)

    def _settled(self, found: Hypothesis) -> Hypothesis:
        """The best set after members were left out and exchanged, as long as that helps."""
        while frozenset(found.effects) not in self._exchanged:
            self._exchanged.add(frozenset(found.effects))
            for name in found.effects:
                if self.catalogue.may_leave((name,), found.effects):
                    self._grow(self.without(found, name), missing=name)
            for pair in itertools.combinations(found.effects, 2):
                if self.catalogue.may_leave(pair, found.effects):
                    self._grow(self.without(self.without(found, pair[1]), pair[0]))
            best = max(
                (one for one in self.pool.values() if len(one.effects) <= len(found.effects)),
                key=self.posterior,
            )
            found = max(best, found, key=self.posterior)
        return found

    def without(self, found: Hypothesis, name: str) -> Hypothesis:
        """The set without one member, fitted from where it is, or the better one that is known."""
        names = tuple(one for one in found.effects if one != name)
        known = self.pool.get(frozenset(names))
        if known is not None:
            return known
        fitted = self._left_out(found, name)
        return self._keep(fitted) if self.catalogue.may_leave((name,), found.effects) else fitted

    def _left_out(self, found: Hypothesis, name: str) -> Hypothesis:
        """A fit without one member from where a set is."""
        names = tuple(one for one in found.effects if one != name)
        items = tuple(item for item in found.items if item.effect != name)
        own = {item.key: item.null for item in found.items if item.effect == name}
        start = jumped(found.point, [i for i in found.items if i.effect == name], list(own.values()))
        return self._fit(names, items, without_keys(start, set(own)))

    def _fit(self, names: Sequence[str], items: Sequence[Coordinate], start: Point) -> Hypothesis:
        """A fit that is as good as it has to be beside the best one that is known."""
        return fit(names, items, start, aim=min(one.point.cost for one in self.pool.values()))

    def _keep(self, found: Hypothesis) -> Hypothesis:
        """The better of a fit and what is known of its set."""
        key = frozenset(found.effects)
        known = self.pool.get(key)
        if known is None or found.log_evidence > known.log_evidence:
            self.pool[key] = found
            self._scores.pop(key, None)
        return self.pool[key]

    # Growth -----------------------------------------------------------------------------------------------------

    def _grow(self, base: Hypothesis, missing: str = "", most: int | None = None) -> None:
        """Refit the best of each group of twins beside a set, and twins that may win.

        ``missing``: a member of a larger set that was taken out here; its twins are refitted in any case.
        """
        key = frozenset(base.effects)
        groups = grouped([one for one in self.scores(base) if (key, one.name) not in self._short], self.rules)
        worth = [group for group in groups if group[0].gain > self.catalogue.price]
        fewest = 0 if base.effects and not missing else self.rules.fewest_refits
        if base is self.null and base.point.problem.levels_known and not self.leaves_noise(base):
            worth, most = groups, len(groups)  # derivatives in a wrong order promise nothing
        number = max(fewest, min(len(worth), most or self.rules.refits))
        if missing:
            number = min(number, self.rules.fewest_refits)
        found: dict[str, Hypothesis] = {}
        self.pace.left = min(number, len(groups))
        for group in groups[:number]:
            wanted = self._may_lead(base, group[0]) or len(found) < fewest or worth is groups
            if wanted or (not missing and self._is_underrated(base, group[0])):
                found[group[0].name] = self._added(base, group[0])
        if not found:
            return
        least = max(self.posterior(one) for one in found.values()) - self.rules.class_width
        for group in groups:
            first = found.get(group[0].name)
            near = missing in {one.name for one in group} or (
                first is not None and self.posterior(first) > least
            )
            if near or first is not None:
                self._add_twins(base, [one for one in group if one.name != missing], least, near)

    def _add_twins(self, base: Hypothesis, group: Sequence[Scored], least: float, near: bool) -> None:
        """Refit the twins of an effect that came near the best, or did not bring what they promise.

        An effect that derivatives mislead says nothing of its twins. They are refitted as far as they come near the
        best if they bring what they promise, and as soon as one does, those that may bring a little more.
        ``least``: posterior from which on a set is near the best.
        """
        self.pace.left = len(group)
        kept = self._kept(base, group) if near else self.rules.least_of_promise
        for one in group:
            if not self._may_lead(base, one, kept):
                continue
            if self.posterior(self._added(base, one)) > least and not near:
                near, kept = True, self._kept(base, group)

    def _kept(self, base: Hypothesis, group: Sequence[Scored]) -> float:
        """How many times what derivatives promise an effect of a group of twins has brought, 1 at least."""
        sets = [(one, self.pool.get(frozenset((*base.effects, one.name)))) for one in group if one.gain > 0.0]
        brought = [(own.log_evidence - base.log_evidence) / one.gain for one, own in sets if own is not None]
        return max([1.0, *brought])

    def _may_lead(self, base: Hypothesis, one: Scored, kept: float = 1.0) -> bool:
        """Whether a set with one effect more comes near the best, if derivatives promise all but a part."""
        return kept * one.gain > self._least_gain(base, 1)

    def _is_underrated(self, base: Hypothesis, one: Scored) -> bool:
        """Whether an effect explains more at its linear step than derivatives promise, where more than noise is left.

        The fringes of a sensor whose absorption falls grow with every degree: what the fit brings is not known then.
        """
        best = max(self.pool.values(), key=self.posterior)
        if one.start is not None or self.leaves_noise(best):
            return False
        start = linear_start(base, self.catalogue.items[one.name], one.step)
        promised = 0.5 * one.fall / self.rules.least_of_promise
        return start is not None and base.point.cost - start.cost > promised

    def _least_gain(self, base: Hypothesis, number: int) -> float:
        """What so many effects more must promise to come near the best."""
        best = max(self.posterior(known) for known in self.pool.values())
        behind = best - self.rules.class_width - self.posterior(base) + number * self.catalogue.price
        return self.rules.least_of_promise * behind

    def scores(self, base: Hypothesis) -> list[Scored]:
        """All effects that a set lacks, by what one derivative promises; best first.

        Where a thickness that is known may have a phase that is missing in the model, each by the better of the
        derivatives with it and without.
        """
        key = frozenset(base.effects)
        if key not in self._scores:
            best: dict[str, Scored] = {}
            self._joints[key] = []
            for point in dict.fromkeys((base.point, led(base.point))):
                for one in self._scored_at(point, base):
                    if one.name not in best or one.gain > best[one.name].gain:
                        best[one.name] = one
            self._scores[key] = sorted(best.values(), key=lambda one: -one.gain)
        return self._scores[key]

    def _scored_at(self, point: Point, base: Hypothesis) -> list[Scored]:
        """The same by derivatives at one point; effects that propose themselves do so at that of the set."""
        scorer = scorer_at(point, base, self.rules.sizes, base.point)
        elsewhere = [scorer_at(one, base, self.rules.sizes) for one in in_open_orders(point)]
        found = []
        for name, items in self.catalogue.items.items():
            if not self.catalogue.may_add(name, base.effects):
                continue
            effect, one = self.catalogue.effects[name], None
            if not (effect.search.sought or effect.local):
                one = best_of_orders(scorer.score(name, items), elsewhere, name, items, base)
            elif point is base.point:
                one = proposed(effect, items, base)
            if one is not None:
                found.append(one)
        self._joints[frozenset(base.effects)].append(scorer.joint())
        return found

    def _added(self, base: Hypothesis, one: Scored) -> Hypothesis:
        """The set with one effect more."""
        names = (*base.effects, one.name)
        step = frozenset(base.effects), one.name
        if step in self._added_before:
            return self.pool[frozenset(names)]
        items = self.catalogue.items[one.name]
        with self.pace.fit():
            found = None if one.start is None else self._proposed(one, names, (*base.items, *items))
            if found is None or (base.point.problem.levels_known and not self._is_kept(base, found, one)):
                known = [] if found is None else [found]
                found = max([*known, self._fitted(base, one, names, items)], key=self.posterior)
        self._added_before.add(step)
        brings = found.log_evidence - base.log_evidence
        if one.gain > 0.0:
            self._brought[one.name] = max(self._brought.get(one.name, 0.0), brings / one.gain)
        self.say(f"  {'+'.join(names)}: promised {one.gain:.1f}, brings {brings:.1f}{self.pace.text}")
        return self._keep(found)

    def _proposed(self, one: Scored, names: tuple[str, ...], items: tuple[Coordinate, ...]) -> Hypothesis:
        """The fit from what an effect proposes; of an island from the best place about that, too."""
        assert one.start is not None
        found, effect = self._fit(names, items, one.start), self.catalogue.effects[one.name]
        if not effect.local:
            return found
        return in_best_place(effect, self.catalogue.items[one.name], found, partial(self._fit, names, items))

    def _fitted(
        self, base: Hypothesis, one: Scored, names: tuple[str, ...], items: tuple[Coordinate, ...]
    ) -> Hypothesis:
        """The fit from the linear step; from elsewhere where that does not bring what it promised, or repeats."""
        fitted = partial(self._fit, names, (*base.items, *items))
        first = linear_start(base, items, one.step)
        found = fitted(base.point if first is None else first)
        kept = self._is_kept(base, found, one)
        if len(items) > 1 or (kept and not items[0].repeat):
            return found
        sizes = () if kept else self.rules.sizes
        return fitted_elsewhere(base, found, items[0], fitted, sizes, self.rules.most_turns)

    def _is_kept(self, base: Hypothesis, found: Hypothesis, one: Scored) -> bool:
        """Whether a fit brings what derivatives promised, or little less."""
        return found.log_evidence - base.log_evidence >= self.rules.least_of_promise * one.gain
