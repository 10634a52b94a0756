"""From a cube to a problem: the part held out, cells, first thickness, noise, fit of the unchanged model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...array_types import BoolArray, FloatArray
from ...effects import Effect
from ...model import FringeModel
from ...products.fringe_cube import FringeCube
from ...products.mask import mask_bits
from ..exposures import Exposures
from ..inference import (
    CellShape,
    Data,
    Forward,
    Hypothesis,
    Point,
    Problem,
    fit,
    in_best_orders,
    in_whole_orders,
    with_common_offset,
    with_free_contrast,
)
from .cells import FEWEST_TO_HOLD_OUT, CellData, finest_useful_cell
from .checks import are_few
from .continuation import continued
from .known_thickness import as_known, stated_sigma_um, with_error_of_map
from .neighbour_order import in_order_of_neighbours
from .noise import STATED_UNCERTAINTY, is_measured, measured_noise, neighbour_scatter
from .options import SearchOptions
from .outliers import spoiled_cells
from .sensor_part import SensorPart, told_of_part, with_edges_of_sensor
from .start import starting_thickness
from .surface import robust_surface

BLOCKS_ACROSS = 8  # Blocks along a side of the sensor that are held out or not

MARGIN_UM = 0.8
"""Thickness beyond the first one that tables cover [µm]: effects may move it by some fringe orders."""

OPEN_ORDERS = 6
"""Fringe orders on both sides in which every fit of a few pixels is tried."""

FIRST_ERROR_UM = 0.004  # Error of the first thickness [µm]: it is one of steps of 0.01
SURFACE_CELLS = 8.0  # Distance of the knots of the surface whose slope limits the size of cells [cells]
KNOWN_UM = 1e-6  # Error of a thickness that is known [µm]

NO_SCATTER, FIRST_SCATTER = 1e-6, 0.003
"""Response scatter that is none, and what it is before it is measured."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A part of the data to search, and a part that nothing has seen."""

    cells: CellData  # the part searched, with measured noise
    unseen: CellData  # the part held out
    problem: Problem
    null: Hypothesis
    noise_factor: FloatArray  # (W,): measured over stated standard deviation
    free: Point  # the unchanged model with the contrast of the data

    @property
    def point(self) -> Point:
        """The unchanged model at its best."""
        return self.null.point

    @property
    def few(self) -> bool:
        """Whether there are too few pixels to tell the levels of the flats from the fringes."""
        return self.problem.levels_known

    @property
    def measured(self) -> bool:
        """Whether the noise is that of the data, not as stated."""
        return is_measured(self.cells.seen)

    @property
    def told(self) -> tuple[str, ...]:
        """What is believed and not measured, for the verdict."""
        noise = f"noise taken as stated plus {STATED_UNCERTAINTY:.0%}: too few cells to measure it"
        levels = "flat levels taken as known up to a common factor"
        doubts = (() if self.measured else (noise,)) + ((levels,) if self.few else ())
        return told_of_part(self.cells) + doubts


def prepare(
    cube: FringeCube,
    model: FringeModel,
    effects: Sequence[Effect],
    options: SearchOptions,
    rng: np.random.Generator,
    exposures: Exposures | None = None,
) -> Prepared:
    """Split a cube, average what is searched to cells, find thickness and noise, fit the unchanged model.

    Cells are made larger while the thickness of one is not known well enough and fringes stay wider than a cell.
    ``exposures``: their light, flats by default; other light is of sensors whose thickness is known.
    """
    good = np.asarray((np.asarray(cube.mask) == 0).all(axis=0))
    held = _held_out(good, options.heldout_fraction, rng)
    size = finest_useful_cell(_masked(cube, held), most_cells=options.most_cells)
    part = SensorPart.of(good.shape, size, options.most_cells)
    if not part.inside(good.shape).all():
        held[:] = False
        held[part.rows, part.columns] = _held_out(
            good[part.rows, part.columns], options.heldout_fraction, rng
        )
    split = Split(cube, held, part)
    prepared = _in_cells(split, size, model, effects, options, exposures)
    if prepared.problem.known:
        return prepared
    turn = 2.0 * np.pi / prepared.problem.forward.order_um
    # Smaller ones than are needed may be in wrong orders, and tell nothing of larger ones.
    while turn * _thickness_error_um(prepared.free) > options.phase_error:
        size *= 2
        if min(cube.shape[1:]) // size < FEWEST_TO_HOLD_OUT:
            break
        larger = _in_cells(split, size, model, effects, options)
        across = turn * _steepest_um(larger) * size
        if across < options.cell_phase and _is_likelier(larger, prepared):
            prepared = larger
    return prepared


