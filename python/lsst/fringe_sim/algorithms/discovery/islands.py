"""Where on a sensor, and how large, an effect may be that is in a part of it only."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.optimize import minimize

from ...array_types import BoolArray, FloatArray
from ...effects.disc_search import Disc, Discs
from ..parabola import parabolic_minimum
from .cells import CellData
from .channels import State, beside_thickness
from .comparison import chi2_with_free_fringes, local_minima
from .continuation import continued
from .fit import Coordinate, Fit, Problem
from .thickness_steps import best_thickness_step

SIZES_TRIED = (0.01, 0.02, 0.04)
SIZES_PER_REPETITION = 12
"""Sizes of the effect that are tried: small ones, in units of where it repeats, and so many between repetitions."""

MOST_DISCS, MOST_STARTS = 2, 3
WORTH_TRYING = 0.5
"""Discs that are followed, minima in size for each, and what a disc must promise of what the best one does."""

LEAST_KEPT, DOUBT = 0.3, 9.0
"""Part of what the best size takes off χ² that another one must, and by how much the best may raise it."""

RIM_REACH, RIM_STEP, RIM_TOLERANCE, MOST_TRIALS = 3, 0.7, 0.003, 200
"""How far beyond an island cells are compared, the first step of its rim and the last [cells], and steps at most."""

SHIFTS_PER_ORDER = 20
COMPARED_THICKNESSES = 120
ISLAND_CELLS = 400
"""Shifts of the thickness in a fringe order, and the thicknesses or cells on which they are compared."""

ANOTHER_ORDER = 0.5  # Fringe orders from which on a thickness is another one, to which no fit gets by itself


@dataclass(frozen=True, eq=False)
class IslandStart:
    """Values from which to fit a local effect."""

    position: FloatArray
    promise: float  # expected fall of χ²


def island_starts(
    problem: Problem,
    state: State,
    settings: Mapping[str, float],
    coordinates: Sequence[Coordinate],
    level: FloatArray,
) -> list[IslandStart]:
    """Places and sizes of a local effect that would explain most, best first.

    For every size up to where it repeats, what the effect would do to each cell is compared with what the fit leaves
    there, beside a thickness of the cell; sums of both over discs of all radii at all places tell where it promises
    most. The thickness of the fit has followed the phase that the effect changes, by as much as their fringes are
    apart. In the best discs, all sizes are compared with the data themselves: what anything else has done there may
    promise much along the effect, and the data are farther from all of it than from nothing.

    ``coordinates``: those of the effect: its size, and the places called ``centre_x``, ``centre_y`` and
    ``radius``. ``level``: level of every wavelength in the fit; broadcasts to the cells.
    """
    (size,) = (item for item in coordinates if not item.place)
    sizes = _sizes(size)
    discs, about, none = [], Discs.of(problem.cells.seen), _active(settings, coordinates, size, sizes[0])
    off = problem.forward.within_cells(none, state.thickness_um)
    for value in sizes:
        if value > size.neighbour:  # it looks like a smaller one
            break
        active = _active(settings, coordinates, size, value)
        changed = _change(problem, state, size.effect, active, off)
        signature = beside_thickness(state, state.whiten(level * changed))
        score = (signature * state.residual).sum(axis=0)
        discs.append(about.best(score, (signature**2).sum(axis=0)))
    found: list[IslandStart] = []
    # The best of so many places and sizes promises as much where there is only noise.
    by_chance = 2.0 * math.log(state.value[0].size * len(sizes))
    for disc in _apart([disc for disc in discs if disc[0] > by_chance]):
        promise = disc[0] - by_chance
        places = [_position(problem, coordinates, size, value, disc) for value in sizes]
        gains = [
            _on_island(problem, size.effect, _active(settings, coordinates, size, value, place),
                       state.thickness_um, level).gain
            for value, place in zip(sizes, places, strict=True)
        ]  # fmt: skip
        best = sorted(map(int, local_minima(-np.array(gains))), key=lambda number: -gains[number])
        least = max(0.0, LEAST_KEPT * max(gains)) - DOUBT
        found += [
            IslandStart(places[number], promise) for number in best[:MOST_STARTS] if gains[number] > least
        ]
    return found


def start_at_step(
    problem: Problem, state: State, settings: Mapping[str, float], coordinates: Sequence[Coordinate]
) -> IslandStart | None:
    """Where a local effect would explain most if all that it did looked like a thickness; `None` if nowhere.

    A thin gap moves the fringes, and does little else. A thickness for every cell takes that up, which a smooth one
    cannot. Parameters as of `island_starts`, the field of the ``problem`` smooth.
    """
    (size,) = (item for item in coordinates if not item.place)
    sizes = [value for value in _sizes(size) if value <= size.neighbour]
    disc, step_um = best_thickness_step(state)
    promise = disc[0] - 2.0 * math.log(state.value[0].size * len(sizes))
    if promise <= 0.0:
        return None
    # With the effect the thickness is what it is around.
    apart = [
        abs(_suited_shift(problem, state, size.effect, _active(settings, coordinates, size, value)) + step_um)
        for value in sizes
    ]
    best = sizes[int(np.argmin(apart))]
    return IslandStart(_position(problem, coordinates, size, best, disc), promise)


def followed_on_island(
    problem: Problem, name: str, settings: Mapping[str, float], thickness_um: FloatArray, level: FloatArray
) -> FloatArray:
    """Thickness moved on the island of a local effect to where the fringes there lie on the data [µm].

    ``thickness_um`` (ny, nx). ``level``: level of every wavelength; broadcasts to the cells.
    """
    if not problem.forward.has_island(name, settings):
        return thickness_um
    shift = _on_island(problem, name, settings, thickness_um, level).shift_um
    return np.asarray(thickness_um + shift * problem.forward.coverage(name, settings))


def placed_on_island(
    problem: Problem,
    coordinates: Sequence[Coordinate],
    position: FloatArray,
    thickness_um: FloatArray,
    level: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """A local effect where it lies best on the data if every cell on it and about it has a thickness of its own.

    A rim that moves over a cell changes its phase, and steps of all parameters at once leave its thickness where it
    was. Here every place is judged with the thickness that each cell then wants.

    ``coordinates``: effects of a fit, the local one last. ``thickness_um`` (ny, nx): thickness that lies well
    on the data in the middle of the island. ``level``: level of every wavelength; broadcasts to the cells.
    Returns (ny, nx).
    """
    name = coordinates[-1].effect
    settings = {item.key: item.value(x) for item, x in zip(coordinates, position, strict=True)}
    if not problem.forward.has_island(name, settings):
        return position, thickness_um
    free = [number for number, item in enumerate(coordinates) if item.effect == name and item.place]
    about = _Surroundings.of(problem, name, settings, thickness_um, level)
    if about is None:
        return position, thickness_um
    cell = float(np.mean(problem.cells.geometry.cell_px))

    def misfit(place: FloatArray) -> float:
        return about.chi2(_moved(coordinates, position, free, place))[0]

    first = position[free]
    simplex = np.vstack([first, first + RIM_STEP * cell * np.eye(len(free))])
    found = minimize(
        misfit, first, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": MOST_TRIALS, "xatol": RIM_TOLERANCE * cell, "fatol": 0.1},
    )  # fmt: skip
    placed = position.copy()
    placed[free] = [coordinates[number].clip(x) for number, x in zip(free, found.x, strict=True)]
    return placed, about.chi2(_moved(coordinates, position, free, placed[free]))[1]


def thickness_on_islands(
    problem: Problem, fit: Fit, thickness_um: FloatArray, held_out: BoolArray
) -> FloatArray:
    """Thickness of cells on islands that took no part in a fit, from those within half an order [µm].

    ``thickness_um`` (ny, nx): thickness so far, returned for all other cells. ``held_out`` (ny, nx).
    """
    level, _ = problem.amplitudes(fit.levels)
    found = thickness_um
    for name in dict.fromkeys(
        item.effect for item in fit.coordinates if problem.forward.is_island(item.effect)
    ):
        if not problem.forward.has_island(name, fit.settings):
            continue
        unknown = (problem.forward.coverage(name, fit.settings) > 0.0) & held_out
        about = _Surroundings.of(problem, name, fit.settings, found, level) if unknown.any() else None
        if about is not None:
            found = np.where(unknown, about.chi2(fit.settings)[1], found)
    return found


def mended_on_islands(
    problem: Problem, fit: Fit, thickness_um: FloatArray, around_um: FloatArray
) -> FloatArray:
    """Thickness with islands in the fringe order of what is about them, if that lies better on the data [µm].

    Without the local effect the fringes there belong to another thickness, and where they are narrow a fit leaves
    part of an island in another order than the rest.

    ``thickness_um``, ``around_um`` (ny, nx): thickness of the fit, for cells on islands, and one for all
    others.
    """
    on = problem.forward.on_islands(fit.settings)
    torn = np.where(on, thickness_um, around_um)
    known = ~on & problem.cells.seen
    if not on.any() or not known.any():
        return torn
    whole = thickness_on_islands(problem, fit, np.where(on, continued(around_um, known), around_um), on)
    mended = np.where(np.abs(whole - torn) > ANOTHER_ORDER * problem.order_um, whole, torn)
    return min(torn, mended, key=lambda thickness: problem.chi2_at(fit.settings, thickness))


def _moved(
    coordinates: Sequence[Coordinate], position: FloatArray, free: Sequence[int], place: FloatArray
) -> dict[str, float]:
    """All effects with some coordinates elsewhere, within their bounds."""
    moved = position.copy()
    moved[free] = place
    return {item.key: item.value(item.clip(x))
            for item, x in zip(coordinates, moved, strict=True)}  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """Cells on an island and about it, with what they would be on and off it at many thicknesses."""

    problem: Problem
    name: str
    thickness_um: FloatArray
    own: NDArray[np.intp]
    places: FloatArray  # (S, n): thicknesses [µm]
    # outside, inside (W, S, n): signal at its level
    outside: FloatArray
    inside: FloatArray
    value: FloatArray
    weight: FloatArray

    @classmethod
    def of(
        cls,
        problem: Problem,
        name: str,
        settings: Mapping[str, float],
        thickness_um: FloatArray,
        level: FloatArray,
    ) -> _Surroundings | None:
        forward, cells = problem.forward, problem.cells
        part = forward.coverage(name, settings)
        near = binary_dilation(part > 0.0, iterations=RIM_REACH)
        own = np.flatnonzero((near & cells.seen).ravel())
        if not own.size:
            return None
        shifts = _covered_shifts(problem, thickness_um)
        places = thickness_um.ravel()[own] + shifts[:, np.newaxis]
        value, weight, level = _of_cells(cells, level, own)
        inside, outside = (
            level * light for light in forward.on_and_off_island(name, settings, thickness_um, own, places)
        )
        return cls(problem, name, thickness_um, own, places, outside, inside, value, weight)

    def chi2(self, settings: Mapping[str, float]) -> tuple[float, FloatArray]:
        """χ² of the cells with the island elsewhere, and the thickness of all cells with which it is reached."""
        part = self.problem.forward.coverage(self.name, settings).ravel()[self.own]
        model = self.outside + part * (self.inside - self.outside)
        chi2 = (self.weight * (self.value - model) ** 2).sum(axis=0)
        found = parabolic_minimum(chi2)
        thickness = self.thickness_um.copy()
        step = self.places[1] - self.places[0]
        thickness.ravel()[self.own] = self.places[0] + found.place * step
        return float(found.value.sum()), thickness


def _of_cells(cells: CellData, level: FloatArray, own: NDArray[np.intp]) -> tuple[FloatArray, ...]:
    """Value, weight and level of some cells, each ``(W, 1, n)``."""
    return tuple(
        np.broadcast_to(each, cells.shape).reshape(cells.shape[0], 1, -1)[..., own]
        for each in (cells.value, cells.weight, level)
    )


@dataclass(frozen=True)
class _Compared:
    """A local effect on its island, compared with the data there."""

    shift_um: float  # shift of the thickness with which it lies best
    gain: float  # fall of χ² from none, with the thickness that suits each cell


def _on_island(
    problem: Problem, name: str, settings: Mapping[str, float], thickness_um: FloatArray, level: FloatArray
) -> _Compared:
    """How a local effect lies on the data where it is, from some of the cells there."""
    cells, part = problem.cells, problem.forward.coverage(name, settings)
    covered = np.flatnonzero(((part > 0.5) & cells.seen).ravel())
    if not covered.size:
        return _Compared(0.0, -math.inf)
    own = covered[:: max(1, covered.size // ISLAND_CELLS)]
    shifts = _covered_shifts(problem, thickness_um)
    places = thickness_um.ravel()[own] + shifts[:, np.newaxis]
    value, weight, level = _of_cells(cells, level, own)
    chi2 = [
        (weight * (value - level * light) ** 2).sum(axis=0)
        for light in problem.forward.on_and_off_island(name, settings, thickness_um, own, places)
    ]
    place = parabolic_minimum(chi2[0].sum(axis=1, keepdims=True)).place[0]
    each, without = (float(parabolic_minimum(curves).value.sum()) for curves in chi2)
    shift = float(np.interp(place, np.arange(len(shifts)), shifts))
    return _Compared(shift, (without - each) * covered.size / own.size)


def _active(
    settings: Mapping[str, float],
    coordinates: Sequence[Coordinate],
    size: Coordinate,
    value: float,
    position: FloatArray | None = None,
) -> dict[str, float]:
    """Effects with the local one of some size, by default wherever its null is."""
    places = np.zeros(len(coordinates)) if position is None else position
    own = {item.key: item.value(x) for item, x in zip(coordinates, places, strict=True)}
    return {**settings, **own, size.key: value}


def _apart(discs: list[Disc]) -> list[Disc]:
    """The best discs that promise anything, none in the middle of a better one."""
    kept: list[Disc] = []
    for disc in sorted(discs, key=lambda each: -each[0]):
        away = all(math.hypot(disc[1] - other[1], disc[2] - other[2]) > 0.5 * other[3] for other in kept)
        if away and disc[0] > (WORTH_TRYING * kept[0][0] if kept else 0.0) and len(kept) < MOST_DISCS:
            kept.append(disc)
    return kept


def _covered_shifts(problem: Problem, thickness_um: FloatArray) -> FloatArray:
    """Shifts of a thickness up to half an order on both sides [µm], within the tables."""
    order = problem.order_um
    shifts = np.linspace(-0.5, 0.5, SHIFTS_PER_ORDER + 1) * order
    for shift in (shifts[0], shifts[-1]):
        problem.forward.cover(thickness_um + shift)
    return shifts


def _sizes(size: Coordinate) -> list[float]:
    """Sizes that are tried, increasing."""
    many = np.arange(1, math.floor(SIZES_PER_REPETITION * size.high / size.neighbour) + 1)
    return [size.neighbour * float(part) for part in (*SIZES_TRIED, *(many / SIZES_PER_REPETITION))]


def _change(
    problem: Problem, state: State, name: str, active: Mapping[str, float], off: FloatArray
) -> FloatArray:
    """What a local effect would do to every cell, were it there; the thickness follows.

    ``off`` (W, 1, n): light of the cells without it.
    """
    forward, thickness = problem.forward, state.thickness_um
    shift = _suited_shift(problem, state, name, active)
    on = forward.within_cells(active, thickness, None, (thickness + shift).reshape(1, -1), island=name)
    return (on - off).reshape(-1, *thickness.shape)


def _suited_shift(problem: Problem, state: State, name: str, active: Mapping[str, float]) -> float:
    """Shift of the thickness with which the fringes of a local effect lie on those without it [µm]."""
    forward, thickness = problem.forward, state.thickness_um
    shifts = _covered_shifts(problem, thickness)
    seen = thickness[problem.cells.seen]
    few = np.linspace(float(seen.min()), float(seen.max()), COMPARED_THICKNESSES)[np.newaxis]
    inside = forward.sampled_on_island(name, active, few + shifts[:, np.newaxis, np.newaxis]).value
    outside = forward.sampled(active, few).value
    misfit = chi2_with_free_fringes(inside, outside, np.ones_like(outside))
    (place,) = parabolic_minimum(misfit[:, np.newaxis]).place
    return float(np.interp(place, np.arange(len(shifts)), shifts))


def _position(
    problem: Problem, coordinates: Sequence[Coordinate], size: Coordinate, value: float, disc: Disc
) -> FloatArray:
    geometry = problem.cells.geometry
    rows, columns = geometry.cell_px
    _, row, column, radius = disc
    place = {
        "centre_y": float(geometry.y_px[0]) + rows * row,
        "centre_x": float(geometry.x_px[0]) + columns * column,
        "radius": 0.5 * (rows + columns) * radius,
    }
    return np.array(
        [item.coordinate(value if item is size else place[item.parameter]) for item in coordinates]
    )
