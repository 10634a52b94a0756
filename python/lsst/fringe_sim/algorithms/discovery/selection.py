"""Which effect: score tests, refits, evidence, classes of effects that the data cannot tell apart."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtrc

from ...array_types import FloatArray
from ...effects import Effect, Residuals
from ...errors import InputError
from .channels import Channel, State, chance_beyond, combined_probability, measure_channels
from .comparison import local_minima
from .evidence import log_evidence, prior_cost
from .fit import (
    Coordinate,
    Design,
    Fit,
    FullColumns,
    Problem,
    coordinate_derivative,
    coordinates_of,
    fit_model,
    linearise_at,
    solve_symmetric,
)
from .following import ThicknessFollower
from .islands import IslandStart, followed_on_island, island_starts, placed_on_island, start_at_step
from .orders import fields_in_other_orders, starts_in_other_orders
from .spots import log_evidence_of_spots, spot_channel
from .trends import FEWEST_DRAWS, trend_channel

SCAN = (0.1, 0.3, 1.0, 3.0, 10.0)
FIRST_SCAN = (0.3, 3.0)
FINE_SCAN = tuple(float(size) for size in np.geomspace(0.1, 10.0, 8))
"""Departures, in prior scales, at which the finite signature of an effect is tried; the fine ones where it may grow
with the fourth power (a beam whose onset is taken for thickness). The first two tell whether it is worth while."""

WORTH_SCANNING = 0.1
"""Part of the most that derivatives promise which the form of a finite signature, of any strength, must explain for
other sizes of the effect to be tried."""

STRAIGHT = 0.8
"""Part of all finite signatures of an effect along its derivatives, beside all nuisances, from which on these promise
what it would bring, and its finite signatures are not asked again."""

IMPRECISION = 0.01
"""Part of what an effect does to the fringes in which our description of it may be wrong, and not the effect."""

WANTS_TO_GO_ON = 9.0
"""Fall of χ² beyond a natural end of its range that a parameter does not promise by noise."""

PRECISION = 5e-5
"""Part of the fringes to which cells are described: tables, and what the thickness does within a cell. It is below
the noise but on whole sensors."""

LIKE_THICKNESS = 0.5
"""Part of a signature that thickness could make at one wavelength, in an effect that shifts the phase."""

MANY_PARAMETERS = 8
"""Parameters from which on an effect may hide another; one at a time of so many is not tried at other sizes."""

MINIMA_TRIED, MOVES_AMONG_MINIMA, AT_THE_EDGE = 12, 8, 0.7
"""Neighbouring minima on both sides among which the deepest is looked for, how often, and the part of that reach from
which on it is looked for once more."""

MOST_OF_PROMISE = 0.9
"""Part of the promised fall of χ² that a fit must bring, to be believed to be in the same valley as its base."""

PLACES_REFITTED = 10  # Minima in size and thickness from which a few pixels are fitted
LEAST_MOVE_UM = 0.005  # Move of the thickness that a fit finds by itself [µm]
PLACES_TRIED = 4  # How often a local effect is placed anew, and fitted from there

STEPS_PER_MINIMUM = 5
MINIMA_REFITTED = 4
MINIMA_WALKED = 8
HOPELESS = 25.0
"""Minima that are followed on each side of the last fit, and the rise of χ² at which they are given up."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Score test of one effect against a fit that lacks it."""

    name: str
    gain: float  # expected fall of χ² if it is added, from its derivative
    degrees: int  # its free parameters that the data see
    start: FloatArray  # coordinates from which a fit should start
    # Expected fall of χ² from its finite signatures, if that is more: effects whose onset is absorbed by
    # the thickness show only at a finite size
    promise: float = 0.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A set of effects, fitted."""

    names: tuple[str, ...]  # the effects; empty for the unchanged model
    fit: Fit
    log_evidence: float  # Laplace approximation, relative to the unchanged model fitted to the same data
    channels: tuple[Channel, ...] = field(default=())

    @property
    def probability_of_noise(self) -> float:
        """Chance that noise alone leaves so large a residual; see `combined_probability`."""
        return combined_probability(self.channels)


class Selector:
    """Fits and compares sets of effects on one problem.

    ``catalogue``: effects that may be named; ``index``: refractive index of the varying layer, for the fringe
    phase, ``(W,)``; ``generic``: whether there are enough cells for the tests without a catalogue; ``first_field``:
    field from which the first effect is fitted; that of ``null`` by default, which a strong effect distorts;
    ``shifts_um``: moves of the first field [µm] among which every set of effects looks for its own best thickness:
    the order of a few pixels is open; ``guess``: settings with which ``first_field`` was fitted: where to start
    with those effects, besides; ``alike``: one of the same effects on as large cells, from which their coordinates
    are taken over; ``singles``: coordinates of effects that were fitted alone to the same data before: beside the
    unchanged model no other sizes and places are looked for.
    """

    def __init__(
        self,
        problem: Problem,
        catalogue: Sequence[Effect],
        null: Fit,
        index: FloatArray,
        *,
        generic: bool = True,
        first_field: FloatArray | None = None,
        shifts_um: Sequence[float] = (),
        guess: Mapping[str, float] | None = None,
        alike: Selector | None = None,
        singles: Mapping[str, FloatArray] | None = None,
    ) -> None:
        self.problem, self.index, self.generic = problem, index, generic
        self.first_field = null.field if first_field is None else first_field
        self.shifts_um = tuple(shifts_um)
        self.guess, self._singles = dict(guess or {}), dict(singles or {})
        self.null = Hypothesis((), null, 0.0)
        self.effects = {effect.name: effect for effect in catalogue}
        self.coordinates: dict[str, tuple[Coordinate, ...]] = {}
        self.left_out: dict[str, str] = {}
        # Effects whose finite signatures are their derivatives
        self._straight: set[str] = set()
        if alike is not None and alike.problem.cells.cell_px == problem.cells.cell_px:
            self.coordinates, self.left_out = alike.coordinates, alike.left_out
            self._straight = alike._straight
        else:
            self._find_coordinates(catalogue, problem.basis.expand(null.field))
        state = self.state(null)
        fringes = state.value - state.value.mean(axis=(1, 2), keepdims=True)
        self._undescribed = PRECISION**2 * float((state.whiten(fringes) ** 2).sum())
        self.null = replace(self.null, channels=self.criticise(null))
        self.fitted: dict[frozenset[str], Hypothesis] = {frozenset(): self.null}
        self._searched: dict[frozenset[str], Fit] = {}
        # Sets are enlarged, swapped and compared from the same fits.
        self._scores: dict[tuple[Fit, bool], dict[str, Candidate | None]] = {}
        self._island_starts: dict[tuple[Fit, str], list[IslandStart]] = {}

    def _find_coordinates(self, catalogue: Sequence[Effect], thickness_um: FloatArray) -> None:
        """Find the coordinates of every effect that can be looked for, and why the others are left out."""
        forward = self.problem.forward
        for effect in catalogue:
            try:
                effect.check_search(forward.geometry)
                found = coordinates_of(effect, forward, thickness_um)
                for item in found:
                    forward.change({}, {item.key: item.value(0.1 * item.unit_step)}, thickness_um)
            except InputError as error:
                self.left_out[effect.name] = str(error)
            else:
                self.coordinates[effect.name] = found

    def state(self, fit: Fit) -> State:
        """Everything the tests need at a fit."""
        design, residual, prediction, thickness, whiten = linearise_at(self.problem, fit)
        value = self.problem.expected(fit.levels, prediction.value)
        raw = np.where(self.problem.cells.weight > 0, self.problem.cells.value - value, 0.0)
        return State(design, residual, raw, value, thickness, whiten)

    def _signature(
        self, state: State, fit: Fit, settings: Mapping[str, float], thickness_um: FloatArray | None = None
    ) -> FloatArray:
        """Whitened change that other settings make, by default at the thickness of the fit."""
        place = state.thickness_um if thickness_um is None else thickness_um
        changed = self.problem.expected(fit.levels, self.problem.forward.predict(settings, place).value)
        return state.whiten(changed - state.value)

    def criticise(self, fit: Fit, *, imprecision: float = IMPRECISION) -> tuple[Channel, ...]:
        """Tests without a catalogue; effects are described but for so small a part."""
        if not self.generic:
            return (self._total(fit),)
        explained = max(self.null.fit.chi2 - fit.chi2, 0.0)
        state, correlation = self.state(fit), self.problem.forward.noise_correlation(fit.settings)
        undescribed = imprecision**2 * explained + self._undescribed
        channels = measure_channels(state, self.problem.cells.geometry, self.index, undescribed, correlation)
        return (*channels, spot_channel(state, correlation), *self._trends(fit))

    def _trends(self, fit: Fit) -> list[Channel]:
        """Tests that errors of single exposures, where a fit has them, are draws."""
        channels = []
        for name in dict.fromkeys(item.effect for item in fit.coordinates if item.exchangeable):
            own = np.flatnonzero([item.effect == name and item.of_one_exposure for item in fit.coordinates])
            if len(own) < FEWEST_DRAWS:
                continue
            effect = self.effects[name]
            place = [effect.parameter(fit.coordinates[number].parameter).wavelength_nm for number in own]
            covariance = fit.covariance[np.ix_(own, own)]
            channels.append(trend_channel(effect.title, np.array(place), fit.position[own], covariance))
        return channels

    def evidence_of_spots(self, hypothesis: Hypothesis) -> float:
        """Log evidence that a few spots, which no effect is, would bring beside a set."""
        if not self.generic:
            return 0.0
        correlation = self.problem.forward.noise_correlation(hypothesis.fit.settings)
        return log_evidence_of_spots(self.state(hypothesis.fit), correlation)

    def undescribed(self, name: str) -> float:
        """χ² that an effect may gain because the fringes are described only so well."""
        optical = not self.problem.forward.is_image_effect(name)
        return self._undescribed if optical or self.problem.forward.couples_pixels(name) else 0.0

    def _total(self, fit: Fit) -> Channel:
        """χ² of all values, where there are too few for anything else."""
        field_size = 0 if self.problem.field_prior else self.problem.basis.size
        degrees = (
            self.problem.cells.n_values
            - field_size
            - self.problem.level_basis.shape[1]
            - len(fit.coordinates)
        )
        chance = float(chdtrc(max(degrees, 1), fit.chi2)) if degrees > 0 else 1.0
        return Channel("all values", fit.chi2, float(max(degrees, 0)), chance)

    def has_many(self, name: str) -> bool:
        """Whether an effect has so many parameters that it may hide another."""
        return len(self.coordinates[name]) >= MANY_PARAMETERS

    def others(self, hypothesis: Hypothesis) -> list[str]:
        """Effects that a set does not hold."""
        return [name for name in self.coordinates if name not in hypothesis.names]

    def score(self, fit: Fit, names: Sequence[str], *, scan: bool = False) -> list[Candidate]:
        """Score test of every effect at a fit, most promising first.

        With ``scan``, finite signatures are tried besides the derivative.
        """
        known = self._scores.setdefault((fit, scan), {})
        missing = [name for name in names if name not in known]
        if missing:
            known |= self._candidates(self.state(fit), fit, missing, scan)
        found = [candidate for name in names if (candidate := known[name]) is not None]
        return sorted(found, key=lambda item: -item.promise)

    def _candidates(
        self, state: State, fit: Fit, names: Sequence[str], scan: bool
    ) -> dict[str, Candidate | None]:
        """Score tests of effects; `None` for what is not seen or cannot be combined with what is in already."""
        if scan and self._singles and fit is self.null.fit:
            plain = self._candidates(state, fit, names, scan=False)
            return {name: self._as_before(state, fit, name, candidate) for name, candidate in plain.items()}
        found: dict[str, Candidate | None] = {}
        derivatives: dict[str, FloatArray] = {}
        for name in names:
            if self.problem.forward.is_island(name):
                found[name] = (
                    self._on_some_island(state, fit, name) if scan else self._found_island(fit, name)
                )
            elif self.is_sought(name):  # at null its place is anywhere, and its derivative says nothing
                found[name] = self._sought(state, fit, name) if scan else None
            else:
                found[name], features = self._by_derivative(state, fit, name)
                if scan and found[name] is not None and self._may_be_bent(name):
                    derivatives[name] = features
        least = WORTH_SCANNING * max((one.gain for one in found.values() if one is not None), default=0.0)
        for name, features in derivatives.items():
            candidate = found[name]
            assert candidate is not None
            found[name] = self._scanned(state, fit, candidate, features, least)
        return found

    def _by_derivative(self, state: State, fit: Fit, name: str) -> tuple[Candidate | None, FloatArray]:
        """Score test of an effect by its derivatives, and these."""
        features = self._features_if_any(state, fit, name)
        if features is None:
            return None, np.zeros(0)
        return self.along(state, name, features), features

    def along(self, state: State, name: str, features: FloatArray) -> Candidate:
        """Score test of an effect whose derivatives are known."""
        score, information = state.design.project(FullColumns(features), state.residual)
        start, gain, degrees = bounded_minimum(score, information, self.coordinates[name])
        return Candidate(name, gain, degrees, start, gain)

    def score_alike(self, like: Fit, bases: Sequence[Hypothesis]) -> list[list[Candidate]]:
        """Score tests of all other effects beside each of some sets, by derivatives at a fit like those of the sets.

        Sets that explain about as much predict about the same. What each leaves is its own, and decides.
        """
        at, states = self.state(like), [self.state(base.fit) for base in bases]
        found: list[list[Candidate]] = [[] for _ in bases]
        for name in self.coordinates:
            if self.is_sought(name):
                continue
            features = None if self.problem.forward.is_island(name) else self._features_if_any(at, like, name)
            for own, base, state in zip(found, bases, states, strict=True):
                if name in base.names:
                    continue
                if features is None:
                    own += self.score(base.fit, [name])
                else:
                    own.append(self.along(state, name, features))
        return found

    def _features_if_any(self, state: State, fit: Fit, name: str) -> FloatArray | None:
        """Derivatives of an effect; `None` if it does not go with those of the fit."""
        try:
            return self.features(state, fit, name)
        except InputError:
            return None

    def _may_be_bent(self, name: str) -> bool:
        """Whether the finite signature of an effect may be another than its derivatives."""
        of_the_image = self.problem.forward.is_image_effect(name)
        far_from_linear = not of_the_image or self.problem.forward.couples_pixels(name)
        return far_from_linear and not self.has_many(name) and name not in self._straight

    def is_sought(self, name: str) -> bool:
        """Whether an effect has to be looked for in what the model leaves, its place not being known."""
        return self.effects[name].search.sought

    def _sought(self, state: State, fit: Fit, name: str) -> Candidate | None:
        """The effect where it is seen, if it is."""
        start = self._seen(state, name)
        return None if start is None else self._beginning_at(state, fit, name, start)

    def _as_before(self, state: State, fit: Fit, name: str, candidate: Candidate | None) -> Candidate | None:
        """The candidate, or the effect as it was fitted before where that promises more."""
        if name not in self._singles:
            return candidate
        before = self._beginning_at(state, fit, name, self._singles[name])
        if before is None or (candidate is not None and candidate.promise > before.promise):
            return candidate
        return before if candidate is None else replace(candidate, start=before.start, promise=before.promise)

    def _beginning_at(self, state: State, fit: Fit, name: str, start: FloatArray) -> Candidate | None:
        """The effect at some size; `None` if it promises nothing there."""
        coordinates = self.coordinates[name]
        settings = {item.key: item.value(x) for item, x in zip(coordinates, start, strict=True)}
        level, _ = self.problem.amplitudes(fit.levels)
        change = self.problem.forward.change(fit.settings, {**fit.settings, **settings}, state.thickness_um)
        column = FullColumns(state.whiten(level * change)[np.newaxis])
        score, information = state.design.project(column, state.residual)
        promise = float(score[0] ** 2 / max(information[0, 0], 1e-300))
        return Candidate(name, 0.0, len(coordinates), start, promise) if score[0] > 0.0 else None

    def _on_some_island(self, state: State, fit: Fit, name: str) -> Candidate | None:
        """A local effect where it promises most; `None` if nowhere, or if it does not go with those of the fit."""
        try:
            starts = [*self._on_islands(state, fit, name), *self._on_known_island(fit, name)]
        except InputError:
            return None
        if not starts:
            return None
        best = max(starts, key=lambda item: item.promise)
        return Candidate(name, 0.0, len(self.coordinates[name]), best.position, best.promise)

    def _found_island(self, fit: Fit, name: str) -> Candidate | None:
        """A local effect where it is with which the field was chosen; it might have been anywhere."""
        by_chance = 2.0 * math.log(self.problem.cells.value[0].size)
        for start in self._on_known_island(fit, name):
            gain = max(start.promise - by_chance, 0.0)
            return Candidate(name, gain, len(self.coordinates[name]), start.position, gain)
        return None

    def _on_known_island(self, fit: Fit, name: str) -> list[IslandStart]:
        """Where a local effect is with which the field was chosen: a smooth field hides it from the rest."""
        guessed = self._guessed(self.coordinates[name])
        if fit.coordinates or not guessed:
            return []
        there = fit_model(self.problem, (), np.zeros(0), self.first_field, fit.levels, self.guess)
        return [IslandStart(position, fit.chi2 - there.chi2) for position in guessed]

    def _on_islands(self, state: State, fit: Fit, name: str) -> list[IslandStart]:
        """Where a local effect may be, and how large."""
        if (fit, name) not in self._island_starts:
            level, _ = self.problem.amplitudes(fit.levels)
            self._island_starts[fit, name] = island_starts(
                self.problem, state, fit.settings, self.coordinates[name], level
            )
        return self._island_starts[fit, name]

    def at_step(self, name: str, fit: Fit, least: float) -> Hypothesis | None:
        """A local effect beside those of a fit, where it explains a step of the thickness best.

        `None` if it promises less than ``least``.
        """
        start = start_at_step(self.problem, self.state(fit), fit.settings, self.coordinates[name])
        if start is None or start.promise < least:
            return None
        names = tuple(dict.fromkeys(item.effect for item in fit.coordinates))
        return self.hypothesis((*names, name), start.position, fit)

    def _best_place(
        self, fit: Fit, position: FloatArray, field_start: FloatArray, levels: FloatArray, rival: float
    ) -> Fit:
        """The best fit with the last effect, a local one, in several places; how far they are is in its uncertainty.

        With a thickness in every cell, each cell of the rim may be settled in several ways.
        """
        found = [fit]
        for _ in range(PLACES_TRIED):
            placed = self._placed_on_island(fit.coordinates, position, field_start, levels)
            found.append(fit_model(self.problem, fit.coordinates, *placed, levels, rival=rival))
            best = min(found, key=lambda item: item.chi2)
            if len(found) > 2 and found[-1].chi2 > min(item.chi2 for item in found[:-1]) - 1.0:
                break
            position, field_start, levels = best.position, best.field, best.levels
        weight = np.exp(-0.5 * np.array([item.chi2 - best.chi2 for item in found]))
        away = np.stack([item.position - best.position for item in found])
        spread = np.sqrt((weight[:, np.newaxis] * away**2).sum(axis=0) / weight.sum())
        return replace(best, spread=np.hypot(best.spread, spread))

    def _placed_on_island(
        self,
        coordinates: tuple[Coordinate, ...],
        position: FloatArray,
        field_start: FloatArray,
        levels: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Position and field with the last effect, a local one, where it lies best with a thickness in every cell."""
        if self.problem.field_prior or not self.generic:
            return position, field_start
        level, _ = self.problem.amplitudes(levels)
        thickness = self.problem.basis.expand(field_start)
        placed, moved = placed_on_island(self.problem, coordinates, position, thickness, level)
        return placed, self.problem.basis.fit(moved, self.problem.cells.seen.astype(float))

    def _moved_on_island(
        self, name: str, settings: Mapping[str, float], thickness_um: FloatArray, levels: FloatArray
    ) -> FloatArray:
        """Thickness with that on the island of a local effect moved to where the effect wants it."""
        if self.problem.field_prior:
            return thickness_um
        level, _ = self.problem.amplitudes(levels)
        return followed_on_island(self.problem, name, settings, thickness_um, level)

    def _seen(self, state: State, name: str) -> FloatArray | None:
        """Coordinates of an effect where it is seen in what a fit leaves."""
        cells, effect = self.problem.cells, self.effects[name]
        seen = effect.propose(Residuals(state.raw_residual, cells.weight, cells.geometry))
        if not seen:
            return None
        return np.array([item.coordinate(seen[0][item.parameter]) for item in self.coordinates[name]])

    def _scanned(
        self, state: State, fit: Fit, candidate: Candidate, derivatives: FloatArray, least: float
    ) -> Candidate:
        """Candidate with the best of its finite signatures, where that promises more than the derivative."""
        coordinates, own = self.coordinates[candidate.name], len(derivatives)
        places, columns = self._at_sizes(state, fit, candidate.name, lambda item: FIRST_SCAN)
        if not columns:
            return candidate
        every = FullColumns(np.concatenate([derivatives, columns]))
        score, information = state.design.project(every, state.residual)
        score, strength, cross = score[own:], np.diag(information)[own:], information[:own, own:]
        along = (cross * solve_symmetric(information[:own, :own], cross)).sum(axis=0)
        seen = strength > 1.0
        # Of a few pixels in the wrong fringe order neither says anything.
        if self.generic and np.all(along[seen] > STRAIGHT * strength[seen]):
            self._straight.add(candidate.name)
        elif (score**2 / np.maximum(strength, 1e-300)).max() > least:
            others, columns = self._at_sizes(
                state, fit, candidate.name, lambda item: FINE_SCAN if item.quadratic else SCAN[::2]
            )
            further, information = state.design.project(FullColumns(np.stack(columns)), state.residual)
            places += others
            score, strength = np.append(score, further), np.append(strength, np.diag(information))
        amplitude = np.divide(score, strength, out=np.zeros_like(score), where=strength > 1e-6)
        # A finite signature may be scaled only a little: its shape changes with its size. Of one that grows with the
        # square, no size between two of the scan may be lost.
        gain = np.where((amplitude > 0.2) & (amplitude < 3.0), score * amplitude, 0.0)
        best = int(np.argmax(gain))
        if gain[best] <= candidate.gain:
            return candidate
        number, departure = places[best]
        start = np.zeros(len(coordinates))
        start[number] = coordinates[number].clip(departure * min(amplitude[best], 1.5))
        return replace(candidate, start=start, promise=float(gain[best]))

    def _at_sizes(
        self, state: State, fit: Fit, name: str, sizes: Callable[[Coordinate], Sequence[float]]
    ) -> tuple[list[tuple[int, float]], list[FloatArray]]:
        """Finite signatures of an effect, and the number and the departure of the coordinate that has each."""
        places, columns = [], []
        held = self.problem.field_prior > 0.0 or self.problem.forward.is_image_effect(name)
        follower = None if held else self._follower(state.thickness_um)
        for number, item in enumerate(self.coordinates[name]):
            for size in sizes(item):
                for sign in (1.0,) if item.quadratic else (1.0, -1.0):
                    departure = (size * item.scale) ** 2 if item.quadratic else sign * size * item.scale
                    if not item.is_inside(departure):
                        continue
                    settings = {**fit.settings, item.key: item.value(departure)}
                    for thickness in follower.places(settings) if follower else [state.thickness_um]:
                        places.append((number, departure))
                        columns.append(self._signature(state, fit, settings, thickness))
        return places, columns

    def _follower(self, thickness_um: FloatArray) -> ThicknessFollower:
        return ThicknessFollower(self.problem, thickness_um, float(self.index.mean()))

    def features(self, state: State, fit: Fit, name: str) -> FloatArray:
        """Whitened signature of an effect: derivatives with respect to its coordinates at a fit."""
        return np.stack([self._slope(state, fit, item) for item in self.coordinates[name]])

    def _slope(self, state: State, fit: Fit, item: Coordinate) -> FloatArray:
        """Whitened derivative with respect to one coordinate at a fit."""
        level, _ = self.problem.amplitudes(fit.levels)
        at = item.coordinate(fit.settings.get(item.key, item.null))
        return state.whiten(
            level * coordinate_derivative(self.problem.forward, item, at, fit.settings, state.thickness_um)
        )

    def hypothesis(
        self, names: Sequence[str], start: FloatArray | None = None, base: Fit | None = None
    ) -> Hypothesis:
        """Fit a set of effects; remembered.

        ``start``: first guess of the coordinates of the last effect. ``base``: fit of the others, from which
        the search starts.
        """
        key = frozenset(names)
        if key in self.fitted:
            return self.fitted[key]
        ordered = tuple(names)
        base = self.null.fit if base is None else base
        coordinates = tuple(item for name in ordered for item in self.coordinates[name])
        fit = min(
            (
                self._fit_from(ordered, coordinates, first, base)
                for first in self._starts(ordered, start, base)
            ),
            key=lambda item: item.chi2,
        )
        fit = self._best_order(self._deepest(fit))
        hypothesis = Hypothesis(ordered, fit, log_evidence(fit, self.null.fit.chi2))
        self.fitted[key] = hypothesis
        return hypothesis

    def with_candidate(self, base: Hypothesis, candidate: Candidate) -> Hypothesis:
        """A set with one effect more, from the fit of the others; remembered.

        What was fitted before may be in another order, and is fitted again from here if it lacks most of what is
        promised.
        """
        names = (*base.names, candidate.name)
        known = frozenset(names) in self.fitted
        found = self.hypothesis(names, candidate.start, base.fit)
        if known and base.fit.chi2 - found.fit.chi2 < MOST_OF_PROMISE * candidate.promise:
            found = self.improved(names, base.fit)
        return found

    def _best_order(self, fit: Fit) -> Fit:
        """The fit, or a better one with another thickness of all pixels and another size of the last effect."""
        if not fit.coordinates or not len(self.shifts_um):
            return fit
        positions = [fit.position, *self._spread_starts(fit, both_sides=True)]
        chi2 = np.empty((len(positions), len(self.shifts_um)))
        for row, position in zip(chi2, positions, strict=True):
            settings = {c.key: c.value(x) for c, x in zip(fit.coordinates, position, strict=True)}
            row[:] = [self._shifted_chi2(settings, shift) for shift in self.shifts_um]
        # Every thickness may have its best size: near the true one no size that was tried need be good.
        size, least = chi2.argmin(axis=0), chi2.min(axis=0)
        best = sorted(local_minima(least), key=lambda place: float(least[place]))[:PLACES_REFITTED]
        trials = [
            fit_model(
                self.problem,
                fit.coordinates,
                positions[size[place]],
                self.first_field + self.shifts_um[place],
                fit.levels,
                rival=fit.chi2,
            )
            for place in best
        ]
        return min((fit, *trials), key=lambda item: item.chi2)

    def _shifted_chi2(self, settings: dict[str, float], shift_um: float) -> float:
        """χ² with the first field moved as a whole and the best common level."""
        cells = self.problem.cells
        thickness = self.problem.basis.expand(self.first_field + shift_um)
        self.problem.forward.cover(thickness)
        value = self.problem.forward.predict(settings, thickness).value
        level = float((cells.weight * value * cells.value).sum() / (cells.weight * value**2).sum())
        return float((cells.weight * (cells.value - level * value) ** 2).sum())

    def improved(self, names: Sequence[str], base: Fit, *, scan: bool = False) -> Hypothesis:
        """Fit a set again from what a fit of more effects found, or from a scan; the better fit is remembered.

        ``names``: effects, all of them in ``base`` or fitted before. ``scan``: try sizes from the smallest to
        the largest of the last effect as well, and of all that shift the phase: a strong effect may have
        several minima, and one of a pair takes that which suits it alone.
        """
        known = self.hypothesis(names, None, base)
        coordinates = known.fit.coordinates
        first = np.array([item.coordinate(base.settings.get(item.key, known.fit.settings[item.key]))
                          for item in coordinates])  # fmt: skip
        starts = [first] if any(item.key in base.settings for item in coordinates) else []
        trials = [(start, base.field) for start in starts]
        key = frozenset(names)
        if scan and self._searched.get(key) is not known.fit:
            trials += self._starts_in_other_orders(known.fit, known.names[-1]) or [
                (start, base.field) for start in self._spread_starts(known.fit)
            ]
            for name in known.names[:-1]:
                trials += self._starts_in_other_orders(known.fit, name)
        for start, thickness in trials:
            trial = fit_model(self.problem, coordinates, start, thickness, base.levels, rival=known.fit.chi2)
            if trial.chi2 < known.fit.chi2 - 1.0:
                trial = self._deepest(trial)
                known = Hypothesis(known.names, trial, log_evidence(trial, self.null.fit.chi2))
        self.fitted[key] = known
        if scan:
            self._searched[key] = known.fit
        return known

    def _starts_in_other_orders(self, fit: Fit, name: str) -> list[tuple[FloatArray, FloatArray]]:
        """Positions and fields from which one effect of a fit may be found in another fringe order."""
        moved, index = self._shifts_of_phase(fit, name), float(self.index.mean())
        if not moved:
            return []
        if self.has_many(name):
            fields = fields_in_other_orders(self.problem, fit.field, index)
            return [(fit.position, field) for field in fields]
        return starts_in_other_orders(self.problem, fit, moved, self.first_field, index)

    def shifts_phase(self, hypothesis: Hypothesis) -> bool:
        """Whether the last effect of a set shifts the phase of the fringes: its fit may be in the wrong order."""
        return bool(self._shifts_of_phase(hypothesis.fit, hypothesis.names[-1]))

    def _shifts_of_phase(self, fit: Fit, name: str) -> list[int]:
        """Coordinates of one effect that do, at each wavelength by itself, what a change of thickness does."""
        if not self.generic or self.problem.forward.is_image_effect(name):
            return []
        without = fit.without(name).held()
        state = self.state(without)
        features, slope = self.features(state, without, name), state.design.slope
        along = np.einsum("kwyx,wyx->kw", features, slope) ** 2 / (slope**2).sum(axis=(1, 2))
        whole = (features**2).sum(axis=(1, 2, 3))
        part = np.divide(along.sum(axis=1), whole, out=np.zeros(len(whole)), where=whole > 0.0)
        own = [number for number, item in enumerate(fit.coordinates) if item.effect == name]
        return [own[place] for place in np.flatnonzero(part > LIKE_THICKNESS)]

    def _spread_starts(self, fit: Fit, *, both_sides: bool = False) -> list[FloatArray]:
        """The fit with its last effect moved to other sizes, from near the null to near the bound."""
        last = fit.coordinates[-1]
        several = len(fit.coordinates) > 1 and fit.coordinates[-2].effect == last.effect
        if several or last.effect in self._straight:
            return []
        value = last.value(fit.position[-1])
        bounds = (last.low, last.high) if both_sides else (last.high if value >= last.null else last.low,)
        sizes: list[float] = []
        for bound in bounds:
            sizes += list(last.null + np.sign(bound - last.null) * last.scale * np.array(SCAN))
            sizes += list(last.null + np.array([0.3, 0.6, 0.9]) * (bound - last.null))
        inside = sorted({size for size in sizes if last.low <= size <= last.high and size != last.null})
        return [np.append(fit.position[:-1], last.coordinate(size)) for size in inside]

    def _starts(self, names: tuple[str, ...], start: FloatArray | None, base: Fit) -> list[FloatArray]:
        """First guesses: what is known of the others, and for the new effect its best start and its neighbours."""
        known, fresh = [], []
        for name in names:
            own = self.coordinates[name]
            if all(item.key in base.settings for item in own):
                known += [item.coordinate(base.settings[item.key]) for item in own]
                continue
            if self.problem.forward.is_island(name):
                fresh = [one.position for one in self._on_islands(self.state(base), base, name)]
                fresh = fresh or ([] if start is None else [np.asarray(start, dtype=float)])
                fresh += self._guessed(own)
                if fresh:
                    continue
            small = [0.1 * item.unit_step for item in own]
            if start is None and self.is_sought(name):
                start = self._seen(self.state(base), name)
            fresh = [np.array(small) if start is None else np.asarray(start, dtype=float)]
            if not base.coordinates:
                fresh += self._guessed(own)
        if not fresh:
            return [np.array(known)]
        return [np.concatenate([known, one]) for one in fresh]

    def _guessed(self, own: Sequence[Coordinate]) -> list[FloatArray]:
        """Coordinates of an effect with which the field was chosen; none if it was without."""
        if not all(item.key in self.guess for item in own):
            return []
        return [np.array([item.coordinate(self.guess[item.key]) for item in own])]

    def _deepest(self, fit: Fit) -> Fit:
        """The fit, or a better one in neighbouring minima of the coordinates that have many."""
        for number, item in enumerate(fit.coordinates):
            reach = MINIMA_TRIED * item.neighbour
            for _ in range(MOVES_AMONG_MINIMA if item.neighbour else 0):
                before, fit = fit.position[number], self._deeper_along(fit, number)
                if abs(fit.position[number] - before) < AT_THE_EDGE * reach:
                    break
        return fit

    def _deeper_along(self, fit: Fit, number: int) -> Fit:
        """The fit, or a better one in a neighbouring minimum of one coordinate; the others follow."""
        item = fit.coordinates[number]
        reach = np.arange(-MINIMA_TRIED * STEPS_PER_MINIMUM, MINIMA_TRIED * STEPS_PER_MINIMUM + 1)
        around = fit.position[number] + reach * (item.neighbour / STEPS_PER_MINIMUM)
        places = np.unique([item.clip(x) for x in around])
        fall = self._falls(fit, number, places)
        away = np.abs(places - fit.position[number]) > 0.5 * item.neighbour
        minima = [index for index in local_minima(-fall) if away[index] and fall[index] > 0.0]
        best = fit
        for index in sorted(minima, key=lambda index: -fall[index])[:MINIMA_REFITTED]:
            if fall[index] <= fit.chi2 - best.chi2:
                break
            start = fit.position.copy()
            start[number] = places[index]
            trial = fit_model(self.problem, fit.coordinates, start, fit.field, fit.levels, rival=best.chi2)
            best = min(best, trial, key=lambda item: item.chi2)
        return best

    def _falls(self, fit: Fit, number: int, places: FloatArray) -> FloatArray:
        """Fall of χ² that other places of one coordinate promise; the others follow in proportion."""
        item, state = fit.coordinates[number], self.state(fit.holding(number))
        fall = np.zeros(len(places))
        for index, place in enumerate(places):
            settings = {**fit.settings, item.key: item.value(place)}
            column = FullColumns(self._signature(state, fit, settings)[np.newaxis])
            score, information = state.design.project(column, state.residual)
            fall[index] = 2.0 * score[0] - information[0, 0]
        return fall

    def settled(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis in the deepest of its neighbouring minima; how far the others reach is in its uncertainty.

        Where fringes repeat, a parameter may be known to a hundredth of the distance of two minima, and yet not
        which of them is the right one.
        """
        fit = hypothesis.fit
        for number, item in enumerate(fit.coordinates):
            if item.neighbour:
                fit = self._among_minima(fit, number)
        if fit is hypothesis.fit:
            return hypothesis
        best = replace(hypothesis, fit=fit, log_evidence=log_evidence(fit, self.null.fit.chi2))
        self.fitted[frozenset(hypothesis.names)] = best
        return best

    def at_end_of_range(self, fit: Fit) -> list[str]:
        """Parameters at the end of what the model is meant for, or beyond what nature allows.

        Where nature ends the range the truth may be there, which wants to go on no more than noise does.
        """
        found = []
        for number, item in enumerate(fit.coordinates):
            outwards = 1e-3 * item.unit_step * float(np.sign(fit.position[number]))
            if outwards == 0.0 or item.is_inside(fit.position[number] + outwards):
                continue
            natural = self.effects[item.effect].search.natural_bounds
            end = item.value(float(fit.position[number]))
            if end not in natural or self._gain_beyond(fit, number, outwards) > WANTS_TO_GO_ON:
                found.append(item.key)
        return found

    def _gain_beyond(self, fit: Fit, number: int, outwards: float) -> float:
        """Fall of χ² that a coordinate at the end of its range would bring beyond it."""
        state = self.state(fit.holding(number))
        column = FullColumns(self._slope(state, fit, fit.coordinates[number])[np.newaxis])
        score, information = state.design.project(column, state.residual)
        return float(score[0] ** 2 / max(information[0, 0], 1e-300)) if score[0] * outwards > 0.0 else 0.0

    def _among_minima(self, fit: Fit, number: int) -> Fit:
        """The deepest minimum along one coordinate with the mean square distance of the others that data allow."""
        found, item = [fit], fit.coordinates[number]
        for side in (-1.0, 1.0):
            last = fit
            for _ in range(MINIMA_WALKED):
                start = last.position.copy()
                start[number] = item.clip(start[number] + side * item.neighbour)
                trial = fit_model(
                    self.problem, fit.coordinates, start, last.field, last.levels, rival=fit.chi2
                )
                if side * (trial.position[number] - last.position[number]) < 0.5 * item.neighbour:
                    break
                found.append(trial)
                last = trial
                if trial.chi2 > min(other.chi2 for other in found) + HOPELESS:
                    break
        best = min(found, key=lambda other: other.chi2)
        weight = np.exp(-0.5 * np.array([other.chi2 - best.chi2 for other in found]))
        away = np.array([other.position[number] - best.position[number] for other in found])
        spread = best.spread.copy()
        spread[number] = math.sqrt(float((weight * away**2).sum() / weight.sum()))
        return replace(best, spread=spread)

    def _fit_from(
        self, names: tuple[str, ...], coordinates: tuple[Coordinate, ...], first: FloatArray, base: Fit
    ) -> Fit:
        """Fit from one first guess, and from a small one if that led away from the data."""
        position = np.array([item.clip(x) for item, x in zip(coordinates, first, strict=True)])
        # A quadratic coordinate has no slope in its parameter at 0; start beside it.
        nudge = np.array([0.01 * item.unit_step if item.quadratic else 0.0 for item in coordinates])
        position = np.where(position == 0.0, nudge, position)
        field_start = base.field if base.coordinates else self.first_field
        rival = min(item.fit.chi2 for key, item in self.fitted.items() if len(key) <= len(names))
        field_start = self._followed(names[-1], coordinates, position, field_start, base.levels)
        fit = fit_model(self.problem, coordinates, position, field_start, base.levels, rival=rival)
        if self.problem.forward.is_island(names[-1]):
            fit = self._best_place(fit, position, field_start, base.levels, rival)
        if fit.chi2 > base.chi2:
            small = np.array(
                [x if item.key in base.settings else 0.03 * item.unit_step
                 for item, x in zip(coordinates, position, strict=True)]
            )  # fmt: skip
            other = fit_model(self.problem, coordinates, small, base.field, base.levels, rival=rival)
            fit = min(fit, other, key=lambda item: item.chi2)
        return fit

    def _followed(
        self,
        name: str,
        coordinates: tuple[Coordinate, ...],
        position: FloatArray,
        field_start: FloatArray,
        levels: FloatArray,
    ) -> FloatArray:
        """Field moved to where the effects at their first guess want it, if the last one acts on the response."""
        if not self.generic or self.problem.field_prior or self.problem.forward.is_image_effect(name):
            return field_start
        thickness = self.problem.basis.expand(field_start)
        self.problem.forward.cover(thickness)
        settings = {item.key: item.value(x) for item, x in zip(coordinates, position, strict=True)}
        seen = self.problem.cells.seen.astype(float)
        if self.problem.forward.is_island(name):
            return self.problem.basis.fit(self._moved_on_island(name, settings, thickness, levels), seen)
        places = self._follower(thickness).places(settings)
        moved = min(places, key=lambda place: self.problem.chi2_at(settings, place))
        if np.abs(moved - thickness).max() < LEAST_MOVE_UM:
            return field_start
        return self.problem.basis.fit(moved, seen)

    def with_channels(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis with its residual tested."""
        if hypothesis.channels:
            return hypothesis
        known = self.fitted.get(frozenset(hypothesis.names))
        if known is not None and known.fit is hypothesis.fit and known.channels:
            return known
        tested = replace(hypothesis, channels=self.criticise(hypothesis.fit))
        self.fitted[frozenset(hypothesis.names)] = tested
        return tested

    def known(self, size: int) -> list[Hypothesis]:
        """All fitted sets of a size, likeliest first."""
        found = [item for key, item in self.fitted.items() if len(key) == size]
        return sorted(found, key=lambda item: -item.log_evidence)

    def prior_cost(self, hypothesis: Hypothesis, name: str) -> float:
        """Log evidence that the sizes of one effect cost a set, over what sizes near zero would."""
        fit = hypothesis.fit
        return sum(
            prior_cost(item, position)
            for item, position in zip(fit.coordinates, fit.position, strict=True)
            if item.effect == name
        )


def bounded_minimum(
    score: FloatArray, information: FloatArray, coordinates: Sequence[Coordinate]
) -> tuple[FloatArray, float, int]:
    """Minimum of the quadratic expansion within the bounds, its depth and the number of parameters used."""
    scale = np.array([item.unit_step for item in coordinates])
    matrix = information * np.outer(scale, scale) + np.eye(len(scale)) / 9.0
    right = score * scale
    free = np.ones(len(scale), dtype=bool)
    position = np.zeros(len(scale))
    for _ in range(len(scale) + 1):
        position[:] = 0.0
        if not free.any():
            break
        position[free] = np.linalg.solve(matrix[np.ix_(free, free)], right[free])
        outside = np.array(
            [item.one_sided and not item.is_inside(x * s) and abs(x) > 1e-9 and np.sign(x) != _inward(item)
             for item, x, s in zip(coordinates, position, scale, strict=True)]
        )  # fmt: skip
        if not (outside & free).any():
            break
        free &= ~outside
    gain = float(2.0 * position @ right - position @ matrix @ position)
    seen = int((np.diag(matrix)[free] > 1.0).sum())
    clipped = np.array([item.clip(x * s) for item, x, s in zip(coordinates, position, scale, strict=True)])
    return clipped, max(gain, 0.0), max(seen, 1)


def _inward(item: Coordinate) -> float:
    """Sign of the coordinate inside the bounds of a one-sided parameter."""
    return 1.0 if item.quadratic or item.null <= item.low else -1.0


def similarity(design: Design, first: FloatArray, second: FloatArray) -> float:
    """Cosine between the signatures of two effects with nuisances projected out; the largest canonical one."""
    both = FullColumns(np.concatenate([first, second]))
    _, information = design.project(both, np.zeros(first.shape[1:]))
    number = len(first)
    a, b, c = information[:number, :number], information[number:, number:], information[:number, number:]
    inverse_roots = [_inverse_root(matrix) for matrix in (a, b)]
    return float(
        np.clip(np.linalg.svd(inverse_roots[0] @ c @ inverse_roots[1], compute_uv=False)[0], 0.0, 1.0)
    )


def _inverse_root(matrix: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(matrix)
    keep = values > 1e-9 * max(float(values.max()), 1e-300)
    root: FloatArray = (vectors[:, keep] / np.sqrt(values[keep])) @ vectors[:, keep].T
    return root


def chance_of(gain: float, degrees: int, undescribed: float) -> float:
    """Chance that noise, and what the description of the fringes lacks, give as large a gain in χ²."""
    return chance_beyond(gain, degrees, undescribed)