def _is_likelier(larger: Prepared, smaller: Prepared) -> bool:
    """Whether values in small cells are likelier with the thickness of larger ones, which are made of them."""
    coarse, fine = larger.free, smaller.free
    thickness, shape, inside = _in_parts(larger, smaller)
    forward = replace(fine.problem.forward, shape=shape)
    known = replace(fine.problem, forward=forward, thickness_um=thickness, thickness_sigma_um=KNOWN_UM)
    point = with_free_contrast(known.at({}, fine.levels, thickness))
    used, seen = inside & fine.problem.data.seen, coarse.problem.data.seen
    priors = np.log(coarse.thickness_sigma_um / coarse.problem.thickness_sigma_um)[seen]
    gained = point.cell_evidence[used].sum() + priors.sum() - fine.cell_evidence[used].sum()
    return bool(gained > 0.0)


def _in_parts(larger: Prepared, smaller: Prepared) -> tuple[FloatArray, CellShape, BoolArray]:
    """Thickness of larger cells in the smaller ones, its shape there, and which of those lie in one with data."""
    own, size = larger.free.problem.forward.shape, smaller.cells.cell_px
    parts = larger.cells.cell_px // size
    rows, columns = larger.cells.shape[1:]
    target = smaller.cells.shape[1:]
    more = [(0, full - parts * part) for full, part in zip(target, (rows, columns), strict=True)]

    def spread(values: FloatArray) -> FloatArray:
        whole = np.kron(values.reshape(rows, columns), np.ones((parts, parts)))
        return np.pad(whole, more, mode="edge").ravel()

    y, x = (size * (place % parts - 0.5 * (parts - 1)).ravel() for place in np.indices(target))
    down, along = (spread(part) for part in own.gradient)
    yy, yx, xx = hessian = np.stack([spread(part) for part in own.hessian])
    thickness = spread(larger.free.thickness_um) + down * y + along * x
    thickness += 0.5 * (yy * y**2 + 2.0 * yx * y * x + xx * x**2)
    gradient = np.stack([down + yy * y + yx * x, along + yx * y + xx * x])
    inside = spread(larger.cells.seen.astype(float)) > 0.0
    inside &= np.pad(np.ones((parts * rows, parts * columns), dtype=bool), more).ravel()
    return thickness, CellShape(gradient, hessian, size, own.area), inside


