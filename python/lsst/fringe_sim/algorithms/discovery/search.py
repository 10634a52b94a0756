"""The search: fit, test, rank, name, validate on data held out, describe what is left."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import ncx2
from threadpoolctl import threadpool_limits

from ...effects import EFFECTS, Effect
from ...model import FringeModel, Setup
from ...products.fringe_cube import FringeCube
from .channels import Channel
from .classes import EffectClass, classes_in_all_data, classes_of, outsider_probability
from .describe import describe_residual, disagreement
from .fit import Fit, fit_model
from .forward import Exposures
from .hidden_islands import hidden_island
from .next_frames import FrameForecast
from .next_step import Ranking, flats_ranked, with_next_measurements
from .pairs import fitted_pair, likely_pairs
from .preparation import (
    Prepared,
    check_setup,
    headers_apart,
    prepare,
    prepare_again,
    prepare_finer,
    prepare_with_areas,
    sees_areas,
    why_too_poor,
    without_blurs,
)
from .selection import IMPRECISION, Candidate, Hypothesis, Selector, similarity
from .validation import (
    HeldOut,
    held_out_blocks,
    misfit_rms,
    thickness_starts,
    validate,
    whole_thickness,
)
from .verdict import Gap, NamedEffect, ParameterValue, Step, Verdict, Where, probability_text

__all__ = ["SearchOptions", "discover"]

FloatArray = NDArray[np.float64]

SURELY = 1e-7
"""Chance of noise below which an effect is added to a set that leaves nothing else to see."""

WORTH_FITTING = 9.0
"""Fall of χ² that an effect must promise to be fitted."""

MORE_THAN_PROMISED = 3.0
"""By how much a fit may bring more than its score promised."""

MUCH_LEFT = 0.05
"""χ² above that of noise, over the number of values, that is surely no error of the noise."""

HARDLY_LESS = 0.5
"""Part of that excess which one effect must take off, or further ones promise, for sets of several to be tried."""

SHIFTING_SETS = 3
"""Sets of several effects that are looked for in other fringe orders."""

CONTAINED = 0.9
"""Cosine of the signatures from which on an effect may be hidden in another of many parameters."""

MOST_OF_MANY = 0.8
"""Part of what an effect of many parameters brings that two others must promise to be fitted in its place."""

_METRIC = "rms of data minus model, relative counts"

Report = Callable[[str], None]


PAIR = 2
"""Effects with which fringe orders are judged again before a third is looked for: what leaves a residual may be one
effect and a thickness that is wrong in places."""


@dataclass(frozen=True)
class SearchOptions:
    """Thresholds and sizes of a search; the defaults were chosen on other seeds than those of the recorded challenge.

    Attributes
    ----------
    most_cells : `int`
        Cells that the data are averaged to, if the pattern allows it.
    significance : `float`
        Chance of noise below which the unchanged model is held to disagree.
    consistency : `float`
        Chance of noise above which a residual is held to be noise.
    least_evidence : `float`
        Gain in log evidence that an added effect must bring.
    class_width : `float`
        Difference in log evidence within which effects are one class.
    least_probability : `float`
        Probability of a class with which it is named.
    most_effects : `int`
        Largest number of effects named together.
    refits : `int`
        Effects that are refitted in each round, best scores first; twice as many pairs.
    credit : `float`
        Log evidence that a set may lack if what it leaves is noise and what the other leaves is not.
    parents : `int`
        Sets of nearly equal evidence from which larger ones are made.
    heldout_fraction : `float`
        Part of the sensor that no selection sees.
    outsider_prior : `float`
        Prior probability of a cause that is not in the catalogue.
    """

    most_cells: int = 20_000
    significance: float = 1e-3
    consistency: float = 1e-3
    least_evidence: float = 6.0
    class_width: float = 5.0
    least_probability: float = 0.95
    most_effects: int = 3
    refits: int = 10
    credit: float = 20.0
    parents: int = 5
    heldout_fraction: float = 0.25
    outsider_prior: float = 0.15


def discover(
    cube: FringeCube,
    setup: str | Setup | FringeModel,
    effects: Sequence[Effect] = EFFECTS,
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
        The catalogue.
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
        The set-up contradicts the data (temperature, bandpass), or is not one of a laboratory.
    """
    model = setup if isinstance(setup, FringeModel) else FringeModel.from_setup(setup)
    check_setup(cube, model)
    known = {item.effect.name for item in model.effects}
    # Flats do not see the spectrum of the night sky.
    own = [effect for effect in effects if effect.acts_on != "spectrum" or effect.name in known]
    return search_exposures(cube, model, own, rng, options, report)


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
        say("fitting the thickness with the unchanged model")
        prepared = prepare(cube, model, effects, chosen.most_cells, exposures)
        return _Search(cube, prepared, model, effects, chosen, rng, say).run()


