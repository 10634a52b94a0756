"""Order of a whole sensor where light, contrast and wavelengths are free."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .learning import learn
from .learning_cells import LearningCells
from .nuisances import NuisanceFit, Nuisances
from .templates import FlatTemplates

_MOST_ORDERS = 8
_CLEAR = 100.0  # Chi-square difference beyond which the orders behind one need not be asked
_ROUNDS_ELSEWHERE = 6
_INSIDE = 0.99  # Share of a sensor that must lie in the range of thicknesses


@dataclass(frozen=True, eq=False)
class CommonOrder:
    """Order of a whole sensor, all nuisances being free."""

    shift: float  # orders by which the thickness is to be moved
    fit: NuisanceFit  # nuisances there
    margin: float  # chi-square by which the next best order is worse, model error allowed for
    slip: float  # probability that the order is another


def rank_orders(
    cells: LearningCells,
    base: FlatTemplates,
    free: Nuisances,
    start: NuisanceFit,
    order_um: float,
    range_um: tuple[float, float],
) -> CommonOrder:
    """Compare the orders of a whole sensor: each with the light, contrast and wavelengths that it needs."""
    thickness, here = learn(cells, base, free, start)
    if not np.isfinite(
        here.chi2
    ):  # no order describes these flats with any likelihood: each is as good as the next
        return CommonOrder(0.0, here, 0.0, 0.5)
    tried, places = {0.0: here}, {0.0: thickness}

    def ask(shift: float, side: float) -> None:
        """Begin at the order beside this one: from far away, too few steps would reach the best."""
        near = replace(cells, thickness_um=places[shift - side])
        moved, guess = _guess_at_order(near, base, free, tried[shift - side], side * order_um)
        inside = (moved.thickness_um > range_um[0]) & (moved.thickness_um < range_um[1])
        if inside.mean() < _INSIDE:
            tried[shift] = replace(here, chi2=np.inf)
        else:
            places[shift], tried[shift] = learn(moved, base, free, guess, _ROUNDS_ELSEWHERE)

    def costs() -> dict[float, float]:
        """Improbability of all, each where cells err alike as far as those of the best do."""
        shared = min(tried.values(), key=lambda fit: fit.cost()).shared
        return {shift: fit.cost(shared) for shift, fit in tried.items()}

    def clear(shift: float) -> bool:
        cost = costs()
        return cost[shift] > min(cost.values()) + _CLEAR

    for side in (-1.0, 1.0):
        shift = side
        ask(shift, side)
        while abs(shift) < _MOST_ORDERS and not clear(shift):
            shift += side
            ask(shift, side)
    cost = costs()
    best = min(cost, key=lambda shift: cost[shift])
    excess = np.array([cost[shift] - cost[best] for shift in tried if shift != best])
    odds = float(np.exp(-0.5 * excess).sum())
    return CommonOrder(best, tried[best], float(excess.min()), odds / (1.0 + odds))


def _guess_at_order(
    cells: LearningCells, base: FlatTemplates, free: Nuisances, start: NuisanceFit, move_um: float
) -> tuple[LearningCells, NuisanceFit]:
    """Cells moved by some orders, and the wavelengths at which their fringes look the same there."""
    moved = replace(cells, thickness_um=cells.thickness_um + np.float32(move_um))
    if free.wavelength_accuracy_nm == 0.0:
        return moved, start
    wavelength = base.wavelength_nm
    away = move_um * (1.0 - wavelength / wavelength.mean())
    shift = start.shift_nm - away / base.turn_um(float(np.median(moved.thickness_um)))
    return moved, replace(start, shift_nm=shift)
