"""Thickness of a whole sensor at once: orders on cells, then every pixel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from .amplitudes import Amplitudes
from .borders import settle_borders
from .cells import (
    Cells,
    average_cells,
    cell_edges,
    cell_independence,
    compensate_slopes,
    effective_number,
    sample_pixels,
)
from .common_order import rank_orders
from .conclusion import contrast_map, model_error
from .evidence import OrderEvidence, order_evidence, refine_cells
from .first_nuisances import first_nuisances
from .learning import learn
from .learning_cells import LearningCells, sample_blocks
from .narrow_sensor import NarrowSensor, is_own_mean, settle_narrow_sensor
from .nuisances import NuisanceFit, Nuisances, add_offset, patterns_of_cells, subtract_offset
from .orders import SURE, solve_orders
from .pixels import CellSurface, PixelFit, calm_surface, fit_pixels
from .posterior import widen_uncertainties
from .relaxation import SettledCells, settle_orders
from .rescue import rescue_pixels
from .shared_misfit import doubt_from_shared_misfit, leaves_only_noise
from .templates import FringeTemplates

__all__ = ["GlobalFit", "choose_cell_size", "global_fit", "normalise_to_cells", "spans_orders"]

LARGEST_CELL_PX = 8
"""Cells beyond this would wash out the steep fringes of real sensors (9 nm per pixel)."""
MOST_CELLS = 600_000
"""Bound on the memory of the order evidence: about 84 orders of 4 bytes for each cell."""
_STEEPEST_STRUCTURE = 1.0
"""Largest ``1 - cos`` of the phase across a cell, in the steepest tenth of the sensor: a quarter of a fringe."""
_LARGEST_LOSS = 1.0
"""Largest loss of amplitude by the average over a cell, there, in standard deviations of that average.

Slopes inside the cells make up for most of it; beyond this, cells of some phases take the wrong order all the same.
"""
_NINTH_DECILE = 1.28
"""Of a normal distribution, in standard deviations."""
_CLEAREST = 4
"""Wavelengths from which the size of the cells is chosen."""
_CUT_NOISE = 0.902
"""Mean of the squares of normal deviates that are cut at eight times their median."""
_MODEL_CHANGE = 0.15
"""Change of the model, in rms fringe amplitudes, at which the orders are solved again."""
_MOST_SOLUTIONS = 3
_MISFIT = 1.5
"""Reduced chi-square of cells from which on a model is known to be wrong; what it leaves over is shared by many."""
_MEAN_TOLERANCE = 2e-6
"""Relative change of the mean response that is left alone: far below the noise of a smoothed flat."""
_MOST_ROUNDS = 20
_SENSOR_ORDERS = 3.0
"""Orders of thickness that a sensor must span before its mean is near that of the range, whatever its order."""
_FEWEST_TO_SETTLE = 4
"""Wavelengths from which on the mean response of a narrow sensor is sought together with its order."""
_OPEN_ORDERS = 0.5
"""Orders of thickness, times the relative bandwidth of the flats, up to which the mean response is open.

