"""What the header of a raw frame says about the exposure.

What a header lacks is derived where the rest decides it, else refused with one `FrameFormatError` that names
file, keyword, value and what is allowed. No file is opened here.
"""

from __future__ import annotations

import dataclasses
import datetime
import re
from collections.abc import Mapping
from typing import Any

from ..errors import FrameFormatError, UnknownNameError, named_units
from .camera import Camera, Detector
from .raw_checks import refuse_no_flat, refuse_other_instrument, refuse_other_sensor, refuse_stutter
from .raw_header import DeclaredHeader, header_value
from .raw_times import DAY_ROLLOVER_H, begin_of_exposure, day_and_sequence, exposure_id, time_scale
from .stated_facts import NO_READING_C, SAME_SECONDS, refuse_contradictions, refuse_other_filter

__all__ = ["DAY_ROLLOVER_H", "OBSERVATION_TYPES", "RawMetadata", "header_value", "is_of_lsst"]

OBSERVATION_TYPES: Mapping[str, str] = {
    "BIAS": "bias",
    "ZERO": "bias",
    "DARK": "dark",
    "FLAT": "flat",
    "LAMBDA": "flat",
    "SFLAT": "flat",
    "CBP": "cbp",
    "CCOB": "ccob",
    "FE55": "fe55",
    "PPUMP": "ppump",
    "SPOT": "spot",
    "ACQ": "acq",
    "CWFS": "cwfs",
    "ENGTEST": "engtest",
    "FOCUS": "focus",
    "INDEXING": "indexing",
    "OBJECT": "science",
    "SCIENCE": "science",
    "SKYEXP": "science",
    "STUTTERED": "stuttered",
    "TRAP": "trap",
    "OTHER": "other",
}
"""Observation type by the value of ``IMGTYPE``."""

WITHOUT_LIGHT = frozenset({"bias", "dark"})
"""Observation types whose ``MONOWL`` is left over from another exposure."""

WAVELENGTH_RANGE_NM = (200.0, 1300.0)  # Wavelengths to which a silicon CCD and its monochromator can be set

TEMPERATURE_RANGE_C = (NO_READING_C, 60.0)
"""Temperatures that a CCD can have while it is read; a value in kelvin falls outside."""

ZERO_CELSIUS_K = 273.15