def _no_answer(model: FringeModel, reason: str, cube: FringeCube) -> Verdict:
    nan = math.nan
    return Verdict(
        "unexplained", (), Where(), Gap(_METRIC, nan, nan, nan, nan, nan), (), {"reason": reason, "too_poor": True},
        model.setup.name, nan, data={"shape": list(cube.shape)},
    )  # fmt: skip


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
        self._may_judge_orders = self._may_take_areas = self._may_look_for_islands = True
        self._take_other_cells(prepared)

    def _take_other_cells(self, prepared: Prepared) -> None:
        shape = prepared.problem.cells.shape[1:]
        self.heldout = held_out_blocks(shape, self.options.heldout_fraction, self.rng)
        self._take(prepared)

    def _take(self, prepared: Prepared) -> None:
        self.prepared, self.cells = prepared, prepared.problem.cells
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
        )
        self.where = self._where(whole)
        chance = self._chance(whole, whole.null)
        self.say(f"chance that noise alone disagrees as much: {chance:.3g}")
        if chance > self.options.significance:
            return self._with_hidden_island(whole.null) or self._verdict(
                "no_discrepancy", whole, whole.null, chance, (), {}
            )
        training = self._training(whole)
        if known is not None and known.coordinates:
            chosen, steps = self._resumed(training, known)
            chosen = self._enlarge(whole, training, chosen, steps, self.options.most_effects)
            return self._conclude(whole, training, self._finished(training, chosen, steps), steps, chance)
        singles = self._refit(training, training.null)
        if singles and singles[0].log_evidence > self.options.least_evidence and refinements > 0:
            refined, _ = self._refined(whole, singles[0])
            if refined is not None:
                self.say("field and noise are judged again with the best effect in the model")
                self._take(refined)
                return self.run(refinements - 1)
        if singles and self._is_too_coarse(training, singles[0]):
            return self._run_finer(singles[0].fit, self._thickness(whole, singles[0].fit))
        chosen, steps = self._first(whole, training, singles)
        if self._is_hopeless(training, chosen):
            self.say("the catalogue explains next to nothing of it: no sets of several effects are tried")
            return self._conclude(whole, training, chosen, steps, chance)
        chosen = self._enlarge(whole, training, chosen, steps, min(PAIR, self.options.most_effects))
        doubtful = not self._consistent(chosen) or self._places > 0
        if self._may_judge_orders and chosen.names and doubtful:
            self._may_judge_orders = False
            refined, mended = self._refined(whole, chosen)
            if refined is not None and (mended or refined.problem.forward.places != self._places):
                # One effect alone, whose misfit may look like sharper pixels, does not judge them better once more.
                self._take(refined)
                return self.run(refinements=0)
        if len(chosen.names) == PAIR:
            chosen = self._enlarge(whole, training, chosen, steps, self.options.most_effects)
        chosen = self._finished(training, chosen, steps)
        if self._may_take_areas and sees_areas(training.problem, chosen.fit):
            self._may_take_areas = self._may_judge_orders = False
            self.say("pixels see their area, and the blur is what few places lacked of it")
            self._take(prepare_with_areas(self.prepared, chosen.fit, self._thickness(whole, chosen.fit)))
            return self.run(refinements=0, known=without_blurs(chosen.fit))
        if chosen.names and self._consistent(chosen):
            verdict = self._with_hidden_island(self._of_all_data(whole, chosen))
            if verdict is not None:
                return verdict
        return self._conclude(whole, training, chosen, steps, chance)

    def _resumed(self, selector: Selector, known: Fit) -> tuple[Hypothesis, list[Step]]:
        """The effects of a fit to data that were judged otherwise."""
        names = tuple(dict.fromkeys(item.effect for item in known.coordinates))
        field = self.prepared.undistorted_field
        base = replace(
            known,
            field=self.prepared.null.field if field is None else field,
            levels=known.levels[: selector.problem.n_levels],
        )
        found = selector.with_channels(selector.hypothesis(names, None, base))
        return found, [self._step(selector, selector.null, found)]

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
            (_chance_of(c.gain, c.degrees, selector.undescribed(c.name)) for c in scores), default=1.0
        )
        # Effects are alike in groups; counting each as a look of its own errs on the safe side.
        catalogue = float(-np.expm1(len(scores) * np.log1p(-min(smallest, 1 - 1e-16)))) if scores else 1.0
        self.scores = scores
        both = min(hypothesis.probability_of_noise, catalogue)
        return float(-np.expm1(2.0 * np.log1p(-min(both, 1.0 - 1e-16))))

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
        )

    def _refit(
        self, selector: Selector, base: Hypothesis, rival: Hypothesis | None = None
    ) -> list[Hypothesis]:
        """Refits of the best-scored additions to a set, likeliest first; none that cannot come near a rival."""
        scores = selector.score(base.fit, selector.others(base), scan=True)
        if self.prepared.shifts_um:  # a score in the wrong order says nothing
            worth = scores
        else:
            missing = base.fit.chi2 - rival.fit.chi2 if rival else 0.0
            least = max(WORTH_FITTING, missing / MORE_THAN_PROMISED)
            worth = [c for c in scores if c.promise > least][: self.options.refits]
        refitted = [selector.hypothesis((*base.names, c.name), c.start, base.fit) for c in worth]
        for hypothesis in refitted:
            self._say_refit(base, hypothesis)
        return sorted(refitted, key=lambda item: -item.log_evidence)

    def _refined(self, whole: Selector, best: Hypothesis) -> tuple[Prepared | None, int]:
        """Field and noise as judged with effects in the model, if that differs, and cells that change their order."""
        refined, mended = prepare_again(self.prepared, best.fit, self._thickness(whole, best.fit))
        if mended:
            self.say(f"{mended} cells change their fringe order with {', '.join(best.names)}")
        return refined, mended

    def _is_too_coarse(self, selector: Selector, found: Hypothesis) -> bool:
        """Whether a blur explains much, but not all, in cells that were chosen for the image that it left."""
        if self.cells.cell_px == 1 or not self.prepared.rich or self.prepared.problem.field_prior:
            return False
        blurs = any(selector.problem.forward.couples_pixels(name) for name in found.names)
        return blurs and not self._consistent(selector.with_channels(found))

    def _run_finer(self, fit: Fit, thickness_um: FloatArray) -> Verdict:
        """Search again in cells of half the size."""
        self.say(f"light was finer before it was blurred: cells of {self.cells.cell_px // 2} px")
        finer = prepare_finer(self.cube, self.prepared, fit, thickness_um, self.options.most_cells)
        self._take_other_cells(finer)
        return self.run(refinements=1)

    def _thickness(self, whole: Selector, fit: Fit) -> FloatArray:
        return whole_thickness(whole.problem, whole.null.fit, fit, self.heldout)

    def _first(
        self, whole: Selector, selector: Selector, singles: list[Hypothesis]
    ) -> tuple[Hypothesis, list[Step]]:
        """The most credible single effect, if there is one that helps."""
        if not singles or singles[0].log_evidence < self.options.least_evidence:
            return selector.null, []
        best = self._most_credible(selector, singles)
        if not self._consistent(best):
            best = self._most_credible(selector, self._searched_harder(selector, singles))
        elif selector.shifts_phase(best):  # few data see only noise in a wrong order too
            best = selector.with_channels(selector.improved(best.names, selector.null.fit, scan=True))
        best = self._rescued(whole, selector, best)
        return best, [self._step(selector, selector.null, best)]

    def _enlarge(
        self, whole: Selector, selector: Selector, current: Hypothesis, steps: list[Step], most: int
    ) -> Hypothesis:
        """Add effects, up to so many, while a residual remains and they help."""
        while steps and not steps[-1].consistent and len(current.names) < most:
            larger = self._one_more(selector, current)
            if larger is None:
                break
            larger = self._rescued(whole, selector, larger)
            steps.append(self._step(selector, current, larger))
            current = larger
        return current

    def _rescued(self, whole: Selector, training: Selector, found: Hypothesis) -> Hypothesis:
        """The set fitted again from its fit to all data, where that leaves noise and this one does not.

        Single cells between others that are held out or masked may be in another fringe order.
        """
        if self._consistent(found):
            return found
        final = self._of_all_data(whole, found)
        if not self._consistent(final):
            return found
        return training.with_channels(training.improved(found.names, final.fit))

    def _finished(self, selector: Selector, current: Hypothesis, steps: list[Step]) -> Hypothesis:
        """The set with what noise surely does not explain, and without members that bring nothing."""
        if not steps:
            return current
        while self._consistent(current) and len(current.names) < self.options.most_effects:
            better = self._surely_better(selector, current)
            if better is None:
                break
            other = self._other_member(selector, current, steps)
            if other is None:
                steps.append(self._step(selector, current, better))
            current = other or better
        other = self._pair_instead(selector, current)
        if other is not current:
            steps.append(self._step(selector, current, other))
            current = other
        complete = selector.with_channels(self._completed(selector, current))
        if complete.names != current.names:
            steps.append(self._step(selector, current, complete))
        return self._pruned(selector, complete)

    def _other_member(self, selector: Selector, current: Hypothesis, steps: list[Step]) -> Hypothesis | None:
        """The set with another effect in the place of one, if that is clearly likelier and leaves noise as well.

        What a wrong effect leaves is another form, which two or three more make up for.
        """
        taken = list(steps)
        likelier = selector.with_channels(self._classified(selector, current, taken)[0])
        if likelier.names == current.names or not self._consistent(likelier):
            return None
        steps[:] = taken
        return likelier

    def _pair_instead(self, selector: Selector, current: Hypothesis) -> Hypothesis:
        """The set with two effects in the place of one of many parameters, where they are likelier and leave noise.

        Errors of all wavelengths take in what an absorbing silicon and a wider line do together, neither of which is
        likely by itself.
        """
        best = current
        if not self._consistent(current) or len(current.names) >= self.options.most_effects:
            return best
        for name in filter(selector.has_many, current.names):
            left = tuple(other for other in current.names if other != name)
            rest = selector.improved(left, current.fit) if left else selector.null
            least = MOST_OF_MANY * (rest.fit.chi2 - current.fit.chi2)
            pairs = likely_pairs(selector, rest.fit, selector.others(current))[: self.options.refits]
            for pair in (pair for pair in pairs if pair.gain > max(least, WORTH_FITTING)):
                found = fitted_pair(selector, rest, pair)
                self._say_refit(rest, found)
                likelier = found.log_evidence > best.log_evidence + self.options.least_evidence
                if likelier and self._consistent(selector.with_channels(found)):
                    best = selector.with_channels(found)
        return best

    def _one_more(self, selector: Selector, current: Hypothesis) -> Hypothesis | None:
        """The most credible set with one effect more, if it is likelier."""
        larger = self._enlarged(selector, current)
        if not larger:
            return None
        best = self._most_credible(selector, larger)
        if not self._consistent(best):
            best = self._most_credible(selector, self._in_other_orders(selector, larger))
        if best.log_evidence < current.log_evidence + self.options.least_evidence:
            return None
        return best if self._consistent(best) else self._swapped(selector, best)

    def _surely_better(self, selector: Selector, current: Hypothesis) -> Hypothesis | None:
        """The set with one effect more that no noise explains, though the tests without a catalogue see only noise.

        Those tests share their power among many patterns; one effect has a single one. What it brings may be no more
        than what is wrong with the form of the others: then nothing else may be left, though nothing is allowed for
        that.
        """
        wrong = IMPRECISION**2 * self._explained_by_guesses(selector, current)
        worth = [
            candidate
            for candidate in selector.score(current.fit, selector.others(current))
            if _surely_gains(selector, candidate)
        ]
        found = []
        for candidate in worth[: self.options.parents]:
            larger = selector.hypothesis((*current.names, candidate.name), candidate.start, current.fit)
            self._say_refit(current, larger)
            if _surely_gains(selector, candidate, wrong) or self._is_all(selector, larger):
                found.append(larger)
        best = max(found, key=lambda item: item.log_evidence, default=None)
        if best is None or best.log_evidence < current.log_evidence + self.options.least_evidence:
            return None
        return selector.with_channels(best)

    def _is_all(self, selector: Selector, hypothesis: Hypothesis) -> bool:
        """Whether a set leaves noise though the form of its effects is taken for exact."""
        return self._consistent(self._taken_for_exact(selector, hypothesis))

    @staticmethod
    def _taken_for_exact(selector: Selector, hypothesis: Hypothesis) -> Hypothesis:
        return replace(hypothesis, channels=selector.criticise(hypothesis.fit, imprecision=0.0))

    @staticmethod
    def _explained_by_guesses(selector: Selector, current: Hypothesis) -> float:
        """χ² that the effects of a set explain whose form may be wrong."""
        exact = tuple(name for name in current.names if selector.effects[name].exact)
        if exact == current.names:
            return 0.0
        without = selector.hypothesis(exact, None, current.fit) if exact else selector.null
        return max(without.fit.chi2 - current.fit.chi2, 0.0)

    def _completed(self, selector: Selector, current: Hypothesis) -> Hypothesis:
        """The set with an effect beside one of many parameters that can play its part, where that is likelier.

        Sixteen offsets of the amplifiers take in a pedestal, and the residual is noise without it; that all of them
        lie far on one side of zero is likelier with both.
        """
        best = current
        for name in current.names:
            if (
                not selector.has_many(name)
                or selector.prior_cost(current, name) < self.options.least_evidence
            ):
                continue
            rest = selector.hypothesis(tuple(n for n in current.names if n != name), None, current.fit)
            state = selector.state(rest.fit)
            own = selector.features(state, rest.fit, name)
            alike = []
            for candidate in selector.score(rest.fit, selector.others(current)):
                smaller = len(selector.coordinates[candidate.name]) < len(own)
                if candidate.promise > WORTH_FITTING and smaller:
                    features = selector.features(state, rest.fit, candidate.name)
                    alike.append((similarity(state.design, own, features), candidate))
            for cosine, candidate in sorted(alike, key=lambda pair: -pair[0])[: self.options.parents]:
                if cosine > CONTAINED:
                    larger = selector.hypothesis(
                        (*current.names, candidate.name), candidate.start, current.fit
                    )
                    self._say_refit(current, larger)
                    best = max(best, larger, key=lambda item: item.log_evidence)
        return best if best.log_evidence > current.log_evidence + self.options.least_evidence else current

    def _is_hopeless(self, selector: Selector, chosen: Hypothesis) -> bool:
        """Whether so much is left, and so little of it promised by all effects, that no set leaves noise."""
        noise = selector.problem.cells.n_values
        before, excess = selector.null.fit.chi2 - noise, chosen.fit.chi2 - noise
        if self.prepared.shifts_um or excess < max(MUCH_LEFT * noise, HARDLY_LESS * before):
            return False
        scores = selector.score(chosen.fit, selector.others(chosen), scan=True)
        best = sorted((candidate.promise for candidate in scores), reverse=True)[: self.options.most_effects]
        return MORE_THAN_PROMISED * sum(best) < HARDLY_LESS * excess

    def _enlarged(self, selector: Selector, current: Hypothesis) -> list[Hypothesis]:
        """Refits of the most promising sets with one effect more.

        The best set need not hold the best smaller one: every set nearly as good is scored, and what all of them
        promise is compared.
        """
        near = 0.3 * max(current.log_evidence, 100.0)
        parents = [
            h for h in selector.known(len(current.names)) if h.log_evidence > current.log_evidence - near
        ]
        promised: dict[frozenset[str], tuple[float, Hypothesis, Candidate]] = {}
        for parent in parents[: self.options.parents]:
            for candidate in selector.score(parent.fit, selector.others(parent), scan=True):
                key = frozenset((*parent.names, candidate.name))
                left = parent.fit.chi2 - candidate.promise
                if candidate.promise > WORTH_FITTING and left < promised.get(key, (math.inf,))[0]:
                    promised[key] = (left, parent, candidate)
        best = sorted(promised.values(), key=lambda item: item[0])[: 2 * self.options.refits]
        found = []
        for _, parent, candidate in best:
            found.append(selector.hypothesis((*parent.names, candidate.name), candidate.start, parent.fit))
            self._say_refit(parent, found[-1])
        return found

    def _say_refit(self, before: Hypothesis, after: Hypothesis) -> None:
        self.say(
            f"  with {', '.join(after.names)}: chi2 falls by {before.fit.chi2 - after.fit.chi2:.1f}, "
            f"log evidence {after.log_evidence:.1f}"
        )

    def _swapped(self, selector: Selector, current: Hypothesis, rounds: int = 3) -> Hypothesis:
        """Replace members one at a time while that helps: the best set need not hold the best single effect."""
        for _ in range(rounds):
            before = current
            for name in current.names:
                rest = tuple(other for other in current.names if other != name)
                best = max(
                    self._refit(selector, selector.improved(rest, current.fit), current),
                    key=lambda item: item.log_evidence,
                    default=current,
                )
                if best.log_evidence > current.log_evidence + 1.0:
                    current = best
                    break
            if current is before:
                break
        return selector.with_channels(current)

    def _searched_harder(self, selector: Selector, singles: list[Hypothesis]) -> list[Hypothesis]:
        """The nearly best single effects, and those that shift the phase, tried at other sizes too."""
        near = [h for h in singles if h.log_evidence > 0.7 * singles[0].log_evidence][:4]
        near += [h for h in singles if h not in near and selector.shifts_phase(h)]
        return [selector.improved(h.names, selector.null.fit, scan=True) for h in near]

    def _in_other_orders(self, selector: Selector, found: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The sets, the best of those that shift the phase looked for in other fringe orders too."""
        ranked = sorted(found, key=lambda h: -h.log_evidence)
        shifting = [h for h in ranked if selector.shifts_phase(h)][:SHIFTING_SETS]
        return [selector.improved(h.names, h.fit, scan=True) if h in shifting else h for h in ranked]

    def _most_credible(self, selector: Selector, found: Sequence[Hypothesis]) -> Hypothesis:
        """Best of some sets by their evidence and by what they leave: a residual that is no noise speaks against."""
        top = max(item.log_evidence for item in found)
        near = [
            selector.with_channels(item) for item in found if item.log_evidence > top - self.options.credit
        ]

        def credibility(item: Hypothesis) -> float:
            chance = max(item.probability_of_noise, 1e-300) / self.options.consistency
            return item.log_evidence + max(min(math.log(chance), 0.0), -self.options.credit)

        return max(near, key=credibility)

    def _pruned(self, selector: Selector, hypothesis: Hypothesis) -> Hypothesis:
        """Leave out members that bring nothing."""
        for name in hypothesis.names:
            rest = tuple(other for other in hypothesis.names if other != name)
            if not rest:
                continue
            smaller = selector.with_channels(selector.improved(rest, hypothesis.fit))
            if smaller.log_evidence > hypothesis.log_evidence - 3.0 and self._consistent(smaller):
                return self._pruned(selector, smaller)
        return hypothesis

    def _consistent(self, hypothesis: Hypothesis) -> bool:
        return hypothesis.probability_of_noise > self.options.consistency

    def _step(self, selector: Selector, before: Hypothesis, after: Hypothesis) -> Step:
        return Step(
            tuple(name for name in after.names if name not in before.names),
            after.log_evidence - before.log_evidence,
            before.fit.chi2 - after.fit.chi2,
            misfit_rms(selector.problem, before.fit),
            misfit_rms(selector.problem, after.fit),
            self._consistent(after),
        )

    # Conclusion ---------------------------------------------------------------------------------------------

    def _conclude(
        self, whole: Selector, training: Selector, chosen: Hypothesis, steps: list[Step], chance: float
    ) -> Verdict:
        if not chosen.names:
            return self._unexplained(
                whole, whole.null, chance, steps, "no effect of the catalogue explains it"
            )
        chosen, classes = self._classified(training, chosen, steps)
        final = self._of_all_data(whole, chosen)
        if self._is_too_coarse(whole, final):
            return self._run_finer(final.fit, whole.problem.basis.expand(final.fit.field))
        room = len(chosen.names) < self.options.most_effects
        if room and self._consistent(chosen) and not self._consistent(final):
            self.say("a residual remains that only all data show")
            larger = self._one_more(training, chosen)
            if larger is not None:
                larger = self._pruned(training, self._rescued(whole, training, larger))
                steps.append(self._step(training, chosen, larger))
                chosen, classes = self._classified(training, larger, steps)
                final = self._of_all_data(whole, chosen)
        classes = classes_in_all_data(
            classes, chosen, final, lambda rival: self._transfer(whole, rival), self.options.class_width
        )
        self.unseen = validate(
            whole.problem, whole.null.fit, final.fit, self.heldout, rich=self.prepared.rich
        )
        # All data decide: they hold the part searched, and a cause that is there stands out more clearly in them.
        reasons = [] if self._consistent(final) else [self._what_remains(final)]
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
        self.notes.extend(self._what_may_be_form(training, chosen))
        decided, self.next_measurements = with_next_measurements(
            named,
            {name: group.values for name, group in classes.items()},
            self._ranking(whole, final, named),
            self.say,
        )
        return self._verdict("named", whole, final, chance, decided, {}, steps)

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
            f"(chance {worst.probability:.2g})"
        )

    def _what_may_be_form(self, selector: Selector, chosen: Hypothesis) -> list[str]:
        """That more than noise is left, though no more than what may be wrong with the form of the effects."""
        strict = self._taken_for_exact(selector, chosen)
        if self._consistent(strict):
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

    def _classified(
        self, training: Selector, chosen: Hypothesis, steps: list[Step]
    ) -> tuple[Hypothesis, dict[str, EffectClass]]:
        """Class of each effect of a set, and the set with a rival in the place of one that is clearly likelier."""
        classes = classes_of(training, chosen, self.options.class_width)
        for _ in range(self.options.most_effects):
            best = max((group.best for group in classes.values()), key=lambda item: item.log_evidence)
            if best.log_evidence < chosen.log_evidence + self.options.class_width:
                break
            likelier = self._most_credible(training, [chosen, best])
            if likelier.names == chosen.names:
                break
            steps.append(self._step(training, chosen, likelier))
            chosen, classes = likelier, classes_of(training, likelier, self.options.class_width)
        return chosen, classes

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
        description: dict[str, Any] = {
            "reason": reason,
            "too_poor": False,
            "partial": [
                {"name": e.name, "probability": e.probability, "significance": e.significance,
                 "parameters": {k: [p.value, p.sigma] for k, p in e.parameters.items()}}
                for e in partial
            ],
            **describe_residual(state, self.cells.geometry, self.prepared.index, self.cells.cell_px, channels),
        }  # fmt: skip
        return self._verdict("unexplained", whole, hypothesis, chance, (), description, steps)

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
        gap = Gap(_METRIC, before, after, unseen.before_rms, unseen.after_rms, self.cells.noise_rms)
        candidates = tuple({"name": c.name, "score": c.gain, "degrees": c.degrees} for c in self.scores)  # type: tuple[dict[str, Any], ...]
        for name, why in whole.left_out.items():
            self.notes.append(f"{name} was left out: {why}")
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
            self.next_measurements, tuple(self.notes), data,
        )  # fmt: skip


def _surely_gains(selector: Selector, candidate: Candidate, wrong: float = 0.0) -> bool:
    """Whether an effect gains more than noise, what the description of the fringes lacks, and ``wrong``."""
    undescribed = selector.undescribed(candidate.name)
    return _chance_of(candidate.gain - wrong, candidate.degrees, undescribed) < SURELY


def _chance_of(gain: float, degrees: int, undescribed: float) -> float:
    """Chance that noise, and what the description of the fringes lacks, give as large a gain in χ²."""
    noise = ncx2(degrees, undescribed) if undescribed > 0.0 else chi2_distribution(degrees)
    return float(noise.sf(gain))
