"""Headers of raw frames as `astro_metadata_translator` understands them.

The interpretation itself is that of `RawMetadata`; these classes only name its fields as the translator wants
them. Their registered names differ from those of Rubin's own translators, so that both can be installed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import astropy.units as u
from astro_metadata_translator import FitsTranslator, PropertyDefinition, cache_translation
from astropy.time import Time, TimeDelta

from ..errors import InputError
from ..instrument.raw_metadata import DAY_ROLLOVER_H, RawMetadata
from .instruments import INSTRUMENTS, MONOCHROMATOR, NO_FILTER

NO_TARGET = "none"


def target_name(metadata: RawMetadata) -> str:
    """What was observed: the wavelength of a monochromatic flat, as ``0960.030 nm``.

    Of fixed width, so that the order of the texts is that of the wavelengths and a query can ask for a range.
    """
    if metadata.wavelength_nm is None:
        return NO_TARGET
    return f"{metadata.wavelength_nm:08.3f} nm"


_EXTENSIONS = {
    "wavelength_nm": PropertyDefinition("Wavelength of the monochromator in nm", "float", float),
    "temperature_k": PropertyDefinition("Temperature of the CCD in K", "float", float),
}

# What a header from the laboratory does not tell.
_NOT_KNOWN: dict[str, Any] = {
    "telescope": None,
    "location": None,
    "boresight_rotation_angle": None,
    "boresight_rotation_coord": None,
    "tracking_radec": None,
    "altaz_begin": None,
    "altaz_end": None,
    "focus_z": None,
    "temperature": None,
    "pressure": None,
    "relative_humidity": None,
    "has_simulated_content": False,
}

# The parent class maps keywords that these headers use for something else.
_FROM_ONE_KEYWORD: dict[str, Any] = {}


class FringeTranslator(FitsTranslator):
    """Translation of any header in the LSST raw layout; the subclasses say of which instrument."""

    camera_name: ClassVar[str]

    extensions = _EXTENSIONS
    _const_map = _NOT_KNOWN
    _trivial_map = _FROM_ONE_KEYWORD

    @classmethod
    def can_translate(cls, header: Mapping[str, Any], filename: str | None = None) -> bool:
        """Whether the header is that of a raw frame of this instrument."""
        try:
            return RawMetadata.from_header(header, source="header").camera == cls.camera_name
        except InputError:
            return False

    @property
    def raw_metadata(self) -> RawMetadata:
        """The header, interpreted."""
        found: RawMetadata | None = self.__dict__.get("_raw_metadata")
        if found is None:
            found = RawMetadata.from_header(self._header, source=self.filename or "header")
            self.__dict__["_raw_metadata"] = found
        return found

    @cache_translation
    def to_observation_id(self) -> str:
        """Name of the exposure: the header's own, or instrument and number."""
        stated = str(self._header.get("OBSID") or "").strip()
        return stated or f"{self.to_instrument()}_{self.raw_metadata.exposure_id}"


def _begin(metadata: RawMetadata) -> Time:
    return Time(metadata.date_obs, format="datetime", scale=metadata.time_scale).tai


def _physical_filter(metadata: RawMetadata) -> str:
    """Filter of the camera, else the monochromator, else none."""
    if metadata.filter_name and metadata.camera != "ts8":
        return metadata.filter_name
    return NO_FILTER if metadata.wavelength_nm is None else MONOCHROMATOR


_FROM_METADATA: dict[str, Callable[[RawMetadata], Any]] = {
    "instrument": lambda m: INSTRUMENTS[m.camera].getName(),
    "exposure_id": lambda m: m.exposure_id,
    "visit_id": lambda m: m.exposure_id,  # every exposure is a visit, and a group of its own
    "exposure_group": lambda m: str(m.exposure_id),
    "observing_day": lambda m: m.day_obs,
    "observing_day_offset": lambda m: TimeDelta(DAY_ROLLOVER_H[m.camera] * 3600, format="sec", scale="tai"),
    "observation_counter": lambda m: m.seq_num,
    "group_counter_start": lambda m: m.seq_num,
    "group_counter_end": lambda m: m.seq_num,
    "observation_type": lambda m: m.observation_type,
    "observation_reason": lambda m: m.test_type or "unknown",
    "object": target_name,
    "science_program": lambda m: m.run or "unknown",
    "physical_filter": _physical_filter,
    "exposure_time": lambda m: m.exposure_time_s * u.s,
    "exposure_time_requested": lambda m: m.exposure_time_s * u.s,  # the header has but one
    "dark_time": lambda m: m.dark_time_s * u.s,
    "datetime_begin": _begin,
    "datetime_end": lambda m: _begin(m) + m.exposure_time_s * u.s,
    "can_see_sky": lambda m: m.observation_type == "science",
    "boresight_airmass": lambda m: m.airmass,
    "detector_num": lambda m: m.detector,
    "detector_name": lambda m: m.slot,
    "detector_group": lambda m: m.raft,
    "detector_unique_name": lambda m: f"{m.raft}_{m.slot}",
    "detector_serial": lambda m: m.serial or "unknown",
    "detector_exposure_id": lambda m: m.exposure_id * 1000 + m.detector,
    "ext_wavelength_nm": lambda m: m.wavelength_nm,
    "ext_temperature_k": lambda m: m.temperature_k,
}
"""What the translator calls a property, and how it follows from the header."""


def _translation(name: str, value: Callable[[RawMetadata], Any]) -> Callable[[FringeTranslator], Any]:
    def translate(self: FringeTranslator) -> Any:
        return value(self.raw_metadata)

    translate.__name__ = f"to_{name}"
    return cache_translation(translate)


for _name, _value in _FROM_METADATA.items():
    setattr(FringeTranslator, f"to_{_name}", _translation(_name, _value))


class FringeTs8Translator(FringeTranslator):
    """Raw frames of the test stand TS8."""

    name = "LSST-TS8 fringe"
    camera_name = "ts8"


class FringeLsstCamTranslator(FringeTranslator):
    """Raw frames of the LSST Camera."""

    name = "LSSTCam fringe"
    camera_name = "lsstCam"


class FringeMonoCamTranslator(FringeTranslator):
    """Raw frames of MonoCam."""

    name = "MonoCam fringe"
    camera_name = "monocam"


TRANSLATORS: dict[str, type[FringeTranslator]] = {
    cls.camera_name: cls for cls in (FringeTs8Translator, FringeLsstCamTranslator, FringeMonoCamTranslator)
}
"""Translator by the name of its camera."""
