"""Where an effect that shifts the phase of the fringes may be, when the thickness had it in another fringe order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...array_types import BoolArray, FloatArray
from .comparison import FEW_CELLS, chi2_with_free_fringes, fringe_order_um, local_minima, sampled_part
from .fit import Coordinate, Fit, Problem, fit_model

SIZES_TRIED = (0.1, 0.15, 0.23, 0.35, *(0.5 * n for n in range(1, 21)))
"""Departures, in prior scales, at which one that shifts the phase is: its misfit has a minimum for every fringe."""

PARTS_BETWEEN = (0.5, 0.25)
"""Parts of the distance to the next size by which the best ones of all orders are changed, in turn."""

ORDERS_MOVED, STEPS_PER_ORDER = 6, 12  # How far the field is moved [fringe orders], and the steps to an order

PLACES_REFITTED, STEPS_ALONE, PLACES_KEPT = 8, 8, 2
"""Places from which the size of an effect is fitted alone, the steps of such a fit (a fifth of an order at most, from
less than half an order away), and the best ones, from which all effects are fitted."""

STRONGEST = 2.0
"""Most by which effects that are not in the set yet may strengthen the fringes: nearly all of them weaken them. A
cone so wide that it takes all fringes away is no start for a fit, however well fringes many times as strong would
do."""

LEAST_THICKNESS_UM, MOST_SIGMAS = 0.5, 4.0
"""Thinnest layer, and how far a map that is known may be moved, over its uncertainty."""

NEIGHBOURING_ORDERS = (-2, -1, 1, 2)
"""Orders in which an effect that shifts each wavelength by itself is looked for."""


@dataclass(frozen=True, eq=False)
class _Place:
    """A size of one coordinate, with the field moved to where it fits best within an order."""

    moved: int
    position: FloatArray
    shift_um: float
    even: bool
    chi2: float


def starts_in_other_orders(
    problem: Problem, fit: Fit, moved: Sequence[int], first_field: FloatArray, index: float
) -> list[tuple[FloatArray, FloatArray]]:
    """Positions and fields from which a fit may find a deeper valley than the one it is in.

    A strong effect on the phase is taken for thickness at first, in the order that suits it best; from there no fit
    finds back. One coordinate at a time is set to other sizes with the field moved by up to some orders, and finds
    its size with the others held: a second coordinate that is nearly thickness itself would lead a fit from a rough
    size astray.

    ``fit``: what is known of the effects so far. ``moved``: coordinates of one effect that shift the phase.
    ``first_field`` (M,).
    """
    found, least = [], np.inf
    for place, field in _fields(problem, _places(problem, fit, moved, first_field, index), first_field):
        others = [n for n in range(len(place.position)) if n != place.moved]
        held = {fit.coordinates[n].key: fit.coordinates[n].value(place.position[n]) for n in others}
        own = (fit.coordinates[place.moved],)
        alone = fit_model(
            problem, own, place.position[[place.moved]], field, fit.levels, held,
            iterations=STEPS_ALONE, rival=least,
        )  # fmt: skip
        settled = place.position.copy()
        settled[place.moved] = alone.position[0]
        found.append((settled, alone.field, alone.chi2))
        least = min(least, alone.chi2)
    found.sort(key=lambda item: item[2])
    return [(position, field) for position, field, _ in found[:PLACES_KEPT]]


def fields_in_other_orders(problem: Problem, field: FloatArray, index: float) -> list[FloatArray]:
    """The field moved evenly by one and two fringe orders to either side, where that leaves a layer.

    For an effect with a shift of its own at each wavelength: it follows such a move by itself, as what an order more
    lacks at the ends of the spectrum is a small part of a fringe.

    ``field`` (M,).
    """
    whole, used = problem.basis.expand(field), problem.cells.seen.astype(float)
    shifts = np.array(NEIGHBOURING_ORDERS, dtype=float) * fringe_order_um(problem.cells.wavelength_nm, index)
    return [problem.basis.fit(whole + shift, used) for shift in shifts[_is_possible(problem, whole, shifts)]]


def _fields(
    problem: Problem, places: Sequence[_Place], first_field: FloatArray
) -> list[tuple[_Place, FloatArray]]:
    """The best places of each coordinate, with their fields."""
    whole, used = problem.basis.expand(first_field), problem.cells.seen.astype(float)
    middle = float(whole.mean())
    best: list[_Place] = []
    for number in {place.moved for place in places}:
        own = [place for place in places if place.moved == number]
        best += sorted(own, key=lambda place: place.chi2)[:PLACES_REFITTED]
    return [
        (place, problem.basis.fit(_moved(whole, place.shift_um, place.even, middle), used)) for place in best
    ]


def _moved(field: FloatArray, shift_um: float, even: bool, middle_um: float) -> FloatArray:
    """A field moved in proportion, as an index wants it, or evenly, as fringes from another layer do."""
    return field + shift_um if even else field * (1.0 + shift_um / middle_um)


def _places(
    problem: Problem, fit: Fit, moved: Sequence[int], first_field: FloatArray, index: float
) -> list[_Place]:
    """The best sizes of each coordinate; sizes lie too far apart for the right one to win at once.

    A sample of cells is compared with the model, levels and contrasts free.
    """
    whole = problem.basis.expand(first_field)
    order = fringe_order_um(problem.cells.wavelength_nm, index)
    shifts = _shifts(problem, whole, order)
    if not shifts.size:
        return []
    for edge in (shifts[0], shifts[-1]):
        for even in (False, True):
            problem.forward.cover(_moved(whole, edge, even, float(whole.mean())))
    found = []
    for number in moved:
        rough: list[_Rough] = []
        for turn in range(-ORDERS_MOVED, ORDERS_MOVED + 1):
            inside = shifts[np.abs(shifts - turn * order) <= 0.51 * order]
            if inside.size:
                rough += _Trial(problem, fit, whole, inside).minima(number)
        rough.sort(key=lambda item: item.place.chi2)
        found += [item.trial.refined(item) for item in rough[: 2 * PLACES_REFITTED]]
    return found


@dataclass(frozen=True, eq=False)
class _Trial:
    """Comparison of a sample of cells with a field that is moved by less than an order."""

    problem: Problem
    fit: Fit
    whole: FloatArray
    shifts_um: FloatArray

    @cached_property
    def sample(self) -> tuple[slice, slice, slice]:
        """Which cells are compared."""
        return sampled_part(self.whole.size, FEW_CELLS)

    @cached_property
    def fields_um(self) -> FloatArray:
        """The sample moved in proportion, and then evenly, ``(2 S, ny, nx)``; the same for every size."""
        few, middle = self.whole[self.sample[1:]], float(self.whole.mean())
        moves = [(shift, even) for even in (False, True) for shift in self.shifts_um]
        return np.stack([_moved(few, shift, even, middle) for shift, even in moves])

    def minima(self, number: int) -> list[_Rough]:
        """The sizes of one coordinate than which no size near it is better."""
        sizes = _sizes(self.fit.coordinates[number])
        own = [self.place(number, size) for size in sizes]
        return [
            _Rough(self, own[low], sizes[low], float(np.diff(sizes)[max(low - 1, 0) : low + 1].min()))
            for low in local_minima(np.array([place.chi2 for place in own]))
        ]

    def refined(self, rough: _Rough) -> _Place:
        """The best of some sizes between a minimum and its neighbours."""
        best, size = rough.place, rough.size
        for part in PARTS_BETWEEN:
            beside = [size - part * rough.gap, size + part * rough.gap]
            tried = [(self.place(best.moved, one), one) for one in beside]
            best, size = min([(best, size), *tried], key=lambda item: item[0].chi2)
        return best

    def place(self, number: int, size: float) -> _Place:
        """One coordinate at a size, with the field where it fits best."""
        position = _single_step(self.fit, number, size)
        settings = {c.key: c.value(x) for c, x in zip(self.fit.coordinates, position, strict=True)}
        model = self.problem.forward.sampled(settings, self.fields_um).value
        value, weight = self.problem.cells.value[self.sample], self.problem.cells.weight[self.sample]
        chi2 = chi2_with_free_fringes(model, value, weight, STRONGEST).reshape(2, -1)
        lowest = [_vertex(self.shifts_um, each) for each in chi2]
        even = lowest[1][1] < lowest[0][1]
        return _Place(number, position, lowest[even][0], even, lowest[even][1])


@dataclass(frozen=True, eq=False)
class _Rough:
    """A size of one coordinate than which no other is better, and how far the nearest one tried is."""

    trial: _Trial
    place: _Place
    size: float
    gap: float


def _vertex(places: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Place and value of the minimum of a function on even steps, by a parabola through the lowest three."""
    low = int(values.argmin())
    if not 0 < low < len(values) - 1:
        return float(places[low]), float(values[low])
    before, middle, after = values[low - 1 : low + 2]
    part = 0.5 * (before - after) / max(before - 2.0 * middle + after, 1e-300)
    return float(places[low] + part * (places[low] - places[low - 1])), float(
        middle - 0.25 * (before - after) * part
    )


