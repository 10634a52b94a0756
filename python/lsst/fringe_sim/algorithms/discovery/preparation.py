"""From a cube to a fitted problem: cells, first thickness, freedom of the field, noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import binary_dilation

from ...array_types import BoolArray, FloatArray
from ...effects import Effect
from ...errors import InputError
from ...model import FringeModel
from ...products.fringe_cube import FringeCube
from ..exposures import Exposures
from .basis import CellBasis, FieldBasis, SplineBasis
from .cells import UNSTATED_UM, CellData, bin_cube, finest_useful_cell
from .comparison import chi2_with_free_fringes, fringe_order_um
from .fit import Fit, Problem, fit_model, linearise_at
from .forward import Forward
from .growth import fitted_smooth, grown_thickness
from .islands import mended_on_islands
from .noise import STATED_UNCERTAINTY, NoiseEstimate, estimate_noise, map_variance_share, noise_ratio
from .outliers import spoiled_cells
from .planes import is_torn, joined_planes
from .start import mended_thickness, starting_thickness

SPACINGS = (8.0, 4.0, 2.0)
MUCH_SMOOTHER = 0.5
"""Knots that a field is tried with [cells], and the part of its coefficients that a much smoother one has at most."""

SMOOTH_SPACING = 8.0
MUCH_BETTER, CLEARLY_BETTER = 0.7, 0.995
"""Knots with which two thicknesses are compared [cells], and the part of χ² for which one is taken for the other: as
they are, and once fitted."""

FARTHEST_K, SAME_K = 5.0, 0.5
"""How far the temperature of flats may be from that of the set-up, and how far it is taken to be the same [K]."""

MUCH_SHARPER, SURELY_SHARPER = 9.0, 25.0
FEW_PLACES = (2, 3, 4)
MUCH_EXPLAINED, NOISE_SIGMAS = 0.5, 5.0
"""χ², over its mean, that pixels without an area must gain: three standard deviations, five if they have a few places
along a side; the part of the misfit beyond noise that they may leave, and the uncertainty of that noise [standard
deviations]."""

PIXEL_RMS = 1.0 / math.sqrt(12.0)  # Rms radius of a pixel's area along one axis [px]

SAME_AREA = 0.5
"""Part by which the variance of a blur may differ from what few places lack of an area, to be taken for it."""

AREA_LOSS = 9.0  # Rise of χ² for which pixels are taken to see their area instead of few places and a blur
RIM_CELLS = 2  # Cells on both sides of the rim of a local effect that do not decide how fine the thickness is
FEWEST_ROWS = 6  # Rows and columns of cells from which on noise and levels can be measured

FEWEST_OF_A_MEAN = 500
"""Pixels in fewer rows or columns than that from which on their mean is about that of a fringe."""

ORDERS_TRIED = 6  # Fringe orders on both sides of the first one in which a few pixels are fitted

STEPS_PER_ORDER = 12

LARGEST_SEARCH = 2
"""Cells, over those wanted, from which on a part of the sensor is searched: fringes of a few pixels forbid larger
cells, and time grows with their number."""

FEWEST_ROWS_OF_PART = 96

SPOILED_ROUNDS = 3
FEW_SPOILED = 1e-5
"""How often spoiled cells are looked for, and the part of the data that need not be looked at again: each draws the
thickness of its surroundings."""

WIDE_FRINGE, STEEP = 4.0, 0.95
"""Cells over which a fringe is described well by slopes, and the part of the cells that are less steep than those
where that is asked."""

NOISE_DRAWS, LARGEST_ERROR = 24, 0.1
"""Draws of noise from which the scatter of the thickness is found; the part of an order to which it is believed."""

LARGEST_PRIOR, HELD_PRIOR = 1e8, 1e12
"""Precision of the best map, and of one that is not to move [1/µm²]: 0.1 nm and a thousandth of that."""

NOISE_CHANGE = 0.02
SCATTER_CHANGE = 0.05
"""Parts by which noise and response scatter may change before the search is done again with them."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """Data and model, ready for the search."""

    problem: Problem  # data with their measured noise, model and nuisances
    null: Fit  # fit of the unchanged model
    noise: NoiseEstimate  # what was measured of the noise
    index: FloatArray  # (W,): refractive index of the varying layer
    # Whether there are enough cells to measure noise and levels, and for the tests without a catalogue
    rich: bool
    stated: CellData  # the data with their stated noise
    notes: tuple[str, ...] = field(default=())  # for the verdict
    undistorted_field: FloatArray | None = None  # field that was fitted with free contrasts
    # Moves of the whole field among which the order of a few pixels is looked for
    shifts_um: tuple[float, ...] = ()
    # Settings with which ``undistorted_field`` was fitted
    guess: Mapping[str, float] = field(default_factory=dict)

    @property
    def told(self) -> tuple[str, ...]:
        """Notes, and how pixels are taken if not as areas."""
        places = self.problem.forward.places
        return (*self.notes, _places_told(places)) if places else self.notes


def _places_told(places: int) -> str:
    taken = "a point" if places == 1 else f"{places} by {places} points"
    return f"sharper than light averaged over pixels can be: each is taken as {taken}"


def check_setup(cube: FringeCube, model: FringeModel) -> None:
    """Refuse data that contradict the set-up."""
    if model.setup.kind != "monochromator":
        raise InputError("set-up", model.setup.name, "a laboratory set-up with a monochromator")
    rows = cube.exposures
    known = {item.effect.name for item in model.effects}
    stated = model.base_system.temperature_k
    if np.any(np.abs(rows.temperature_k - stated) > FARTHEST_K) and "temperature" not in known:
        allowed = f"within {FARTHEST_K:g} of the set-up's {stated:g}, or with the effect temperature.kelvin"
        farthest = rows.temperature_k[np.abs(rows.temperature_k - stated).argmax()]
        raise InputError("temperature of the flats [K]", float(farthest), allowed)
    width = model.setup.bandwidth_fwhm_nm
    measured = rows.bandwidth_fwhm_nm[rows.bandwidth_fwhm_nm > 0.0]
    if np.any(np.abs(measured - width) > 0.02 * width) and "bandwidth" not in known:
        raise InputError("bandwidth FWHM [nm]", rows.bandwidth_fwhm_nm.tolist(), f"the set-up's {width:g}")
    single = model.base_system.beam.theta.size == 1
    if single and np.any(np.isfinite(rows.f_number)) and "converging_beam" not in known:
        raise InputError("f_number", rows.f_number.tolist(), "infinite: the set-up's light is parallel")


def headers_apart(cube: FringeCube, model: FringeModel) -> tuple[str, ...]:
    """What the flats say of the laboratory and the model does not follow, for the verdict."""
    stated, temperature = model.base_system.temperature_k, cube.exposures.temperature_k
    known = any(item.effect.name == "temperature" for item in model.effects)
    if known or not np.any(np.abs(temperature - stated) > SAME_K):
        return ()
    return (
        f"the flats state {_span(temperature)} K, the model has the set-up's {stated:g} K; to believe the flats, "
        f"set the effect temperature.kelvin",
    )


def _span(values: FloatArray) -> str:
    """A number, or the smallest and the largest of several."""
    low, high = float(values.min()), float(values.max())
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def are_few(shape: tuple[int, ...], pixels: int) -> bool:
    """Whether the mean of so many good pixels in rows and columns is not about that of a fringe."""
    return min(shape) < FEWEST_ROWS and pixels < FEWEST_OF_A_MEAN


def why_too_poor(cube: FringeCube, model: FringeModel) -> str:
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
    if cube.unit == "electron" and are_few(cube.shape[1:], pixels):
        return (
            f"{pixels} pixel(s) in electrons: their mean is not the level of the flats; give counts relative to the "
            "mean of the whole sensor, or more pixels"
        )
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


def prepare(
    cube: FringeCube,
    model: FringeModel,
    effects: Sequence[Effect],
    most_cells: int,
    exposures: Exposures | None = None,
) -> Prepared:
    """Average a cube to cells, find their thickness, measure their noise, fit the unchanged model.

    The thickness must be known where the light of the ``exposures`` is not that of flats.
    """
    size = finest_useful_cell(cube, most_cells=most_cells)
    prepared = _prepare_in_cells(cube, model, effects, size, most_cells, exposures)
    finer = prepared
    while size > 1 and finer.problem.forward.places and _narrowest_fringe(finer) < WIDE_FRINGE:
        # Fringes hardly wider than a cell may look sharper in it than they are.
        size //= 2
        finer = _prepare_in_cells(cube, model, effects, size, most_cells, exposures)
    return prepared if finer.problem.forward.places else finer


def _narrowest_fringe(prepared: Prepared) -> float:
    """Width of a fringe where the thickness is steep [cells]."""
    forward, seen = prepared.problem.forward, prepared.problem.cells.seen
    slope = np.hypot(*forward.gradient(prepared.problem.basis.expand(prepared.null.field)))[seen]
    return prepared.problem.order_um / max(float(np.quantile(slope, STEEP)), 1e-300)


def _prepare_in_cells(
    cube: FringeCube,
    model: FringeModel,
    effects: Sequence[Effect],
    size: int,
    most_cells: int,
    exposures: Exposures | None,
) -> Prepared:
    """The same in cells of so many pixels."""
    cells = _cells_of(cube, size, most_cells)
    stack = model.system.stack
    medium = stack.layers[stack.position(model.system.varying)].medium
    index = np.real(medium.index(cells.wavelength_nm, model.system.temperature_k))
    if cells.thickness_um is not None:
        return _prepare_known(cells, model, effects, index, exposures)
    start = starting_thickness(model, cells)
    forward = Forward.of_cells(model, effects, cells, (float(start.min()) - 0.5, float(start.max()) + 0.5))
    if not _is_rich(cells):
        return _prepare_few(cells, forward, start, index)
    problem = Problem(cells, forward, CellBasis(start.shape), _free_levels(cells))
    joined = _joined(problem, fit_model(problem, (), np.zeros(0), start.ravel(), iterations=0), start)
    return _prepare_rich(cells, forward, start if joined is None else joined[0], index, {})


def prepare_finer(
    cube: FringeCube, prepared: Prepared, fit: Fit, thickness_um: FloatArray, most_cells: int
) -> Prepared:
    """Data in cells of half the size, with field and noise as judged with an effect in the model.

    Cells are chosen by what is seen of the pattern. An effect that blurs it hides how fine the light was.

    ``prepared``: their larger cells, without a map of the thickness. ``thickness_um`` (ny, nx): thickness of
    all larger cells in that fit.
    """
    larger, old = prepared.problem.cells, prepared.problem.forward
    cells = _cells_of(cube, larger.cell_px // 2, most_cells)
    places = np.meshgrid(cells.geometry.y_px, cells.geometry.x_px, indexing="ij")
    between = RegularGridInterpolator(
        (larger.geometry.y_px, larger.geometry.x_px), thickness_um, bounds_error=False, fill_value=None
    )
    start = np.asarray(between(np.stack(places, axis=-1)))
    limits = (float(start.min()) - 0.5, float(start.max()) + 0.5)
    forward = Forward.of_cells(old.model, old.catalogue, cells, limits, old.exposures)
    finer = _prepare_rich(cells, forward, start, prepared.index, fit.settings)
    return replace(finer, guess=dict(fit.settings))


def _prepare_rich(
    cells: CellData, forward: Forward, start: FloatArray, index: FloatArray, settings: Mapping[str, float]
) -> Prepared:
    """Field and noise from a first thickness, as judged with some effects in the model."""
    problem = Problem(cells, forward, CellBasis(start.shape), _free_levels(cells))
    problem, fit, cells = _without_spoiled(*_choose_field(problem, start, settings), cells, settings)
    return _settle(*_choose_pixels(problem, fit, settings), cells, index)


def _cells_of(cube: FringeCube, size: int, most_cells: int) -> CellData:
    cells = bin_cube(cube, size)
    return cells.window(*_part_searched(cells.shape[1:], LARGEST_SEARCH * most_cells))


def _part_searched(shape: tuple[int, ...], most: int) -> tuple[slice, slice]:
    """Rows and columns about the middle with so many cells at most: as wide as may be, to see all amplifiers."""
    rows, columns = shape
    high = rows if rows * columns <= most else min(rows, max(FEWEST_ROWS_OF_PART, most // columns))
    wide = min(columns, max(most // high, 1))
    top, left = (rows - high) // 2, (columns - wide) // 2
    return slice(top, top + high), slice(left, left + wide)


def _part_told(cells: CellData) -> list[str]:
    """Which part of the sensor is searched, if it is not the whole."""
    whole = tuple(size // cells.cell_px for size in cells.geometry.shape)
    if cells.shape[1:] == whole:
        return []
    ends = [
        f"{name} {int(place[0] - 0.5 * (cells.cell_px - 1))} to {int(place[-1] + 0.5 * (cells.cell_px - 1))}"
        for name, place in (("rows", cells.geometry.y_px), ("columns", cells.geometry.x_px))
    ]
    return [f"the fringes are too narrow for larger cells: searched in {' and '.join(ends)}"]


def prepare_again(prepared: Prepared, fit: Fit, thickness_um: FloatArray) -> tuple[Prepared | None, int]:
    """Field and noise as judged with an effect in the model.

    ``thickness_um`` (ny, nx). Returns `None` if the judgement is about the same, and the cells that are in
    another fringe order now.
    """
    problem = prepared.problem
    if not prepared.rich:
        return None, 0
    if problem.field_prior:
        return _with_other_pixels(prepared, fit), 0
    start, settings = _mended(problem, fit, thickness_um)
    half_order = 0.5 * fringe_order_um(problem.cells.wavelength_nm, float(prepared.index.mean()))
    mended = int(np.count_nonzero(np.abs(start - thickness_um) > half_order))
    rim = _rims(problem, settings)
    seen, fitted = _choose_field(problem.with_cells(problem.cells.restricted(~rim)), start, settings)
    chosen = _choose_pixels(seen, fitted, _without_rest_of_area(settings, problem.forward))
    refined = _settle(*chosen, prepared.stated, prepared.index)
    refined = replace(refined, null=_better_null(refined, prepared), guess=settings)
    change = np.abs(refined.noise.factor / prepared.noise.factor - 1.0).max()
    scatter = abs(refined.noise.response_scatter - prepared.noise.response_scatter)
    same_pixels = refined.problem.forward.places == problem.forward.places
    size, before = refined.problem.basis.size, problem.basis.size
    # Across a rim the thickness goes on as it is, and tells more the smoother it may be.
    much_smoother = rim.any() and size <= MUCH_SMOOTHER * before
    same_field = size <= before and not much_smoother and not mended and same_pixels
    if same_field and change < NOISE_CHANGE and scatter < SCATTER_CHANGE * problem.cells.noise_rms:
        return None, mended
    return refined, mended


def is_judged_better(prepared: Prepared, other: Prepared) -> bool:
    """Whether the field of one, and the effects it was judged with, lie much better on the data than another's."""
    return _misfit_as_judged(prepared) < MUCH_BETTER * _misfit_as_judged(other)


