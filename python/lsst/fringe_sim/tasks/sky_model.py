"""What the tasks that look at the sky share: set-up, spectrum, beams, and stand-ins for missing thickness maps."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from lsst.daf.butler import DataCoordinate
from lsst.pex.config import ChoiceField, Field, FieldValidationError, ListField, RangeField
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input

from ..algorithms.field_response import SensorPlacement
from ..algorithms.island_response import response_with_islands
from ..algorithms.sky_frame import sky_response
from ..algorithms.sky_of_maps import SiliconSeries, known_silicon_um, silicon_nodes_um, sky_of_maps
from ..algorithms.sky_response import Response
from ..algorithms.thickness_stand_in import stand_in_thickness
from ..array_types import Float32Array, FloatArray
from ..effects import activate_effects, known_effects
from ..effects.active import settings_of
from ..errors import InputError, to_number
from ..instrument.detector import Detector
from ..instrument.flat_spectrum import FlatSpectrum
from ..instrument.sky import EmissionLines, SkySpectrum
from ..model import LABORATORY_TEMPERATURE, FringeModel, Setup
from ..model.provenance import effects_of_header
from ..products import SensorSection, ThicknessMap
from ..products.sensor_section import SECTION_KEYWORDS
from ..products.thickness_map import thickness_span_um
from .model_config import FringeModelConfig, ModelChoice
from .quantum import SENSOR, common_header

LINE_LIST = "PALACE OH (Noll et al. 2025)"


@dataclasses.dataclass(frozen=True)
class SkyModel:
    """All that the response of a sensor to the sky depends on; the hour is not among it."""

    choice: tuple[str, tuple[tuple[str, float], ...]]  # set-up, and sorted pairs of effects and values
    placement: SensorPlacement  # place of the sensor in the field
    beams: str  # ``pixel`` or ``centre``
    # airmass, solar_flux_sfu: airmass, and solar radio flux [sfu]
    airmass: float
    solar_flux_sfu: float
    # rotational_temperature_k, vibrational_temperature_k: temperatures of OH
    rotational_temperature_k: float | None
    vibrational_temperature_k: float | None
    thickness_range_um: tuple[float, float]  # thicknesses of the map
    laboratory_temperature_k: float | None = None  # at which it was measured, if it states that
    phase_sigma: float = 0.0  # of the adhesive between laboratory and sky [rad per 10 K]
    silicon_nodes_um: tuple[float, ...] | None = None  # thicknesses of the silicon; that of the stack without
    flat_spectrum: str | None = None  # light of the flat field, see `FlatSpectrum.from_name`

    def fringe_model(self) -> FringeModel:
        """Sensor behind the telescope."""
        setup, effects = self.choice
        model = ModelChoice(setup, dict(effects)).model(
            field_x_deg=self.placement.field_x_deg, field_y_deg=self.placement.field_y_deg
        )
        stated = self.laboratory_temperature_k
        return model if stated is None else model.at_laboratory_temperature({LABORATORY_TEMPERATURE: stated})

    def spectrum(self) -> SkySpectrum:
        """Dark sky with all OH bands at their reference intensity."""
        lines = EmissionLines.oh(self.rotational_temperature_k, self.vibrational_temperature_k)
        dark = SkySpectrum.dark(lines, self.airmass, solar_flux_sfu=self.solar_flux_sfu)
        flat = FlatSpectrum.from_name(self.flat_spectrum) if self.flat_spectrum else None
        return dataclasses.replace(dark, flat=flat)

    def response(self, silicon_um: FloatArray | None = None) -> tuple[FringeModel, SkySpectrum, Response]:
        """Model, sky and response, shared by the exposures of a night that this process simulates.

        The response takes seconds, for every thickness of the silicon, a frame tenths of one. ``silicon_um``: map of
        the silicon, if it has one.
        """
        model, sky, series = _response(self)
        return model, sky, series.on(silicon_um)


@functools.lru_cache(maxsize=4)
def _response(sky_model: SkyModel) -> tuple[FringeModel, SkySpectrum, SiliconSeries]:
    model, sky = sky_model.fringe_model(), sky_model.spectrum()

    def in_one_beam(own: FringeModel, span: tuple[float, float], like: tuple[Response, ...]) -> Response:
        return response_with_islands(own, lambda part: sky_response(part, sky, thickness_range_um=span))

    series = sky_of_maps(
        model,
        sky,
        sky_model.placement,
        sky_model.thickness_range_um,
        sky_model.silicon_nodes_um,
        phase_sigma=sky_model.phase_sigma,
        respond=in_one_beam if sky_model.beams == "centre" else None,
    )
    return model, sky, series


class SensorSky(NamedTuple):
    """A sensor under the sky: thickness of its layer [µm], NaN where a map is not known, and what it responds."""

    known_um: Float32Array
    sky_model: SkyModel
    model: FringeModel
    sky: SkySpectrum
    response: Response


class SkyModelConfig(FringeModelConfig):
    """Set-up, effects, spectrum and beams of the sky, and what replaces a thickness map that does not exist."""

    beams = ChoiceField[str](
        default="pixel",
        doc="Which beam a pixel sees, where the telescope has one that varies over the field.",
        allowed={
            "pixel": "that of its own place; maps of any number of pixels cover the whole sensor",
            "centre": "that of the centre of its sensor, as in Guo et al. 2022; wrong by 15 % of the peak-to-peak "
            "and more",
        },
    )
    stand_in = Field[bool](
        default=False,
        doc="Whether a sensor without a thickness map gets a random field with the statistics of measured ones.",
    )
    stand_in_seed = Field[int](
        default=0, doc="With the number of the sensor, the seed of its stand-in.", check=lambda n: n >= 0
    )
    stand_in_shape = ListField[int](
        optional=True, length=2, doc="Rows and columns of stand-ins; by default those of the sensor."
    )
    rotational_temperature_k = Field[float](
        optional=True, doc="Rotational temperature of OH, K; by default the PALACE populations."
    )
    vibrational_temperature_k = Field[float](
        optional=True, doc="Vibrational temperature of OH, K; by default the PALACE populations."
    )
    solar_flux_sfu = Field[float](
        default=129.0, doc="Solar radio flux, sfu, which scales the airglow continuum."
    )

    flat_spectrum = Field[str](
        optional=True,
        doc="Light of the flat field: white, gaussian:MEAN:FWHM in nm, or a table with columns wavelength and "
        "photons; by default white where every pixel has its own beam, and none otherwise.",
    )

    def setDefaults(self) -> None:
        """Look at the sky."""
        super().setDefaults()
        self.setup = "lsst_e2v"

    def validate(self) -> None:
        """Refuse set-ups without a sky, or of different bands."""
        super().validate()
        for raft in ("", *self.rafts):
            setup = Setup.from_name(self.choice(raft).setup)
            if setup.kind != "sky":
                raise FieldValidationError(
                    SkyModelConfig.setup, self, f"set-up {setup.name} does not see the sky"
                )
            if _band(setup) != self.band:
                message = f"raft {raft} has band {_band(setup)}, the others have {self.band}"
                raise FieldValidationError(SkyModelConfig.rafts, self, message)

    @property
    def band(self) -> str:
        """Band of the set-up, as ``y``."""
        return _band(Setup.from_name(self.setup))

    def map_of(self, thickness: ThicknessMap | None, detector: Detector) -> ThicknessMap:
        """The map of a sensor, or its stand-in."""
        choice = self.choice_of(detector)
        if thickness is not None:
            _check_map(thickness, choice)
            return thickness
        if not self.stand_in:
            raise InputError("thickness map", None, "one, or stand_in=True", source=detector.name)
        shape = (self.stand_in_shape[0], self.stand_in_shape[1]) if self.stand_in_shape else None
        return stand_in_thickness(Setup.from_name(choice.setup), detector, self.stand_in_seed, shape)

    def sky_model(
        self, detector: Detector, airmass: float, thickness_um: Float32Array, header: Mapping[str, Any]
    ) -> SkyModel:
        """What the response of a sensor depends on; the header of its map says which part of it the map shows."""
        rows, columns = thickness_um.shape
        section = SensorSection.of_image(detector, (rows, columns), header)
        choice = self.choice_of(detector)
        setup = Setup.from_name(choice.setup)
        stated = header.get(LABORATORY_TEMPERATURE)
        return SkyModel(
            choice=(choice.setup, tuple(sorted(choice.applied_effects.items()))),
            placement=SensorPlacement.of(detector, setup.pixel_scale_arcsec, section),
            beams=self.beams,
            airmass=airmass,
            solar_flux_sfu=self.solar_flux_sfu,
            rotational_temperature_k=self.rotational_temperature_k,
            vibrational_temperature_k=self.vibrational_temperature_k,
            thickness_range_um=thickness_span_um(thickness_um),
            laboratory_temperature_k=None if stated is None else to_number(LABORATORY_TEMPERATURE, stated),
            flat_spectrum=self.flat_spectrum,
        )


class MapConnections(base.PipelineTaskConnections, dimensions=SENSOR):
    """A thickness map in, of science sensors."""

    config: Any

    thickness = Input(
        "epoxyThickness",
        "ThicknessMap",
        "Thickness of the varying layer; not needed where the configuration allows stand-ins.",
        dimensions=SENSOR,
    )

    def __init__(self, *, config: Any = None) -> None:
        if config is not None and config.stand_in:
            # For sensors with and without a map.
            self.thickness = dataclasses.replace(self.thickness, minimum=0, deferGraphConstraint=True)

    def adjust_all_quanta(self, adjuster: base.QuantaAdjuster) -> None:
        """Keep the science sensors, and of them what is wanted."""
        for data_id in list(adjuster.iter_data_ids()):
            expanded = adjuster.expand_quantum_data_id(data_id)
            record: Any = expanded.records["detector"]
            if record.purpose != "SCIENCE" or not self.wants(expanded):
                adjuster.remove_quantum(data_id)

    def wants(self, data_id: DataCoordinate) -> bool:
        """Whether there is a quantum for an expanded data id of a science sensor."""
        return True


class SensorMapsConnections(MapConnections, dimensions=SENSOR):
    """Maps of a sensor in, of both layers."""

    silicon = Input(
        "siliconThickness",
        "ThicknessMap",
        "Thickness of the silicon on the same pixels; only where the configuration asks for it.",
        dimensions=SENSOR,
    )

    def __init__(self, *, config: Any = None) -> None:
        super().__init__(config=config)
        if config is not None and config.silicon != "map":
            del self.silicon

    def wants(self, data_id: DataCoordinate) -> bool:
        """Whether the filter is in the band of the set-up."""
        return bool(data_id["band"] == self.config.band)


class SensorMapsConfig(SkyModelConfig):
    """What the maps of a sensor say of its sky: also the silicon, and what is not known of the adhesive."""

    silicon = ChoiceField[str](
        default="even",
        doc="Thickness of the silicon above the varying layer.",
        allowed={
            "even": "that of the stack, the same everywhere",
            "map": "that of a map, which a fit to flats with a narrow line makes",
        },
    )
    phase_sigma: Any = RangeField(
        dtype=float,
        default=0.3,
        min=0.0,
        max=2.0,
        inclusiveMax=True,
        doc="Standard uncertainty of the phase of the adhesive between laboratory and sky temperature, rad per "
        "10 K; what it leaves open goes into the header. Its value is the effect epoxy_temperature.phase_per_10k.",
    )

    def sensor_sky(
        self, detector: Detector, airmass: float, layer: ThicknessMap, silicon: ThicknessMap | None
    ) -> SensorSky:
        """Response of a sensor to the sky, and the thickness of the layer on the pixels where all maps are known."""
        known, silicon_um = layer.known_um(), None
        if silicon is not None:
            setup = Setup.from_name(self.choice_of(detector).setup)
            silicon_um = known_silicon_um(silicon, known.shape, setup, sensor=layer.detector)
            known = np.where(np.isfinite(silicon_um), known, np.float32(np.nan))
        made = self.sky_model(detector, airmass, known, layer.metadata)
        made = dataclasses.replace(made, phase_sigma=self.phase_sigma)
        if silicon_um is not None:
            nodes = silicon_nodes_um(made.fringe_model(), silicon_um)
            made = dataclasses.replace(made, silicon_nodes_um=nodes)
        return SensorSky(known, made, *made.response(silicon_um))

    def map_header(
        self, detector: Detector, layer: ThicknessMap, *, stand_in: bool, silicon: bool
    ) -> dict[str, Any]:
        """Header keywords of what is made of the maps of a sensor."""
        return {
            **common_header(self),
            **self.choice_of(detector).header(),
            **{key: layer.metadata[key] for key in ("STANDSD", *SECTION_KEYWORDS) if key in layer.metadata},
            "LINELIST": LINE_LIST,
            "BEAMS": self.beams,
            "STANDIN": stand_in,
            "SIMAP": silicon,
        }


def maps_of(butlerQC: base.QuantumContext, inputRefs: Any) -> list[ThicknessMap | None]:
    """Maps of the varying layer and of the silicon, `None` for those that a quantum does without."""
    return [
        butlerQC.get(getattr(inputRefs, name)) if hasattr(inputRefs, name) else None
        for name in ("thickness", "silicon")
    ]


def _band(setup: Setup) -> str:
    return setup.filter_name.rpartition("_")[2]


def _check_map(thickness: ThicknessMap, choice: ModelChoice) -> None:
    """Refuse a map that means something else than the model takes it for."""
    thickness.of_setup(Setup.from_name(choice.setup))
    if "SETUP" not in thickness.metadata:
        return  # not fitted here
    fitted = effects_of_header(thickness.metadata)
    on_sky = _of_the_map(ModelChoice(choice.setup, fitted).applied_effects)
    wanted = _of_the_map(choice.applied_effects)
    if on_sky != wanted:
        raise InputError(
            "effects on the sky",
            wanted,
            f"{on_sky}, with which the thickness was fitted",
            source=thickness.detector,
        )


def _of_the_map(settings: Mapping[str, float]) -> dict[str, float]:
    """Those effects on which the thickness depends that flats give: not those of the sky alone."""
    active = activate_effects(settings, known_effects())
    return settings_of(item for item in active if not item.effect.sky_only)
