"""The search: fit, test, rank, name, validate on data held out, describe what is left."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution
from threadpoolctl import threadpool_limits

from ...effects import EFFECTS, Effect
from ...errors import InputError
from ...model import FringeModel, Setup
from ...products.fringe_cube import FringeCube
from .basis import CellBasis, FieldBasis, SplineBasis
from .cells import CellData, bin_cube, finest_useful_cell
from .channels import Channel
from .describe import describe_residual, disagreement
from .fit import Fit, Problem, fit_model
from .forward import Forward
from .next_step import with_next_measurements
from .noise import STATED_UNCERTAINTY, NoiseEstimate, estimate_noise
from .selection import IMPRECISION, Candidate, Hypothesis, Selector, similarity
from .start import mended_thickness, starting_thickness
from .verdict import Gap, NamedEffect, ParameterValue, Step, Verdict, Where

__all__ = ["SearchOptions", "discover"]

FloatArray = NDArray[np.float64]

MIMICKED = 0.05
"""Part of the causes outside the catalogue that effects in it can mimic."""

DECADES_OF_CHANCE = 200.0
"""Powers of ten by which a residual of signal to noise 30 is improbable."""

ORDERS_TRIED = 6
"""Fringe orders on both sides of the first one in which a few pixels are fitted."""

STEPS_PER_ORDER = 12

SURELY = 1e-7
"""Chance of noise below which an effect is added to a set that leaves nothing else to see."""

SHIFTING_SETS = 3
"""Sets of several effects that are looked for in other fringe orders."""

MANY_PARAMETERS = 8
CONTAINED = 0.9
"""Parameters from which on an effect may hide another, and the cosine from which on one may be hidden in it."""

Report = Callable[[str], None]


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
    outsider_prior: float = 0.1


@dataclass(frozen=True, eq=False)
class _Prepared:
    problem: Problem
    null: Fit
    noise: NoiseEstimate
    index: FloatArray
    rich: bool
    stated: CellData
    notes: tuple[str, ...] = field(default=())
    undistorted_field: FloatArray | None = None
    shifts_um: tuple[float, ...] = ()


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
    chosen = options or SearchOptions()
    say = report or (lambda text: None)
    model = setup if isinstance(setup, FringeModel) else FringeModel.from_setup(setup)
    _check_setup(cube, model)
    # Many small matrices: threads of the linear algebra would wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        poor = _too_poor(cube, model)
        if poor:
            return _no_answer(model, poor, cube)
        say("fitting the thickness with the unchanged model")
        prepared = _prepare(cube, model, effects, chosen)
        return _Search(prepared, model, effects, chosen, rng, say).run()


def _check_setup(cube: FringeCube, model: FringeModel) -> None:
    if model.setup.kind != "monochromator":
        raise InputError("set-up", model.setup.name, "a laboratory set-up with a monochromator")
    rows = cube.exposures
    known = {item.effect.name for item in model.effects}
    stated = model.base_system.temperature_k
    if np.any(np.abs(rows.temperature_k - stated) > 5.0) and "temperature" not in known:
        raise InputError(
            "temperature [K]", rows.temperature_k.tolist(), f"within 5 of the set-up's {stated:g}"
        )
    width = model.setup.bandwidth_fwhm_nm
    measured = rows.bandwidth_fwhm_nm[rows.bandwidth_fwhm_nm > 0.0]
    if np.any(np.abs(measured - width) > 0.02 * width) and "bandwidth" not in known:
        raise InputError("bandwidth FWHM [nm]", rows.bandwidth_fwhm_nm.tolist(), f"the set-up's {width:g}")
    single = model.base_system.beam.theta.size == 1
    if single and np.any(np.isfinite(rows.f_number)) and "converging_beam" not in known:
        raise InputError("f_number", rows.f_number.tolist(), "infinite: the set-up's light is parallel")


def _too_poor(cube: FringeCube, model: FringeModel) -> str:
    """Why these data cannot answer, or nothing."""
    good = (np.asarray(cube.mask) == 0).reshape(cube.shape[0], -1)
    pixels = int(good.any(axis=0).sum())
    if pixels == 0:
        return "no good pixel"
    dark = [f"{cube.wavelength_nm[k]:g} nm" for k in range(cube.shape[0]) if not good[k].any()]
    if dark:
        return f"no good pixel at {', '.join(dark)}"
    constant = [
        f"{cube.wavelength_nm[k]:g} nm"
        for k in range(cube.shape[0])
        if pixels > 1 and float(np.ptp(np.asarray(cube.image[k]).reshape(-1)[good[k]])) == 0.0
    ]
    if constant:
        return f"the frame is constant at {', '.join(constant)}: no fringes and no noise, so not data"
    waves = int(np.unique(cube.wavelength_nm).size)
    if cube.thickness is None:
        if waves < 3:
            return (
                f"{waves} wavelength(s) without a thickness map: thickness and effects cannot be told apart"
            )
        if pixels < 8 and waves < 6:
            return f"{pixels} pixel(s) at {waves} wavelengths: fewer data than free parameters"
    elif pixels < 16 and waves < 4:
        return f"{pixels} pixel(s) at {waves} wavelength(s): fewer data than free parameters"
    return ""


def _no_answer(model: FringeModel, reason: str, cube: FringeCube) -> Verdict:
    nan = math.nan
    return Verdict(
        "unexplained", (), Where(), Gap(_METRIC, nan, nan, nan, nan, nan), (), {"reason": reason, "too_poor": True},
        model.setup.name, nan, data={"shape": list(cube.shape)},
    )  # fmt: skip


_METRIC = "rms of data minus model, relative counts"


def _prepare(
    cube: FringeCube, model: FringeModel, effects: Sequence[Effect], options: SearchOptions
) -> _Prepared:
    size = finest_useful_cell(cube, most_cells=options.most_cells)
    cells = bin_cube(cube, size)
    rich = min(cells.shape[1:]) >= 6
    stack = model.system.stack
    medium = stack.layers[stack.position(model.system.varying)].medium
    index = np.real(medium.index(cells.wavelength_nm, model.system.temperature_k))
    if cells.thickness_um is not None:
        problem, first = _known_thickness(cells, model, effects)
        null = fit_model(problem, (), np.zeros(0), first)
        noise = _measure_noise(problem, null)
        problem = problem.with_cells(cells.scaled_noise(noise.factor, noise.response_scatter))
        return _Prepared(problem, fit_model(problem, (), np.zeros(0), null.field), noise, index, rich, cells)
    start = starting_thickness(model, cells)
    forward = Forward.of_cells(model, effects, cells, (float(start.min()) - 0.5, float(start.max()) + 0.5))
    levels = np.eye(cells.shape[0]) if rich else np.ones((cells.shape[0], 1))
    if not rich:
        return _prepare_few(cells, model, forward, start, levels, index)
    problem, fit = _choose_field(Problem(cells, forward, CellBasis(start.shape), levels), start, {})
    return _settle(problem, fit, cells, index)


def _choose_field(problem: Problem, start: FloatArray, settings: Mapping[str, float]) -> tuple[Problem, Fit]:
    """Coarsest parametrisation of the field that the data do not want finer, and its fit.

    The contrast of each wavelength is free: a field that had to make up for a wrong contrast would be drawn into
    ever finer coefficients.
    """
    cells = problem.cells
    weight = (cells.weight > 0).any(axis=0).astype(float)
    best: tuple[Problem, Fit] | None = None
    for spacing in (8.0, 4.0, 2.0, 0.0):
        basis: FieldBasis = SplineBasis.of_grid(start.shape, spacing) if spacing else CellBasis(start.shape)
        if spacing and basis.size > start.size:
            continue
        trial = replace(problem, basis=basis, free_contrast=True)
        field_map = start if best is None else best[0].basis.expand(best[1].field)
        levels = None if best is None else best[1].levels
        fit = fit_model(trial, (), np.zeros(0), basis.fit(field_map, weight), levels, settings)
        if best is not None and not _finer_is_better(best, (trial, fit)):
            break
        best = (trial, fit)
    assert best is not None
    return best


def _settle(problem: Problem, fit: Fit, stated: CellData, index: FloatArray) -> _Prepared:
    """Measure the noise at a fit with free contrast, and fit the unchanged model with it."""
    value = problem.forward.predict(fit.settings, problem.basis.expand(fit.field)).value
    expected = problem.expected(fit.levels, value)
    even = stated.with_noise_of(expected)
    noise = _measure_noise(replace(problem, cells=even), fit)
    cells = even.scaled_noise(noise.factor, noise.response_scatter)
    problem = replace(problem, cells=cells, free_contrast=False, reference=expected)
    levels = fit.levels[: problem.n_levels]
    settled = fit_model(problem, (), np.zeros(0), fit.field, levels)
    notes = []
    if abs(noise.neighbour_correlation) > 0.1:
        notes.append(f"noise of neighbouring cells is correlated ({noise.neighbour_correlation:.2f})")
    if not noise.measured:
        notes.append("noise level taken as stated: too few cells to measure it")
    return _Prepared(problem, settled, noise, index, True, stated, tuple(notes), fit.field)


def _finer_is_better(coarse: tuple[Problem, Fit], fine: tuple[Problem, Fit]) -> bool:
    """Whether more coefficients of the field lower χ² beyond what noise (or misfit) lets them."""
    extra = fine[0].basis.size - coarse[0].basis.size
    degrees = max(fine[0].cells.n_values - fine[0].basis.size - fine[0].cells.shape[0], 1)
    unit = fine[1].chi2 / degrees
    return coarse[1].chi2 - fine[1].chi2 > unit * (extra + 5.0 * math.sqrt(2.0 * max(extra, 1)))


def _known_thickness(
    cells: CellData, model: FringeModel, effects: Sequence[Effect]
) -> tuple[Problem, FloatArray]:
    """Problem for a given thickness map: the field may move only within its uncertainty."""
    assert cells.thickness_um is not None
    known = np.where(np.isfinite(cells.thickness_um), cells.thickness_um, np.nanmedian(cells.thickness_um))
    sigma = 0.01 if cells.thickness_sigma_um is None else float(np.nanmedian(cells.thickness_sigma_um))
    forward = Forward.of_cells(model, effects, cells, (float(known.min()) - 0.5, float(known.max()) + 0.5))
    rich = min(cells.shape[1:]) >= 6
    levels = np.eye(cells.shape[0]) if rich else np.ones((cells.shape[0], 1))
    basis = CellBasis(known.shape)
    return Problem(cells, forward, basis, levels, 1.0 / max(sigma, 1e-4) ** 2), known.ravel()


def _prepare_few(
    cells: CellData,
    model: FringeModel,
    forward: Forward,
    start: FloatArray,
    levels: FloatArray,
    index: FloatArray,
) -> _Prepared:
    """A few pixels with many wavelengths: every fringe order is tried, the stated noise is believed."""
    basis = CellBasis(start.shape)
    order = float(np.median(cells.wavelength_nm)) * 1e-3 / (2.0 * float(index.mean()))
    spread = cells.scaled_noise(1.0 + STATED_UNCERTAINTY, 0.0)
    problem = Problem(spread, forward, basis, levels)
    reach = np.arange(-ORDERS_TRIED * STEPS_PER_ORDER, ORDERS_TRIED * STEPS_PER_ORDER + 1)
    shifts = reach * (order / STEPS_PER_ORDER)
    shifts = shifts[float(start.min()) + shifts > 0.5]
    fits = [
        fit_model(problem, (), np.zeros(0), (start + shift).ravel()) for shift in shifts[::STEPS_PER_ORDER]
    ]
    noise = NoiseEstimate(np.ones(cells.shape[0]), 0.0, False, 0.0)
    best = min(fits, key=lambda fit: fit.chi2)
    note = "noise taken as stated plus 20 %; flat levels taken as known up to a common factor"
    return _Prepared(
        problem, best, noise, index, False, cells, (note,), start.ravel(), tuple(shifts.tolist())
    )


def _measure_noise(problem: Problem, fit: Fit) -> NoiseEstimate:
    thickness = problem.basis.expand(fit.field)
    value = problem.forward.predict(fit.settings, thickness).value
    expected = problem.expected(fit.levels, value)
    residual = np.where(problem.cells.weight > 0, problem.cells.value - expected, 0.0)
    return estimate_noise(problem.cells, residual)


@dataclass(frozen=True)
class _Class:
    """Effects that explain the data about as well: shares and fitted values by name, what is sure of all together."""

    members: dict[str, float]
    probability: float
    values: dict[str, dict[str, float]]
    significance: float


def _values_of(name: str, fit: Fit) -> dict[str, float]:
    return {
        key.partition(".")[2]: value for key, value in fit.settings.items() if key.partition(".")[0] == name
    }


class _Search:
    """One run of the search; every method is one stage."""

    def __init__(
        self,
        prepared: _Prepared,
        model: FringeModel,
        effects: Sequence[Effect],
        options: SearchOptions,
        rng: np.random.Generator,
        say: Report,
    ) -> None:
        self.model, self.effects, self.options, self.say = model, effects, options, say
        shape = prepared.problem.cells.shape[1:]
        self.heldout = _held_out_blocks(shape, options.heldout_fraction, rng, prepared.rich)
        self.next_measurements: tuple[dict[str, Any], ...] = ()
        self._take(prepared)

    def _take(self, prepared: _Prepared) -> None:
        self.prepared, self.cells = prepared, prepared.problem.cells
        self.notes = list(prepared.notes)

    def run(self, refinements: int = 2) -> Verdict:
        """Search; start again if a named effect shows that field or noise were misjudged without it."""
        whole = Selector(
            self.prepared.problem,
            self.effects,
            self.prepared.null,
            self.prepared.index,
            generic=self.prepared.rich,
            first_field=self.prepared.undistorted_field,
            shifts_um=self.prepared.shifts_um,
        )
        self.where = self._where(whole)
        chance = self._chance(whole, whole.null)
        self.say(f"chance that noise alone disagrees as much: {chance:.3g}")
        if chance > self.options.significance:
            return self._verdict("no_discrepancy", whole, whole.null, chance, (), {})
        training = self._training(whole)
        singles = self._refit(training, training.null)
        if singles and singles[0].log_evidence > self.options.least_evidence and refinements > 0:
            refined = self._refined(whole, singles[0])
            if refined is not None:
                self.say("field and noise are judged again with the best effect in the model")
                self._take(refined)
                return self.run(refinements - 1)
        chosen, steps = self._grow(training, singles)
        return self._conclude(whole, training, chosen, steps, chance)

    # Stages -------------------------------------------------------------------------------------------------

    def _where(self, whole: Selector) -> Where:
        state = whole.state(whole.null.fit)
        return disagreement(
            state, whole.null.channels, self.cells.geometry, self.prepared.index, self.cells.cell_px
        )

    def _chance(self, selector: Selector, hypothesis: Hypothesis) -> float:
        """Chance of noise, over the tests without a catalogue and the score tests of the catalogue together."""
        names = [name for name in selector.coordinates if name not in hypothesis.names]
        scores = selector.score(hypothesis.fit, names)
        smallest = min((float(chi2_distribution.sf(c.gain, c.degrees)) for c in scores), default=1.0)
        # Effects are alike in groups; counting each as a look of its own errs on the safe side.
        catalogue = float(-np.expm1(len(scores) * np.log1p(-min(smallest, 1 - 1e-16)))) if scores else 1.0
        self.scores = scores
        both = min(hypothesis.probability_of_noise, catalogue)
        return float(-np.expm1(2.0 * np.log1p(-min(both, 1.0 - 1e-16))))

    def _training(self, whole: Selector) -> Selector:
        """Selector that does not see the part held out."""
        if not self.heldout.any():
            return whole
        problem = whole.problem.with_cells(self.cells.restricted(~self.heldout))
        null = fit_model(problem, (), np.zeros(0), self.prepared.null.field, self.prepared.null.levels)
        self.say("ranking effects")
        return Selector(
            problem,
            self.effects,
            null,
            self.prepared.index,
            generic=self.prepared.rich,
            first_field=self.prepared.undistorted_field,
        )

    def _refit(self, selector: Selector, base: Hypothesis) -> list[Hypothesis]:
        """Refits of the best-scored additions to a set, likeliest first."""
        names = [name for name in selector.coordinates if name not in base.names]
        scores = selector.score(base.fit, names, scan=True)
        if self.prepared.shifts_um:  # a score in the wrong order says nothing
            worth = scores
        else:
            worth = [c for c in scores if c.promise > 9.0][: self.options.refits]
        refitted = [selector.hypothesis((*base.names, c.name), c.start, base.fit) for c in worth]
        for hypothesis in refitted:
            self._say_refit(base, hypothesis)
        return sorted(refitted, key=lambda item: -item.log_evidence)

    def _refined(self, whole: Selector, best: Hypothesis) -> _Prepared | None:
        """Field and noise as judged with an effect in the model, if that differs from the judgement without."""
        prepared = self.prepared
        if not prepared.rich or prepared.problem.field_prior:
            return None
        found = self._whole_field(whole, best.fit)
        optical = {
            k: v
            for k, v in best.fit.settings.items()
            if not whole.problem.forward.is_image_effect(k.split(".")[0])
        }
        start = mended_thickness(
            self.model.with_effects({**self.model.effect_settings, **optical}, self.effects),
            self.cells,
            found,
        )
        mended = int(np.count_nonzero(start != found))
        if mended:
            self.say(f"{mended} cells change their fringe order")
        problem, fit = _choose_field(whole.problem, start, best.fit.settings)
        refined = _settle(problem, fit, prepared.stated, prepared.index)
        change = np.abs(refined.noise.factor / prepared.noise.factor - 1.0).max()
        scatter = abs(refined.noise.response_scatter - prepared.noise.response_scatter)
        typical = _noise_rms(self.cells)
        same = problem.basis.size <= prepared.problem.basis.size and not mended
        if same and change < 0.02 and scatter < 0.05 * typical:
            return None
        return refined

    def _whole_field(self, whole: Selector, fit: Fit) -> FloatArray:
        """Thickness of all cells from a fit to a part: what the part moved by, as a function of thickness."""
        before = whole.problem.basis.expand(whole.null.fit.field)
        if not self.heldout.any():
            return whole.problem.basis.expand(fit.field)
        moved = whole.problem.basis.expand(fit.field) - before
        seen = ~self.heldout & (self.cells.weight > 0).any(axis=0)
        middle, half = before.mean(), max(0.5 * float(np.ptp(before)), 1e-6)
        depth = (before - middle) / half
        columns = np.stack([depth**power for power in range(3)], axis=-1)
        solution = np.linalg.lstsq(columns[seen], moved[seen], rcond=None)[0]
        return before + columns @ solution

    def _grow(self, selector: Selector, singles: list[Hypothesis]) -> tuple[Hypothesis, list[Step]]:
        """Add effects while they help; look two ahead where one is not enough."""
        current: Hypothesis = selector.null
        steps: list[Step] = []
        if not singles or singles[0].log_evidence < self.options.least_evidence:
            return current, []
        best = self._most_credible(selector, singles)
        if not self._consistent(best):
            best = self._most_credible(selector, self._searched_harder(selector, singles))
        steps.append(self._step(selector, current, best))
        current = best
        while not steps[-1].consistent and len(current.names) < self.options.most_effects:
            larger = self._enlarged(selector, current)
            if not larger:
                break
            best = self._most_credible(selector, larger)
            if not self._consistent(best):
                best = self._most_credible(selector, self._other_orders(selector, larger))
            if best.log_evidence < current.log_evidence + self.options.least_evidence:
                break
            if not self._consistent(best):
                best = self._swapped(selector, best)
            steps.append(self._step(selector, current, best))
            current = best
        while self._consistent(current) and len(current.names) < self.options.most_effects:
            better = self._surely_better(selector, current)
            if better is None:
                break
            steps.append(self._step(selector, current, better))
            current = better
        complete = selector.with_channels(self._completed(selector, current))
        if complete.names != current.names:
            steps.append(self._step(selector, current, complete))
        return self._pruned(selector, complete), steps

    def _surely_better(self, selector: Selector, current: Hypothesis) -> Hypothesis | None:
        """The set with one effect more that no noise explains, though the tests without a catalogue see only noise.

        Those tests share their power among many patterns; one effect has a single one.
        """
        explained = selector.null.fit.chi2 - current.fit.chi2
        least = IMPRECISION**2 * explained
        names = [name for name in selector.coordinates if name not in current.names]
        worth = [
            candidate
            for candidate in selector.score(current.fit, names)
            if candidate.gain > least
            and float(chi2_distribution.sf(candidate.gain - least, candidate.degrees)) < SURELY
        ]
        found = []
        for candidate in sorted(worth, key=lambda item: -item.gain)[: self.options.parents]:
            found.append(selector.hypothesis((*current.names, candidate.name), candidate.start, current.fit))
            self._say_refit(current, found[-1])
        best = max(found, key=lambda item: item.log_evidence, default=None)
        if best is None or best.log_evidence < current.log_evidence + self.options.least_evidence:
            return None
        return selector.with_channels(best)

    def _completed(self, selector: Selector, current: Hypothesis) -> Hypothesis:
        """The set with an effect beside one of many parameters that can play its part, where that is likelier.

        Sixteen offsets of the amplifiers take in a pedestal, and the residual is noise without it; that all of them
        lie far on one side of zero is likelier with both.
        """
        best = current
        for name in current.names:
            if len(selector.coordinates[name]) < MANY_PARAMETERS:
                continue
            rest = selector.hypothesis(tuple(n for n in current.names if n != name), None, current.fit)
            state = selector.state(rest.fit)
            own = selector.features(state, rest.fit, name)
            for candidate in selector.score(
                rest.fit, [n for n in selector.coordinates if n not in current.names]
            ):
                if candidate.promise < 9.0:
                    continue
                features = selector.features(state, rest.fit, candidate.name)
                if len(features) < len(own) and similarity(state.design, own, features) > CONTAINED:
                    start = candidate.start if len(candidate.start) else None
                    larger = selector.hypothesis((*current.names, candidate.name), start, current.fit)
                    self._say_refit(current, larger)
                    best = max(best, larger, key=lambda item: item.log_evidence)
        return best if best.log_evidence > current.log_evidence + self.options.least_evidence else current

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
            names = [name for name in selector.coordinates if name not in parent.names]
            for candidate in selector.score(parent.fit, names, scan=True):
                key = frozenset((*parent.names, candidate.name))
                left = parent.fit.chi2 - candidate.promise
                if candidate.promise > 9.0 and left < promised.get(key, (math.inf,))[0]:
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
                    self._refit(selector, selector.improved(rest, current.fit)),
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

    def _other_orders(self, selector: Selector, found: Sequence[Hypothesis]) -> list[Hypothesis]:
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
            _rms(selector.problem, before.fit),
            _rms(selector.problem, after.fit),
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
        final = whole.with_channels(whole.settled(self._transfer(whole, chosen)))
        classes = self._classes(training, chosen)
        gains = self._validate(whole, final)
        reasons = []
        if not self._consistent(final) or not self._consistent(chosen):
            worst = min(final.channels, key=lambda c: c.probability)
            reasons.append(
                f"with {', '.join(final.names)} a residual remains in '{worst.name}' (chance {worst.probability:.2g})"
            )
        if gains["blocks"] + gains["wavelengths"] <= 0.0 or min(gains.values()) < -9.0:
            reasons.append("data held out are not predicted better")
        outsider = self._outsider_probability(final)
        named = []
        for name in final.names:
            probability = classes[name].probability * (1.0 - outsider)
            if probability < self.options.least_probability:
                reasons.append(f"the class of {name} has probability {probability:.2f} only")
            named.append(self._named(final, name, classes[name], probability))
        self.notes.append(f"held out: chi2 of blocks falls by {gains['blocks']:.1f}, of wavelengths by "
                          f"{gains['wavelengths']:.1f}")  # fmt: skip
        if reasons:
            return self._unexplained(whole, final, chance, steps, "; ".join(reasons), partial=named)
        thickness = whole.problem.basis.expand(final.fit.field)
        decided, self.next_measurements = with_next_measurements(
            named,
            {name: group.values for name, group in classes.items()},
            {name: group.significance for name, group in classes.items()},
            self.model,
            self.cells,
            (float(thickness.min()) - 1e-3, float(thickness.max()) + 1e-3),
            self.effects,
            self.say,
        )
        return self._verdict("named", whole, final, chance, decided, {}, steps)

    def _transfer(self, whole: Selector, chosen: Hypothesis) -> Hypothesis:
        """The chosen set fitted to all data."""
        start = self._whole_field(whole, chosen.fit)
        weight = (self.cells.weight > 0).any(axis=0).astype(float)
        return whole.hypothesis(
            chosen.names, None, replace(chosen.fit, field=whole.problem.basis.fit(start, weight))
        )

    def _classes(self, selector: Selector, chosen: Hypothesis) -> dict[str, _Class]:
        """Class of each effect."""
        result = {}
        state = selector.state(chosen.fit)
        for name in chosen.names:
            rest = tuple(other for other in chosen.names if other != name)
            without = selector.hypothesis(rest, None, chosen.fit)
            found = {name: chosen}
            own = selector.features(state, chosen.fit, name)
            bare = selector.state(without.fit)
            others = [n for n in selector.coordinates if n not in chosen.names]
            for candidate in selector.score(without.fit, others, scan=True):
                alike = 0.0
                if candidate.promise > 4.0:
                    features = selector.features(bare, without.fit, candidate.name)
                    alike = similarity(bare.design, own, features)
                known = frozenset((*rest, candidate.name)) in selector.fitted
                if known or alike > 0.8:
                    other = selector.hypothesis((*rest, candidate.name), candidate.start, without.fit)
                    found[candidate.name] = other
            top = max(other.log_evidence for other in found.values())
            weight = {n: math.exp(max(other.log_evidence - top, -700.0)) for n, other in found.items()}
            total = sum(weight.values())
            members = {
                n: weight[n] / total for n, other in found.items() if self._is_alike(other, chosen, top)
            }
            values = {n: _values_of(n, found[n].fit) for n in members}
            significance = math.sqrt(max(without.fit.chi2 - chosen.fit.chi2, 0.0))
            result[name] = _Class(members, sum(members.values()), values, significance)
        return result

    def _is_alike(self, other: Hypothesis, chosen: Hypothesis, top: float) -> bool:
        """Whether a replacement explains the data about as well, by evidence or by likelihood.

        The evidence of weak effects leans on the scales of the priors; a fit as good with no more parameters is
        an alternative whatever those are.
        """
        if other.log_evidence > top - self.options.class_width:
            return True
        extra = max(len(other.fit.coordinates) - len(chosen.fit.coordinates), 0)
        return 0.5 * (other.fit.chi2 - chosen.fit.chi2) + 3.0 * extra < self.options.class_width

    def _outsider_probability(self, hypothesis: Hypothesis) -> float:
        """Probability of a cause outside the catalogue, from the chance of noise in what is left.

        An effect of the catalogue leaves noise: any chance is as likely as any other. A cause outside it either is
        mimicked, and leaves noise as well, or leaves a residual whose chance may lie anywhere down to that of a
        signal to noise of 30, each power of ten as likely as the other.
        """
        p = min(max(hypothesis.probability_of_noise, 1e-100), 1.0)
        density = MIMICKED + (1.0 - MIMICKED) / (p * math.log(10.0) * DECADES_OF_CHANCE)
        prior = self.options.outsider_prior
        odds = prior / (1.0 - prior) * density
        return odds / (1.0 + odds)

    def _validate(self, whole: Selector, final: Hypothesis) -> dict[str, float]:
        """Fall of χ² on blocks and on wavelengths that did not take part in fitting the effects."""
        gains = {"blocks": 0.0, "wavelengths": 0.0}
        null = whole.null.fit
        self.heldout_rms = (_rms(whole.problem, null), _rms(whole.problem, final.fit))
        if not self.prepared.rich:
            gains["wavelengths"] = self._validate_single_wavelengths(whole, final)
            return gains
        if self.heldout.any():
            seen = whole.problem.with_cells(self.cells.restricted(~self.heldout))
            fitted = fit_model(
                seen, final.fit.coordinates, final.fit.position, final.fit.field, final.fit.levels
            )
            unseen = whole.problem.with_cells(self.cells.restricted(self.heldout))
            before = fit_model(unseen, (), np.zeros(0), null.field, null.levels)
            start = whole.problem.basis.fit(self._whole_field(whole, fitted), np.ones(self.heldout.shape))
            after = fit_model(unseen, (), np.zeros(0), start, fitted.levels, fitted.settings)
            gains["blocks"] = before.chi2 - after.chi2
            self.heldout_rms = (_rms(unseen, before), _rms(unseen, after))
        waves = self.cells.shape[0]
        if waves >= 8:
            gains["wavelengths"] = self._validate_wavelengths(whole, final)
        return gains

    def _validate_wavelengths(self, whole: Selector, final: Hypothesis) -> float:
        waves = self.cells.shape[0]
        out = np.zeros(waves, dtype=bool)
        out[2::4] = True
        problem = whole.problem.with_cells(self.cells.restricted(~out[:, None, None]))
        unseen = whole.problem.with_cells(self.cells.restricted(out[:, None, None]))
        total = []
        for fit in (whole.null.fit, final.fit):
            fitted = fit_model(problem, fit.coordinates, fit.position, fit.field, fit.levels, fit.settings)
            total.append(_predicted_chi2(unseen, fitted))
        return total[0] - total[1]

    def _validate_single_wavelengths(self, whole: Selector, final: Hypothesis) -> float:
        """Fall of χ² at wavelengths that are left out one by one, of a few pixels whose levels are known."""
        waves = self.cells.shape[0]
        if waves < 4:
            return 0.0
        total, square = np.zeros(2), np.zeros((2, waves))
        for wave in range(waves):
            out = np.arange(waves) == wave
            seen = whole.problem.with_cells(self.cells.restricted(~out[:, None, None]))
            for side, fit in enumerate((whole.null.fit, final.fit)):
                fitted = fit_model(seen, fit.coordinates, fit.position, fit.field, fit.levels, fit.settings)
                value = whole.problem.forward.predict(
                    fitted.settings, whole.problem.basis.expand(fitted.field)
                ).value
                miss = (self.cells.value - whole.problem.expected(fitted.levels, value))[wave]
                total[side] += float((self.cells.weight[wave] * miss**2).sum())
                square[side, wave] = float(np.sqrt(np.mean(miss**2)))
        before, after = np.sqrt((square**2).mean(axis=1))
        self.heldout_rms = (float(before), float(after))
        return float(total[0] - total[1])

    def _named(self, final: Hypothesis, name: str, group: _Class, probability: float) -> NamedEffect:
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
        before, after = _rms(whole.problem, null), _rms(whole.problem, final.fit)
        heldout_before, heldout_after = getattr(self, "heldout_rms", (before, after))
        gap = Gap(_METRIC, before, after, heldout_before, heldout_after, _noise_rms(self.cells))
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


def _held_out_blocks(
    shape: tuple[int, int], fraction: float, rng: np.random.Generator, rich: bool
) -> NDArray[np.bool_]:
    """Blocks of cells that no selection sees, scattered over the sensor; none where there are few cells."""
    if not rich or min(shape) < 12:
        return np.zeros(shape, dtype=bool)
    side = min(8, min(shape) // 3)
    blocks = rng.permutation(side * side).reshape(side, side) < round(fraction * side * side)
    rows = np.arange(shape[0]) * side // shape[0]
    columns = np.arange(shape[1]) * side // shape[1]
    return blocks[np.ix_(rows, columns)]


def _noise_rms(cells: CellData) -> float:
    """Rms of the noise of the cells, response scatter included."""
    used = cells.weight > 0
    return (
        float(np.sqrt((1.0 / cells.weight[used]).mean() + cells.response_scatter**2))
        if used.any()
        else math.nan
    )


def _rms(problem: Problem, fit: Fit) -> float:
    """Rms of data minus model, corrected for the freedom of the nuisances."""
    degrees = (
        problem.cells.n_values - _field_freedom(problem) - problem.level_basis.shape[1] - len(fit.coordinates)
    )
    return _noise_rms(problem.cells) * math.sqrt(fit.chi2 / max(degrees, 1))


def _field_freedom(problem: Problem) -> int:
    """Coefficients of the field that the data reach."""
    if problem.field_prior:
        return 0
    seen = (problem.cells.weight > 0).any(axis=0).astype(float)
    return int((problem.basis.gather(seen[np.newaxis])[:, 0] > 1e-3).sum())


def _predicted_chi2(problem: Problem, fit: Fit) -> float:
    """χ² of data that took no part in a fit, with their levels adjusted."""
    value = problem.forward.predict(fit.settings, problem.basis.expand(fit.field)).value
    weight = problem.cells.weight
    square = (weight * value**2).sum(axis=(1, 2))
    level = np.divide(
        (weight * value * problem.cells.value).sum(axis=(1, 2)),
        square,
        out=np.ones(len(square)),
        where=square > 0,
    )
    return float((weight * (problem.cells.value - level[:, None, None] * value) ** 2).sum())
