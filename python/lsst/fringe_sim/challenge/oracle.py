"""What could be reached on a sealed case: an oracle that is told its effects, their sizes and the thickness."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.ndimage import map_coordinates

from ..algorithms.discovery import Verdict
from ..algorithms.discovery.cells import CellData
from ..algorithms.discovery.options import SearchOptions
from ..algorithms.discovery.preparation import Prepared, prepare
from ..algorithms.inference import CellShape, Forward, Hypothesis, Point, Problem, coordinates_of, fit, jumped
from ..array_types import FloatArray
from ..effects import EFFECTS, Effect
from ..model import FringeModel
from .sealed_cases import SealedCase

ORDERS = (0.0, -1.0, 1.0)
"""Fringe orders by which the thickness is shifted for a fit that lacks an effect: it may be likelier there."""

VALLEYS = 8  # Minima on both sides that are tried for a parameter that comes back after a fringe

ALL_DATA = SearchOptions(heldout_fraction=0.0)
"""Options of a preparation that holds nothing out."""


@dataclass(frozen=True)
class Visibility:
    """How clearly the effects of a case are in its data."""

    all: float  # Signal to noise of all effects together
    each: dict[str, float]  # That of each beside the others


@dataclass(frozen=True)
class Oracle:
    """What could be reached on a case."""

    visibility: Visibility  # How clearly its effects are seen
    verdict: Verdict  # Of the search, told which effects can be in


def visibility(case: SealedCase, *, most_cells: int = 20_000) -> Visibility:
    """Signal to noise of the effects of a case, from fits that begin at their true sizes and the true thickness.

    Its square is twice the log likelihood that the best fit without them lacks. A search may miss a minimum that is
    there, and would call faint what it has missed. Every cell has a thickness of its own, so that what is in a part
    of the sensor only is as clear as it is beside a thickness that steps there.
    """
    complete = _complete(case, most_cells)

    @cache
    def clearness_beside(names: tuple[str, ...]) -> float:
        lost = _best_with(names, complete).point.cost - complete.point.cost
        return math.sqrt(max(2.0 * lost, 0.0))

    each = {name: clearness_beside(tuple(n for n in case.names if n != name)) for name in case.names}
    return Visibility(clearness_beside(()), each)


def _complete(case: SealedCase, most_cells: int) -> Hypothesis:
    """The fit with all effects of a case, from their true sizes and the true thickness."""
    effects = [effect for effect in EFFECTS if effect.name in case.names]
    keys = {f"{effect.name}.{parameter.name}" for effect in effects for parameter in effect.parameters}
    # Gains of amplifiers, say, are drawn: the case knows their spread alone.
    known = {key: value for key, value in case.values.items() if key in keys}
    model = FringeModel.from_setup(case.setup)
    # Noise is judged with the effects in the model. Nothing is held out, so that nothing is drawn.
    options = replace(ALL_DATA, most_cells=most_cells)
    told = prepare(case.cube, model.with_effects(known), EFFECTS, options, np.random.default_rng(0))
    problem = _with_free_effects(told, model, effects, _at_cells(case.thickness_um, told.cells))
    items = tuple(item for effect in effects for item in coordinates_of(effect, problem.forward))
    return fit(case.names, items, problem.at(known, told.point.levels, problem.thickness_um))


def _with_free_effects(
    told: Prepared, model: FringeModel, effects: Sequence[Effect], thickness_um: FloatArray
) -> Problem:
    """The problem about the true thickness ``(ny, nx)`` and a model without effects.

    Its tables reach where the thickness goes without some of the effects.
    """
    old = told.problem.forward
    # A phase that is larger without an effect belongs to a thickness that is smaller.
    thicker = [-old.log_phase(_absent(effect, model)) for effect in effects]
    low, high = old.range_um
    low *= math.exp(math.fsum(min(part, 0.0) for part in thicker))
    high *= math.exp(math.fsum(max(part, 0.0) for part in thicker))
    shape = CellShape.of_field(thickness_um, told.cells.cell_px, area=old.shape.area)
    forward = Forward(model, EFFECTS, old.geometry, shape, (low, high), old.centroid)
    return replace(told.problem, forward=forward).about(thickness_um.ravel())


def _absent(effect: Effect, model: FringeModel) -> dict[str, float]:
    """Settings with which an effect does nothing."""
    nulls = effect.null_values(model.base_system)
    return {f"{effect.name}.{name}": value for name, value in nulls.items()}


def _at_cells(image: FloatArray, cells: CellData) -> FloatArray:
    """An image of the whole sensor in the middle of cells."""
    places = np.meshgrid(cells.geometry.y_px, cells.geometry.x_px, indexing="ij")
    return np.asarray(map_coordinates(image, places, order=1, mode="nearest"))


def _best_with(names: tuple[str, ...], complete: Hypothesis) -> Hypothesis:
    """The best fit with some of the effects, in any of the orders and valleys that are tried."""
    kept = tuple(item for item in complete.items if item.effect in names)
    gone = [item for item in complete.items if item.effect not in names]
    start = _in_own_scale(jumped(complete.point, gone, [item.null for item in gone]), complete.point)
    aim = complete.point.cost
    fits = (fit(names, kept, _in_order(start, number), aim=aim) for number in ORDERS)
    return _deepest(min(fits, key=lambda one: one.point.cost), aim)


def _in_own_scale(start: Point, complete: Point) -> Point:
    """A start whose cells are as steep as its own thickness is, about which their prior is."""
    old = complete.problem
    scale = math.exp(old.forward.log_phase(complete.settings) - old.forward.log_phase(start.settings))
    shape = old.forward.shape
    shape = replace(shape, gradient=scale * shape.gradient, hessian=scale * shape.hessian)
    problem = replace(old.about(scale * old.thickness_um), forward=replace(old.forward, shape=shape))
    return problem.at(start.settings, start.levels, start.thickness_um)


def _in_order(start: Point, number: float) -> Point:
    """A start shifted by fringe orders, and the prior of its thickness with it."""
    shift_um = number * start.problem.forward.order_um
    problem = start.problem.about(start.problem.thickness_um + shift_um)
    return problem.at(start.settings, start.levels, start.thickness_um + shift_um)


def _deepest(found: Hypothesis, aim: float) -> Hypothesis:
    """The fit, or a better one in the valleys beside it: one effect may go there to do what another did."""
    for item in found.items:
        for side in (-1.0, 1.0) if item.repeat else ():
            last = found
            for _ in range(VALLEYS):
                value = last.point.settings[item.key] + side * item.repeat
                last = fit(found.effects, found.items, jumped(last.point, [item], [value]), aim=aim)
                found = min(found, last, key=lambda one: one.point.cost)
    return found
