"""Orders, mean response and nuisances of a sensor, solved in turn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from .amplitudes import Amplitudes
from .cells import Cells, compensate_slopes
from .common_order import rank_orders
from .evidence import OrderEvidence, order_evidence, refine_cells
from .first_nuisances import first_nuisances
from .learning import learn
from .learning_cells import MOST_CELLS, LearningCells, sample_blocks, some_of
from .local_surface import local_surface
from .mean_response import SENSOR_ORDERS, normalise_to_cells, normalise_to_pixels, spans_orders
from .misfit import judge_cells
from .narrow_sensor import NarrowSensor, is_own_mean, settle_narrow_sensor
from .nuisances import NuisanceFit, Nuisances, add_offset, patterns_of_cells, subtract_offset
from .orders import SURE, solve_orders
from .pixels import CellSurface
from .shared_misfit import cells_leave_only_noise, leaves_only_noise
from .templates import FlatTemplates

_MODEL_CHANGE = 0.15  # Change of the model, in rms fringe amplitudes, at which the orders are solved again
_MOST_SOLUTIONS = 3
_MOST_COMPARED = 20_000  # Cells that show how far cells err alike
_FEWEST_TO_SETTLE = 4
"""Wavelengths from which on the mean response of a narrow sensor is sought together with its order."""
_OPEN_ORDERS = 0.5
"""Orders of thickness, times the relative bandwidth of the flats, up to which the mean response is open.