def _misfit_as_judged(prepared: Prepared) -> float:
    """χ² by the stated noise, contrasts free."""
    assert prepared.undistorted_field is not None
    problem = replace(prepared.problem, cells=prepared.stated, free_contrast=True)
    return fit_model(problem, (), np.zeros(0), prepared.undistorted_field, None, prepared.guess).chi2


def field_bases(shape: tuple[int, int]) -> list[FieldBasis]:
    """Parametrisations of the field that are tried on so many rows and columns, smoothest first."""
    splines: list[FieldBasis] = [SplineBasis.of_grid(shape, spacing) for spacing in SPACINGS]
    return [basis for basis in splines if basis.size <= math.prod(shape)] + [CellBasis(shape)]


def smoother(prepared: Prepared) -> Iterator[Prepared]:
    """The same data and noise with a field that may not be as fine, smoothest first."""
    problem = prepared.problem
    thickness = problem.basis.expand(prepared.null.field)
    for basis in field_bases((thickness.shape[0], thickness.shape[1])):
        if basis.size > MUCH_SMOOTHER * problem.basis.size:
            break
        trial = replace(problem, basis=basis)
        field = basis.fit(thickness, problem.cells.seen.astype(float))
        yield replace(
            prepared, problem=trial, null=fit_model(trial, (), np.zeros(0), field, prepared.null.levels)
        )