def _sizes(item: Coordinate) -> FloatArray:
    """Values of a parameter at which it is tried, from the lowest to the highest."""
    away = item.scale * np.array(SIZES_TRIED)
    sizes = np.sort(np.concatenate([item.null - away, item.null + away]))
    return np.asarray(sizes[(sizes >= item.low) & (sizes <= item.high)])


def _single_step(fit: Fit, number: int, size: float) -> FloatArray:
    """Position in which one coordinate has another size, and others of its effect none."""
    own = np.array([item.effect == fit.coordinates[number].effect for item in fit.coordinates])
    position = np.where(own, 0.0, fit.position)
    position[number] = fit.coordinates[number].clip(fit.coordinates[number].coordinate(float(size)))
    return position


def _shifts(problem: Problem, whole: FloatArray, order: float) -> FloatArray:
    """Moves of the mean of a field [µm] that leave a layer everywhere, and the map where it is if it is known."""
    steps = np.arange(-ORDERS_MOVED * STEPS_PER_ORDER, ORDERS_MOVED * STEPS_PER_ORDER + 1, dtype=float)
    shifts = steps * (order / STEPS_PER_ORDER)
    return np.asarray(shifts[_is_possible(problem, whole, shifts)])


def _is_possible(problem: Problem, whole: FloatArray, shifts: FloatArray) -> BoolArray:
    least = whole.min() + np.minimum(shifts, shifts * whole.min() / whole.mean())
    possible = least > LEAST_THICKNESS_UM
    return np.asarray(possible & (np.abs(shifts) * np.sqrt(problem.field_prior) <= MOST_SIGMAS))