The mean over the range misses that over a sensor by about the fringe amplitude over the number of orders; a wrong
order turns the fringes at one end of the band against those at the other by the relative bandwidth.
"""
_SURELY_MORE = 4.0
"""Times that many orders with which a sensor holds enough of them even if a good part is wrong."""
_MOST_MEANS = 4  # Solutions of a narrow sensor whose mean response is tried on all cells
_MOST_SHAPES = 4  # Rounds of mean response and orders of a narrow sensor
_RIVAL = 2.0
"""Solutions of so many times the least chi-square are still looked at: cells astray cost the true one as much."""
_SAME_SHAPE = 0.25  # Reliefs that agree within this many orders everywhere are one
_WORTHWHILE = 0.01  # Relative gain of chi-square for which another round is worth its time
_NARROW_MARGIN = 3.0  # Orders beyond what a narrow sensor showed in a sample that its other cells may have


@dataclass(frozen=True, eq=False)
class State:
    """Where a solution stands: cells without nuisances and loss of contrast, and the model that fits them."""

    cells: Cells
    slope_y: NDArray[np.float32]
    slope_x: NDArray[np.float32]
    thickness_um: NDArray[np.float32]
    templates: FlatTemplates
    nuisance: NuisanceFit
    normalisation: str
    found: OrderEvidence
    range_um: tuple[float, float]
    common_slip: float = 0.0
    common_sigma_um: float = 0.0
    searched: bool = False
    """Whether mean response and orders were found together, by a search that may have missed the true ones."""
    free: Nuisances = field(default_factory=Nuisances)
    margin: float = np.inf
    rival: float = np.inf
    """Improbability, above that of this one, of a solution with another relief that the search came upon."""
    alike: float = 1.0
    """Variance of sums over cells relative to cells that err by themselves, the largest that was met on the way."""
    described: bool = False
    """Whether the model as it is describes the flats, so that the orders are those that it gives."""


@dataclass(frozen=True)
class Solver:
    """Orders, mean response and nuisances of a sensor, in turn."""

    order_um: float
    range_um: tuple[float, float]
    temper: float
    free: Nuisances
    threads: int
    data: Amplitudes
    base: FlatTemplates | None = None

    def solve(self, cells: Cells, templates: FlatTemplates) -> State:
        """Solve the orders, and again if the model turns out to be another than was thought."""
        if not self.free.any:
            return self._solve_held(cells, templates)
        narrow = None
        if np.isfinite(self.free.gain_accuracy):
            described, narrow = self._described(cells, templates)
            if described is not None:
                return described
        # Fringes of few orders look like light that each wavelength has of its own, or like levels of zones.
        starts = [
            first_nuisances(cells, templates, self.free, own)
            for own in ((True,) if narrow is None else (True, False))
        ]
        solved = (state for start in starts for state in self._solve_from(start, cells, templates))
        alone = (self._learn(state, ranked=True) for state in (narrow,) if state is not None)
        level = self._solve_with_one_level(cells, templates) if narrow is not None else iter(())
        return self._likeliest(map(self._on_surfaces, chain(solved, alone, level)))

    def _likeliest(self, states: Iterator[State]) -> State:
        """The most probable of some solutions; the best with another relief is its rival."""
        best, seen = next(states), []
        seen.append((best.thickness_um, best.nuisance))
        for state in states:  # one at a time: the evidence of all cells is large
            seen.append((state.thickness_um, state.nuisance))
            if state.nuisance.cost() <= best.nuisance.cost():
                best = state
        if not np.isfinite(best.nuisance.chi2):
            return best
        rivals = [
            fit.cost(best.nuisance.shared) - best.nuisance.cost(best.nuisance.shared)
            for thickness, fit in seen
            if self._is_other_relief(thickness - best.thickness_um)
        ]
        return replace(best, rival=min(rivals, default=np.inf))

    def _is_other_relief(self, apart_um: NDArray[np.float32]) -> bool:
        """Whether a difference of thickness is more than one of whole orders, which are ranked with all pixels."""
        turns = np.rint(np.nanmedian(apart_um) / self.order_um)
        return bool(np.nanmedian(np.abs(apart_um - turns * self.order_um)) > _SAME_SHAPE * self.order_um)

    def _solve_from(self, nuisance: NuisanceFit, cells: Cells, templates: FlatTemplates) -> Iterator[State]:
        """Orders and all that is free in turn, from a first light and contrast: every solution on the way."""
        fitted, alike = nuisance.applied_to(templates), 1.0
        for turn in range(_MOST_SOLUTIONS):
            even = subtract_offset(cells, nuisance.light(cells, self.free))
            before = self._state(even, fitted, nuisance, "sensor", self.range_um, alike)
            state = self._learn(before, ranked=turn == 0)
            yield state
            if _agree(before, state):
                break
            fitted, nuisance, alike = state.templates, state.nuisance, state.alike

    def _solve_with_one_level(self, cells: Cells, templates: FlatTemplates) -> Iterator[State]:
        """A solution that begins without levels of zones, which take fringes that hardly turn within a zone."""
        zones = patterns_of_cells(cells, self.free, *np.zeros((2, 1), np.intp))[1]
        if zones == 0:
            return
        one = replace(self, free=replace(self.free, zones="sensor"))
        start = first_nuisances(cells, templates, one.free)
        state = min(one._solve_from(start, cells, templates), key=lambda state: state.nuisance.cost())
        even = np.insert(state.nuisance.coefficients, [1] * zones, 0.0, axis=1)
        state = replace(state, free=self.free, nuisance=replace(state.nuisance, coefficients=even))
        yield self._learn(state, ranked=True)

    def _on_surfaces(self, state: State) -> State:
        """The solution with cells on the surface that their neighbours show, while that is more probable.

        A cell of weak fringes stays where noise put it, and all that is learned follows. Only a sensor all of whose
        cells are learned from is asked: of others each cell has little say.
        """
        if not 0 < np.count_nonzero(np.isfinite(state.thickness_um)) <= MOST_CELLS:
            return state
        for _ in range(_MOST_SOLUTIONS):
            surface = surface_of(state, self.order_um)
            local = local_surface(surface, state.cells, state.templates, surface.known, self.order_um)
            thickness = np.where(surface.known, local.terms[..., 0], np.float32(np.nan))
            moved = self._learn(replace(state, thickness_um=thickness), ranked=False)
            if not moved.nuisance.cost() < state.nuisance.cost():
                break
            state = moved
        return state

    def _described(self, cells: Cells, templates: FlatTemplates) -> tuple[State | None, State | None]:
        """Solution with the model as it is, if that describes the flats, and in any case that of a narrow sensor.

        What is free moves no order of the first; the second is one from which all that is free may be learned.

        Light and contrast of a sensor of few orders cannot be told from its fringes: there they stay as they are.
        """
        held = replace(self, free=Nuisances())
        nothing = NuisanceFit.none(templates.n_wavelengths)
        probe = held._state(cells, templates, nothing, "range", self.range_um)
        count = patterns_of_cells(cells, self.free, *np.zeros((2, 1), np.intp))[0].shape[-1]
        start = NuisanceFit.none(templates.n_wavelengths, count)
        if held._mean_is_open(probe) or not held._is_wide(probe):
            state = held._solve_held(cells, templates, probe)
            alone = cells_leave_only_noise(state.cells, state.templates, state.thickness_um)
            free = replace(state, free=self.free, nuisance=start, normalisation="sensor")
            return state if alone and self._leaves_only_noise(state) else None, free
        if not self._leaves_only_noise(held.adjust(replace(probe, normalisation="sensor"))):
            return None, None
        state = held._solve_held(cells, templates, probe)
        return replace(state, free=self.free, nuisance=start, described=True), None

    def _leaves_only_noise(self, state: State) -> bool:
        """Whether a solution leaves over nothing that neighbouring pixels share."""
        if not np.isfinite(state.thickness_um).any():
            return False
        surface = surface_of(state, self.order_um)
        fitted = normalise_to_pixels(self.data, state.templates, surface, self.threads)
        return leaves_only_noise(self.data, fitted, surface)

    def _solve_held(self, cells: Cells, templates: FlatTemplates, probe: State | None = None) -> State:
        """Solve the orders where nothing is free but the mean response; ``probe`` is the first solution if known."""
        nuisance = NuisanceFit.none(templates.n_wavelengths)
        nuisance = replace(nuisance, contrast=templates.contrast)
        fitted, normalisation = templates, "range"
        searched, slip = False, 0.0
        for _ in range(_MOST_SOLUTIONS):
            state = probe or self._state(cells, fitted, nuisance, normalisation, self.range_um)
            probe = None
            if normalisation == "range" and self._mean_is_open(state):
                state = self._narrow(cells, state)
                searched, slip = state.searched, state.common_slip
            state = replace(state, searched=searched, common_slip=slip)
            if not spans_orders(state.thickness_um, self.order_um):
                return state
            before, state = state, self.adjust(replace(state, normalisation="sensor"))
            if _agree(before, state):
                break
            fitted, normalisation = state.templates, state.normalisation
        return state

    def _is_wide(self, state: State) -> bool:
        """Whether a sensor holds orders enough to tell light and contrast from the fringes."""
        if not np.isfinite(state.thickness_um).any():
            return False
        orders = self._open_orders(state.templates)
        if spans_orders(state.thickness_um, self.order_um, _SURELY_MORE * orders):
            return True
        joined = solve_orders(state.cells, state.found, sure=np.inf)
        return spans_orders(joined, self.order_um, orders)

    @staticmethod
    def _open_orders(templates: FlatTemplates) -> float:
        """Orders of thickness up to which the mean response is open."""
        wavelength = templates.wavelength_nm
        bandwidth = max(float(np.ptp(wavelength)) / float(wavelength.mean()), 1e-6)
        return max(_OPEN_ORDERS / bandwidth, SENSOR_ORDERS)

    def _mean_is_open(self, state: State) -> bool:
        """Whether mean response and orders must be found together."""
        if state.templates.n_wavelengths < _FEWEST_TO_SETTLE:
            return False  # of fewer wavelengths nothing is believed, so there is nothing to settle
        if not np.isfinite(state.thickness_um).any() or not is_own_mean(state.cells, state.templates):
            return False
        orders = self._open_orders(state.templates)
        if spans_orders(state.thickness_um, self.order_um, _SURELY_MORE * orders):
            return False
        # Wrong orders make a sensor look thicker and thinner than it is; joined by phases alone it cannot jump.
        joined = solve_orders(state.cells, state.found, sure=np.inf)
        return not all(
            spans_orders(thickness, self.order_um, orders) for thickness in (state.thickness_um, joined)
        )

    def _state(
        self,
        cells: Cells,
        templates: FlatTemplates,
        nuisance: NuisanceFit,
        normalisation: str,
        range_um: tuple[float, float],
        alike: float = 1.0,
    ) -> State:
        """Orders of all cells, the model being as it is; ``alike`` is how far cells erred alike before it was so."""
        found = order_evidence(
            cells, templates, self.order_um, range_um=range_um, temper=self.temper, threads=self.threads
        )
        compensated, slope_y, slope_x = compensate_slopes(cells, found.slope_y, found.slope_x, self.order_um)
        state = State(
            compensated, slope_y, slope_x, found.best_um, templates, nuisance, normalisation, found, range_um,
            free=self.free,
        )  # fmt: skip
        # Evidence of a model that does not describe the flats is worth less, however many agree: they err alike.
        alike = max(alike, self._erring_alike(state)) if self.free.any else 1.0
        thickness = solve_orders(cells, found, SURE * alike)
        return replace(state, thickness_um=thickness, alike=alike)

    def _erring_alike(self, state: State) -> float:
        """Variance of sums over cells, each at its own best thickness, relative to cells that err by themselves."""
        thickness = state.found.best_um.ravel()
        every = np.flatnonzero(np.isfinite(thickness))
        known = some_of(every, _MOST_COMPARED)
        value, weight = (
            part.reshape(-1, part.shape[-1])[known] for part in (state.cells.value, state.cells.weight)
        )
        _, alike = judge_cells(value, weight, state.templates, thickness[known], self.order_um)
        return 1.0 + (float(alike[-1]) - 1.0) * every.size / max(known.size, 1)

    def _narrow(self, cells: Cells, first: State) -> State:
        """Orders of a sensor of few orders, whose mean response depends on them, and they on it.

        With a mean response that is a little off, cells of some phases are joined a whole order off, and no common
        thickness fits a relief so torn. So mean response and relief are found in turn.
        """
        shapes: list[NDArray[np.float32]] = [first.thickness_um]
        ranked: list[NarrowSensor] = []
        for turn in range(_MOST_SHAPES):
            before = ranked[0].chi2 if ranked else np.inf
            ranked = settle_narrow_sensor(
                first.cells,
                first.templates,
                shapes,
                self.order_um,
                range_um=self.range_um,
                temper=self.temper,
                earlier=ranked,
                threads=self.threads,
            )
            best = ranked[0]
            solved = self._with_mean_of(best, cells, first)
            rivalled = any(other.chi2 < _RIVAL * best.chi2 for other in ranked[1:])
            settled = not rivalled and best.agrees_with(solved.thickness_um, self.order_um)
            if settled or best.chi2 > (1.0 - _WORTHWHILE) * before or turn == _MOST_SHAPES - 1:
                break
            known, shapes = shapes, []
            for other in ranked[:_MOST_MEANS]:
                tried = solved if other is best else self._with_mean_of(other, cells, first)
                joined = solve_orders(tried.cells, tried.found, sure=np.inf)
                for shape in (tried.thickness_um, joined):
                    if not _among(shape, shapes, self.order_um):
                        shapes.append(shape)
            if all(_among(shape, known, self.order_um) for shape in shapes):
                break
        solved = replace(solved, common_slip=best.slip, searched=True)
        if spans_orders(solved.thickness_um, self.order_um):
            return replace(solved, range_um=self.range_um)
        return self.adjust(replace(solved, common_sigma_um=best.sigma_um))

    def _with_mean_of(self, narrow: NarrowSensor, cells: Cells, first: State) -> State:
        """Orders of all cells with the mean response of a solution, in its neighbourhood."""
        margin = _NARROW_MARGIN * self.order_um
        range_um = (
            max(self.range_um[0], narrow.range_um[0] - margin),
            min(self.range_um[1], narrow.range_um[1] + margin),
        )
        return self._state(cells, narrow.templates, first.nuisance, "narrow", range_um)

    def adjust(self, state: State) -> State:
        """Fit mean response and nuisances to the cells, the orders being as they are, but for a common one."""
        if state.described:  # what is free is learned from the pixels
            return state
        if state.free.any:
            return self._on_surfaces(self._learn(state, ranked=True))
        if state.normalisation == "range":
            return state
        if state.normalisation == "narrow":  # refitting and renormalising in turn would crawl
            thickness = refine_cells(state.cells, state.templates, state.thickness_um, self.threads)
            return replace(state, thickness_um=thickness)
        thickness, fitted = normalise_to_cells(state.cells, state.templates, state.thickness_um, self.threads)
        return replace(state, thickness_um=thickness, templates=fitted)

    def _learn(self, state: State, ranked: bool) -> State:
        """Learn light, contrast and wavelengths; if ``ranked``, the order of the whole sensor with them."""
        whole = add_offset(state.cells, state.nuisance.light(state.cells, state.free))
        sample = LearningCells.of(whole, state.thickness_um, state.free, self.temper, self.order_um)
        if sample.thickness_um.size == 0:
            return state
        base = self.base or state.templates
        if ranked:
            found = rank_orders(sample, base, state.free, state.nuisance, self.order_um, state.range_um)
            fit, shift, margin = found.fit, found.shift, min(found.margin, state.rival)
            slip = 1.0 - (1.0 - found.slip) / (1.0 + (1.0 - found.slip) * np.exp(-0.5 * state.rival))
        else:
            fit, shift = learn(sample, base, state.free, state.nuisance)[1], 0.0
            slip, margin = state.common_slip, state.margin
        thickness = state.thickness_um + np.float32(shift * self.order_um)
        cells = subtract_offset(whole, fit.light(state.cells, state.free))
        fitted = fit.applied_to(base)
        return replace(
            state,
            cells=cells,
            thickness_um=refine_cells(cells, fitted, thickness, self.threads),
            templates=fitted,
            nuisance=fit,
            common_slip=slip,
            margin=margin,
        )

    def relearn(self, state: State, data: Amplitudes, surface: CellSurface) -> State:
        """Learn once more, on small blocks of pixels, which lose nothing where the fringes are steep."""
        model = state.templates
        noise = float(
            np.median(1.0 / np.sqrt(np.maximum(state.cells.weight[..., : model.n_wavelengths], 1e-12)))
        )
        pixels = np.sqrt(np.diff(state.cells.y_edges).max() * np.diff(state.cells.x_edges).max())
        strength = float(model.amplitude().std(axis=0).mean())
        phase_sigma = noise * float(pixels) / (strength * np.sqrt(model.n_wavelengths))
        sample = sample_blocks(data, surface, state.free, phase_sigma, self.order_um)
        if sample.thickness_um.size == 0:
            return state
        base = self.base or model
        fit = learn(sample, base, state.free, state.nuisance, final=True)[1]
        return replace(state, templates=fit.applied_to(base), nuisance=fit)


def _among(shape: NDArray[np.float32], others: list[NDArray[np.float32]], order_um: float) -> bool:
    """Whether a map differs from one of others by no more than a constant, to a fraction of an order."""
    for other in others:
        difference = shape - other
        if np.nanmax(np.abs(difference - np.nanmedian(difference))) < _SAME_SHAPE * order_um:
            return True
    return False


def _agree(before: State, after: State) -> bool:
    """Whether two models differ too little to matter for the orders."""
    new = after.templates.amplitude()
    change = np.abs(new - before.templates.amplitude()).mean(axis=0)
    same_light = before.nuisance.coefficients.shape == after.nuisance.coefficients.shape
    if same_light and after.nuisance.coefficients.size:
        change += np.abs(after.nuisance.coefficients - before.nuisance.coefficients).max(axis=1)
    return bool(np.all(change < _MODEL_CHANGE * new.std(axis=0)))


def surface_of(state: State, order: float) -> CellSurface:
    """Surface on which the pixels begin; cells without data borrow from the nearest with data."""
    thickness, slope_y, slope_x = state.thickness_um, state.slope_y, state.slope_x
    empty = ~np.isfinite(thickness)
    if empty.any() and not empty.all():
        near = distance_transform_edt(empty, return_distances=False, return_indices=True)
        thickness = thickness[tuple(near)]
        slope_y, slope_x = np.where(empty, 0.0, slope_y), np.where(empty, 0.0, slope_x)
    cells = state.cells
    sigma = _noise_of_cells(cells, state.templates, thickness)
    return CellSurface.from_cells(
        thickness, slope_y, slope_x, cells.y_centre, cells.x_centre, order, ~empty, sigma
    )


def _noise_of_cells(
    cells: Cells, templates: FlatTemplates, thickness_um: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Uncertainty of the thickness of each cell from the noise of its mean amplitudes [µm]; infinite if unknown."""
    slope = np.gradient(templates.amplitude(), templates.step_um, axis=0)
    place = (thickness_um - templates.start_um) / templates.step_um
    place = np.clip(np.nan_to_num(place), 0, len(slope) - 1).astype(np.intp)
    weight = cells.weight[..., : templates.n_wavelengths]
    information = (weight * slope[place] ** 2).sum(axis=-1)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(information), np.float32)
