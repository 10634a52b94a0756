"""Which further data would tell effects apart that frames of the night sky have left in one class.

As for flats (`next_measurement`), but at the cells, the map and the noise of the search itself: further frames share
the thickness with those that are there; flats of the laboratory have levels and a thickness of their own, and their
information adds up with that of the sky. What belongs to the sky leaves flats as they are: flats that show nothing
decide as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...array_types import FloatArray
from ...model import FringeModel, Setup, setup_names
from ..exposures import Exposures
from ..measurement_forecast import RESPONSE_SCATTER
from ..next_measurement import FlatMeasurement, FlatSeries, Measurement, PairForecast, RankedMeasurement
from .cells import CellData
from .fit import (
    Coordinate,
    Fit,
    FullColumns,
    Problem,
    coordinate_derivative,
    linearise_at,
    solve_symmetric,
)
from .forward import Forward
from .next_step import Values


class FrameForecast:
    """Information of frames that are there, and of data that could be taken, about effects of a class.

    ``coordinates``: coordinates of every effect of the catalogue.
    """

    def __init__(self, problem: Problem, fit: Fit, coordinates: Mapping[str, tuple[Coordinate, ...]]) -> None:
        self.problem, self.fit, self.coordinates = problem, fit, coordinates

    def ranked(self, name: str, rivals: Values) -> tuple[RankedMeasurement, ...]:
        """Measurements by how well they would tell an effect from others, best first."""
        present = self._information(self.problem, name, rivals)
        ranked = []
        for measurement, after in self._candidates(name, rivals, present):
            pairs, first = [], 1
            for other in rivals:
                own = slice(first, first + 1 + len(self.coordinates[other]))
                first = own.stop
                now, then = pair_of(present, own), pair_of(after, own)
                pairs.append(PairForecast(name, other, now[0], then[0], now[1], then[1]))
            pairs.sort(key=lambda pair: pair.separation_after)
            ranked.append(RankedMeasurement(measurement, tuple(pairs)))
        return tuple(sorted(ranked, key=lambda item: -item.separation))

    def _candidates(
        self, name: str, rivals: Values, present: FloatArray
    ) -> list[tuple[Measurement, FloatArray]]:
        """What could be measured, and the information of all data then."""
        forward = self.problem.forward
        if forward.exposures is None:
            return []
        found: list[tuple[Measurement, FloatArray]] = []
        for key, title, exposures in forward.exposures.further():
            problem = _of_twice_as_many(self.problem, exposures)
            found.append((Measurement(key, title), self._information(problem, name, rivals)))
        for measurement, laboratory in laboratory_flats(forward.model):
            problem = _of_flats(self.problem, laboratory, measurement.series)
            found.append((measurement, present + self._information(problem, name, rivals)))
        return found

    def _information(self, problem: Problem, name: str, rivals: Values) -> FloatArray:
        """Products of signatures with one another, nuisances projected out.

        First that of the effect that was found; then, for each of the others, what the effect does beyond the other,
        and the derivatives with respect to the parameters of the other.
        """
        without = self.fit.without(name)
        held = replace(without, settings=self.fit.settings, levels=np.ones(problem.n_levels))
        design, _, prediction, thickness, whiten = linearise_at(problem, held)
        forward = problem.forward
        columns = [prediction.value - forward.predict(without.settings, thickness).value]
        for other, values in rivals.items():
            settings = {**without.settings, **{f"{other}.{key}": value for key, value in values.items()}}
            columns.append(prediction.value - forward.predict(settings, thickness).value)
            for item in self.coordinates[other]:
                at = item.coordinate(settings.get(item.key, item.null))
                columns.append(coordinate_derivative(forward, item, at, settings, thickness))
        features = FullColumns(whiten(np.stack(columns)))
        return design.project(features, np.zeros(problem.cells.shape))[1]


def pair_of(information: FloatArray, own: slice) -> tuple[float, float]:
    """Likeness of the effect and another one, and the standard deviations by which the other fits worse."""
    difference, tangent = own.start, slice(own.start + 1, own.stop)
    cross = information[tangent, difference]
    moved = float(cross @ solve_symmetric(information[tangent, tangent], cross))
    left = max(float(information[difference, difference]) - moved, 0.0)
    strength = float(information[0, 0])
    likeness = math.sqrt(max(1.0 - left / strength, 0.0)) if strength > 0.0 else math.nan
    return likeness, math.sqrt(left)


def laboratory_of(setup: Setup) -> Setup | None:
    """Set-up of a laboratory with the sensor of another set-up, that with most wavelengths; `None` without one."""
    shipped = [Setup.from_name(name) for name in setup_names()]
    own = [
        each
        for each in shipped
        if each.kind == "monochromator" and each.varying == setup.varying and each.stack == setup.stack
    ]
    return max(own, key=lambda each: len(each.wavelengths_nm), default=None)


def laboratory_flats(model: FringeModel) -> list[tuple[FlatMeasurement, FringeModel]]:
    """Flats that the laboratory of a sensor on the sky would take of it, and its model there; none without one."""
    setup = laboratory_of(model.setup)
    if setup is None:
        return []
    series = FlatSeries(setup.wavelengths_nm)
    title = f"{len(series.wavelength_nm)} laboratory flats of {series.level_e:.0f} electrons ({setup.name})"
    settings = {
        f"{item.effect.name}.{key}": value
        for item in model.effects
        if not (item.effect.laboratory_only or item.effect.sky_only)
        for key, value in item.values.items()
    }
    return [(FlatMeasurement("laboratory", title, series), FringeModel.from_setup(setup, settings))]


def _of_twice_as_many(problem: Problem, exposures: Exposures) -> Problem:
    """The data and as many further frames of the same noise."""
    cells = problem.cells
    geometry = replace(
        cells.geometry,
        wavelength_nm=np.tile(cells.geometry.wavelength_nm, 2),
        level_e=np.tile(cells.geometry.level_e, 2),
        dark_time_s=np.tile(cells.geometry.dark_time_s, 2),
    )
    twice = (2, 1, 1)
    both = replace(
        cells,
        value=np.tile(cells.value, twice),
        weight=np.tile(cells.weight, twice),
        geometry=geometry,
        centroid=None if cells.centroid is None else np.tile(cells.centroid, (1, *twice)),
    )
    forward = _forward_like(problem.forward, both, problem.forward.model, exposures)
    forward.scatter_um2 = problem.forward.scatter_um2
    return _problem_with(problem, both, forward)


def _of_flats(problem: Problem, model: FringeModel, series: FlatSeries) -> Problem:
    """Flats of the same cells, the thickness of which is not known beforehand."""
    cells, waves = problem.cells, np.array(series.wavelength_nm)
    shape = (len(waves), *cells.shape[1:])
    weight = np.where(cells.seen, series.level_e * cells.cell_px**2, 0.0)
    geometry = replace(
        cells.geometry,
        wavelength_nm=waves,
        level_e=np.full(len(waves), series.level_e),
        dark_time_s=np.array(series.dark_time_s),
    )
    flats = CellData(
        np.ones(shape),
        np.broadcast_to(weight, shape).copy(),
        geometry,
        cells.cell_px,
        RESPONSE_SCATTER / cells.cell_px,
    )
    forward = _forward_like(problem.forward, flats, model, None)
    return replace(_problem_with(problem, flats, forward), field_prior=0.0, field_centre=None)


def _forward_like(
    forward: Forward, cells: CellData, model: FringeModel, exposures: Exposures | None
) -> Forward:
    """Other data of the same thicknesses and effects."""
    like = Forward.of_cells(model, forward.catalogue, cells, forward.range_um, exposures)
    return like.with_places(forward.places)


def _problem_with(problem: Problem, cells: CellData, forward: Forward) -> Problem:
    """Other data with the same field, each exposure with a level of its own."""
    return replace(
        problem, cells=cells, forward=forward, level_basis=np.eye(cells.shape[0]), free_contrast=False,
        reference=None,
    )  # fmt: skip