@named_units
@dataclasses.dataclass(frozen=True)
class RawMetadata:
    """What the headers of a raw frame say about the exposure.

    Attributes
    ----------
    source : `str`
        File from which this was read.
    camera : `str`
        ``ts8``, ``lsstCam`` or ``monocam``.
    observation_type : `str`
        ``bias``, ``flat``, ``dark``, ``science``, …
    test_type : `str`
        ``TESTTYPE``, lower case (``lambda``); empty if absent.
    wavelength_nm : `float` or `None`
        Wavelength of the monochromator; `None` without light (bias, dark) and for flats of white light.
    bandpass_nm : `float` or `None`
        Width to which the monochromator's slits were set, if the header states one.
    exposure_time_s, dark_time_s : `float`
        Time with the shutter open, and time since the CCD was cleared.
    temperature_k : `float` or `None`
        Temperature of the CCD; `None` if no header states it.
    temperature_source : `str`
        Keyword from which the temperature came (``CCDTEMP``, ``SENSTEMP``, ``TEMP_SET``); empty if none.
    raft, slot : `str`
        Place of the sensor: ``R11``/``S01`` in LSSTCam, ``RTM-020``/``S01`` on TS8.
    serial : `str`
        Serial number of the sensor (``LSST_NUM`` without ``-Dev``); empty if absent.
    detector : `int`
        Number of the sensor in its camera.
    filter_name : `str`
        Name of the filter; empty if the header states none.
    airmass : `float` or `None`
        Airmass at the begin of an exposure through a telescope, if the header states one.
    run : `str`
        ``RUNNUM``; empty if absent.
    date_obs : `datetime.datetime`
        Start of the exposure as the header has it, without time zone.
    time_scale : `str`
        What that is in: ``tai`` or ``utc``. As in obs_lsst, TAI where ``TIMESYS`` does not state it.
    day_obs : `int`
        Observing day, ``YYYYMMDD``.
    seq_num : `int`
        Number of the exposure within the day; seconds since the day began where the header states none.
    exposure_id : `int`
        Number of the exposure, the same for all sensors read together.
    notes : `tuple` [`str`, ...]
        What was taken for granted because the header does not state it.
    """

    source: str
    camera: str
    observation_type: str
    test_type: str
    wavelength_nm: float | None
    bandpass_nm: float | None
    exposure_time_s: float
    dark_time_s: float
    temperature_k: float | None
    temperature_source: str
    raft: str
    slot: str
    serial: str
    detector: int
    filter_name: str
    airmass: float | None
    run: str
    date_obs: datetime.datetime
    time_scale: str
    day_obs: int
    seq_num: int
    exposure_id: int
    notes: tuple[str, ...] = ()

    def require_wavelength_nm(self) -> float:
        """Return the wavelength of a monochromatic flat.

        Raises
        ------
        FrameFormatError
            The frame has none: a bias, a dark, or a flat of white light.
        """
        if self.wavelength_nm is None:
            raise FrameFormatError(
                "MONOWL",
                None,
                f"the wavelength of the monochromator in nm (this is a {self.observation_type} frame)",
                source=self.source,
            )
        return self.wavelength_nm

    def require_temperature_k(self) -> float:
        """Return the temperature of the CCD.

        Raises
        ------
        FrameFormatError
            No header states it.
        """
        if self.temperature_k is None:
            raise FrameFormatError("CCDTEMP", None, "the temperature of the CCD in °C", source=self.source)
        return self.temperature_k

    @classmethod
    def from_header(cls, header: Mapping[str, Any], *, source: str) -> RawMetadata:
        """Interpret the header of a raw frame.

        Parameters
        ----------
        header : `~collections.abc.Mapping`
            Primary header, with what it lacks of the test conditions (`read_raw_header`).
        source : `str`
            Name of the file, for messages.

        Raises
        ------
        FrameFormatError
            A keyword is absent and cannot be derived, or has a value that is not allowed.
        UnknownNameError
            The sensor that the header names is not in the camera.
        """
        return _interpret(DeclaredHeader(header, source))


def _interpret(header: DeclaredHeader) -> RawMetadata:
    camera = _camera(header)
    told = {key: header.text(key) for key in ("OBSID", "CAMCODE", "TESTTYPE", "CREATOR", "CONTRLLR")}
    refuse_other_instrument(told, camera, header.source)
    refuse_contradictions([("", header.cards)], lambda _, keyword: header.value(keyword), header.source)
    observation_type = _observation_type(header)
    refuse_stutter(header.value("STUTTER ROWS"), observation_type, header.source)
    wavelength, filter_name = _wavelength(header, observation_type), _filter_name(header)
    exposure_time, dark_time = _times(header, observation_type)
    if observation_type == "flat" and wavelength is not None:
        refuse_no_flat(header.text("TESTTYPE"), exposure_time, header.source)
        refuse_other_filter(header.text("FILTER"), wavelength, header.source)
    temperature, temperature_source = _temperature(header)
    detector = _detector(header, camera)
    start, scale = begin_of_exposure(header, camera), time_scale(header, camera)
    day_obs, seq_num = day_and_sequence(header, camera, start)
    return RawMetadata(
        source=header.source,
        camera=camera,
        observation_type=observation_type,
        test_type=header.text("TESTTYPE").lower(),
        wavelength_nm=wavelength,
        bandpass_nm=_bandpass(header),
        exposure_time_s=exposure_time,
        dark_time_s=dark_time,
        temperature_k=temperature,
        temperature_source=temperature_source,
        raft=detector.raft,
        slot=detector.slot,
        serial=header.text("LSST_NUM").removesuffix("-Dev"),
        detector=detector.id,
        filter_name=filter_name,
        airmass=_airmass(header),
        run=header.text("RUNNUM"),
        date_obs=start,
        time_scale=scale,
        day_obs=day_obs,
        seq_num=seq_num,
        exposure_id=exposure_id(header, camera, start, day_obs, seq_num),
        notes=_notes(header, camera, detector),
    )


