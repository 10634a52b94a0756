"""Which further data would tell effects apart that frames of the sky have left in one class; see `..next_frames`.

Further frames are of the same cells. Flats of the laboratory have levels, a thickness and a response of their own,
and their information adds up with that of the sky.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ....array_types import FloatArray
from ....model import FringeModel
from ...exposures import Exposures
from ...inference import Forward, Hypothesis, Problem
from ...measurement_forecast import RESPONSE_SCATTER
from ...next_measurement import FlatSeries, Measurement
from ..next_frames import laboratory_flats
from .next_flats import FlatForecast, Seen


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
