"""What could be reached on a sealed case: an oracle that is told its effects, their sizes and the thickness."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.ndimage import map_coordinates

from ..algorithms.discovery import Verdict
from ..algorithms.discovery.basis import CellBasis
from ..algorithms.discovery.cells import CellData
from ..algorithms.discovery.fit import Fit, Problem, coordinates_of, fit_model
from ..algorithms.discovery.preparation import prepare
from ..array_types import FloatArray
from ..effects import EFFECTS
from ..model import FringeModel
from .sealed_cases import SealedCase

ORDERS = (0.0, -1.0, 1.0)
"""Fringe orders by which the thickness is shifted for a fit that lacks an effect: it may be likelier there."""

VALLEYS = 8  # Minima on both sides that are tried for a parameter that comes back after a fringe


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

    A search may miss a minimum that is there, and would call faint what it has missed. What is in a part of the
    sensor only may look like a thickness that steps there: it is as clear as it is beside a thickness of each cell.
    """
    keys = {f"{effect.name}.{parameter.name}" for effect in EFFECTS for parameter in effect.parameters}
    # Gains of amplifiers, say, are drawn: the case knows their spread alone.
    known = {key: value for key, value in case.values.items() if key in keys}
    model = FringeModel.from_setup(case.setup).with_effects(known)
    problem = prepare(case.cube, model, EFFECTS, most_cells).problem
    thickness = _at_cells(case.thickness_um, problem.cells)
    complete = _fit_with(problem, case, case.names, thickness)
    order = float(model.fringe_order_um(float(np.median(problem.cells.wavelength_nm))))

    @cache
    def gain_over(names: tuple[str, ...]) -> float:
        shifted = (_fit_with(problem, case, names, thickness + number * order) for number in ORDERS)
        best = min(shifted, key=lambda fit: fit.chi2)
        gain = _deepest(problem, case, names, best).chi2 - complete.chi2
        if any(effect.local for effect in EFFECTS if effect.name in set(case.names) - set(names)):
            gain = min(gain, beside_fine_thickness(names))
        return math.sqrt(max(gain, 0.0))

    def beside_fine_thickness(names: tuple[str, ...]) -> float:
        # Data without noise, which a fine thickness would follow.
        noiseless = replace(problem.cells, value=problem.expected_of(complete))
        fine = replace(problem.with_cells(noiseless), basis=CellBasis(noiseless.shape[1:]))
        return _fit_with(fine, case, names, problem.basis.expand(complete.field)).chi2

    each = {name: gain_over(tuple(n for n in case.names if n != name)) for name in case.names}
    return Visibility(gain_over(()), each)


def _at_cells(image: FloatArray, cells: CellData) -> FloatArray:
    """An image of the whole sensor at the middle of cells."""
    places = np.meshgrid(cells.geometry.y_px, cells.geometry.x_px, indexing="ij")
    return np.asarray(map_coordinates(image, places, order=1, mode="nearest"))


def _deepest(problem: Problem, case: SealedCase, names: tuple[str, ...], fit: Fit) -> Fit:
    """The fit, or a better one in the valleys beside it: one effect may go there to do what another did."""
    for number, item in enumerate(fit.coordinates):
        for side in (-1.0, 1.0) if item.neighbour else ():
            last = fit
            for _ in range(VALLEYS):
                start = last.position.copy()
                start[number] = item.clip(start[number] + side * item.neighbour)
                thickness = problem.basis.expand(last.field)
                last = _fit_with(problem, case, names, thickness, start)
                fit = min(fit, last, key=lambda each: each.chi2)
    return fit


def _fit_with(
    problem: Problem,
    case: SealedCase,
    names: tuple[str, ...],
    thickness_um: FloatArray,
    start: FloatArray | None = None,
) -> Fit:
    """Fit with some effects of a case, from their true sizes by default, all others absent."""
    effects = [effect for effect in EFFECTS if effect.name in case.names]
    absent = {
        f"{effect.name}.{name}": null
        for effect in effects
        if effect.name not in names
        for name, null in effect.null_values(problem.forward.model.base_system).items()
    }
    coordinates = tuple(
        item
        for effect in effects
        if effect.name in names
        for item in coordinates_of(effect, problem.forward, thickness_um)
    )
    if start is None:
        start = np.array([item.coordinate(case.values.get(item.key, item.null)) for item in coordinates])
    field = problem.basis.fit(thickness_um, problem.cells.seen.astype(float))
    return fit_model(problem, coordinates, start, field, None, absent)