The mean over the range misses that over a sensor by about the fringe amplitude over the number of orders; a wrong
order turns the fringes at one end of the band against those at the other by the relative bandwidth.
"""
_SURELY_MORE = 4.0
"""Times that many orders with which a sensor holds enough of them even if a good part is wrong."""
_MOST_MEANS = 4
"""Solutions of a narrow sensor whose mean response is tried on all cells."""
_MOST_SHAPES = 4
"""Rounds of mean response and orders of a narrow sensor."""
_RIVAL = 2.0
"""Solutions of so many times the least chi-square are still looked at: cells astray cost the true one as much."""
_SAME_SHAPE = 0.25
"""Reliefs that agree within this many orders everywhere are one."""
_WORTHWHILE = 0.01
"""Relative gain of chi-square for which another round is worth its time."""
_NARROW_MARGIN = 3.0
"""Orders beyond what a narrow sensor showed in a sample that its other cells may have."""


@dataclass(frozen=True, eq=False)
class GlobalFit:
    """What the global fit found.

    Attributes
    ----------
    pixels : `PixelFit`
        Value, uncertainty, chi-square of every pixel.
    cells : `Cells`
        Averages that the orders were solved on.
    settled : `SettledCells`
        Order of every cell, and how sure it is.
    border_slip : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Probability that a pixel near a step lies on the other side of it, or that one which was fitted by itself
        has another order.
    templates : `FringeTemplates`
        The model as it was normalised in the end.
    nuisance : `NuisanceFit`
        Patterns and contrast beside the fringes.
    order_um : `float`
        Thickness of one fringe order [µm].
    normalisation : `str`
        ``sensor``, ``narrow`` or ``range``: over which thicknesses the mean response was taken. ``narrow`` is a
        sensor of few orders, whose mean response was found together with its order.
    common_slip : `float`
        Probability that the sensor as a whole has another order.
    margin : `float`
        Chi-square by which the next best order of the whole sensor is worse, where nuisances are free.
    contrast_map : `numpy.ndarray`, float32
        Contrast in blocks of the sensor, over that of the sensor.
    """

    pixels: PixelFit
    cells: Cells
    settled: SettledCells
    border_slip: NDArray[np.float32]
    templates: FringeTemplates
    nuisance: NuisanceFit
    order_um: float
    normalisation: str
    common_slip: float = 0.0
    margin: float = np.inf
    contrast_map: NDArray[np.float32] = field(default_factory=lambda: np.ones((1, 1), np.float32))


def global_fit(
    data: Amplitudes,
    templates: FringeTemplates,
    *,
    range_um: tuple[float, float],
    cell_px: int | None = None,
    nuisances: Nuisances | None = None,
    threads: int = 2,
) -> GlobalFit:
    """Fit a sensor.

    Parameters
    ----------
    data : `Amplitudes`
        The flats.
    templates : `FringeTemplates`
        The model; its grid must contain the range and half an order on both sides.
    range_um : `tuple` [`float`, `float`]
        Thicknesses that are possible [µm].
    cell_px : `int`, optional
        Size of the cells [px]; chosen from the steepness of the fringes if not given.
    nuisances : `Nuisances`, optional
        What else than thickness is free; nothing by default.
    threads : `int`, optional
        Number of threads; has no influence on the result.
    """
    _, ny, nx = data.shape
    nuisances = (nuisances or Nuisances()).fitting(ny, nx)
    order = templates.order_um()
    size = choose_cell_size(data) if cell_px is None else cell_px
    y_breaks, x_breaks = nuisances.breaks(ny, nx)
    cells = average_cells(
        data,
        cell_edges(ny, size, y_breaks),
        cell_edges(nx, size, x_breaks),
        largest_amplitude=np.abs(templates.amplitude()).max(axis=0),
        threads=threads,
    )
    independence = cell_independence(size, data.noise_correlation_px)
    solver = _Solver(order, range_um, independence, nuisances, threads, data, templates)
    state = solver.solve(cells, templates)
    settled = settle_orders(
        state.cells, state.templates, state.thickness_um, state.slope_y, state.slope_x, order, state.found,
        range_um=state.range_um, temper=solver.temper, correlation_px=data.noise_correlation_px, threads=threads,
    )  # fmt: skip
    state = solver.adjust(replace(state, thickness_um=settled.thickness_um))
    surface = _surface(state, order)
    calmed = calm_surface(surface, threads)
    if state.free.any:
        state = solver.relearn(state, data, calmed)
    light = state.nuisance.light(cells, state.free)
    fringes = replace(data, offset=light, y_edges=cells.y_edges, x_edges=cells.x_edges)
    if state.normalisation == "sensor" and not state.free.any:
        state = replace(state, templates=_normalise_to_pixels(data, state.templates, calmed, threads))
    pixels = fit_pixels(fringes, state.templates, calmed, order, threads=threads)
    rough = spread_to_pixels(cells, ~surface.smooth)
    independent = effective_number(64, 64, data.noise_correlation_px) / 64**2
    pixels, border_slip = settle_borders(fringes, state.templates, pixels, rough, order, independent)
    pixels = rescue_pixels(
        fringes, state.templates, pixels, border_slip, order, range_um=state.range_um, threads=threads
    )
    typical = cells.weight[..., : templates.n_wavelengths].mean(axis=(0, 1))
    widen_uncertainties(fringes, state.templates, pixels, order, typical, threads)
    pixels = model_error(pixels, state.nuisance.scale_sigma)
    if state.common_sigma_um > 0.0:
        whole = np.hypot(pixels.sigma, np.float32(state.common_sigma_um))
        pixels = replace(pixels, sigma=np.asarray(whole, np.float32))
    common_slip = state.common_slip
    if state.searched and not state.free.any:
        doubt = doubt_from_shared_misfit(fringes, state.templates, pixels.value, order)
        common_slip = 1.0 - (1.0 - common_slip) * (1.0 - doubt)
    # Near a step the pixels have been asked one by one, which is worth more than the answer of their cell.
    settled = replace(settled, cell_slip=np.where(surface.smooth, settled.cell_slip, np.float32(0)))
    return GlobalFit(
        pixels, state.cells, settled, border_slip, state.templates, state.nuisance, order, state.normalisation,
        common_slip, state.margin, contrast_map(state.cells, state.templates, state.thickness_um),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _State:
    """Where a solution stands: cells without nuisances and loss of contrast, and the model that fits them."""

    cells: Cells
    slope_y: NDArray[np.float32]
    slope_x: NDArray[np.float32]
    thickness_um: NDArray[np.float32]
    templates: FringeTemplates
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
    described: bool = False
    """Whether the model as it is describes the flats, so that the orders are those that it gives."""

    @property
    def misfit(self) -> float:
        """Median reduced chi-square of the cells, each by itself."""
        freedom = np.maximum(self.cells.n_wavelengths - 1, 1)
        reduced = (self.found.chi2 / freedom)[np.isfinite(self.found.chi2)]
        return float(np.median(reduced)) if reduced.size else 1.0


@dataclass(frozen=True)
class _Solver:
    """Orders, mean response and nuisances of a sensor, in turn."""

    order_um: float
    range_um: tuple[float, float]
    temper: float
    free: Nuisances
    threads: int
    data: Amplitudes
    base: FringeTemplates | None = None

    def solve(self, cells: Cells, templates: FringeTemplates) -> _State:
        """Solve the orders, and again if the model turns out to be another than was thought."""
        if not self.free.any:
            return self._solve_held(cells, templates)
        if np.isfinite(self.free.gain_accuracy):
            described = self._described(cells, templates)
            if described is not None:
                return described
        nuisance = first_nuisances(cells, templates, self.free)
        fitted = nuisance.applied_to(templates)
        for turn in range(_MOST_SOLUTIONS):
            even = subtract_offset(cells, nuisance.light(cells, self.free))
            state = self._state(even, fitted, nuisance, "sensor", self.range_um)
            before, state = state, self._learn(state, ranked=turn == 0)
            if _agree(before, state):
                break
            fitted, nuisance = state.templates, state.nuisance
        return state

    def _described(self, cells: Cells, templates: FringeTemplates) -> _State | None:
        """Solution with the model as it is, if that describes the flats; what is free then moves no order.

        Light and contrast of a sensor of few orders cannot be told from its fringes: there they stay as they are.
        """
        held = replace(self, free=Nuisances())
        nothing = NuisanceFit.none(templates.n_wavelengths)
        probe = held._state(cells, templates, nothing, "range", self.range_um)
        narrow = held._mean_is_open(probe) or not held._is_wide(probe)
        if narrow:
            state = held._solve_held(cells, templates, probe)
            return state if self._leaves_only_noise(state) else None
        if not self._leaves_only_noise(held.adjust(replace(probe, normalisation="sensor"))):
            return None
        state = held._solve_held(cells, templates, probe)
        count = patterns_of_cells(cells, self.free, *np.zeros((2, 1), np.intp))[0].shape[-1]
        start = NuisanceFit.none(templates.n_wavelengths, count)
        return self._learn(replace(state, free=self.free, nuisance=start, described=True), ranked=False)

    def _leaves_only_noise(self, state: _State) -> bool:
        """Whether a solution leaves over nothing that neighbouring pixels share."""
        if not np.isfinite(state.thickness_um).any():
            return False
        surface = calm_surface(_surface(state, self.order_um), self.threads)
        fitted = _normalise_to_pixels(self.data, state.templates, surface, self.threads)
        return leaves_only_noise(self.data, fitted, surface)

    def _solve_held(self, cells: Cells, templates: FringeTemplates, probe: _State | None = None) -> _State:
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

    def _is_wide(self, state: _State) -> bool:
        """Whether a sensor holds orders enough to tell light and contrast from the fringes."""
        if not np.isfinite(state.thickness_um).any():
            return False
        joined = solve_orders(state.cells, state.found, sure=np.inf).thickness_um
        return spans_orders(joined, self.order_um, self._open_orders(state.templates))

    @staticmethod
    def _open_orders(templates: FringeTemplates) -> float:
        """Orders of thickness up to which the mean response is open."""
        wavelength = templates.wavelength_nm
        bandwidth = max(float(np.ptp(wavelength)) / float(wavelength.mean()), 1e-6)
        return max(_OPEN_ORDERS / bandwidth, _SENSOR_ORDERS)

    def _mean_is_open(self, state: _State) -> bool:
        """Whether mean response and orders must be found together."""
        if state.templates.n_wavelengths < _FEWEST_TO_SETTLE:
            return False  # of fewer wavelengths nothing is believed, so there is nothing to settle
        if not np.isfinite(state.thickness_um).any() or not is_own_mean(state.cells, state.templates):
            return False
        orders = self._open_orders(state.templates)
        if spans_orders(state.thickness_um, self.order_um, _SURELY_MORE * orders):
            return False
        # Wrong orders make a sensor look thicker and thinner than it is; joined by phases alone it cannot jump.
        joined = solve_orders(state.cells, state.found, sure=np.inf).thickness_um
        return not all(
            spans_orders(thickness, self.order_um, orders) for thickness in (state.thickness_um, joined)
        )

    def _state(
        self,
        cells: Cells,
        templates: FringeTemplates,
        nuisance: NuisanceFit,
        normalisation: str,
        range_um: tuple[float, float],
    ) -> _State:
        """Orders of all cells, the model being as it is."""
        found = order_evidence(
            cells, templates, self.order_um, range_um=range_um, temper=self.temper, threads=self.threads
        )
        compensated, slope_y, slope_x = compensate_slopes(cells, found.slope_y, found.slope_x, self.order_um)
        state = _State(
            compensated, slope_y, slope_x, found.best_um, templates, nuisance, normalisation, found, range_um,
            free=self.free,
        )  # fmt: skip
        # Evidence of a model that does not fit is not believed, however many cells agree: they err alike.
        sure = np.inf if self.free.any and state.misfit > _MISFIT else SURE
        return replace(state, thickness_um=solve_orders(cells, found, sure).thickness_um)

    def _narrow(self, cells: Cells, first: _State) -> _State:
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
                for shape in (tried.thickness_um, joined.thickness_um):
                    if not _among(shape, shapes, self.order_um):
                        shapes.append(shape)
            if all(_among(shape, known, self.order_um) for shape in shapes):
                break
        solved = replace(solved, common_slip=best.slip, searched=True)
        if spans_orders(solved.thickness_um, self.order_um):
            return replace(solved, range_um=self.range_um)
        return self.adjust(replace(solved, common_sigma_um=best.sigma_um))

    def _with_mean_of(self, narrow: NarrowSensor, cells: Cells, first: _State) -> _State:
        """Orders of all cells with the mean response of a solution, in its neighbourhood."""
        margin = _NARROW_MARGIN * self.order_um
        range_um = (
            max(self.range_um[0], narrow.range_um[0] - margin),
            min(self.range_um[1], narrow.range_um[1] + margin),
        )
        return self._state(cells, narrow.templates, first.nuisance, "narrow", range_um)

    def adjust(self, state: _State) -> _State:
        """Fit mean response and nuisances to the cells, the orders being as they are, but for a common one."""
        if state.free.any:
            return self._learn(state, ranked=not state.described)
        if state.normalisation == "range":
            return state
        if state.normalisation == "narrow":  # refitting and renormalising in turn would crawl
            thickness = refine_cells(state.cells, state.templates, state.thickness_um, self.threads)
            return replace(state, thickness_um=thickness)
        thickness, fitted = normalise_to_cells(state.cells, state.templates, state.thickness_um, self.threads)
        return replace(state, thickness_um=thickness, templates=fitted)

    def _learn(self, state: _State, ranked: bool) -> _State:
        """Learn light, contrast and wavelengths; if ``ranked``, the order of the whole sensor with them."""
        whole = add_offset(state.cells, state.nuisance.light(state.cells, state.free))
        sample = LearningCells.of(whole, state.thickness_um, state.free, self.temper)
        if sample.thickness_um.size == 0:
            return state
        base = self.base or state.templates
        if ranked:
            found = rank_orders(sample, base, state.free, state.nuisance, self.order_um, state.range_um)
            fit, shift, slip, margin = found.fit, found.shift, found.slip, found.margin
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

    def relearn(self, state: _State, data: Amplitudes, surface: CellSurface) -> _State:
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
        fit = learn(sample, base, state.free, state.nuisance)[1]
        return replace(state, templates=fit.applied_to(base), nuisance=fit)


def _among(shape: NDArray[np.float32], others: list[NDArray[np.float32]], order_um: float) -> bool:
    """Whether a map differs from one of others by no more than a constant, to a fraction of an order."""
    for other in others:
        difference = shape - other
        if np.nanmax(np.abs(difference - np.nanmedian(difference))) < _SAME_SHAPE * order_um:
            return True
    return False


def _agree(before: _State, after: _State) -> bool:
    """Whether two models differ too little to matter for the orders."""
    new = after.templates.amplitude()
    change = np.abs(new - before.templates.amplitude()).mean(axis=0)
    same_light = before.nuisance.coefficients.shape == after.nuisance.coefficients.shape
    if same_light and after.nuisance.coefficients.size:
        change += np.abs(after.nuisance.coefficients - before.nuisance.coefficients).max(axis=1)
    return bool(np.all(change < _MODEL_CHANGE * new.std(axis=0)))


def spread_to_pixels(cells: Cells, values: NDArray[Any]) -> NDArray[Any]:
    """Image in which every pixel holds the value of its cell."""
    rows = np.repeat(values, np.diff(cells.y_edges), axis=0)
    return np.repeat(rows, np.diff(cells.x_edges), axis=1)


def spans_orders(thickness_um: NDArray[np.float32], order_um: float, orders: float = _SENSOR_ORDERS) -> bool:
    """Whether a sensor holds enough orders for the mean response over it to be known from its map."""
    values = thickness_um[np.isfinite(thickness_um)]
    return values.size > 0 and float(np.ptp(np.percentile(values, (2.0, 98.0)))) > orders * order_um


def normalise_to_cells(
    cells: Cells, templates: FringeTemplates, thickness_um: NDArray[np.float32], threads: int = 2
) -> tuple[NDArray[np.float32], FringeTemplates]:
    """Refit the cells and renormalise the templates in turn until neither changes.

    A wrong mean response shifts each thickness by a little that depends on its phase, and so bends the very
    distribution from which the mean response is taken; a few rounds straighten it.

    Parameters
    ----------
    cells : `Cells`
        Mean amplitudes.
    templates : `FringeTemplates`
        The model as it is normalised so far.
    thickness_um : `numpy.ndarray`, shape ``(ncy, ncx)``
        Thickness of the cells to within a fraction of an order [µm]; NaN where there is none.
    threads : `int`, optional
        Number of threads; has no influence on the result.

    Returns
    -------
    thickness_um : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
    templates : `FringeTemplates`
    """
    thickness, fitted = thickness_um, templates.normalised_to(thickness_um)
    for _ in range(_MOST_ROUNDS):
        thickness = refine_cells(cells, fitted, thickness, threads)
        before, fitted = fitted, fitted.normalised_to(thickness)
        if np.abs(fitted.mean_response / before.mean_response - 1.0).max() < _MEAN_TOLERANCE:
            break
    return thickness, fitted


def _surface(state: _State, order: float) -> CellSurface:
    """Surface on which the pixels begin; cells without data borrow from the nearest with data."""
    thickness, slope_y, slope_x = state.thickness_um, state.slope_y, state.slope_x
    empty = ~np.isfinite(thickness)
    if empty.any() and not empty.all():
        near = distance_transform_edt(empty, return_distances=False, return_indices=True)
        thickness = thickness[tuple(near)]
        slope_y, slope_x = np.where(empty, 0.0, slope_y), np.where(empty, 0.0, slope_x)
    cells = state.cells
    return CellSurface.from_cells(thickness, slope_y, slope_x, cells.y_centre, cells.x_centre, order, ~empty)


def _normalise_to_pixels(
    data: Amplitudes, templates: FringeTemplates, surface: CellSurface, threads: int
) -> FringeTemplates:
    """Renormalise to single pixels: a steep cell spreads over a part of a fringe that its mean does not show."""
    return normalise_to_cells(*_sample_on(data, surface, templates, threads))[1]


def _sample_on(
    data: Amplitudes, surface: CellSurface, templates: FringeTemplates, threads: int
) -> tuple[Cells, FringeTemplates, NDArray[np.float32], int]:
    """Some single pixels, and where they begin, as `normalise_to_cells` takes them."""
    sample = sample_pixels(data)
    start = surface.at(sample.y_edges[:-1], sample.x_edges[:-1])
    start[sample.n_wavelengths == 0] = np.nan
    return sample, templates, start, threads


def choose_cell_size(data: Amplitudes) -> int:
    """Largest cell over which the steepest tenth of the sensor still shows its fringes, to within the noise.

    The structure function ``<(a(x + s) - a(x))²> / 2 var(a)`` of a fringe is ``1 - cos`` of its phase over the
    distance ``s``; it is taken in blocks, at the wavelengths with the clearest fringes, with the noise subtracted.

    Parameters
    ----------
    data : `Amplitudes`
        The flats.

    Returns
    -------
    size : `int`
        1, 2, 4 or 8 px, or what keeps the number of cells below `MOST_CELLS`.
    """
    _, ny, nx = data.shape
    least = int(np.ceil(np.sqrt(ny * nx / MOST_CELLS)))
    rows = np.unique(np.linspace(0, max(ny - 2 * LARGEST_CELL_PX, 0), 16).astype(int))
    height = min(2 * LARGEST_CELL_PX, ny)
    lines = [_strip(data, slice(None), int(row), height, every=4) for row in rows]
    image, variance = (np.concatenate(parts, axis=1) for parts in zip(*lines, strict=True))
    seen = np.flatnonzero(np.isfinite(image).any(axis=(1, 2)))
    if seen.size == 0:
        return max(LARGEST_CELL_PX, least)
    noise = np.array([np.nanmean(variance[k]) for k in seen])
    excess = np.array([np.nanvar(image[k]) for k in seen]) - noise
    best = np.argsort(-excess / noise)[:_CLEAREST]
    best = best[excess[best] > 0.0]
    if best.size == 0:
        return max(LARGEST_CELL_PX, least)
    noise, signal, seen = noise[best], excess[best], seen[best]
    strips = [_strip(data, slice(None), int(row), height)[0][seen] for row in rows]
    for size in (8, 4, 2):
        if size <= least:
            break
        if size >= max(ny, nx):
            continue
        structure = _structure(strips, size, noise, signal)
        # The mean over a ramp of phase f is sin(f/2) / (f/2) of its middle: about 1 - (1 - cos f) / 12.
        lost = structure / 12.0 * size * np.sqrt(signal[0] / noise[0])
        if structure < _STEEPEST_STRUCTURE and lost < _LARGEST_LOSS:
            return max(size, least)
    return max(least, 1)


def _strip(
    data: Amplitudes, bands: slice, row: int, height: int, every: int = 1
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Amplitude and variance of some rows (or every so many of them), NaN where not to be used."""
    image, variance, bad = (part[bands, ::every] for part in data.rows(row, row + height))
    scale = data.scale.astype(np.float32)[bands, None, None]
    good = (bad == 0) & np.isfinite(image) & (variance > 0) & np.isfinite(variance)
    return (
        np.where(good, image * scale - np.float32(1), np.float32(np.nan)),
        np.where(good, variance * scale**2, np.float32(np.nan)),
    )