def _held_out(good: BoolArray, fraction: float, rng: np.random.Generator) -> BoolArray:
    """Pixels that no selection sees, in blocks; none where the other ``good`` ones would not tell the noise."""
    rows, columns = good.shape
    side = min(BLOCKS_ACROSS, max(min(good.shape) // FEWEST_TO_HOLD_OUT, 3))
    blocks = rng.permutation(side * side).reshape(side, side) < round(fraction * side * side)
    held = blocks[np.ix_(np.arange(rows) * side // rows, np.arange(columns) * side // columns)]
    some = is_measured(good & ~held) and not are_few(good.shape, int(good.sum()))
    return np.asarray(held if some else np.zeros_like(held))


def _masked(cube: FringeCube, out: BoolArray) -> FringeCube:
    """The cube without data where ``out`` is true."""
    mask = np.array(cube.mask)
    mask[:, out] |= mask_bits("NO_DATA")
    return replace(cube, mask=mask)


@dataclass(frozen=True, eq=False)
class Split:
    """A cube, which of its pixels are held out, and the part of the sensor that is searched."""

    cube: FringeCube
    held: BoolArray
    part: SensorPart

    def in_cells(self, size: int) -> tuple[CellData, CellData]:
        """What is searched and what is held out in cells of so many pixels."""
        cells = self.part.in_cells(_masked(self.cube, self.held), size)
        if not self.held.any():
            return cells, cells.restricted(np.zeros(cells.shape, bool))
        return cells, self.part.in_cells(_masked(self.cube, ~self.held), size)


def _in_cells(
    split: Split,
    size: int,
    model: FringeModel,
    effects: Sequence[Effect],
    options: SearchOptions,
    exposures: Exposures | None = None,
) -> Prepared:
    """The same in cells of so many pixels."""
    cells, unseen = split.in_cells(size)
    stated = cells.thickness_um
    if stated is None:
        first = continued(starting_thickness(model, cells), cells.seen)
    else:  # cells that are held out lie where the map has them
        mapped = np.isfinite(stated)
        first = stated if mapped.all() else np.where(mapped, stated, continued(stated, mapped))
    few = are_few(cells.shape[1:], int((cells.seen | unseen.seen).sum()))
    problem = as_known(_problem(cells, model, effects, first, exposures, few), cells)
    # The first thickness does not believe in the contrast of the model; it stays until that of the data is known.
    known = replace(problem, thickness_sigma_um=KNOWN_UM)
    start = known.at({}, np.ones(cells.shape[0]), problem.thickness_um)
    point = with_free_contrast(with_common_offset(start))
    about = point.problem.thickness_um
    problem = replace(problem, forward=point.problem.forward, thickness_um=about)
    point = with_free_contrast(problem.at({}, point.levels, about))
    point = in_best_orders(point) if problem.known else in_whole_orders(point, options.class_width)
    factor = np.ones(cells.shape[0])
    if not is_measured(cells.seen):
        factor += STATED_UNCERTAINTY
        cells = cells.scaled_noise(factor, cells.response_scatter)
    for _ in range(2):
        spoiled = spoiled_cells(_left(point, cells), cells.weight > 0.0)
        cells, noise, problem = _judged(cells.restricted(~spoiled), point, options)
        factor = factor * noise
        start_um = point.thickness_um if problem.known else problem.thickness_um
        point = with_free_contrast(problem.at({}, point.levels, start_um), rounds=4)
        point = _with_likelier_pixels(point, options)
    unseen = unseen.scaled_noise(factor, cells.response_scatter)
    problem, thickness = _as_modelled(point.problem), point.thickness_um
    if problem.known:  # where the map has it, not where the judgement of the noise has moved it
        thickness = thickness - problem.thickness_um + first.ravel()
        problem = replace(problem, thickness_um=first.ravel())
    null = fit((), (), problem.at({}, point.levels, thickness), aim=point.cost)
    return Prepared(cells, unseen, problem, null, factor, point)


def _with_likelier_pixels(point: Point, options: SearchOptions) -> Point:
    """The same with pixels that see the point in their middle, not all of their area, or the reverse, if likelier."""
    forward = point.problem.forward
    shape = replace(forward.shape, area=not forward.shape.area)
    problem = replace(point.problem, forward=replace(forward, shape=shape))
    other = with_free_contrast(problem.at(point.settings, point.levels, point.thickness_um), rounds=4)
    return other if point.cost - other.cost > options.class_width else point


def _as_modelled(problem: Problem) -> Problem:
    """A problem with the contrast of the model."""
    return replace(problem, forward=replace(problem.forward, contrast=1.0))


def _steepest_um(prepared: Prepared) -> float:
    """Change of the thickness where it is steep but for a twentieth of the cells [µm/px].

    Of the surface through most cells, as some may lie in other orders.
    """
    cells, problem = prepared.cells, prepared.problem
    field = problem.thickness_um.reshape(cells.shape[1:])
    surface = robust_surface(field, cells.seen, SURFACE_CELLS, problem.forward.order_um)
    return float(np.quantile(np.hypot(*np.gradient(surface, cells.cell_px)), 0.95))


def prepare_again(prepared: Prepared, found: Hypothesis, options: SearchOptions) -> Prepared:
    """Noise, and what pixels see and the thickness does within cells, as judged with effects in the model."""
    point = with_free_contrast(with_common_offset(found.point))
    cells, noise, problem = _judged(prepared.cells, point, options)
    # What pixels see is told by slopes that are right: before, they are those of a wrong model.
    start = problem.at(point.settings, point.levels, point.thickness_um)
    point = _with_likelier_pixels(with_free_contrast(start, rounds=4), options)
    # Every fit may return to the first thickness, whatever has been fitted since.
    problem = replace(_as_modelled(point.problem), thickness_um=prepared.problem.thickness_um)
    null = problem.at({}, prepared.point.levels, prepared.point.thickness_um)
    return replace(
        prepared,
        cells=cells,
        unseen=prepared.unseen.scaled_noise(noise, cells.response_scatter),
        problem=problem,
        null=fit((), (), null, aim=point.cost),
        noise_factor=prepared.noise_factor * noise,
        free=point,
    )


def _judged(cells: CellData, point: Point, options: SearchOptions) -> tuple[CellData, FloatArray, Problem]:
    """Cells with the noise that a fit leaves, its measured over stated deviation, and the problem about the fit."""
    expected = (point.levels[:, np.newaxis] * point.value).reshape(cells.shape)
    cells = cells.with_noise_of(expected)
    point = with_error_of_map(point.problem_with(data_of(cells)), cells)
    noise, scatter = measured_noise(point, cells.shape)
    cells = cells.scaled_noise(noise, scatter)
    old, (thickness, shape) = point.problem.forward, in_shape(point, cells)
    # Levels tell how many electrons a mean of one is; they are known from the first fit on.
    geometry = old.geometry
    if geometry is cells.geometry:
        geometry = replace(geometry, level_e=geometry.level_e * point.levels)
    # Tables stay; they reach farther than the thickness moves.
    forward = replace(old, shape=shape, geometry=geometry)
    problem = replace(
        point.problem.about(thickness.ravel()),
        data=data_of(cells),
        forward=forward,
        response_sigma=max(scatter, NO_SCATTER),
    )
    return cells, noise, problem


def in_shape(point: Point, cells: CellData) -> tuple[FloatArray, CellShape]:
    """Thickness of all cells ``(ny, nx)``, in the orders of their neighbours, and what it does within them."""
    thickness = _whole(point, cells)
    # A wrong model errs in the thickness by more than noise does, and slopes that follow the errors blur fringes.
    error = max(_thickness_error_um(point), neighbour_scatter(thickness, cells.seen, 0.0))
    area = point.problem.forward.shape.area
    shape = CellShape.of_field(thickness, cells.cell_px, error, area=area)
    return thickness, with_edges_of_sensor(shape, cells)


def _left(point: Point, cells: CellData) -> FloatArray:
    """Data minus model."""
    return np.asarray(
        (point.problem.data.value - point.levels[:, np.newaxis] * point.value).reshape(cells.shape)
    )


def _whole(point: Point, cells: CellData) -> FloatArray:
    """Thickness of all cells, ``(ny, nx)``, in the orders of their neighbours.

    Where there are no data, it is continued from where there are.
    """
    field = point.thickness_um.reshape(cells.shape[1:])
    order_um = point.problem.forward.order_um
    return continued(in_order_of_neighbours(field, cells.seen, order_um), cells.seen)


def data_of(cells: CellData) -> Data:
    """Values and weights of cells."""
    return Data(cells.value.reshape(cells.shape[0], -1), cells.weight.reshape(cells.shape[0], -1))


def _problem(
    cells: CellData,
    model: FringeModel,
    effects: Sequence[Effect],
    thickness_um: FloatArray,
    exposures: Exposures | None,
    few: bool,
) -> Problem:
    """Problem about a first thickness ``(ny, nx)``; a few pixels hardly tell levels and fringe order."""
    error = FIRST_ERROR_UM if cells.thickness_um is None else float(np.median(stated_sigma_um(cells)))
    shape = with_edges_of_sensor(CellShape.of_field(thickness_um, cells.cell_px, error), cells)
    orders = OPEN_ORDERS if few and cells.thickness_um is None else 0
    margin = MARGIN_UM + orders * float(model.fringe_order_um(np.median(cells.wavelength_nm)))
    limits = (max(float(thickness_um.min()) - margin, 0.05), float(thickness_um.max()) + margin)
    centroid = None
    if cells.centroid is not None:
        centroid = cells.cell_px * cells.centroid.reshape(2, cells.shape[0], -1)
    weight = None if exposures is None else exposures.place_weight(cells.geometry)
    weight = None if weight is None or len(weight) == 1 else weight.reshape(len(weight), -1)
    forward = Forward(
        model, effects, cells.geometry, shape, limits, centroid, exposures=exposures, place_weight=weight
    )
    shapes = np.ones((cells.shape[0], 1)) if few else None
    return Problem(
        data_of(cells), forward, thickness_um.ravel(), FIRST_SCATTER, level_shapes=shapes, orders=orders
    )


def _thickness_error_um(point: Point) -> float:
    """Typical error of the thickness of a cell [µm]."""
    return float(np.median(point.thickness_sigma_um[point.problem.data.seen]))