def _rims(problem: Problem, settings: Mapping[str, float]) -> BoolArray:
    """Cells at the rim of local effects: one that is a little off would ask for a thickness of each of them."""
    found = np.zeros(problem.cells.shape[1:], dtype=bool)
    for part in problem.forward.island_parts(settings):
        found |= binary_dilation((part > 0.0) & (part < 1.0), iterations=RIM_CELLS)
    return found


def sees_areas(problem: Problem, fit: Fit) -> bool:
    """Whether pixels that see their area explain as much without the blurs of a fit as few places in each with them.

    Real pixels see their area.
    """
    names = _blurs_of(fit, problem.forward)
    if not problem.forward.places or not names:
        return False
    rest = without_blurs(fit, problem.forward)
    areas = replace(problem, forward=problem.forward.with_places(0))
    other = fit_model(areas, rest.coordinates, rest.position, fit.field, fit.levels)
    return other.chi2 < fit.chi2 + AREA_LOSS * len(names)


def without_blurs(fit: Fit, forward: Forward) -> Fit:
    """The same place without effects that blur the light; not a minimum."""
    for name in _blurs_of(fit, forward):
        fit = fit.without(name)
    return fit


def _blurs_of(fit: Fit, forward: Forward) -> set[str]:
    """Effects of a fit that blur the light."""
    return {item.effect for item in fit.coordinates if forward.blurs(item.effect)}