_CAMERAS = {
    "LSSTCAM": "lsstCam",
    "LSST_CAMERA": "lsstCam",
    "LSST-TS8": "ts8",
    "TS8": "ts8",
    "MONOCAM": "monocam",
}


def is_of_lsst(instrument: str) -> bool:
    """Whether ``INSTRUME`` names a camera or test stand whose frames are in the LSST layout."""
    return instrument.upper() in _CAMERAS


def _camera(header: DeclaredHeader) -> str:
    """Camera or test stand that took the frame; the place of the sensor tells where nothing says it outright."""
    if header.value("INSTRUME") is not None:
        instrument = header.text("INSTRUME").upper()
        if instrument not in _CAMERAS:
            raise header.refuse("INSTRUME", header.value("INSTRUME"), ", ".join(_CAMERAS))
        return _CAMERAS[instrument]
    if "TS8" in header.text("TSTAND").upper():
        return "ts8"
    bay = _bay(header) is not None
    sensor = _module(header) is not None or header.value("LSST_NUM") is not None
    if bay and sensor:  # the headers of both have them
        found = header.value("TSTAND")
        raise header.refuse("TSTAND", found, "TS8 for a frame of ts8, or INSTRUME, which names the camera")
    if bay or sensor:
        return "lsstCam" if bay else "ts8"
    raise header.refuse(
        "INSTRUME",
        None,
        "lsstCam or MonoCam; or TSTAND = TS8; or RAFTBAY, RAFTNAME or LSST_NUM, which tell it",
    )


def _notes(header: DeclaredHeader, camera: str, detector: Detector) -> tuple[str, ...]:
    """The instrument decides about sensor and exposure number: say so where the header does not name it.

    So does the serial number on the test stand, whose rafts were rebuilt, against the place.
    """
    notes = []
    if header.value("INSTRUME") is None and "TS8" not in header.text("TSTAND").upper():
        told = "RAFTBAY or RAFTNAME" if camera == "lsstCam" else "RAFTNAME or LSST_NUM"
        notes.append(
            f"neither INSTRUME nor TSTAND = TS8 in the header: taken as a frame of {camera}, for its {told}"
        )
    place = _place(header, camera)
    raft, _, slot = place.partition("_")
    if camera == "ts8" and place and (slot != detector.slot or ("RTM" in raft and raft != detector.raft)):
        notes.append(
            f"the header has the sensor at {place}; LSST_NUM {header.text('LSST_NUM')} decides: {detector.name}"
        )
    return tuple(notes)


def _bay(header: DeclaredHeader) -> str | None:
    """Raft bay of the LSST Camera, from either keyword that holds it."""
    for keyword in ("RAFTBAY", "RAFTNAME"):
        if re.fullmatch(r"R\d\d", header.text(keyword)):
            return header.text(keyword)
    return None


def _module(header: DeclaredHeader) -> str | None:
    """Raft module, ``RTM-020``."""
    match = re.search(r"RTM-\d{3}", header.text("RAFTNAME"))
    return match.group(0) if match else None


def _detector(header: DeclaredHeader, camera: str) -> Detector:
    """The sensor. In a camera its place decides; on the test stand its serial number, for rafts were rebuilt."""
    table = Camera.from_name(camera)
    if len(table.detectors) == 1:
        return table.detectors[0]
    place, serial = _place(header, camera), header.text("LSST_NUM")
    if camera == "lsstCam" and place and serial:
        refuse_other_sensor(table, place, serial, header.source)
    keys = [key for key in ((place, serial) if camera == "lsstCam" else (serial, place)) if key]
    if not keys:
        raise header.refuse("LSST_NUM", None, "the serial number of the sensor, or RAFTBAY and CCDSLOT")
    for key in keys:
        try:
            return table.detector(key)
        except UnknownNameError as error:
            unknown = error
    raise unknown.in_source(header.source)


