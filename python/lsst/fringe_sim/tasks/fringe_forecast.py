"""How strong the fringes of a sensor will be, and what a correction will leave of them."""

from __future__ import annotations

from typing import Any, ClassVar

from lsst.pex.config import Field, FieldValidationError, ListField
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Output

from ..algorithms.field_response import SensorResponse
from ..algorithms.focal_plane import ForecastOptions, SkyLevel, forecast_sensor
from ..errors import InputError
from ..instrument.detector import Detector
from ..instrument.night import NightHistory, random_nights
from ..model import Setup
from ..products import ThicknessMap
from .quantum import SENSOR, common_header, data_id_of, sensor_of, unusable
from .sky_model import LINE_LIST, MapConnections, SkyModelConfig


class FringeForecastConnections(MapConnections, dimensions=SENSOR):
    """A thickness map in, where there is one; one table out."""

    forecast = Output(
        "fringeForecast",
        "AstropyTable",
        "Fringes in cells of the sensor; the header has those of the whole sensor.",
        dimensions=SENSOR,
    )


class FringeForecastConfig(
    SkyModelConfig, base.PipelineTaskConfig, pipelineConnections=FringeForecastConnections
):
    """Configuration of `FringeForecastTask`."""

    task_name: ClassVar[str] = "fringeForecast"

    airmass = Field[float](
        default=1.2, doc="Airmass of the exposures.", check=lambda airmass: 1.0 <= airmass < 10.0
    )
    cells = Field[int](default=8, doc="Cells along each side of a sensor.", check=lambda cells: cells > 0)
    apertures_arcsec = ListField[float](
        default=[1.0, 2.0, 5.0, 10.0, 20.0],
        doc="Sides of the square apertures in which fringe and noise are compared, whole arcseconds.",
    )
    templates = Field[int](
        default=3, doc="Largest number of templates of the correction.", check=lambda count: count > 0
    )
    nights = Field[int](default=5, doc="Random nights that are corrected.", check=lambda count: count > 0)
    nights_seed = Field[int](default=0, doc="Seed of the random nights.", check=lambda seed: seed >= 0)

    def setDefaults(self) -> None:
        """Every sensor has a forecast."""
        super().setDefaults()
        self.stand_in = True

    def validate(self) -> None:
        """Refuse apertures and telescopes that a forecast cannot have."""
        super().validate()
        try:
            self.options()
        except InputError as error:
            raise FieldValidationError(type(self).apertures_arcsec, self, str(error)) from error
        if not Setup.from_name(self.setup).telescope or self.beams != "pixel":
            raise FieldValidationError(
                SkyModelConfig.beams, self, "a forecast needs a traced telescope and the beams of its pixels"
            )

    def options(self) -> ForecastOptions:
        """Cells, apertures and templates."""
        return ForecastOptions(self.cells, tuple(self.apertures_arcsec), self.templates)

    def observed(self) -> NightHistory:
        """Hours of random nights, none of which makes a template."""
        return random_nights(self.nights, self.nights_seed)


class FringeForecastTask(base.PipelineTask):
    """Forecast the fringes of one sensor."""

    ConfigClass = FringeForecastConfig
    config: FringeForecastConfig
    _DefaultName = "fringeForecast"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read the map if there is one, forecast, store."""
        detector = sensor_of(data_id_of(butlerQC))
        with unusable(detector.name):
            thickness = butlerQC.get(inputRefs.thickness) if hasattr(inputRefs, "thickness") else None
            result = self.run(thickness, detector)
        butlerQC.put(result, outputRefs)

    def run(self, thickness: ThicknessMap | None, detector: Detector) -> base.Struct:
        """Forecast one sensor.

        Parameters
        ----------
        thickness : `ThicknessMap` or `None`
            Thickness of the varying layer of this sensor; `None` where a stand-in is wanted.
        detector : `Detector`
            The sensor; its place in the focal plane decides the beams.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``forecast``, an `astropy.table.Table` (`SensorForecast.to_table`).

        Raises
        ------
        InputError
            No map where one is needed; a map of another layer, or fitted with other effects than those configured
            here; a telescope whose beams do not depend on the distance from the axis alone.
        """
        layer = self.config.map_of(thickness, detector)
        known = layer.known_um()
        made = self.config.sky_model(detector, self.config.airmass, known, layer.metadata)
        model, sky, response = made.response()
        if not isinstance(response, SensorResponse):
            raise InputError(
                "telescope", model.setup.telescope, "one whose beams depend on the field radius alone"
            )
        light = float(response.field.relative_illumination(detector.field_radius_deg))
        forecast = forecast_sensor(
            known,
            response,
            detector,
            SkyLevel.of(sky, model, detector.read_noise, light),
            NightHistory.guo2022(),
            self.config.observed(),
            stand_in=thickness is None,
            options=self.config.options(),
        )
        table = forecast.to_table()
        header: dict[str, Any] = {**common_header(self.config), **self.config.choice_of(detector).header()}
        table.meta.update(header, LINELIST=LINE_LIST, NIGHTSD=self.config.nights_seed)
        if thickness is None:
            table.meta["STANDSD"] = self.config.stand_in_seed
        self.log.info(
            "%s: fringe rms %.4f %%, %.2f times the shot noise; after correction with %d templates %.3f times",
            *(detector.name, 100.0 * forecast.amplitudes.rms, forecast.over_noise.max()),
            *(len(forecast.residual_over_noise), forecast.residual_over_noise[-1].max()),
        )
        return base.Struct(forecast=table)