def prepare_with_areas(prepared: Prepared, fit: Fit, thickness_um: FloatArray) -> Prepared:
    """Field and noise with pixels that see their area, and the effects of a fit but blurs."""
    forward = prepared.problem.forward
    settings = without_blurs(fit, forward).settings
    problem = replace(prepared.problem, forward=forward.with_places(0))
    seen, fitted = _choose_field(problem, thickness_um, settings)
    refined = _settle(seen, fitted, prepared.stated, prepared.index)
    return replace(refined, null=_better_null(refined, prepared), guess=settings)


def _mended(problem: Problem, fit: Fit, thickness_um: FloatArray) -> tuple[FloatArray, dict[str, float]]:
    """Thickness without the cells that a better model shows in another fringe order, and its effects."""
    model = problem.forward.model_with(fit.settings)
    start = mended_thickness(model, problem.cells, thickness_um)
    start = _better_start(problem, fit.settings, start, starting_thickness(model, problem.cells))
    joined = _joined(problem, fit, start)
    if joined is not None:
        start, fit = joined
    # Elsewhere the fringes are not those of the island of a local effect.
    start = mended_on_islands(problem, fit, thickness_um, start)
    if not any(problem.forward.couples_pixels(item.effect) for item in fit.coordinates):
        return start, dict(fit.settings)
    if _is_blurred(problem.forward, fit.settings):
        problem = replace(problem, forward=problem.forward.with_places(0))
    grown = grown_thickness(problem, fit, start)
    return (start, dict(fit.settings)) if grown is None else (grown.thickness_um, grown.settings)