def _place(header: DeclaredHeader, camera: str) -> str:
    """Raft and slot, joined; empty where one of them is not stated."""
    slot = header.text("SLOTNAME") or header.text("CCDSLOT")
    raft = _bay(header) if camera == "lsstCam" else _module(header) or _bay(header)
    return f"{raft}_{slot}" if raft and slot else ""


def _observation_type(header: DeclaredHeader) -> str:
    """From ``IMGTYPE``; where it is absent, from ``TESTTYPE``."""
    keyword = "IMGTYPE" if header.value("IMGTYPE") is not None else "TESTTYPE"
    spelled = header.text(keyword).upper()
    # TESTTYPE carries a suffix with the wavelength: SFLAT_500.
    known = spelled if keyword == "IMGTYPE" else spelled.partition("_")[0]
    if known not in OBSERVATION_TYPES:
        raise header.refuse("IMGTYPE", header.value(keyword), ", ".join(OBSERVATION_TYPES))
    return OBSERVATION_TYPES[known]


def _wavelength(header: DeclaredHeader, observation_type: str) -> float | None:
    """``MONOWL``. ``MONOCH-WAVELENG`` is not used: it can still hold the value of an earlier exposure."""
    if observation_type in WITHOUT_LIGHT:
        return None
    value = header.value("MONOWL")
    lambda_flat = observation_type == "flat" and header.text("TESTTYPE").upper() == "LAMBDA"
    not_set = value is None or (isinstance(value, int | float) and value <= 0)
    if not_set and not lambda_flat:
        return None
    low, high = WAVELENGTH_RANGE_NM
    return header.number(
        "MONOWL", value, f"a wavelength from {low:g} to {high:g} nm", lambda nm: low <= nm <= high
    )


def _bandpass(header: DeclaredHeader) -> float | None:
    value = header.value("MONOCH-BANDPASS")
    if value is None:
        return None
    # 0 means that the slits were not set to a width in nm.
    return header.number("MONOCH-BANDPASS", value, "0 or a width in nm", lambda nm: 0 <= nm < 1000) or None


def _times(header: DeclaredHeader, observation_type: str) -> tuple[float, float]:
    """Exposure time (that of the shutter where it was measured) and dark time, seconds; 0 for a bias without them."""
    value = header.value("EXPTIME")
    if value is None and observation_type == "bias":
        value = 0.0
    asked = exposure = header.seconds_of_light("EXPTIME", value, observation_type)
    shutter = header.value("SHUTTIME")
    if shutter is not None:
        # 0 where the shutter stayed closed.
        exposure = header.seconds_of_light("SHUTTIME", shutter, observation_type) or exposure
    dark = header.value("DARKTIME")
    if dark is None:
        return exposure, exposure
    least = min(exposure, asked) - SAME_SECONDS  # the shutter opens after the sensor was cleared
    allowed = f"seconds, not less than the exposure time of {exposure:g} s"
    return exposure, header.number("DARKTIME", dark, allowed, lambda s: s >= max(least, 0.0))


def _temperature(header: DeclaredHeader) -> tuple[float | None, str]:
    low, high = TEMPERATURE_RANGE_C
    for keyword in ("CCDTEMP", "SENSTEMP", "TEMP_SET"):
        value = header.value(keyword)
        if value is not None:
            celsius = header.number(
                keyword, value, f"°C from {low:g} to {high:g}", lambda c: low <= c <= high
            )
            return celsius + ZERO_CELSIUS_K, keyword
    return None, ""


def _filter_name(header: DeclaredHeader) -> str:
    """Filter of the LSST Camera: its parts joined by ``~``, empty places left out."""
    parts = [header.text(keyword) for keyword in ("FILTER", "FILTER1", "FILTER2")]
    named = [part for part in parts if part and part.lower() not in {"empty", "none"}]
    return "~".join(dict.fromkeys(named))


def _airmass(header: DeclaredHeader) -> float | None:
    """``AMSTART``; `None` where it is absent, or 0 as where there is no telescope."""
    value = header.value("AMSTART")
    if value is None or value == 0:
        return None
    return header.number("AMSTART", value, "1 to 40", lambda airmass: 1 <= airmass <= 40)
