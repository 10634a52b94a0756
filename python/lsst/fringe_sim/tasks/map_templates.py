"""From the thickness map of a sensor to the templates of its sky."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from lsst.pex.config import Field
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Output

from ..algorithms.laboratory_shift import template_pair
from ..instrument.detector import Detector
from ..products import FringeTemplates, ThicknessMap
from .quantum import SENSOR_FILTER, data_id_of, run_datetime, sensor_of, unusable
from .sky_model import SensorMapsConfig, SensorMapsConnections, maps_of


class MapTemplatesConnections(SensorMapsConnections, dimensions=SENSOR_FILTER):
    """Maps of a sensor in, templates of its sky in a filter out."""

    templates = Output(
        "fringeTemplates",
        "FringeTemplates",
        "The sky of the map, and how the phase of the adhesive, which the laboratory does not tell, changes it.",
        dimensions=SENSOR_FILTER,
        isCalibration=True,
    )


class MapTemplatesConfig(
    SensorMapsConfig, base.PipelineTaskConfig, pipelineConnections=MapTemplatesConnections
):
    """Configuration of `MapTemplatesTask`."""

    task_name: ClassVar[str] = "mapTemplates"

    airmass = Field[float](
        default=1.2, doc="Airmass of the exposures.", check=lambda airmass: 1.0 <= airmass < 10.0
    )


class MapTemplatesTask(base.PipelineTask):
    """Make the templates that a correction fits from what the laboratory knows of a sensor."""

    ConfigClass = MapTemplatesConfig
    config: MapTemplatesConfig
    _DefaultName = "mapTemplates"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read the maps, make the templates, store."""
        data_id = data_id_of(butlerQC)
        detector = sensor_of(data_id)
        created = run_datetime(outputRefs.templates.run)
        with unusable(f"{detector.name}, {data_id['physical_filter']}"):
            thickness, silicon = maps_of(butlerQC, inputRefs)
            result = self.run(thickness, detector, str(data_id["physical_filter"]), created, silicon)
        butlerQC.put(result, outputRefs)

    def run(
        self,
        thickness: ThicknessMap | None,
        detector: Detector,
        physical_filter: str,
        creation_datetime: str,
        silicon: ThicknessMap | None = None,
    ) -> base.Struct:
        """Make the templates of one sensor.

        Parameters
        ----------
        thickness : `ThicknessMap` or `None`
            Thickness of the varying layer of this sensor; `None` where a stand-in is wanted.
        detector : `Detector`
            The sensor; its place in the focal plane decides the beam.
        physical_filter : `str`
            Filter, as the instrument names it.
        creation_datetime : `str`
            When the calibration is made, ``YYYY-MM-DDThh:mm:ss``.
        silicon : `ThicknessMap`, optional
            Thickness of its silicon on the same pixels; that of the stack everywhere if not given.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``templates``, a `FringeTemplates`: the sky, and the phase of the adhesive where it is open.

        Raises
        ------
        InputError
            The map is of another layer, or was fitted with other effects than those configured here.
        """
        layer = self.config.map_of(thickness, detector)
        found = self.config.sensor_sky(detector, self.config.airmass, layer, silicon)
        pair = template_pair(
            found.known_um, found.model, found.response, self.config.phase_sigma, creation_datetime
        )
        patterns = np.stack([template.image for template in pair])
        header = self.config.map_header(
            detector, layer, stand_in=thickness is None, silicon=silicon is not None
        )
        mask = pair[0].mask | layer.mask
        templates = FringeTemplates(
            coverage=(pair[0].mask == 0).astype(np.float32),
            patterns=patterns,
            variance=np.zeros_like(patterns),
            # The one frame that they are made of is the sky of the map itself.
            scores=np.eye(1, len(pair)),
            mask=mask,
            creation_datetime=creation_datetime,
            metadata={**header, "PHASESIG": self.config.phase_sigma},
            detector=detector.name,
            physical_filter=physical_filter,
        )
        self.log.info(
            "%s in %s: rms of the templates %s",
            *(detector.name, physical_filter),
            ", ".join(f"{100 * float(pattern[mask == 0].std()):.4f} %" for pattern in patterns),
        )
        return base.Struct(templates=templates)