def _joined(problem: Problem, fit: Fit, thickness_um: FloatArray) -> tuple[FloatArray, Fit] | None:
    """Thickness through planes on the fringes of many cells each, where one that is torn lies worse on the data.

    Both are fitted with as few knots, effects included: what single cells add to a torn one is noise.
    """
    if not is_torn(thickness_um, problem.cells.seen, problem.order_um):
        return None
    planes = joined_planes(problem.forward.model_with(fit.settings), problem.cells, thickness_um)
    if planes is None:
        return None
    torn, joined = (fitted_smooth(problem, fit, each, SMOOTH_SPACING) for each in (thickness_um, planes))
    if joined.fit.chi2 > CLEARLY_BETTER * torn.fit.chi2:
        return None
    thickness = joined.problem.basis.expand(joined.fit.field)
    return thickness, replace(fit, settings=joined.fit.settings, position=joined.fit.position)


def _with_other_pixels(prepared: Prepared, fit: Fit) -> Prepared | None:
    """Data with a map, if an effect in the model changes how their pixels are judged; it can look like an area."""
    problem = prepared.problem
    free = replace(problem, free_contrast=True)
    first = fit_model(free, (), np.zeros(0), fit.field, None, fit.settings)
    forward = _choose_pixels(free, first, fit.settings)[0].forward
    if forward.places == problem.forward.places:
        return None
    problem = replace(problem, forward=forward)
    null = fit_model(problem, (), np.zeros(0), prepared.null.field, prepared.null.levels)
    return replace(prepared, problem=problem, null=null, guess=dict(fit.settings))


def _better_start(
    problem: Problem, settings: Mapping[str, float], first: FloatArray, second: FloatArray
) -> FloatArray:
    """The one of two thicknesses whose fringes lie better on the data, contrasts free, once both are smooth.

    A fit without an effect that weakens the fringes in some places may have left the right thickness there.
    """
    basis = SplineBasis.of_grid((first.shape[0], first.shape[1]), SMOOTH_SPACING)
    seen = problem.cells.seen.astype(float)
    values = []
    for thickness in (first, second):
        smooth = basis.expand(basis.fit(thickness, seen))
        problem.forward.cover(smooth)
        values.append(problem.forward.predict(settings, smooth).value)
    chi2 = chi2_with_free_fringes(np.stack(values, axis=1), problem.cells.value, problem.cells.weight)
    return second if chi2[1] < MUCH_BETTER * chi2[0] else first


def _better_null(refined: Prepared, before: Prepared) -> Fit:
    """Fit of the unchanged model, from the thickness with the effect or from that without, whichever is better."""
    problem, null = refined.problem, refined.null
    thickness = before.problem.basis.expand(before.null.field)
    weight = problem.cells.seen.astype(float)
    other = fit_model(problem, (), np.zeros(0), problem.basis.fit(thickness, weight), null.levels)
    return min(null, other, key=lambda fit: fit.chi2)


def _is_rich(cells: CellData) -> bool:
    return min(cells.shape[1:]) >= FEWEST_ROWS


def _free_levels(cells: CellData) -> FloatArray:
    """One level for each wavelength; one for all where there are too few cells to tell it from the fringes."""
    return np.eye(cells.shape[0]) if _is_rich(cells) else np.ones((cells.shape[0], 1))


