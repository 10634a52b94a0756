"""The search on one likelihood from a cube to a verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...effects import Effect
from ...model import FringeModel
from ...products.fringe_cube import FringeCube
from ..evaluations import OutOfTimeError, time_limit
from ..exposures import Exposures
from ..inference import Hypothesis
from ..next_measurement import RankedMeasurement
from .accuracy import told_accuracy
from .catalogue import Catalogue
from .channels import Channel
from .checks import headers_apart
from .critics import is_out_of_reach, judge, state_of, total_chance
from .describe import describe_residual, disagreement
from .heldout import Unseen, judge_unseen, rms_unseen
from .learning import best_evidence, learn
from .lesson import CellLesson, CellPart, in_all_data, with_corrections
from .naming import Naming, name_effects
from .neighbours import not_replaced
from .next_flats import FlatForecast
from .next_frames import FrameForecast
from .next_step import Values, with_next_measurements
from .options import SearchOptions
from .preparation import prepare, prepare_again
from .set_search import SetSearch
from .steps import told_of_steps
from .telling import data_of, rms_left, size_of, steps_of
from .verdict import Gap, NamedEffect, Verdict
from .verdict_words import METRIC, WITHIN_ACCURACY, chance_text, said_of_left_out


class WholeSearch:
    """One search of exposures by one log marginal likelihood, and how its answer is put.

    Parameters are those of `search_exposures`; thickness and noise are fitted with the unchanged model when it is
    made.
    """

    def __init__(
        self,
        cube: FringeCube,
        model: FringeModel,
        effects: Sequence[Effect],
        rng: np.random.Generator,
        options: SearchOptions,
        report: Callable[[str], None],
        exposures: Exposures | None = None,
    ) -> None:
        report("fitting the thickness with the unchanged model")
        prepared = prepare(cube, model, effects, options, rng, exposures)
        self.prepared, self.model, self.rules, self.report = prepared, model, options, report
        self.rng, self.until = rng, math.inf
        # On the sky the errors of the tables are those of the map too.
        self.teaches = exposures is None and not prepared.few
        stack = model.system.stack
        medium = stack.layers[stack.position(model.system.varying)].medium
        wavelength = prepared.cells.wavelength_nm
        self.index = np.real(medium.index(wavelength, model.system.temperature_k))
        self.notes = [*headers_apart(cube, model), *prepared.told]
        self._judged_with: list[set[str]] = []
        self._judged: dict[tuple[Hypothesis, Hypothesis], tuple[Channel, ...]] = {}
        self.catalogue = Catalogue.of(effects, prepared.problem, options.most_effects)
        self.sets = SetSearch(self.catalogue, prepared.null, options, report, self._leaves_noise)

    def _leaves_noise(self, found: Hypothesis) -> bool:
        return total_chance(self._channels(found)) > self.rules.significance

    def _channels(self, found: Hypothesis) -> tuple[Channel, ...]:
        key = found, self.prepared.null
        if key not in self._judged:
            self._judged[key] = judge(*key, self.index, self.rules)
        return self._judged[key]

    @property
    def _chance(self) -> float:
        """Chance that noise alone disagrees as much with the unchanged model."""
        return total_chance(self._channels(self.prepared.null))

    def run(self) -> Verdict:
        """The answer."""
        self.report(f"chance that noise alone disagrees as much: {self._chance:.3g}")
        best = self._best()
        if best.effects:
            return self._concluded(best)
        if self._chance > self.rules.significance:
            self.notes += told_of_steps(self.sets, self.prepared.null, self.rules)
            return self._told("no_discrepancy", self.prepared.null)
        return self._unexplained(self.prepared.null, ["no effect of the catalogue explains it"])

    def best_so_far(self, until: float) -> Verdict:
        """Answer of a search that was stopped; the part held out is asked about it until an instant [s]."""
        best, self.until = self.sets.best_so_far(), until
        if best.effects:
            try:
                with time_limit(until):
                    return replace(self._concluded(best), complete=False)
            except OutOfTimeError:
                self.notes.append(f"best so far, not judged on data held out: {', '.join(best.effects)}")
        return replace(self._unexplained(self.prepared.null, ["the search was stopped"]), complete=False)

    def _best(self) -> Hypothesis:
        """The best set, found one effect at a time; noise and cells are judged with the best of every size."""
        best = self.prepared.null
        for _ in range(self.rules.most_effects):
            size = len(best.effects)
            if size and all(self._is_out_of_reach(one) for one in self.sets.best_of(size)):
                self.report(f"no set of {self.rules.most_effects} effects comes near what is left")
                break
            best = self._judged_again(self.sets.larger(best))
            if len(best.effects) <= size:
                break
        return best

    def _is_out_of_reach(self, found: Hypothesis) -> bool:
        """Whether no set that is named leaves noise, if effects bring what derivatives promise, or little more.

        Sets with the members of the best set, or twins of them, are enlarged from there.
        """
        scored, best = self.sets.scores(found), self.sets.best_of(len(found.effects))[0]
        own = [one.signature for one in scored if one.name in best.effects]
        hoped = sorted(
            self.sets.hoped(one) + self.sets.catalogue.price + self.rules.class_width for one in scored
            if all(abs(float(one.signature @ other)) < self.rules.twin_cosine for other in own)
        )[len(found.effects) - self.rules.most_effects:]  # fmt: skip
        fall = 2.0 * sum(hoped)
        return is_out_of_reach(self._channels(found), found, self.prepared.null, fall, self.rules)

    def _judged_again(self, best: Hypothesis) -> Hypothesis:
        """The best set once noise and slopes in the cells are those that it leaves itself."""
        if not self.prepared.measured:
            return best
        for _ in range(self.rules.most_judged if len(best.effects) == 1 else 1):
            if not best.effects or set(best.effects) in self._judged_with or self._is_judged_with_alike(best):
                break
            self._judged_with.append(set(best.effects))
            self.report(f"noise and cells are judged again with {', '.join(best.effects)}")
            prepared = prepare_again(self.prepared, best, self.rules)
            self.sets, self.prepared = self.sets.on(prepared.null), prepared
            best = self.sets.settled(best)
        return best

    def _is_judged_with_alike(self, best: Hypothesis) -> bool:
        """Whether noise and cells are those that a set of the same class leaves."""
        last = self.sets.pool.get(frozenset(self._judged_with[-1])) if self._judged_with else None
        if last is None or len(last.effects) != len(best.effects):
            return False
        return best.log_evidence - last.log_evidence < self.rules.class_width

    # Judgement --------------------------------------------------------------------------------------------------

    def _concluded(self, best: Hypothesis) -> Verdict:
        """Judgement of the set that was selected."""
        best = self.sets.alike(best)
        self.report(f"data held out are asked about {', '.join(best.effects)}")
        unseen = judge_unseen(self.prepared, best)
        explained, after = self._left_in_all_data(best)
        naming = name_effects(self.sets, self.sets.over_valleys(best), explained, total_chance(after))
        reasons: list[str] = []
        for channels in (self._channels(best), after):
            if not reasons and total_chance(channels) < self.rules.significance:
                worst, names = min(channels, key=lambda one: one.probability), ", ".join(best.effects)
                chance = chance_text(worst.probability)
                reasons.append(f"with {names} a residual remains in '{worst.name}' (chance {chance})")
        reasons += [*self._at_ends(best), *naming.doubts]
        self.notes.append(unseen.text)
        reasons += [why] if (why := unseen.why_not(self.rules.outsider_prior)) else []
        if reasons:
            return self._unexplained(best, reasons, naming.effects, unseen)
        form = self._what_may_be_form(best)
        self.notes += form
        decided, measurements = self._what_would_decide(best, naming)
        found = self._told("named", best, decided, {}, unseen)
        return replace(
            found,
            next_measurements=measurements,
            accuracy=self._accuracy(best),
            learned=self._learned(best) if form else {},
        )

    def _left_in_all_data(self, best: Hypothesis) -> tuple[float, tuple[Channel, ...]]:
        """χ² that the selected set takes off the unchanged model in all data, and what the critics say of the rest.

        A cause outside the catalogue, if it is there, stands out more clearly in all data than in the part searched.
        """
        null, whole = self.prepared.null, best
        if self.prepared.unseen.seen.any():
            null, whole = in_all_data(self.prepared, best)
        return null.chi2 - whole.chi2, judge(whole, null, self.index, self.rules)

    def _at_ends(self, best: Hypothesis) -> list[str]:
        """Parameters at an end of their range that nature does not have."""
        found = []
        for item, value in zip(best.items, best.values, strict=True):
            natural = self.catalogue.effects[item.effect].search.natural_bounds
            if not item.place and value in (item.low, item.high) and value not in (item.null, *natural):
                found.append(f"{item.key} is at the end of its range ({value:g})")
        return found

    def _what_may_be_form(self, best: Hypothesis) -> list[str]:
        """That more than noise is left, though no more than what may be wrong with the form of the effects."""
        exact = replace(self.rules, imprecision=0.0)
        channels = judge(best, self.prepared.null, self.index, exact)
        if total_chance(channels) > self.rules.significance:
            return []
        worst = min(channels, key=lambda channel: channel.probability)
        told = (
            f"less than {self.rules.imprecision:.0%} of what {', '.join(best.effects)} explains is left in "
            f"'{worst.name}' (chance {chance_text(worst.probability)}): its form may be wrong by as much, or a "
            "fainter effect be there"
        )
        alike = [one for one in self.sets.scores(best)[:1] if one.gain > 0.0]
        return [told + "".join(f", most like {one.name} (gain {2.0 * one.gain:.0f})" for one in alike)]

    def _what_would_decide(
        self, best: Hypothesis, naming: Naming
    ) -> tuple[tuple[NamedEffect, ...], tuple[dict[str, Any], ...]]:
        """Named effects with the data that would decide between the members of their class."""
        made = FlatForecast if best.point.problem.forward.exposures is None else FrameForecast
        forecast = made(best, self.model, self.prepared.cells)

        def rank(effect: NamedEffect, rivals: Values) -> tuple[RankedMeasurement, ...]:
            known: Mapping[str, Hypothesis] = naming.classes[effect.name].rivals
            return forecast.ranked(effect.name, {name: known[name] for name in rivals})

        values = {name: group.values for name, group in naming.classes.items()}
        return with_next_measurements(naming.effects, values, rank, self.report)

    # Without a name -----------------------------------------------------------------------------------------------

    def _alike(self, found: Hypothesis) -> Hypothesis:
        """The effects of a set that are not the cause, and which no correction can replace."""

        def evidence(one: Hypothesis) -> float:
            return self.sets.posterior(one) + (best_evidence(self._part(one)) if self.teaches else 0.0)

        def smaller(one: Hypothesis) -> list[Hypothesis]:
            leave = [name for name in one.effects if self.catalogue.may_leave((name,), one.effects)]
            return [self.sets.without(one, name) for name in leave]

        try:
            with time_limit(self.until):
                return not_replaced(found, smaller, evidence, self.rules.sure)
        except OutOfTimeError:
            return self.prepared.null

    def _part(self, found: Hypothesis) -> CellPart:
        return CellPart(with_corrections(found.point), self.prepared.cells.noise_rms)

    def _learned(self, found: Hypothesis) -> dict[str, Any]:
        """A correction beside a set, judged by cells that it has not seen; nothing where there is none."""
        if not self.teaches:
            return {}
        self.report("learning a correction from what is left")
        least = self.rules.sure + self.catalogue.price  # what an effect must bring
        try:
            with time_limit(self.until):
                learned = learn(CellLesson.of(self.prepared, found), self.rng, least)
        except OutOfTimeError:
            return {}
        return {} if learned is None else learned.as_mapping(found.effects)

    def _accuracy(self, found: Hypothesis) -> dict[str, Any]:
        """The disagreement beside what the model may be wrong by."""
        assumed = self.rules.model_accuracy
        if not self.teaches or assumed == 0.0:
            return {}
        try:
            with time_limit(self.until):
                return told_accuracy(self.prepared.null, found, self.index, self.rules, assumed, self._chance)
        except OutOfTimeError:
            return {"assumed": assumed}

    # Layout -------------------------------------------------------------------------------------------------------

    def _unexplained(
        self,
        found: Hypothesis,
        reasons: Sequence[str],
        partial: Sequence[NamedEffect] = (),
        unseen: Unseen | None = None,
    ) -> Verdict:
        accuracy = self._accuracy(found)
        # A search that was stopped says nothing of what it did not try, and what an effect explains is no error of a
        # table.
        ended = math.isinf(self.until) and not partial
        within = ended and accuracy.get("chance", 0.0) > self.rules.significance
        # What fails on data held out is like nothing.
        fails = unseen is not None and unseen.gain is not None and unseen.gain <= 0.0
        alike = self.prepared.null if within or fails else self._alike(found)
        state = state_of(found.point, found.point.level_columns)
        cells = self.prepared.cells
        description = {
            "reason": "; ".join([*([WITHIN_ACCURACY] if within else []), *reasons]),
            "too_poor": False,
            "like": list(alike.effects),
            "partial": [
                {"name": e.name, "probability": e.probability, "significance": e.significance,
                 "parameters": {k: [p.value, p.sigma] for k, p in e.parameters.items()}}
                for e in partial
            ],
            **describe_residual(
                state, cells.geometry, self.index, cells.cell_px, self._channels(found), float(cells.seen.mean())
            ),
        }  # fmt: skip
        told = self._told("no_discrepancy" if within else "unexplained", found, (), description, unseen)
        learned = {} if within else self._learned(alike)
        return replace(told, learned=learned, accuracy={**accuracy, "within": within})

    def _rms_outside(self, inside: tuple[float, float], unseen: Unseen | None) -> tuple[float, float]:
        """Rms of the part held out before and after; that inside where there is none, or no time."""
        if unseen is not None:
            return unseen.before_rms, unseen.after_rms
        try:
            with time_limit(self.until):
                unchanged = rms_unseen(self.prepared)
        except OutOfTimeError:
            return inside
        return inside if unchanged is None else (unchanged, unchanged)

    def _told(
        self,
        word: str,
        found: Hypothesis,
        effects: tuple[NamedEffect, ...] = (),
        unexplained: dict[str, Any] | None = None,
        unseen: Unseen | None = None,
    ) -> Verdict:
        prepared, cells = self.prepared, self.prepared.cells
        null, before = prepared.null, self._channels(prepared.null)
        state = state_of(null.point, null.point.level_columns)
        first, last = rms_left(prepared, null), rms_left(prepared, found)
        outside = self._rms_outside((first, last), unseen)
        scores = [
            {"name": one.name, "score": one.fall, "degrees": one.degrees}
            for one in sorted(self.sets.scores(null), key=lambda one: -one.fall)
        ]
        # Of sets that fell far behind none is left.
        rounds = [own[0] for size in range(1, len(found.effects)) if (own := self.sets.best_of(size))]
        steps = steps_of(prepared, [*rounds, found] if found.effects else [], self._leaves_noise)
        return Verdict(
            word, effects,
            disagreement(state, before, cells.geometry, self.index, cells.cell_px, float(cells.seen.mean())),
            Gap(METRIC, first, last, *outside, cells.noise_rms),
            steps, unexplained or {}, self.model.setup.name, total_chance(before),
            tuple(scores),
            (), (*self.notes, *said_of_left_out(self.catalogue.left_out)), data_of(prepared, found),
            size=size_of(prepared),
        )  # fmt: skip
