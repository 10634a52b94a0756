"""The night sky with its fringes, as one sensor sees it through the telescope."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lsst.pex.config import ChoiceField, Field, FieldValidationError, ListField
from lsst.pipe.base import (
    InputQuantizedConnection,
    OutputQuantizedConnection,
    PipelineTask,
    PipelineTaskConfig,
    PipelineTaskConnections,
    QuantaAdjuster,
    QuantumContext,
    Struct,
)
from lsst.pipe.base.connectionTypes import Input, Output

from ..algorithms.sky_frame import SkyResponse, simulate_sky_frame, sky_response, throughput_electrons
from ..errors import InputError, OutOfRangeError
from ..instrument.bandpass import Bandpass
from ..instrument.detector import Detector
from ..instrument.night import NightHistory, StochasticNight
from ..instrument.sky import EmissionLines, SkySpectrum
from ..middleware.night import airmass_of, hour_of_night
from ..model import FringeModel, Setup
from ..products import ThicknessMap, mask_bits
from .model_config import FringeModelConfig, ModelChoice
from .quantum import common_header, data_id_of, sensor_of, unusable

__all__ = [
    "SkyExposure",
    "SkyFringeSimConfig",
    "SkyFringeSimConnections",
    "SkyFringeSimTask",
    "SkyModel",
]

FIRST_HOUR = 19.0
"""Local time at which the tabulated night begins [h]."""

RANDOM_NIGHT_H = (12.0, 36.0, 0.25)
"""First, last and step of the times at which a random night is drawn [h]: the same for all its exposures."""

RANGE_MARGIN_UM = 1e-3

LINE_LIST = "PALACE OH (Noll et al. 2025)"


@dataclasses.dataclass(frozen=True)
class SkyExposure:
    """One exposure of the sky.

    Parameters
    ----------
    exposure_id, day_obs : `int`
        Number of the exposure and of its night; they decide the noise and a random night.
    hour : `float`
        Local time, in hours; after midnight on beyond 24.
    exposure_s, airmass : `float`
        Exposure time [s] and airmass.
    physical_filter : `str`
        Filter, as the instrument names it.
    """

    exposure_id: int
    day_obs: int
    hour: float
    exposure_s: float
    airmass: float
    physical_filter: str


@dataclasses.dataclass(frozen=True)
class SkyModel:
    """All that the response of a sensor to the sky depends on; the hour is not among it.

    Parameters
    ----------
    choice : `tuple`
        Set-up, and sorted pairs of effects and values.
    field_x_deg, field_y_deg : `float`
        Place of the sensor in the field [deg].
    airmass, solar_flux_sfu : `float`
        Airmass, and solar radio flux [sfu].
    rotational_temperature_k, vibrational_temperature_k : `float` or `None`
        Temperatures of OH [K].
    thickness_range_um : `tuple` [`float`, `float`]
        Thicknesses of the map [µm].
    """

    choice: tuple[str, tuple[tuple[str, float], ...]]
    field_x_deg: float
    field_y_deg: float
    airmass: float
    solar_flux_sfu: float
    rotational_temperature_k: float | None
    vibrational_temperature_k: float | None
    thickness_range_um: tuple[float, float]

    def fringe_model(self) -> FringeModel:
        """Sensor behind the telescope."""
        setup, effects = self.choice
        return ModelChoice(setup, dict(effects)).model(
            field_x_deg=self.field_x_deg, field_y_deg=self.field_y_deg
        )

    def spectrum(self) -> SkySpectrum:
        """Dark sky with all OH bands at their reference intensity."""
        lines = EmissionLines.oh(self.rotational_temperature_k, self.vibrational_temperature_k)
        return SkySpectrum.dark(lines, self.airmass, solar_flux_sfu=self.solar_flux_sfu)


@functools.lru_cache(maxsize=4)
def _responses(sky_model: SkyModel) -> tuple[FringeModel, SkySpectrum, SkyResponse]:
    """Model, sky and response, shared by the exposures of a night that this process simulates.

    The response takes seconds, a frame tenths of one.
    """
    model, sky = sky_model.fringe_model(), sky_model.spectrum()
    return model, sky, sky_response(model, sky, thickness_range_um=sky_model.thickness_range_um)


class SkyFringeSimConnections(PipelineTaskConnections, dimensions=("instrument", "exposure", "detector")):
    """A thickness map in, one sky frame out."""

    config: SkyFringeSimConfig

    thickness = Input(
        doc="Thickness of the varying layer.",
        name="epoxyThickness",
        storageClass="ThicknessMap",
        dimensions=("instrument", "detector"),
    )
    sky = Output(
        doc="Night sky with its fringes, in electrons.",
        name="skyFringe",
        storageClass="SkyFringe",
        dimensions=("instrument", "exposure", "detector"),
    )

    def adjust_all_quanta(self, adjuster: QuantaAdjuster) -> None:
        """Keep the exposures of the sky in the band of the set-up: laboratory frames have exposures too."""
        for data_id in list(adjuster.iter_data_ids()):
            expanded = adjuster.expand_quantum_data_id(data_id)
            exposure: Any = expanded.records["exposure"]
            wanted = exposure.observation_type in self.config.observation_types
            if not wanted or expanded["band"] != self.config.band:
                adjuster.remove_quantum(data_id)


class SkyFringeSimConfig(FringeModelConfig, PipelineTaskConfig, pipelineConnections=SkyFringeSimConnections):
    """Configuration of `SkyFringeSimTask`."""

    task_name: ClassVar[str] = "skyFringeSim"

    observation_types: ListField[str] = ListField(
        dtype=str, default=["science"], doc="Observation types of exposures that show the sky."
    )
    night: ChoiceField[str] = ChoiceField(
        dtype=str,
        default="guo2022",
        doc="How the OH bands change with time.",
        allowed={
            "guo2022": "the hourly table of Guo et al. 2022, after Noll et al. 2015; from 19 h to 5 h",
            "random": "a random night, the same for all exposures and sensors of its date and this seed",
            "steady": "not at all",
        },
    )
    level: ChoiceField[str] = ChoiceField(
        dtype=str,
        default="model",
        doc="Mean level of a frame.",
        allowed={
            "model": "what the stack itself detects",
            "throughput": "what the measured quantum efficiency in the throughput tables detects",
        },
    )
    noise: Field[bool] = Field(dtype=bool, default=False, doc="Whether photon and read noise are added.")
    seed: Field[int] = Field(
        dtype=int,
        default=0,
        doc="With exposure and sensor, the seed of the noise; with the date, of random nights.",
    )
    rotational_temperature_k: Field[float] = Field(
        dtype=float, optional=True, doc="Rotational temperature of OH, K; by default the PALACE populations."
    )
    vibrational_temperature_k: Field[float] = Field(
        dtype=float, optional=True, doc="Vibrational temperature of OH, K; by default the PALACE populations."
    )
    solar_flux_sfu: Field[float] = Field(
        dtype=float, default=129.0, doc="Solar radio flux, sfu, which scales the airglow continuum."
    )

    def setDefaults(self) -> None:
        """Look at the sky."""
        super().setDefaults()
        self.setup = "lsst_e2v"

    def validate(self) -> None:
        """Refuse set-ups without a sky, or of different bands."""
        super().validate()
        if self.seed < 0:
            raise FieldValidationError(type(self).seed, self, "must not be negative")
        for raft in ("", *self.rafts):
            setup = Setup.from_name(self.choice(raft).setup)
            if setup.kind != "sky":
                raise FieldValidationError(
                    type(self).setup, self, f"set-up {setup.name} does not see the sky"
                )
            if _band(setup) != self.band:
                message = f"raft {raft} has band {_band(setup)}, the others have {self.band}"
                raise FieldValidationError(type(self).rafts, self, message)

    @property
    def band(self) -> str:
        """Band of the set-up, as ``y``."""
        return _band(Setup.from_name(self.setup))


def _band(setup: Setup) -> str:
    return setup.bandpass.rpartition("_")[2]


class SkyFringeSimTask(PipelineTask):
    """Simulate the sky of one exposure on one sensor."""

    ConfigClass = SkyFringeSimConfig
    config: SkyFringeSimConfig
    _DefaultName = "skyFringeSim"

    def runQuantum(
        self,
        butlerQC: QuantumContext,
        inputRefs: InputQuantizedConnection,
        outputRefs: OutputQuantizedConnection,
    ) -> None:
        """Read the map, simulate, store."""
        data_id = data_id_of(butlerQC)
        detector = sensor_of(data_id)
        record: Any = data_id.records["exposure"]
        with unusable(f"{detector.name}, exposure {record.id}"):
            setup = Setup.from_name(self.config.choice(detector.raft).setup)
            exposure = SkyExposure(
                exposure_id=record.id,
                day_obs=record.day_obs,
                hour=hour_of_night(record),
                exposure_s=record.exposure_time,
                airmass=airmass_of(record) or setup.airmass,
                physical_filter=str(data_id["physical_filter"]),
            )
            result = self.run(butlerQC.get(inputRefs.thickness), exposure, detector)
        butlerQC.put(result, outputRefs)

    def run(self, thickness: ThicknessMap, exposure: SkyExposure, detector: Detector) -> Struct:
        """Simulate one frame.

        Parameters
        ----------
        thickness : `ThicknessMap`
            Thickness of the varying layer of this sensor.
        exposure : `SkyExposure`
            When, how long, through what.
        detector : `Detector`
            The sensor; its place in the focal plane decides the beam.

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
        choice = self.config.choice(detector.raft)
        _check_map(thickness, choice)
        if choice.left_out:
            self.log.info("%s: on the sky without %s", detector.name, ", ".join(choice.left_out))
        known = np.where(thickness.mask & mask_bits("NO_DATA"), np.float32(np.nan), thickness.value)
        model, sky, response = _responses(self._sky_model(choice, exposure, detector, known))
        scale = self._band_scale(exposure, sky.lines)
        frame = simulate_sky_frame(
            known,
            model,
            response=response,
            scale={name: factor for name, factor in scale.items() if name in response.component},
            exposure_s=exposure.exposure_s,
            mean_electrons=self._level(sky.with_band_scale(scale), model, exposure),
            read_noise_e=detector.read_noise,
            seed=self._seed(exposure, detector) if self.config.noise else None,
            hour=exposure.hour,
            detector=detector.name,
            physical_filter=exposure.physical_filter,
        )
        metadata = {
            **common_header(),
            **choice.header(),
            "LINELIST": LINE_LIST,
            "NIGHT": self.config.night,
            "LEVEL": self.config.level,
            **{f"BAND {name}": factor for name, factor in scale.items()},
            **frame.metadata,
        }
        self.log.info(
            "%s at %.2f h: %.0f e, fringe rms %.4f %%, quadrature error %.1e",
            *(detector.name, exposure.hour, frame.mean_electrons),
            *(100.0 * float(frame.metadata["FRINGRMS"]), frame.quadrature_error),
        )
        # What the map calls doubtful stays doubtful.
        return Struct(sky=dataclasses.replace(frame, mask=frame.mask | thickness.mask, metadata=metadata))

    def _sky_model(
        self,
        choice: ModelChoice,
        exposure: SkyExposure,
        detector: Detector,
        thickness_um: NDArray[np.float32],
    ) -> SkyModel:
        return SkyModel(
            choice=(choice.setup, tuple(sorted(choice.applied_effects.items()))),
            field_x_deg=_place(detector.field_x_deg),
            field_y_deg=_place(detector.field_y_deg),
            airmass=exposure.airmass,
            solar_flux_sfu=self.config.solar_flux_sfu,
            rotational_temperature_k=self.config.rotational_temperature_k,
            vibrational_temperature_k=self.config.vibrational_temperature_k,
            thickness_range_um=_range_of(thickness_um),
        )

    def _band_scale(self, exposure: SkyExposure, lines: EmissionLines) -> Mapping[str, float]:
        """Factors on the OH bands at the time of the exposure."""
        if self.config.night == "steady":
            return {}
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
        return int(sequence.generate_state(1, np.uint64)[0] >> 1)


