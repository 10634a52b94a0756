"""What the header of a raw frame says about the exposure.

What a header lacks is derived where the rest decides it, else refused with one `FrameFormatError` that names
file, keyword, value and what is allowed. No file is opened here.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import re
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from astropy.io import fits
from astropy.time import Time

from ..errors import FrameFormatError, InputError, UnknownNameError, to_number
from .camera import Camera, Detector
from .raw_checks import refuse_other_day, refuse_other_instrument

__all__ = ["DAY_ROLLOVER_H", "OBSERVATION_TYPES", "RawMetadata", "header_value"]

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

WAVELENGTH_RANGE_NM = (200.0, 1300.0)
"""Wavelengths to which a silicon CCD and its monochromator can be set."""

TEMPERATURE_RANGE_C = (-200.0, 60.0)
"""Temperatures that a CCD can have while it is read; a value in kelvin falls outside."""

ZERO_CELSIUS_K = 273.15

CONTROLLERS = "OCHPQS"
"""Data-acquisition controllers of the LSST Camera; the place adds thousands of years to the exposure number."""

LAST_DAY_OF_OWN_COUNT = {"C": 20231004, "P": 20250417, "Q": 20250417, "S": 20250417}
"""Last observing day on which a controller counted for itself; since then it shares the count of O (obs_lsst)."""

TS8_NUMBERED_SINCE = datetime.datetime(2023, 5, 24, 23)
"""Since then exposures of TS8 are numbered like those of the camera (obs_lsst)."""

OF_RUBIN = ("ts8", "lsstCam")
"""Cameras whose headers state times in TAI unless they say otherwise (obs_lsst)."""

DAY_ROLLOVER_H = {"ts8": 8.0, "lsstCam": 12.0, "monocam": 12.0}
"""UTC hour at which the observing day begins, as obs_lsst has it."""


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
        return _interpret(_Header(header, source))


def header_value(header: Mapping[str, Any], keyword: str) -> Any:
    """Value of a keyword; `None` if it is absent, undefined or blank.

    Raises
    ------
    FrameFormatError
        The card is not FITS (other cards of the header may be), or there are several with different values.
    """
    try:
        value = header.get(keyword)
        if isinstance(header, fits.Header) and keyword in header and header.count(keyword) > 1:
            _refuse_different(header, keyword)
    except fits.VerifyError:
        raise FrameFormatError(keyword, "a card that cannot be parsed", "a value as FITS has it") from None
    if isinstance(value, fits.card.Undefined) or (isinstance(value, str) and not value.strip()):
        return None
    return value.strip() if isinstance(value, str) else value


def _refuse_different(header: fits.Header, keyword: str) -> None:
    values = [header[keyword, number] for number in range(header.count(keyword))]
    if any(value != values[0] for value in values):
        raise FrameFormatError(keyword, " and ".join(map(str, values)), "one value, not several that differ")


@dataclasses.dataclass(frozen=True)
class _Header:
    """Header of a frame, asked for values of a certain kind."""

    cards: Mapping[str, Any]
    source: str

    def value(self, keyword: str) -> Any:
        try:
            return header_value(self.cards, keyword)
        except FrameFormatError as error:
            raise error.in_source(self.source) from None

    def text(self, keyword: str) -> str:
        value = self.value(keyword)
        return "" if value is None else str(value)

    def number(self, keyword: str, value: Any, allowed: str, accept: Callable[[float], bool]) -> float:
        """``value`` as a finite number that is accepted, or an error that names the keyword."""
        try:
            number = to_number(keyword, value)
        except InputError:
            number = math.nan
        if not (math.isfinite(number) and accept(number)):
            raise self.refuse(keyword, value, allowed)
        return number

    def refuse(self, keyword: str, value: Any, allowed: str) -> FrameFormatError:
        return FrameFormatError(keyword, value, allowed, source=self.source)


def _interpret(header: _Header) -> RawMetadata:
    camera = _camera(header)
    refuse_other_instrument(
        {key: header.text(key) for key in ("OBSID", "TESTTYPE", "CREATOR", "CONTRLLR")}, camera, header.source
    )
    observation_type = _observation_type(header)
    exposure_time, dark_time = _times(header, observation_type)
    temperature, temperature_source = _temperature(header)
    detector = _detector(header, camera)
    start, scale = _date_obs(header), _time_scale(header, camera)
    day_obs, seq_num = _day_and_sequence(header, camera, start)
    return RawMetadata(
        source=header.source,
        camera=camera,
        observation_type=observation_type,
        test_type=header.text("TESTTYPE").lower(),
        wavelength_nm=_wavelength(header, observation_type),
        bandpass_nm=_bandpass(header),
        exposure_time_s=exposure_time,
        dark_time_s=dark_time,
        temperature_k=temperature,
        temperature_source=temperature_source,
        raft=detector.raft,
        slot=detector.slot,
        serial=header.text("LSST_NUM").removesuffix("-Dev"),
        detector=detector.id,
        filter_name=_filter_name(header),
        run=header.text("RUNNUM"),
        date_obs=start,
        time_scale=scale,
        day_obs=day_obs,
        seq_num=seq_num,
        exposure_id=_exposure_id(header, camera, start, day_obs, seq_num),
        notes=_notes(header, camera),
    )


_CAMERAS = {
    "LSSTCAM": "lsstCam",
    "LSST_CAMERA": "lsstCam",
    "LSST-TS8": "ts8",
    "TS8": "ts8",
    "MONOCAM": "monocam",
}


def _camera(header: _Header) -> str:
    """Camera or test stand that took the frame; the place of the sensor tells where nothing says it outright."""
    if header.value("INSTRUME") is not None:
        instrument = header.text("INSTRUME").upper()
        if instrument not in _CAMERAS:
            raise header.refuse("INSTRUME", header.value("INSTRUME"), ", ".join(_CAMERAS))
        return _CAMERAS[instrument]
    if "TS8" in header.text("TSTAND").upper():
        return "ts8"
    if _bay(header) is not None:
        return "lsstCam"
    if _module(header) is not None or header.value("LSST_NUM") is not None:
        return "ts8"
    raise header.refuse(
        "INSTRUME",
        None,
        "lsstCam or MonoCam; or TSTAND = TS8; or RAFTBAY, RAFTNAME or LSST_NUM, which tell it",
    )


def _notes(header: _Header, camera: str) -> tuple[str, ...]:
    """The instrument decides about sensor and exposure number: say so where the header does not name it."""
    if header.value("INSTRUME") is not None or "TS8" in header.text("TSTAND").upper():
        return ()
    told = "RAFTBAY or RAFTNAME" if camera == "lsstCam" else "RAFTNAME or LSST_NUM"
    return (f"neither INSTRUME nor TSTAND = TS8 in the header: taken as a frame of {camera}, for its {told}",)


def _bay(header: _Header) -> str | None:
    """Raft bay of the LSST Camera, from either keyword that holds it."""
    for keyword in ("RAFTBAY", "RAFTNAME"):
        if re.fullmatch(r"R\d\d", header.text(keyword)):
            return header.text(keyword)
    return None


def _module(header: _Header) -> str | None:
    """Raft module, ``RTM-020``."""
    match = re.search(r"RTM-\d{3}", header.text("RAFTNAME"))
    return match.group(0) if match else None


def _detector(header: _Header, camera: str) -> Detector:
    """The sensor. In a camera its place decides; on the test stand its serial number, for rafts were rebuilt."""
    table = Camera.from_name(camera)
    if len(table.detectors) == 1:
        return table.detectors[0]
    slot = header.text("SLOTNAME") or header.text("CCDSLOT")
    raft = _bay(header) if camera == "lsstCam" else _module(header) or _bay(header)
    place = f"{raft}_{slot}" if raft and slot else ""
    serial = header.text("LSST_NUM")
    keys = [key for key in ((place, serial) if camera == "lsstCam" else (serial, place)) if key]
    if not keys:
        raise header.refuse("LSST_NUM", None, "the serial number of the sensor, or RAFTBAY and CCDSLOT")
    for key in keys:
        try:
            return table.detector(key)
        except UnknownNameError as error:
            unknown = error
    raise unknown.in_source(header.source)


def _observation_type(header: _Header) -> str:
    """From ``IMGTYPE``; where it is absent, from ``TESTTYPE``."""
    keyword = "IMGTYPE" if header.value("IMGTYPE") is not None else "TESTTYPE"
    spelled = header.text(keyword).upper()
    # TESTTYPE carries a suffix with the wavelength: SFLAT_500.
    known = spelled if keyword == "IMGTYPE" else spelled.partition("_")[0]
    if known not in OBSERVATION_TYPES:
        raise header.refuse("IMGTYPE", header.value(keyword), ", ".join(OBSERVATION_TYPES))
    return OBSERVATION_TYPES[known]


def _wavelength(header: _Header, observation_type: str) -> float | None:
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


def _bandpass(header: _Header) -> float | None:
    value = header.value("MONOCH-BANDPASS")
    if value is None:
        return None
    # 0 means that the slits were not set to a width in nm.
    return header.number("MONOCH-BANDPASS", value, "0 or a width in nm", lambda nm: 0 <= nm < 1000) or None


def _times(header: _Header, observation_type: str) -> tuple[float, float]:
    """Exposure time (that of the shutter where it was measured) and dark time, seconds; 0 for a bias without them."""
    value = header.value("EXPTIME")
    if value is None and observation_type == "bias":
        value = 0.0
    exposure = header.number("EXPTIME", value, "seconds, 0 or more", lambda s: s >= 0)
    shutter = header.value("SHUTTIME")
    if shutter is not None:
        # 0 where the shutter stayed closed.
        exposure = header.number("SHUTTIME", shutter, "seconds, 0 or more", lambda s: s >= 0) or exposure
    dark = header.value("DARKTIME")
    if dark is None:
        return exposure, exposure
    return exposure, header.number("DARKTIME", dark, "seconds, 0 or more", lambda s: s >= 0)


def _temperature(header: _Header) -> tuple[float | None, str]:
    low, high = TEMPERATURE_RANGE_C
    for keyword in ("CCDTEMP", "SENSTEMP", "TEMP_SET"):
        value = header.value(keyword)
        if value is not None:
            celsius = header.number(
                keyword, value, f"°C from {low:g} to {high:g}", lambda c: low <= c <= high
            )
            return celsius + ZERO_CELSIUS_K, keyword
    return None, ""


def _filter_name(header: _Header) -> str:
    """Filter of the LSST Camera: its parts joined by ``~``, empty places left out."""
    parts = [header.text(keyword) for keyword in ("FILTER", "FILTER1", "FILTER2")]
    named = [part for part in parts if part and part.lower() not in {"empty", "none"}]
    return "~".join(dict.fromkeys(named))


_DATES = (
    ("DATE-BEG", "isot"),
    ("MJD-BEG", "mjd"),
    ("DATE-OBS", "isot"),
    ("MJD-OBS", "mjd"),
    ("MJD", "mjd"),
)
"""Keywords of the start of the exposure, and their formats. ``DATE-OBS`` was once its end (obs_lsst)."""


def _time_scale(header: _Header, camera: str) -> str:
    scale = header.text("TIMESYS").lower()
    if scale not in ("", "utc", "tai"):
        raise header.refuse("TIMESYS", header.value("TIMESYS"), "UTC or TAI")
    return scale or ("tai" if camera in OF_RUBIN else "utc")


def _date_obs(header: _Header) -> datetime.datetime:
    for keyword, scale in _DATES:
        value = header.value(keyword)
        if value is None:
            continue
        try:
            text = str(value).rstrip("Z").replace(" ", "T") if scale == "isot" else float(value)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return Time(text, format=scale, scale="utc").to_datetime()
        except (TypeError, ValueError, OverflowError):
            allowed = "YYYY-MM-DDThh:mm:ss.sss" if scale == "isot" else "a modified Julian date"
            raise header.refuse(keyword, value, allowed) from None
    raise header.refuse("DATE-OBS", None, "YYYY-MM-DDThh:mm:ss.sss, or MJD-OBS")


def _day_and_sequence(header: _Header, camera: str, start: datetime.datetime) -> tuple[int, int]:
    """``DAYOBS`` and ``SEQNUM``; where absent, the day on which the night began and the seconds since then."""
    day_start = start - datetime.timedelta(hours=DAY_ROLLOVER_H[camera])
    stated = header.value("DAYOBS")
    derived = int(day_start.strftime("%Y%m%d"))
    day = derived if stated is None else _day(header, stated)
    refuse_other_day(day, start, derived, header.source)
    value = header.value("SEQNUM")
    if value is None:
        midnight = day_start.replace(hour=0, minute=0, second=0, microsecond=0)
        return day, int((day_start - midnight).total_seconds())
    number = header.number("SEQNUM", value, "an integer from 0 to 99999", lambda n: 0 <= n < 100000)
    if number != int(number):
        raise header.refuse("SEQNUM", value, "an integer from 0 to 99999")
    return day, int(number)


def _day(header: _Header, value: Any) -> int:
    digits = str(value).replace("-", "")
    try:
        datetime.datetime.strptime(digits, "%Y%m%d")
    except ValueError:
        raise header.refuse("DAYOBS", value, "a date YYYYMMDD") from None
    return int(digits)


def _exposure_id(header: _Header, camera: str, start: datetime.datetime, day_obs: int, seq_num: int) -> int:
    """Number of the exposure, as obs_lsst has it.

    In the cameras the day and the sequence number, moved by 1000 years for each controller that counts for itself. On
    TS8 the same since ``OBSID`` begins with TS_C; before, ``SEQNUM`` repeated within a day, and the digits of
    ``DATE-OBS`` down to tenths of a second are the number.
    """
    numbered = start > TS8_NUMBERED_SINCE and header.text("OBSID").startswith("TS_C_")
    if camera == "ts8" and not numbered:
        digits = re.sub(r"\D", "", header.text("DATE-OBS")[:21])
        if len(digits) == 15:
            return int(digits)
        return int(start.strftime("%Y%m%d%H%M%S")) * 10 + start.microsecond // 100_000
    controller = header.text("CONTRLLR").upper() or "O"
    if controller not in CONTROLLERS:
        raise header.refuse("CONTRLLR", controller, f"one of {', '.join(CONTROLLERS)}")
    if day_obs > LAST_DAY_OF_OWN_COUNT.get(controller, day_obs):
        controller = "O"
    return (day_obs + CONTROLLERS.index(controller) * 10_000_000) * 100_000 + seq_num