def _prepare_known(
    cells: CellData,
    model: FringeModel,
    effects: Sequence[Effect],
    index: FloatArray,
    exposures: Exposures | None,
) -> Prepared:
    """Data with a thickness map: the field may move only within its uncertainty."""
    assert cells.thickness_um is not None
    known = np.where(np.isfinite(cells.thickness_um), cells.thickness_um, np.nanmedian(cells.thickness_um))
    sigma = UNSTATED_UM if cells.thickness_sigma_um is None else float(np.nanmedian(cells.thickness_sigma_um))
    range_um = (float(known.min()) - 0.5, float(known.max()) + 0.5)
    forward = Forward.of_cells(model, effects, cells, range_um, exposures)
    basis = CellBasis(known.shape)
    prior = min(1.0 / max(sigma, 1e-300) ** 2, LARGEST_PRIOR)
    rich, centre = _is_rich(cells), known.ravel()
    # Errors of the map at a wrong contrast would be taken for noise.
    problem = Problem(cells, forward, basis, _free_levels(cells), prior, centre, free_contrast=rich)
    fit = fit_model(problem, (), np.zeros(0), centre)
    if rich:
        problem, fit, spoiled = _spoiled_of(problem, fit, {})
        cells = cells.restricted(~spoiled)
        problem, fit = _choose_pixels(problem, fit, {})
        problem = _settle(problem, fit, cells, index).problem
        problem, fit, taken = _with_map_as_good_as_it_is(problem, centre)
        return _settle(problem, fit, cells, index, taken)
    return _settle(problem, fit, cells, index)


def _with_map_as_good_as_it_is(problem: Problem, centre: FloatArray) -> tuple[Problem, Fit, FloatArray]:
    """Problem and fit with the uncertainty of its map as the data show it, where that is less than stated.

    Also the part of the variance of the noise, by wavelength, that the thickness takes up where it may move.

    A thickness that may move further than it must follows the noise, and the fringes look stronger than they are, by
    the square of the phase that it may move; what it scatters about the truth in the end weakens them.
    """
    held = replace(problem, field_prior=HELD_PRIOR, free_contrast=True)
    design, residual, *_ = linearise_at(held, fit_model(held, (), np.zeros(0), centre))
    share = map_variance_share(design.slope, residual, 1.0 / problem.field_prior)
    prior = min(problem.field_prior / max(share, 1e-300), LARGEST_PRIOR)
    variance = 1.0 / (prior + (design.slope**2).sum(axis=0))
    problem.forward.scatter_um2 = variance
    problem = replace(problem, field_prior=prior, free_contrast=True)
    taken = (design.slope**2 * variance).sum(axis=(1, 2)) / np.maximum(
        (design.slope != 0.0).sum(axis=(1, 2)), 1
    )
    return problem, fit_model(problem, (), np.zeros(0), centre), taken


def _prepare_few(cells: CellData, forward: Forward, start: FloatArray, index: FloatArray) -> Prepared:
    """A few pixels with many wavelengths: every fringe order is tried, the stated noise is believed."""
    basis = CellBasis(start.shape)
    order = fringe_order_um(cells.wavelength_nm, float(index.mean()))
    spread = cells.scaled_noise(1.0 + STATED_UNCERTAINTY, 0.0)
    problem = Problem(spread, forward, basis, _free_levels(cells))
    reach = np.arange(-ORDERS_TRIED * STEPS_PER_ORDER, ORDERS_TRIED * STEPS_PER_ORDER + 1)
    shifts = reach * (order / STEPS_PER_ORDER)
    shifts = shifts[float(start.min()) + shifts > 0.5]
    fits = [
        fit_model(problem, (), np.zeros(0), (start + shift).ravel()) for shift in shifts[::STEPS_PER_ORDER]
    ]
    noise = NoiseEstimate(np.ones(cells.shape[0]), 0.0, False, 0.0)
    best = min(fits, key=lambda fit: fit.chi2)
    note = "noise taken as stated plus 20 %; flat levels taken as known up to a common factor"
    return Prepared(problem, best, noise, index, False, cells, (note,), start.ravel(), tuple(shifts.tolist()))


def _choose_field(problem: Problem, start: FloatArray, settings: Mapping[str, float]) -> tuple[Problem, Fit]:
    """Coarsest parametrisation of the field that the data do not want finer, and its fit.

    The contrast of each wavelength is free: a field that had to make up for a wrong contrast would be drawn into
    ever finer coefficients. A coarse field may leave steep parts in wrong fringe orders; finer ones begin from the
    first thickness too.
    """
    cells = problem.cells
    weight = cells.seen.astype(float)
    forward = problem.forward.with_scatter(None)
    best: tuple[Problem, Fit] | None = None
    for basis in field_bases((start.shape[0], start.shape[1])):
        trial = replace(problem, basis=basis, free_contrast=True, forward=forward)
        first = [start] if best is None else [best[0].basis.expand(best[1].field), start]
        fits = [
            fit_model(trial, (), np.zeros(0), field, None if best is None else best[1].levels, settings)
            for field in _in_different_orders([basis.fit(one, weight) for one in first], trial)
        ]
        fit = min(fits, key=lambda item: item.chi2)
        if best is not None and not _finer_is_better(best, (trial, fit)):
            break
        best = (trial, fit)
    assert best is not None
    return best


