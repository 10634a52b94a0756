"""Headers of raw frames as `astro_metadata_translator` understands them.

The interpretation itself is that of `RawMetadata`; these classes only name its fields as the translator wants
them. Their registered names differ from those of Rubin's own translators, so that both can be installed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import astropy.units as u
from astro_metadata_translator import FitsTranslator, PropertyDefinition, cache_translation
from astropy.time import Time, TimeDelta

from ..errors import InputError
from ..instrument.raw_metadata import DAY_ROLLOVER_H, RawMetadata
from .instruments import INSTRUMENTS, MONOCHROMATOR, NO_FILTER

__all__ = [
    "TRANSLATORS",
    "FringeLsstCamTranslator",
    "FringeMonoCamTranslator",
    "FringeTranslator",
    "FringeTs8Translator",
    "target_name",
]

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
    "boresight_airmass": None,
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
            return RawMetadata.from_header(header, source=filename or "header").camera == cls.camera_name
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
    def to_instrument(self) -> str:
        """Name of the instrument in data ids."""
        return INSTRUMENTS[self.raw_metadata.camera].getName()

    @cache_translation
    def to_exposure_id(self) -> int:
        """Number of the exposure."""
        return self.raw_metadata.exposure_id

    @cache_translation
    def to_visit_id(self) -> int:
        """Number of the visit: every exposure is one."""
        return self.raw_metadata.exposure_id

    @cache_translation
    def to_exposure_group(self) -> str:
        """Every exposure is a group of its own."""
        return str(self.raw_metadata.exposure_id)

    @cache_translation
    def to_observation_id(self) -> str:
        """Name of the exposure: the header's own, or instrument and number."""
        stated = str(self._header.get("OBSID") or "").strip()
        return stated or f"{self.to_instrument()}_{self.raw_metadata.exposure_id}"

    @cache_translation
    def to_observing_day(self) -> int:
        """Observing day, YYYYMMDD."""
        return self.raw_metadata.day_obs

    @cache_translation
    def to_observing_day_offset(self) -> TimeDelta:
        """UTC hour at which the observing day begins."""
        seconds = DAY_ROLLOVER_H[self.raw_metadata.camera] * 3600
        return TimeDelta(seconds, format="sec", scale="tai")

    @cache_translation
    def to_observation_counter(self) -> int:
        """Number of the exposure within the day."""
        return self.raw_metadata.seq_num

    @cache_translation
    def to_group_counter_start(self) -> int:
        """First number of the group."""
        return self.raw_metadata.seq_num

    @cache_translation
    def to_group_counter_end(self) -> int:
        """Last number of the group."""
        return self.raw_metadata.seq_num

    @cache_translation
    def to_observation_type(self) -> str:
        """Kind of the frame: bias, flat, …."""
        return self.raw_metadata.observation_type

    @cache_translation
    def to_observation_reason(self) -> str:
        """Kind of the test: lambda, …."""
        return self.raw_metadata.test_type or "unknown"

    @cache_translation
    def to_object(self) -> str:
        """Wavelength of a monochromatic flat; see `target_name`."""
        return target_name(self.raw_metadata)

    @cache_translation
    def to_science_program(self) -> str:
        """Run of the test stand."""
        return self.raw_metadata.run or "unknown"

    @cache_translation
    def to_physical_filter(self) -> str:
        """Filter of the camera, else the monochromator, else none."""
        metadata = self.raw_metadata
        if metadata.filter_name and metadata.camera != "ts8":
            return metadata.filter_name
        return NO_FILTER if metadata.wavelength_nm is None else MONOCHROMATOR

    @cache_translation
    def to_exposure_time(self) -> u.Quantity:
        """Time with the shutter open."""
        return self.raw_metadata.exposure_time_s * u.s

    @cache_translation
    def to_exposure_time_requested(self) -> u.Quantity:
        """Time asked for: the header has but one."""
        return self.raw_metadata.exposure_time_s * u.s

    @cache_translation
    def to_dark_time(self) -> u.Quantity:
        """Time since the CCD was cleared."""
        return self.raw_metadata.dark_time_s * u.s

    @cache_translation
    def to_datetime_begin(self) -> Time:
        """Start of the exposure."""
        return Time(self.raw_metadata.date_obs, format="datetime", scale="utc").tai

    @cache_translation
    def to_datetime_end(self) -> Time:
        """End of the exposure."""
        return self.to_datetime_begin() + self.raw_metadata.exposure_time_s * u.s

    @cache_translation
    def to_can_see_sky(self) -> bool:
        """Whether the frame shows the sky."""
        return self.raw_metadata.observation_type == "science"

    @cache_translation
    def to_detector_num(self) -> int:
        """Number of the sensor."""
        return self.raw_metadata.detector

    @cache_translation
    def to_detector_name(self) -> str:
        """Slot of the sensor."""
        return self.raw_metadata.slot

    @cache_translation
    def to_detector_group(self) -> str:
        """Raft of the sensor."""
        return self.raw_metadata.raft

    @cache_translation
    def to_detector_unique_name(self) -> str:
        """Name of the sensor."""
        return f"{self.raw_metadata.raft}_{self.raw_metadata.slot}"

    @cache_translation
    def to_detector_serial(self) -> str:
        """Serial number of the sensor."""
        return self.raw_metadata.serial or "unknown"

    @cache_translation
    def to_detector_exposure_id(self) -> int:
        """Number of sensor and exposure together."""
        return self.raw_metadata.exposure_id * 1000 + self.raw_metadata.detector

    @cache_translation
    def to_ext_wavelength_nm(self) -> float | None:
        """Wavelength of the monochromator."""
        return self.raw_metadata.wavelength_nm

    @cache_translation
    def to_ext_temperature_k(self) -> float | None:
        """Temperature of the CCD."""
        return self.raw_metadata.temperature_k


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
