"""Which further data would tell effects apart that frames of the night sky have left in one class.

As for flats (`next_measurement`), but at the cells, the map and the noise of the search itself: further frames share
the thickness with those that are there; flats of the laboratory have levels and a thickness of their own, and their
information adds up with that of the sky. What belongs to the sky leaves flats as they are: flats that show nothing
decide as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...array_types import FloatArray
from ...model import FringeModel, Setup, setup_names
from ..exposures import Exposures
from ..inference import Forward, Hypothesis, Problem
from ..next_measurement import FlatMeasurement, FlatSeries, Measurement
from .next_flats import FlatForecast, Seen

RESPONSE_SCATTER = 0.01  # Scatter of the response of single pixels that is known beforehand (relative)


@dataclass(frozen=True, eq=False)
class FrameForecast(FlatForecast):
    """Information of frames that are there, and of data that could be taken, about effects of a class."""

    def _further(
        self, name: str, rivals: Mapping[str, Hypothesis], here: Seen
    ) -> Iterator[tuple[Measurement, FloatArray]]:
        problem = self.best.point.problem
        assert problem.forward.exposures is not None
        for key, title, exposures in problem.forward.exposures.further():
            both = self._seen(self._of_twice_as_many(exposures), None, name, rivals)
            yield Measurement(key, title), self._information([both])
        alone = replace(
            problem,
            known=False,
            thickness_sigma_um=Problem.thickness_sigma_um,
            response_sigma=RESPONSE_SCATTER / self.cells.cell_px,
        )
        present = self._information([here])
        for measurement, model in laboratory_flats(self.model):
            flats = self._seen(
                self._of_laboratory(model, measurement.series), measurement.series, name, rivals
            )
            yield measurement, present + self._information([flats], alone)

    def _of_twice_as_many(self, exposures: Exposures) -> Forward:
        """Model of the frames and of as many further ones."""
        forward = self.best.point.problem.forward
        geometry = forward.geometry
        both = replace(
            geometry,
            wavelength_nm=np.tile(geometry.wavelength_nm, 2),
            level_e=np.tile(geometry.level_e, 2),
            dark_time_s=np.tile(geometry.dark_time_s, 2),
        )
        centroid = None if forward.centroid is None else np.tile(forward.centroid, (1, 2, 1))
        return replace(
            forward,
            geometry=both,
            centroid=centroid,
            exposures=exposures,
            _tables={},
            _levels={},
            _rows={},
            _phases={},
        )

    def _of_laboratory(self, model: FringeModel, series: FlatSeries) -> Forward:
        """Model of the same cells in the laboratory."""
        forward = self.best.point.problem.forward
        waves = np.array(series.wavelength_nm)
        geometry = replace(
            forward.geometry,
            wavelength_nm=waves,
            level_e=np.full(len(waves), series.level_e),
            dark_time_s=np.zeros(len(waves)),
        )
        return Forward(model, forward.catalogue, geometry, forward.shape, forward.range_um)

    def _under(self, series: FlatSeries | None, settings: Mapping[str, float]) -> Mapping[str, float]:
        return settings


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