def _in_different_orders(fields: Sequence[FloatArray], problem: Problem) -> Sequence[FloatArray]:
    """The fields that are not in the same fringe order as the first one everywhere, and the first."""
    maps = [problem.basis.expand(field) for field in fields]
    order = problem.order_um
    seen = problem.cells.seen
    return [
        field
        for number, (field, each) in enumerate(zip(fields, maps, strict=True))
        if number == 0 or np.abs(each - maps[0])[seen].max(initial=0.0) > 0.5 * order
    ]


def _choose_pixels(problem: Problem, fit: Fit, settings: Mapping[str, float]) -> tuple[Problem, Fit]:
    """Pixels as areas or as points, and the fit with them; points only where the data are clearly sharper.

    Real pixels average over their area. Simulated frames may average over none of it or a few places, and no effect
    would ever sharpen them. Points that
    something else blurs by more than that are not told from areas that it blurs by less, which are taken.
    """
    forward = problem.forward
    if _is_blurred(forward, settings):
        if forward.places:
            problem = replace(problem, forward=forward.with_places(0))
            fit = fit_model(problem, (), np.zeros(0), fit.field, fit.levels, settings)
        return problem, fit
    free = problem.n_levels + (0 if problem.field_prior else problem.basis.size)
    degrees = max(problem.cells.n_values - free, 1)
    tried = {forward.places: (problem, fit)}

    def taken_as(places: int) -> tuple[Problem, Fit]:
        if places not in tried:
            other = replace(problem, forward=forward.with_places(places))
            tried[places] = other, fit_model(other, (), np.zeros(0), fit.field, fit.levels, settings)
        return tried[places]

    areas, best = taken_as(0), taken_as(1)
    mean = areas[1].chi2 / degrees
    least = MUCH_SHARPER
    if abs(areas[1].chi2 - best[1].chi2) > SURELY_SHARPER * mean:
        best = min(map(taken_as, (1, *FEW_PLACES)), key=lambda item: item[1].chi2)
        least = MUCH_SHARPER if best[0].forward.places == 1 else SURELY_SHARPER
    if areas[1].chi2 - best[1].chi2 <= least * mean:
        return areas
    noise = _noise_of(*best) * degrees
    # A field in a wrong order, or an effect that is not in the model, may leave either somewhat better.
    chance = NOISE_SIGMAS * noise * math.sqrt(2.0 / degrees)
    explained = best[1].chi2 - noise < MUCH_EXPLAINED * (areas[1].chi2 - noise) + chance
    return best if explained else areas


def _noise_of(problem: Problem, fit: Fit) -> float:
    """Mean of χ² that a value has from noise alone, as measured in what a fit leaves."""
    cells = problem.cells
    noise = estimate_noise(cells, _residual(problem, problem.expected_of(fit)))
    if not problem.field_prior:
        noise = noise.with_taken(_follow_noise(problem, fit).taken)
    used = (cells.weight > 0.0).sum(axis=(1, 2))
    response = noise.response_scatter**2 * cells.weight.sum(axis=(1, 2)) / np.maximum(used, 1)
    return float(np.average(noise.factor**2 + response, weights=used))


def _is_blurred(forward: Forward, settings: Mapping[str, float]) -> bool:
    """Whether effects blur the light by at least as much as the area of a pixel does."""
    return forward.blur_px(settings) >= PIXEL_RMS


def _without_rest_of_area(settings: Mapping[str, float], forward: Forward) -> Mapping[str, float]:
    """Effects without a blur that is what a few places in a pixel lack of its area: that is no effect."""
    if not forward.places:
        return settings
    missing = (PIXEL_RMS / forward.places) ** 2
    variance = forward.blur_px(settings) ** 2 + forward.charge_spread_px2(settings)
    if abs(variance - missing) > SAME_AREA * missing:
        return settings
    return {key: value for key, value in settings.items() if not forward.blurs(key.partition(".")[0])}