def _place(angle_deg: float) -> float:
    """Field angle; zero for cameras without one, whose beam is the same everywhere."""
    return angle_deg if math.isfinite(angle_deg) else 0.0


def _at_hour(night: NightHistory, hour: float) -> NightHistory:
    """The night at one time, interpolated linearly.

    Raises
    ------
    OutOfRangeError
        The night does not reach so far.
    """
    first, last = float(night.hours[0]), float(night.hours[-1])
    # The middle of an exposure is known to rounding only.
    if not first - 1e-6 <= hour <= last + 1e-6:
        raise OutOfRangeError("time since the beginning of the night [h]", hour, f"{first:g} to {last:g}")
    intensity = [np.interp(hour, night.hours, level) for level in night.intensity.T]
    return NightHistory(np.array([hour]), night.upper_level, np.array([intensity]))


def _range_of(thickness_um: NDArray[np.float32]) -> tuple[float, float]:
    """Range of the known thicknesses, widened so that rounding cannot leave it."""
    finite = thickness_um[np.isfinite(thickness_um)]
    if finite.size == 0:
        raise InputError("thickness map", "no known thickness", "one in at least one pixel")
    return max(float(finite.min()) - RANGE_MARGIN_UM, 0.0), float(finite.max()) + RANGE_MARGIN_UM


def _check_map(thickness: ThicknessMap, choice: ModelChoice) -> None:
    """Refuse a map that means something else than the model takes it for."""
    varying = Setup.from_name(choice.setup).varying
    if thickness.layer != varying:
        raise InputError("layer of the thickness map", thickness.layer, varying)
    if "SETUP" not in thickness.metadata:
        return  # not fitted here
    fitted = _effects_in(thickness.metadata)
    on_sky = ModelChoice(choice.setup, fitted).applied_effects
    if on_sky != choice.applied_effects:
        raise InputError(
            "effects of skyFringeSim",
            choice.applied_effects,
            f"{on_sky}, with which the thickness was fitted",
            source=thickness.detector or None,
        )


def _effects_in(header: Mapping[str, Any]) -> dict[str, float]:
    numbers = [key.removeprefix("EFFECT") for key in header if key.startswith("EFFECT")]
    return {str(header[f"EFFECT{number}"]): float(header[f"EFFVAL{number}"]) for number in numbers}
