"""The search: fit, test, rank, name, validate on data held out, describe what is left."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from ...array_types import BoolArray, FloatArray
from ...effects import Effect, known_effects
from ...model import FringeModel, Setup
from ...products.fringe_cube import FringeCube
from ...products.sky_frame import refuse_noiseless
from ..exposures import Exposures
from .accuracy import ACCURACY_SOURCE, MODEL_ACCURACY, chance_within_accuracy
from .channels import Channel, in_looks
from .classes import EffectClass, classes_in_all_data, outsider_probability
from .describe import describe_residual, disagreement
from .evaluations import OutOfTimeError, time_limit
from .fit import Fit, fit_model
from .hidden_islands import hidden_island
from .lesson import evidence_of_correction, learned_beside
from .neighbours import not_replaced
from .next_frames import FrameForecast
from .next_step import Ranking, flats_ranked, with_next_measurements
from .options import SearchOptions
from .preparation import (
    Prepared,
    check_setup,
    headers_apart,
    is_judged_better,
    prepare,
    prepare_again,
    prepare_finer,
    prepare_with_areas,
    sees_areas,
    why_too_poor,
    without_blurs,
)
from .selection import IMPRECISION, Candidate, Hypothesis, Selector, chance_of
from .set_search import SetSearch
from .validation import (
    HeldOut,
    disagreement_size,
    held_out_blocks,
    misfit_rms,
    thickness_starts,
    validate,
    whole_thickness,
)
from .verdict import Gap, NamedEffect, ParameterValue, Step, Verdict, Where, probability_text
from .verdict_words import METRIC, WITHIN_ACCURACY, chance_text, said_of_left_out

Report = Callable[[str], None]


PAIR = 2
"""Effects with which fringe orders are judged again before a third is looked for: what leaves a residual may be one
effect and a thickness that is wrong in places."""


FEW_MENDED = 0.01
"""Part of the cells that may change their fringe order without moving where effects alone are by more than a fit that
starts there finds."""

FOR_JUDGEMENT = 0.2
"""Part of a time budget that is kept for the judgement of the best answer on the data held out."""


def discover(
    cube: FringeCube,
    setup: str | Setup | FringeModel,
    effects: Sequence[Effect] | None = None,
    *,
    rng: np.random.Generator,
    options: SearchOptions | None = None,
    report: Report | None = None,
) -> Verdict:
    """Find out whether flats and model disagree beyond noise, and which effect of a catalogue is the reason.

    Parameters
    ----------
    cube : `FringeCube`
        Flats of one sensor.
    setup : `str`, `Setup` or `FringeModel`
        What is known of sensor and light; a model may hold effects that are known already.
    effects : sequence of `Effect`, optional
        The catalogue; `known_effects` by default.
    rng : `numpy.random.Generator`
        Decides which parts of the sensor are held out; nothing else is random.
    options : `SearchOptions`, optional
        Thresholds and sizes.
    report : callable, optional
        Called with a line of text at every stage.

    Returns
    -------
    verdict : `Verdict`

    Raises
    ------
    InputError
        The flats are simulated without noise; the set-up contradicts them (temperature, bandpass), or is not one of
        a laboratory.
    """
    model = setup if isinstance(setup, FringeModel) else FringeModel.from_setup(setup)
    refuse_noiseless(cube.metadata, cube.detector or None)
    check_setup(cube, model)
    known = {item.effect.name for item in model.effects}
    # Flats do not see the spectrum of the night sky, nor the sensor at the telescope.
    own = [
        effect
        for effect in known_effects(effects)
        if not (effect.sky_only or effect.learned) or effect.name in known
    ]
    verdict = search_exposures(cube, model, own, rng, options, report)
    return replace(verdict, known=model.effect_settings)


def search_exposures(
    cube: FringeCube,
    model: FringeModel,
    effects: Sequence[Effect],
    rng: np.random.Generator,
    options: SearchOptions | None,
    report: Report | None,
    exposures: Exposures | None = None,
) -> Verdict:
    """Search any exposures whose light is known; parameters as of `discover`, which is for flats."""
    chosen = options or SearchOptions()
    say = report or (lambda text: None)
    # Many small matrices: threads of the linear algebra would wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        poor = why_too_poor(cube, model)
        if poor:
            return _no_answer(model, poor, cube)
        begun, budget = time.monotonic(), chosen.time_budget_s
        search: _Search | MarginalSearch | None = None
        try:
            with time_limit(begun + (1.0 - FOR_JUDGEMENT) * budget):
                if chosen.core == "marginal":
                    from .marginal import MarginalSearch  # is made of parts of this package

                    search = MarginalSearch(cube, model, effects, rng, chosen, say, exposures)
                    return search.run()
                say("fitting the thickness with the unchanged model")
                prepared = prepare(cube, model, effects, chosen.most_cells, exposures)
                search = _Search(cube, prepared, model, effects, chosen, rng, say)
                return search.run()
        except OutOfTimeError:
            say(f"the search is stopped: {budget:g} s were given")
            stopped = search.best_so_far(begun + budget) if search is not None else None
            reason = f"{budget:g} s did not suffice to fit the unchanged model"
            return stopped or replace(_no_answer(model, reason, cube, too_poor=False), complete=False)


def _no_answer(model: FringeModel, reason: str, cube: FringeCube, *, too_poor: bool = True) -> Verdict:
    nan = math.nan
    unexplained = {"reason": reason, "too_poor": too_poor}
    return Verdict(
        "unexplained", (), Where(), Gap(METRIC, nan, nan, nan, nan, nan), (), unexplained,
        model.setup.name, nan, data={"shape": list(cube.shape)},
    )  # fmt: skip


@dataclass
class _Reached:
    """How far a search has come."""

    prepared: Prepared
    heldout: BoolArray
    whole: Selector
    chance: float
    sets: SetSearch | None = None


class _Search:
    """One run of the search; every method is one stage."""

    def __init__(
        self,
        cube: FringeCube,
        prepared: Prepared,
        model: FringeModel,
        effects: Sequence[Effect],
        options: SearchOptions,
        rng: np.random.Generator,
        say: Report,
    ) -> None:
        self.cube, self.model, self.effects, self.options, self.say = cube, model, effects, options, say
        self.rng = rng
        self.headers = headers_apart(cube, model)
        self.next_measurements: tuple[dict[str, Any], ...] = ()
        self.unseen: HeldOut | None = None
        self.scores: Sequence[Candidate] = ()
        self.reached: _Reached | None = None
        self.until = math.inf
        self._may_judge_orders = self._may_take_areas = self._may_look_for_islands = True
        self._take_other_cells(prepared)

    def _take_other_cells(self, prepared: Prepared) -> None:
        shape = prepared.problem.cells.shape[1:]
        self.heldout = held_out_blocks(shape, self.options.heldout_fraction, self.rng)
        self._take(prepared)

    def _take(self, prepared: Prepared, singles: Mapping[str, FloatArray] | None = None) -> None:
        """Go on with other field and noise; ``singles``: where effects alone are known to be."""
        self.prepared, self.cells, self._singles = prepared, prepared.problem.cells, singles
        self.notes = [*self.headers, *prepared.told]

    @property
    def _places(self) -> int:
        """Places along a pixel's side that see the thickness, 0 for its area; effects may have looked like a few."""
        return self.prepared.problem.forward.places

    def run(self, refinements: int = 2, known: Fit | None = None) -> Verdict:
        """Search; start again if a named effect shows that field or noise were misjudged without it.

        Effects of a fit that are known to be needed are in the first set.
        """
        whole = Selector(
            self.prepared.problem,
            self.effects,
            self.prepared.null,
            self.prepared.index,
            generic=self.prepared.rich,
            first_field=self.prepared.undistorted_field,
            shifts_um=self.prepared.shifts_um,
            guess=self.prepared.guess,
            alike=None if self.reached is None else self.reached.whole,
        )
        self.where = self._where(whole)
        chance = self._chance(whole, whole.null)
        self.say(f"chance that noise alone disagrees as much: {chance:.3g}")
        self.reached = _Reached(self.prepared, self.heldout, whole, chance)
        if chance > self.options.significance:
            return self._with_hidden_island(whole.null) or self._verdict(
                "no_discrepancy", whole, whole.null, chance, (), {}
            )
        sets = self._sets(whole)
        self.reached.sets = sets
        if known is not None and known.coordinates:
            chosen, steps = self._resumed(sets, known)
            chosen = sets.enlarged(chosen, steps, self.options.most_effects)
            return self._conclude(whole, sets, sets.finished(chosen, steps), steps, chance)
        singles = sets.refits(sets.selector.null)
        if singles and singles[0].log_evidence > self.options.least_evidence and refinements > 0:
            refined, known_singles = self._judged_again(whole, sets, singles)
            if refined is not None:
                self.say("field and noise are judged again with the best effect in the model")
                self._take(refined, known_singles)
                return self.run(refinements - 1)
        if singles and self._is_too_coarse(sets.selector, singles[0]):
            return self._run_finer(singles[0].fit, self._thickness(whole, singles[0].fit))
        chosen, steps = sets.first(singles)
        if sets.is_hopeless(chosen):
            self.say("the catalogue explains next to nothing of it: no sets of several effects are tried")
            return self._conclude(whole, sets, chosen, steps, chance)
        chosen = sets.enlarged(chosen, steps, min(PAIR, self.options.most_effects))
        doubtful = not self.options.is_noise(chosen) or self._places > 0
        if self._may_judge_orders and chosen.names and doubtful:
            self._may_judge_orders = False
            refined, mended = self._refined(whole, chosen)
            if refined is not None and (mended or refined.problem.forward.places != self._places):
                # One effect alone, whose misfit may look like sharper pixels, does not judge them better once more.
                self._take(refined)
                return self.run(refinements=0)
        if len(chosen.names) == PAIR:
            chosen = sets.enlarged(chosen, steps, self.options.most_effects)
        chosen = sets.finished(chosen, steps)
        if self._may_take_areas and sees_areas(sets.selector.problem, chosen.fit):
            self._may_take_areas = self._may_judge_orders = False
            self.say("pixels see their area, and the blur is what few places lacked of it")
            self._take(prepare_with_areas(self.prepared, chosen.fit, self._thickness(whole, chosen.fit)))
            return self.run(refinements=0, known=without_blurs(chosen.fit, self.prepared.problem.forward))
        if not chosen.names or self.options.is_noise(chosen):
            found = self._of_all_data(whole, chosen) if chosen.names else whole.null
            verdict = self._with_hidden_island(found)
            if verdict is not None:
                return verdict
        return self._conclude(whole, sets, chosen, steps, chance)

    def _resumed(self, sets: SetSearch, known: Fit) -> tuple[Hypothesis, list[Step]]:
        """The effects of a fit to data that were judged otherwise."""
        selector, names = sets.selector, tuple(dict.fromkeys(item.effect for item in known.coordinates))
        field = self.prepared.undistorted_field
        base = replace(
            known,
            field=self.prepared.null.field if field is None else field,
            levels=known.levels[: selector.problem.n_levels],
        )
        found = selector.with_channels(selector.hypothesis(names, None, base))
        return found, [sets.step(selector.null, found)]

    # Stages -------------------------------------------------------------------------------------------------

    def _where(self, whole: Selector) -> Where:
        state = whole.state(whole.null.fit)
        return disagreement(
            state, whole.null.channels, self.cells.geometry, self.prepared.index, self.cells.cell_px
        )

    def _chance(self, selector: Selector, hypothesis: Hypothesis) -> float:
        """Chance of noise, over the tests without a catalogue and the score tests of the catalogue together."""
        scores = selector.score(hypothesis.fit, selector.others(hypothesis))
        smallest = min(
            (chance_of(c.gain, c.degrees, selector.undescribed(c.name)) for c in scores), default=1.0
        )
        # Effects are alike in groups; counting each as a look of its own errs on the safe side.
        catalogue = in_looks(smallest, len(scores)) if scores else 1.0
        self.scores = scores
        both = min(hypothesis.probability_of_noise, catalogue)
        return in_looks(both, 2)

    def _with_hidden_island(self, found: Hypothesis) -> Verdict | None:
        """Verdict with a local effect that the thickness had taken up.

        `None` if there is none, or none that is clear; the verdict tells of that.
        """
        if not self._may_look_for_islands:
            return None
        self._may_look_for_islands = False
        hidden = hidden_island(self.prepared, self.effects, found)
        if hidden is None:
            return None
        if hidden.prepared is None:
            self.notes.append(hidden.told)
            return None
        self.say(f"the thickness is smooth beside {hidden.effect.name}, and not without")
        self._take(hidden.prepared)
        return self.run(refinements=0, known=hidden.fit if found.names else None)

    def _sets(self, whole: Selector) -> SetSearch:
        """What looks for sets of effects in the part that is searched."""
        training = self._training(whole)

        def rescued(found: Hypothesis) -> Hypothesis:
            return self._rescued(whole, training, found)

        return SetSearch(
            training, self.options, self.say, rescued, order_open=len(self.prepared.shifts_um) > 0
        )

    def best_so_far(self, until: float) -> Verdict | None:
        """Verdict of a search that was stopped; the data held out are asked about it until an instant [s]."""
        if self.reached is None:
            return None
        found, self.until = self.reached, until
        self.heldout = found.heldout
        self._take(found.prepared)
        chosen, steps = (found.whole.null, []) if found.sets is None else found.sets.best_so_far()
        if found.sets is not None and chosen.names:
            try:
                with time_limit(until):
                    verdict = self._conclude(found.whole, found.sets, chosen, steps, found.chance)
                return replace(verdict, complete=False)
            except OutOfTimeError:
                self.notes.append(f"best so far, not judged on data held out: {', '.join(chosen.names)}")
        reason = f"the search was stopped after {self.options.time_budget_s:g} s"
        return replace(
            self._unexplained(found.whole, found.whole.null, found.chance, steps, reason), complete=False
        )

    def _training(self, whole: Selector) -> Selector:
        """Selector that does not see the part held out."""
        if not self.heldout.any():
            return whole
        problem = whole.problem.without_cells(self.heldout)
        null = fit_model(problem, (), np.zeros(0), self.prepared.null.field, self.prepared.null.levels)
        self.say("ranking effects")
        return Selector(
            problem,
            self.effects,
            null,
            self.prepared.index,
            generic=self.prepared.rich,
            first_field=self.prepared.undistorted_field,
            guess=self.prepared.guess,
            alike=whole,
            singles=self._singles,
        )

    def _refined(self, whole: Selector, best: Hypothesis) -> tuple[Prepared | None, int]:
        """Field and noise as judged with effects in the model, if that differs, and cells that change their order."""
        refined, mended = prepare_again(self.prepared, best.fit, self._thickness(whole, best.fit))
        if mended:
            self.say(f"{mended} cells change their fringe order with {', '.join(best.names)}")
        return refined, mended

    def _judged_again(
        self, whole: Selector, sets: SetSearch, singles: list[Hypothesis]
    ) -> tuple[Prepared | None, dict[str, FloatArray]]:
        """Field and noise as judged with the best single effect, or with one that takes fringes away.

        Where these are not seen the thickness is any, and a fit to it explains less than effects that weaken all of
        them. Once it is continued from where they are, it explains more.

        Also where the effects alone are, if nearly all cells are in the fringe order in which they were fitted.
        """
        best, mended = self._refined(whole, sets.to_judge_with(singles))
        few = mended <= FEW_MENDED * np.count_nonzero(self.cells.seen)
        places = {one.names[0]: one.fit.position for one in singles} if few else {}
        for blur in sets.that_may_hide_fringes(singles):
            other, _ = self._refined(whole, blur)
            if other is not None and is_judged_better(other, best or self.prepared):
                best, places = other, {}
        return best, places

    def _is_too_coarse(self, selector: Selector, found: Hypothesis) -> bool:
        """Whether a blur explains much, but not all, in cells that were chosen for the image that it left."""
        if self.cells.cell_px == 1 or not self.prepared.rich or self.prepared.problem.field_prior:
            return False
        blurs = any(selector.problem.forward.couples_pixels(name) for name in found.names)
        return blurs and not self.options.is_noise(selector.with_channels(found))

    def _run_finer(self, fit: Fit, thickness_um: FloatArray) -> Verdict:
        """Search again in cells of half the size."""
        self.say(f"light was finer before it was blurred: cells of {self.cells.cell_px // 2} px")
        finer = prepare_finer(self.cube, self.prepared, fit, thickness_um, self.options.most_cells)
        self._take_other_cells(finer)
        return self.run(refinements=1)

    def _thickness(self, whole: Selector, fit: Fit) -> FloatArray:
        return whole_thickness(whole.problem, whole.null.fit, fit, self.heldout)

    def _rescued(self, whole: Selector, training: Selector, found: Hypothesis) -> Hypothesis:
        """The set fitted again from its fit to all data, where that leaves noise and this one does not.

        Single cells between others that are held out or masked may be in another fringe order.
        """
        if self.options.is_noise(found):
            return found
        final = self._of_all_data(whole, found)
        if not self.options.is_noise(final):
            return found
        return training.with_channels(training.improved(found.names, final.fit))

    # Conclusion ---------------------------------------------------------------------------------------------

    def _conclude(
        self, whole: Selector, sets: SetSearch, chosen: Hypothesis, steps: list[Step], chance: float
    ) -> Verdict:
        if not chosen.names:
            return self._unexplained(
                whole, whole.null, chance, steps, "no effect of the catalogue explains it"
            )
        chosen, classes = sets.classified(chosen, steps)
        final = self._of_all_data(whole, chosen)
        if self._is_too_coarse(whole, final):
            return self._run_finer(final.fit, whole.problem.basis.expand(final.fit.field))
        room = len(chosen.names) < self.options.most_effects
        if room and self.options.is_noise(chosen) and not self.options.is_noise(final):
            self.say("a residual remains that only all data show")
            larger = sets.one_more(chosen)
            if larger is not None:
                larger = sets.pruned(sets.rescued(larger))
                steps.append(sets.step(chosen, larger))
                chosen, classes = sets.classified(larger, steps)
                final = self._of_all_data(whole, chosen)
        classes = classes_in_all_data(
            classes, chosen, final, lambda rival: self._transfer(whole, rival), self.options.class_width
        )
        self.unseen = validate(
            whole.problem, whole.null.fit, final.fit, self.heldout, rich=self.prepared.rich
        )
        # All data decide: they hold the part searched, and a cause that is there stands out more clearly in them.
        reasons = [] if self.options.is_noise(final) else [self._what_remains(final)]
        reasons.extend(
            f"{key} is at the end of its range ({final.fit.settings[key]:g})"
            for key in whole.at_end_of_range(final.fit)
        )
        if not self.unseen.better:
            reasons.append("data held out are not predicted better")
        explained = whole.null.fit.chi2 - final.fit.chi2
        outsider = outsider_probability(
            final, self.options.outsider_prior, explained, self._spots_instead(whole, final)
        )
        named = []
        for name in final.names:
            probability = classes[name].probability * (1.0 - outsider)
            if probability < self.options.least_probability:
                reasons.append(f"the class of {name} has probability {probability_text(probability)} only")
            named.append(self._named(final, name, classes[name], probability))
        self.notes.append(
            f"held out: chi2 of blocks falls by {self.unseen.blocks:.1f}, "
            f"of wavelengths by {self.unseen.wavelengths:.1f}"
        )
        if reasons:
            return self._unexplained(whole, final, chance, steps, "; ".join(reasons), partial=named)
        form = self._what_may_be_form(sets, chosen)
        self.notes.extend(form)
        decided, self.next_measurements = with_next_measurements(
            named,
            {name: group.values for name, group in classes.items()},
            self._ranking(whole, final, named),
            self.say,
        )
        found = self._verdict("named", whole, final, chance, decided, {}, steps)
        learned = self._learned(whole, final) if form else {}
        return replace(found, learned=learned, accuracy=self._accuracy(whole, chance))

    def _spots_instead(self, whole: Selector, final: Hypothesis) -> float:
        """Log evidence of a few spots in the place of an effect of image or island, over that of the effect.

        Gains of two amplifiers under a stain are most of the stain.
        """
        gains = [-math.inf]
        for effect in self.effects:
            if effect.name in final.names and (effect.acts_on == "image" or effect.local):
                rest = tuple(name for name in final.names if name != effect.name)
                without = whole.improved(rest, final.fit) if rest else whole.null
                brought = final.log_evidence - without.log_evidence
                gains.append(whole.evidence_of_spots(without) - brought)
        return max(gains)

    @staticmethod
    def _what_remains(found: Hypothesis) -> str:
        worst = min(found.channels, key=lambda channel: channel.probability)
        return (
            f"with {', '.join(found.names)} a residual remains in '{worst.name}' "
            f"(chance {chance_text(worst.probability)})"
        )

    def _what_may_be_form(self, sets: SetSearch, chosen: Hypothesis) -> list[str]:
        """That more than noise is left, though no more than what may be wrong with the form of the effects."""
        selector, strict = sets.selector, sets.taken_for_exact(chosen)
        if self.options.is_noise(strict):
            return []
        worst = min(strict.channels, key=lambda channel: channel.probability)
        told = (
            f"less than {IMPRECISION:.0%} of what {', '.join(chosen.names)} explains is left in '{worst.name}' "
            f"(chance {worst.probability:.2g}): its form may be wrong by as much, or a fainter effect be there"
        )
        alike = selector.score(chosen.fit, selector.others(chosen))[:1]
        return [told + "".join(f", most like {one.name} (gain {one.gain:.0f})" for one in alike)]

    def _ranking(self, whole: Selector, final: Hypothesis, named: Sequence[NamedEffect]) -> Ranking:
        """What ranks further data: flats beside flats, frames and flats beside frames of the sky."""
        if whole.problem.forward.exposures is not None:
            forecast = FrameForecast(whole.problem, final.fit, whole.coordinates)
            return lambda effect, rivals: forecast.ranked(effect.name, rivals)
        thickness = whole.problem.basis.expand(final.fit.field)
        # Of a few pixels, those of the same sensor that see the rest of a fringe.
        middle = 0.5 * float(thickness.min() + thickness.max())
        order = float(self.model.fringe_order_um(np.median(self.cells.wavelength_nm)))
        half = 0.5 * max(float(np.ptp(thickness)) + 2e-3, order)
        limits = (middle - half, middle + half)
        return lambda effect, rivals: flats_ranked(
            effect, rivals, named, self.model, self.cells, limits, self.effects, few=not self.prepared.rich
        )

    def _of_all_data(self, whole: Selector, chosen: Hypothesis) -> Hypothesis:
        """The chosen set fitted to all data, and tested there."""
        return whole.with_channels(whole.settled(self._transfer(whole, chosen)))

    def _transfer(self, whole: Selector, chosen: Hypothesis) -> Hypothesis:
        """The chosen set fitted to all data, the cells held out in the likelier fringe order."""
        starts = thickness_starts(whole.problem, whole.null.fit, chosen.fit, self.heldout)
        first, *others = [replace(chosen.fit, field=self._field_of(whole, thickness)) for thickness in starts]
        found = whole.hypothesis(chosen.names, None, first)
        for other in others:
            found = whole.improved(chosen.names, other)
        return found

    def _field_of(self, whole: Selector, thickness_um: FloatArray) -> FloatArray:
        return whole.problem.basis.fit(thickness_um, self.cells.seen.astype(float))

    def _named(self, final: Hypothesis, name: str, group: EffectClass, probability: float) -> NamedEffect:
        parameters = {}
        for item, position, sigma in zip(
            final.fit.coordinates, final.fit.position, final.fit.sigma, strict=True
        ):
            if item.effect == name:
                value, error = item.value(position), item.value_sigma(position, sigma)
                parameters[item.parameter] = ParameterValue(value, float(error), item.unit)
                if item.neighbour and error > 0.1 * item.neighbour:
                    self.notes.append(
                        f"{item.key}: minima {item.neighbour:g} {item.unit} apart are nearly as good"
                    )
        members = group.members
        others = tuple(sorted((n for n in members if n != name), key=lambda n: -members[n]))
        share = members.get(name, 0.0) / max(sum(members.values()), 1e-300)
        return NamedEffect(
            name, parameters, float(probability), others, "", float(share), float(group.significance)
        )

    def _unexplained(
        self,
        whole: Selector,
        hypothesis: Hypothesis,
        chance: float,
        steps: list[Step],
        reason: str,
        partial: Sequence[NamedEffect] = (),
    ) -> Verdict:
        state = whole.state(hypothesis.fit)
        channels: tuple[Channel, ...] = hypothesis.channels or whole.criticise(hypothesis.fit)
        accuracy = self._accuracy(whole, chance)
        # A search that was stopped says nothing of what it did not try, and what an effect explains is no error of a
        # table.
        ended = math.isinf(self.until) and not partial
        within = ended and accuracy.get("chance", 0.0) > self.options.significance
        verdict, accuracy = ("no_discrepancy" if within else "unexplained"), {**accuracy, "within": within}
        if within:
            reason = f"{WITHIN_ACCURACY}; {reason}"
        alike = whole.null if within else self._alike(whole, hypothesis)
        description: dict[str, Any] = {
            "reason": reason,
            "too_poor": False,
            "like": list(alike.names),
            "partial": [
                {"name": e.name, "probability": e.probability, "significance": e.significance,
                 "parameters": {k: [p.value, p.sigma] for k, p in e.parameters.items()}}
                for e in partial
            ],
            **describe_residual(state, self.cells.geometry, self.prepared.index, self.cells.cell_px, channels),
        }  # fmt: skip
        learned = {} if within else self._learned(whole, alike)
        found = self._verdict(verdict, whole, hypothesis, chance, (), description, steps)
        return replace(found, learned=learned, accuracy=accuracy)

    def _alike(self, whole: Selector, found: Hypothesis) -> Hypothesis:
        """The effects of a set that are not the cause, and which no correction can replace."""
        teaches = self.prepared.rich and not self.cells_are_of_sky

        def evidence(one: Hypothesis) -> float:
            return one.log_evidence + (evidence_of_correction(whole.problem, one.fit) if teaches else 0.0)

        def smaller(one: Hypothesis) -> list[Hypothesis]:
            return [
                whole.hypothesis(tuple(n for n in one.names if n != name), None, one.fit)
                for name in one.names
            ]

        try:
            with time_limit(self.until):
                return not_replaced(found, smaller, evidence, self.options.least_evidence)
        except OutOfTimeError:
            return whole.null

    def _learned(self, whole: Selector, found: Hypothesis) -> dict[str, Any]:
        """A correction beside a set, judged by cells that it has not seen; nothing where there is none."""
        if not self.prepared.rich or self.cells_are_of_sky:
            return {}
        self.say("learning a correction from what is left")
        try:
            with time_limit(self.until):
                learned = learned_beside(
                    whole.problem,
                    whole.null.fit,
                    found.fit,
                    self.heldout,
                    self.rng,
                    self.options.least_evidence,
                )
        except OutOfTimeError:
            return {}
        return {} if learned is None else learned.as_mapping(found.names)

    def _accuracy(self, whole: Selector, chance: float) -> dict[str, Any]:
        """The disagreement beside what the model may be wrong by."""
        assumed = self.options.model_accuracy
        if not self.prepared.rich or self.cells_are_of_sky or assumed == 0.0:
            return {}
        source = ACCURACY_SOURCE if assumed == MODEL_ACCURACY else "as asked for"
        told: dict[str, Any] = {"assumed": assumed, "source": source}
        try:
            with time_limit(self.until):
                told["chance"] = max(chance, chance_within_accuracy(whole, whole.null.fit, assumed))
        except OutOfTimeError:
            return told
        return told

    @property
    def cells_are_of_sky(self) -> bool:
        """Whether the light is that of the sky, where the errors of the tables are those of the map too."""
        return self.prepared.problem.forward.exposures is not None

    def _verdict(
        self,
        verdict: str,
        whole: Selector,
        final: Hypothesis,
        chance: float,
        effects: tuple[NamedEffect, ...],
        unexplained: dict[str, Any],
        steps: Sequence[Step] = (),
    ) -> Verdict:
        null = whole.null.fit
        before, after = misfit_rms(whole.problem, null), misfit_rms(whole.problem, final.fit)
        unseen = self.unseen or HeldOut(0.0, 0.0, before, after)
        gap = Gap(METRIC, before, after, unseen.before_rms, unseen.after_rms, self.cells.noise_rms)
        candidates = tuple({"name": c.name, "score": c.gain, "degrees": c.degrees} for c in self.scores)  # type: tuple[dict[str, Any], ...]
        self.notes += said_of_left_out(whole.left_out)
        data = {
            "shape": list(self.cells.shape),
            "cell_px": self.cells.cell_px,
            "wavelength_nm": self.cells.wavelength_nm.tolist(),
            "noise_factor": self.prepared.noise.factor.tolist(),
            "response_scatter": self.prepared.noise.response_scatter,
            "thickness_um": [
                float(whole.problem.basis.expand(final.fit.field).min()),
                float(whole.problem.basis.expand(final.fit.field).max()),
            ],
        }
        return Verdict(
            verdict, effects, self.where, gap, tuple(steps), unexplained, self.model.setup.name, chance, candidates,
            self.next_measurements, tuple(self.notes), data, size=disagreement_size(whole.problem, null),
        )  # fmt: skip