def _structure(
    strips: list[NDArray[np.float32]],
    lag: int,
    noise: NDArray[np.floating],
    signal: NDArray[np.floating],
) -> float:
    """Ninth decile over blocks of the structure function at one distance."""
    values = []
    share = signal / noise**2 / np.sum((signal / noise) ** 2)
    for image in strips:
        width = max(image.shape[2] // 16, 4 * lag)
        for left in range(0, image.shape[2], width):
            block = image[:, :, left : left + width]
            for step in (block[:, lag:] - block[:, :-lag], block[:, :, lag:] - block[:, :, :-lag]):
                square = (step**2).reshape(len(step), -1)
                count = np.isfinite(square).sum(axis=1)
                if square.size and count.min() >= 16:
                    # Spikes are cut: neither a fringe nor noise has squares so far above the median.
                    square = np.minimum(square, 8.0 * np.nanmedian(square, axis=1)[:, None])
                    excess = np.nanmean(square, axis=1) - 2.0 * _CUT_NOISE * noise
                    # Where noise rules, the ninth decile would be that of the noise of these means.
                    scatter = _NINTH_DECILE * np.sqrt(np.sum((share * 2.0 * noise) ** 2 * 2.0 / count))
                    values.append(0.5 * (np.sum(share * excess) - scatter))
    return float(np.percentile(values, 90)) if values else np.inf
