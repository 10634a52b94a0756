"""The night sky with its fringes, as one sensor sees it through the telescope."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from lsst.daf.butler import DataCoordinate
from lsst.pex.config import ChoiceField, Field, FieldValidationError, ListField
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Output

from ..algorithms.photon_migration import photon_migration
from ..algorithms.sky_frame import simulate_sky_frame, throughput_electrons
from ..array_types import FloatArray
from ..errors import OutOfRangeError
from ..instrument.bandpass import Bandpass
from ..instrument.detector import Detector
from ..instrument.night import NightHistory, StochasticNight
from ..instrument.sky import EmissionLines, SkySpectrum
from ..instrument.telescope import Telescope
from ..middleware.night import airmass_of, hour_of_night
from ..model import FringeModel, Setup
from ..products import ThicknessMap, band_cards
from .quantum import SENSOR_EXPOSURE, data_id_of, sensor_of, unusable
from .sky_model import SensorMapsConfig, SensorMapsConnections, SkyModel, maps_of

FIRST_HOUR = 19.0  # Local time at which the tabulated night begins [h]

RANDOM_NIGHT_H = (12.0, 36.0, 0.25)
"""First, last and step of the times at which a random night is drawn [h]: the same for all its exposures."""


@dataclasses.dataclass(frozen=True)
class SkyExposure:
    """One exposure of the sky."""

    # exposure_id, day_obs: number of the exposure and of its night; they decide the noise and a random
    # night
    exposure_id: int
    day_obs: int
    hour: float  # local time, in hours; after midnight on beyond 24
    exposure_s: float
    airmass: float
    physical_filter: str  # filter, as the instrument names it


class SkyFringeSimConnections(SensorMapsConnections, dimensions=SENSOR_EXPOSURE):
    """A thickness map in, one sky frame out."""

    sky = Output(
        "skyFringe", "SkyFringe", "Night sky with its fringes, in electrons.", dimensions=SENSOR_EXPOSURE
    )

    def wants(self, data_id: DataCoordinate) -> bool:
        """Whether it is an exposure of the sky in the band of the set-up: laboratory frames have exposures too."""
        exposure: Any = data_id.records["exposure"]
        return super().wants(data_id) and exposure.observation_type in self.config.observation_types


class SkyFringeSimConfig(
    SensorMapsConfig, base.PipelineTaskConfig, pipelineConnections=SkyFringeSimConnections
):
    """Configuration of `SkyFringeSimTask`."""

    task_name: ClassVar[str] = "skyFringeSim"

    observation_types = ListField[str](
        default=["science"], doc="Observation types of exposures that show the sky."
    )
    night = ChoiceField[str](
        default="guo2022",
        doc="How the OH bands change with time.",
        allowed={
            "guo2022": "the hourly table of Guo et al. 2022, after Noll et al. 2015; from 19 h to 5 h",
            "random": "a random night, the same for all exposures and sensors of its date and this seed",
            "steady": "not at all",
        },
    )
    level = ChoiceField[str](
        default="throughput",
        doc="Mean level of a frame.",
        allowed={
            "model": "what the stack itself detects",
            "throughput": "what the measured quantum efficiency in the throughput tables detects",
        },
    )
    noise = Field[bool](
        default=True,
        doc="Whether photon and read noise are added. Pipelines that make templates go without; nothing can be "
        "searched for in frames without.",
    )
    seed = Field[int](
        default=0, doc="With exposure and sensor, the seed of the noise; with the date, of random nights."
    )
    migration = Field[bool](
        default=False,
        doc="Whether photons walk to neighbouring pixels before they are absorbed (behind a traced telescope).",
    )

    def validate(self) -> None:
        """Refuse what makes no frame."""
        super().validate()
        if self.seed < 0:
            raise FieldValidationError(type(self).seed, self, "must not be negative")
        if self.migration and not Setup.from_name(self.setup).telescope:
            raise FieldValidationError(type(self).migration, self, "needs a traced telescope")


class SkyFringeSimTask(base.PipelineTask):
    """Simulate the sky of one exposure on one sensor."""

    ConfigClass = SkyFringeSimConfig
    config: SkyFringeSimConfig
    _DefaultName = "skyFringeSim"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read the map, simulate, store."""
        data_id = data_id_of(butlerQC)
        detector = sensor_of(data_id)
        record: Any = data_id.records["exposure"]
        with unusable(f"{detector.name}, exposure {record.id}"):
            setup = Setup.from_name(self.config.choice_of(detector).setup)
            exposure = SkyExposure(
                exposure_id=record.id,
                day_obs=record.day_obs,
                hour=hour_of_night(record),
                exposure_s=record.exposure_time,
                airmass=airmass_of(record) or setup.airmass,
                physical_filter=str(data_id["physical_filter"]),
            )
            thickness, silicon = maps_of(butlerQC, inputRefs)
            result = self.run(thickness, exposure, detector, silicon)
        butlerQC.put(result, outputRefs)

    def run(
        self,
        thickness: ThicknessMap | None,
        exposure: SkyExposure,
        detector: Detector,
        silicon: ThicknessMap | None = None,
    ) -> base.Struct:
        """Simulate one frame.

        Parameters
        ----------
        thickness : `ThicknessMap` or `None`
            Thickness of the varying layer of this sensor; `None` where a stand-in is wanted.
        exposure : `SkyExposure`
            When, how long, through what.
        detector : `Detector`
            The sensor; its place in the focal plane decides the beam.
        silicon : `ThicknessMap`, optional
            Thickness of its silicon on the same pixels; that of the stack everywhere if not given.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``sky``, a `SkyFringe`.

        Raises
        ------
        InputError
            The map is of another layer, or was fitted with other effects than those configured here.
        OutOfRangeError
            An hour outside the tabulated night.
        """
        choice = self.config.choice_of(detector)
        layer = self.config.map_of(thickness, detector)
        if choice.left_out:
            self.log.info("%s: on the sky without %s", detector.name, ", ".join(choice.left_out))
        known, sky_model, model, sky, response = self.config.sensor_sky(
            detector, exposure.airmass, layer, silicon
        )
        scale = self._band_scale(exposure, sky.lines)
        frame = simulate_sky_frame(
            known,
            model,
            response=response,
            scale={name: factor for name, factor in scale.items() if name in response.component},
            exposure_s=exposure.exposure_s,
            mean_electrons=self._level(sky.with_band_scale(scale), model, exposure),
            read_noise_e=detector.read_noise,
            charge_kernel=_charge_kernel(sky_model) if self.config.migration else None,
            seed=self._seed(exposure, detector) if self.config.noise else None,
            phase_sigma=self.config.phase_sigma,
            hour=exposure.hour,
            detector=detector.name,
            physical_filter=exposure.physical_filter,
        )
        metadata = {
            **self.config.map_header(
                detector, layer, stand_in=thickness is None, silicon=silicon is not None
            ),
            **({"NIGHTSD": self.config.seed} if self.config.night == "random" else {}),
            "NIGHT": self.config.night,
            "LEVEL": self.config.level,
            **band_cards(scale),
            **frame.metadata,
        }
        self.log.info(
            "%s at %.2f h: %.0f e, fringe rms %.4f %%, quadrature error %.1e",
            *(detector.name, exposure.hour, frame.mean_electrons),
            *(100.0 * float(frame.metadata["FRINGRMS"]), frame.quadrature_error),
        )
        # What the map calls doubtful stays doubtful.
        return base.Struct(sky=dataclasses.replace(frame, mask=frame.mask | layer.mask, metadata=metadata))

    def _band_scale(self, exposure: SkyExposure, lines: EmissionLines) -> Mapping[str, float]:
        """Factors on the OH bands at the time of the exposure."""
        if self.config.night == "steady":
            return dict.fromkeys(lines.bands, 1.0)
        if self.config.night == "guo2022":
            night, since = NightHistory.guo2022(), FIRST_HOUR
        else:
            first, last, step = RANDOM_NIGHT_H
            rng = np.random.default_rng([self.config.seed, exposure.day_obs])
            night, since = StochasticNight().draw(np.arange(first, last + step, step), rng), 0.0
        return _at_hour(night, exposure.hour - since).band_scale(0, lines.bands)

    def _level(self, sky: SkySpectrum, model: FringeModel, exposure: SkyExposure) -> float | None:
        if self.config.level == "model":
            return None
        bandpass = Bandpass.from_name(model.setup.bandpass)
        return throughput_electrons(sky, bandpass, model, exposure.exposure_s)

    def _seed(self, exposure: SkyExposure, detector: Detector) -> int:
        sequence = np.random.SeedSequence([self.config.seed, exposure.exposure_id, detector.id])
        (state,) = sequence.generate_state(1, np.uint64)
        return int(state >> 1)


@functools.lru_cache(maxsize=4)
def _charge_kernel(sky_model: SkyModel) -> FloatArray:
    """Where the photons of a pixel at the centre of a sensor are absorbed."""
    model, sky, _ = sky_model.response()
    setup = model.setup
    telescope = Telescope.from_name(setup.telescope)
    rays = telescope.trace(sky_model.placement.field_x_deg, sky_model.placement.field_y_deg)
    light = sky.components(Bandpass.from_name(setup.bandpass))
    migration = photon_migration(rays, light, model.system.stack, setup.temperature_k)
    return migration.pixel_kernel(telescope.pixel_um)


def _at_hour(night: NightHistory, hour: float) -> NightHistory:
    """The night at one time, interpolated linearly."""
    first, last = float(night.hours[0]), float(night.hours[-1])
    # The middle of an exposure is known to rounding only.
    if not first - 1e-6 <= hour <= last + 1e-6:
        raise OutOfRangeError("time since the beginning of the night [h]", hour, f"{first:g} to {last:g}")
    intensity = [np.interp(hour, night.hours, level) for level in night.intensity.T]
    return NightHistory(np.array([hour]), night.upper_level, np.array([intensity]))
