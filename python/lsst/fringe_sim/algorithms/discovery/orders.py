"""Where an effect that shifts the phase of the fringes may be, when the thickness had it in another fringe order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .comparison import chi2_with_free_fringes, fringe_order_um, sampled_part
from .fit import Fit, Problem, fit_model

__all__ = ["FINE_SCAN", "fields_in_other_orders", "starts_in_other_orders"]

FloatArray = NDArray[np.float64]

FINE_SCAN = tuple(float(size) for size in np.geomspace(0.1, 10.0, 12))
"""Departures, in prior scales, at which an effect is tried where fringe orders change with it."""

ORDERS_MOVED, STEPS_PER_ORDER = 4, 12
ORDERS_REFITTED = 4
"""Fringe orders and fits with which a strong effect on the phase is looked for, and the steps to an order."""

LEAST_THICKNESS_UM, MOST_SIGMAS = 0.5, 4.0
"""Thinnest layer, and how far a map that is known may be moved, over its uncertainty."""


NEIGHBOURING_ORDERS = (-2, -1, 1, 2)
"""Orders in which an effect that shifts each wavelength by itself is looked for."""


@dataclass(frozen=True, eq=False)
class _Place:
    """A size of one coordinate, with the field moved to where it fits best within an order."""

    moved: int
    order: int
    position: FloatArray
    shift_um: float
    chi2: float


def starts_in_other_orders(
    problem: Problem, fit: Fit, moved: Sequence[int], first_field: FloatArray, index: float
) -> list[tuple[FloatArray, FloatArray]]:
    """Positions and fields from which a fit may find a deeper valley than the one it is in.

    A strong effect on the phase is taken for thickness at first, in the order that suits it best; from there no fit
    finds back. One coordinate at a time is set to other sizes with the field moved by up to some orders, and finds
    its size with the others held: a second coordinate that is nearly thickness itself would lead a fit from a rough
    size astray.

    Parameters
    ----------
    problem : `Problem`
        Data and model.
    fit : `Fit`
        What is known of the effects so far.
    moved : sequence of `int`
        Coordinates of the last effect that shift the phase.
    first_field : `numpy.ndarray`, shape ``(M,)``
        Field that is moved.
    index : `float`
        Refractive index of the layer.
    """
    found, least = [], np.inf
    for place, field in _fields(problem, _places(problem, fit, moved, first_field, index), first_field):
        others = [n for n in range(len(place.position)) if n != place.moved]
        held = {fit.coordinates[n].key: fit.coordinates[n].value(place.position[n]) for n in others}
        own = (fit.coordinates[place.moved],)
        alone = fit_model(problem, own, place.position[[place.moved]], field, fit.levels, held, rival=least)
        settled = place.position.copy()
        settled[place.moved] = alone.position[0]
        found.append((settled, alone.field, alone.chi2))
        least = min(least, alone.chi2)
    found.sort(key=lambda item: item[2])
    return [(position, field) for position, field, _ in found[:ORDERS_REFITTED]]


def fields_in_other_orders(problem: Problem, field: FloatArray, index: float) -> list[FloatArray]:
    """The field moved, in proportion, by one and two fringe orders to either side, where that leaves a layer.

    For an effect with a shift of its own at each wavelength: it follows such a move by itself, as what an order more
    lacks at the ends of the spectrum is a small part of a fringe.

    Parameters
    ----------
    problem : `Problem`
        Data and model.
    field : `numpy.ndarray`, shape ``(M,)``
        Field that is moved.
    index : `float`
        Refractive index of the layer.
    """
    whole, used = problem.basis.expand(field), problem.cells.seen.astype(float)
    order, middle = fringe_order_um(problem.cells.wavelength_nm, index), float(whole.mean())
    shifts = np.array(NEIGHBOURING_ORDERS, dtype=float) * order
    return [
        problem.basis.fit(whole * (1.0 + shift / middle), used)
        for shift in shifts[_is_possible(problem, whole, shifts)]
    ]


def _fields(
    problem: Problem, places: Sequence[_Place], first_field: FloatArray
) -> list[tuple[_Place, FloatArray]]:
    """The best places of each coordinate, with their fields."""
    whole, used = problem.basis.expand(first_field), problem.cells.seen.astype(float)
    best: list[_Place] = []
    for number in {place.moved for place in places}:
        own = [place for place in places if place.moved == number]
        best += sorted(own, key=lambda place: place.chi2)[:ORDERS_REFITTED]
    return [
        (place, problem.basis.fit(whole * (1.0 + place.shift_um / float(whole.mean())), used))
        for place in best
    ]


def _places(
    problem: Problem, fit: Fit, moved: Sequence[int], first_field: FloatArray, index: float
) -> list[_Place]:
    """The best size of each coordinate in each order; sizes lie too far apart for the right one to win at once.

    A sample of cells is compared with the model, levels and contrasts free.
    """
    whole = problem.basis.expand(first_field)
    order = fringe_order_um(problem.cells.wavelength_nm, index)
    shifts = _shifts(problem, whole, order)
    if not shifts.size:
        return []
    part, middle = sampled_part(whole.size), float(whole.mean())
    for edge in (shifts[0], shifts[-1]):
        problem.forward.cover(whole * (1.0 + edge / middle))
    fields = whole[part[1:]] * (1.0 + shifts[:, None, None] / middle)
    value, weight = problem.cells.value[part], problem.cells.weight[part]
    best: dict[tuple[int, int], _Place] = {}
    for number, position in _single_steps(fit, moved):
        settings = {c.key: c.value(x) for c, x in zip(fit.coordinates, position, strict=True)}
        chi2 = chi2_with_free_fringes(problem.forward.sampled(settings, fields).value, value, weight)
        for turn in range(-ORDERS_MOVED, ORDERS_MOVED + 1):
            inside = np.flatnonzero(np.abs(shifts - turn * order) <= 0.51 * order)
            if inside.size:
                least = inside[int(chi2[inside].argmin())]
                place = _Place(number, turn, position, float(shifts[least]), float(chi2[least]))
                best[number, turn] = min(best.get((number, turn), place), place, key=lambda item: item.chi2)
    return list(best.values())


def _shifts(problem: Problem, whole: FloatArray, order: float) -> FloatArray:
    """Moves of the mean of a field [µm] that leave a layer everywhere, and the map where it is if it is known."""
    steps = np.arange(-ORDERS_MOVED * STEPS_PER_ORDER, ORDERS_MOVED * STEPS_PER_ORDER + 1, dtype=float)
    shifts = steps * (order / STEPS_PER_ORDER)
    return np.asarray(shifts[_is_possible(problem, whole, shifts)])


def _is_possible(problem: Problem, whole: FloatArray, shifts: FloatArray) -> NDArray[np.bool_]:
    middle = float(whole.mean())
    possible = (middle + shifts) * whole.min() / middle > LEAST_THICKNESS_UM
    return np.asarray(possible & (np.abs(shifts) * np.sqrt(problem.field_prior) <= MOST_SIGMAS))


def _single_steps(fit: Fit, moved: Sequence[int]) -> list[tuple[int, FloatArray]]:
    """Positions in which one coordinate of the last effect has another size, its others none."""
    own = np.array([item.effect == fit.coordinates[-1].effect for item in fit.coordinates])
    found = []
    for number in moved:
        item = fit.coordinates[number]
        for bound in (item.low, item.high):
            for size in item.null + np.sign(bound - item.null) * item.scale * np.array(FINE_SCAN):
                if item.low <= size <= item.high and size != item.null:
                    position = np.where(own, 0.0, fit.position)
                    position[number] = item.coordinate(float(size))
                    found.append((number, position))
    return found