def _settle(
    problem: Problem, fit: Fit, stated: CellData, index: FloatArray, taken: FloatArray | float = 0.0
) -> Prepared:
    """Measure the noise at a first fit, and fit the unchanged model with it.

    The thickness has taken up a part ``taken`` of the variance.
    """
    expected = problem.expected_of(fit)
    even = stated.with_noise_of(expected)
    noise = estimate_noise(even, _residual(replace(problem, cells=even), expected))
    if noise.measured:
        noise = noise.with_taken(taken)
    problem = replace(
        problem, cells=even.scaled_noise(noise.factor, noise.response_scatter), reference=expected
    )
    if _is_rich(stated) and not problem.field_prior:
        follows = _follow_noise(problem, fit)
        if noise.measured:
            noise = noise.with_taken(follows.taken)
            problem = replace(problem, cells=even.scaled_noise(noise.factor, noise.response_scatter))
        problem = replace(problem, forward=problem.forward.with_scatter(follows.scatter_um2))
    problem = replace(problem, free_contrast=False)
    levels = fit.levels[: problem.n_levels]
    settled = fit_model(problem, (), np.zeros(0), fit.field, levels)
    notes = _part_told(stated)
    if abs(noise.neighbour_correlation) > 0.1:
        notes.append(f"noise of neighbouring cells is correlated ({noise.neighbour_correlation:.2f})")
    if noise.measured and noise.factor.max() < 1.0 - STATED_UNCERTAINTY:
        notes.append(
            f"the noise is {noise.factor.max():.2g} of the stated one at most: the data are smoothed, of another "
            "gain, or simulated without noise"
        )
    if not noise.measured:
        notes.append("noise level taken as stated: too few cells to measure it")
    return Prepared(problem, settled, noise, index, _is_rich(stated), stated, tuple(notes), fit.field)


@dataclass(frozen=True, eq=False)
class _Following:
    """What a thickness that follows the noise does: its scatter [µm²], and the part of the noise that it takes up."""

    scatter_um2: FloatArray
    taken: FloatArray


def _follow_noise(problem: Problem, fit: Fit) -> _Following:
    """How far the thicknesses of a fit follow the noise, from draws of it.

    Each lies where the noise has moved it along the fringe. What is left beside it is less than all of the noise, and
    makes the fringes of all cells look stronger, by half the variance of their phases.
    """
    design, _, _, thickness, _ = linearise_at(problem, fit)
    noise = np.random.default_rng(0).standard_normal((NOISE_DRAWS, *problem.cells.shape))
    errors = design.field_errors(noise)
    left = (each - design.slope * error for each, error in zip(noise, errors, strict=True))
    taken = 1.0 - noise_ratio(problem.cells, left, noise)
    order = problem.order_um
    errors = np.clip(errors, -LARGEST_ERROR * order, LARGEST_ERROR * order)
    return _Following(problem.forward.scatter_of(thickness, errors), taken)


def _without_spoiled(
    problem: Problem, fit: Fit, stated: CellData, settings: Mapping[str, float]
) -> tuple[Problem, Fit, CellData]:
    """Fit with some effects, and data, without the cells that something spoiled in one exposure."""
    start = problem.basis.expand(fit.field)
    problem, fit, spoiled = _spoiled_of(problem, fit, settings)
    if not spoiled.any():
        return problem, fit, stated
    cells = stated.restricted(~spoiled)
    # They may have drawn the field into finer coefficients.
    return *_choose_field(problem.with_cells(cells), start, settings), cells


def _spoiled_of(problem: Problem, fit: Fit, settings: Mapping[str, float]) -> tuple[Problem, Fit, BoolArray]:
    """Cells that something spoiled in one exposure, and the fit without them."""
    spoiled = np.zeros(problem.cells.shape, dtype=bool)
    for _ in range(SPOILED_ROUNDS):
        used = problem.cells.weight > 0.0
        fresh = spoiled_cells(_residual(problem, problem.expected_of(fit)), used)
        spoiled |= fresh
        if fresh.sum() <= FEW_SPOILED * used.sum():
            break
        problem = problem.with_cells(problem.cells.restricted(~spoiled))
        fit = fit_model(problem, (), np.zeros(0), fit.field, fit.levels, settings)
    return problem, fit, spoiled


def _finer_is_better(coarse: tuple[Problem, Fit], fine: tuple[Problem, Fit]) -> bool:
    """Whether more coefficients of the field lower χ² beyond what noise (or misfit) lets them."""
    extra = fine[0].basis.size - coarse[0].basis.size
    degrees = max(fine[0].cells.n_values - fine[0].basis.size - fine[0].cells.shape[0], 1)
    unit = fine[1].chi2 / degrees
    return coarse[1].chi2 - fine[1].chi2 > unit * (extra + 5.0 * math.sqrt(2.0 * max(extra, 1)))


def _residual(problem: Problem, expected: FloatArray) -> FloatArray:
    return np.where(problem.cells.weight > 0, problem.cells.value - expected, 0.0)
