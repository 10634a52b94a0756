"""When a raw frame was taken, and the number of its exposure, as obs_lsst has them."""

from __future__ import annotations

import datetime
import re
import warnings
from typing import Any

from astropy.time import Time

from .raw_checks import refuse_other_day
from .raw_header import DeclaredHeader

CONTROLLERS = "OCHPQS"
"""Data-acquisition controllers of the LSST Camera; the place adds thousands of years to the exposure number."""

LAST_DAY_OF_OWN_COUNT = {"C": 20231004, "P": 20250417, "Q": 20250417, "S": 20250417}
"""Last observing day on which a controller counted for itself; since then it shares the count of O (obs_lsst)."""

TS8_NUMBERED_SINCE = datetime.datetime(2023, 5, 24, 23)
"""Since then exposures of TS8 are numbered like those of the camera (obs_lsst)."""

OF_RUBIN = ("ts8", "lsstCam")  # Cameras whose headers state times in TAI unless they say otherwise (obs_lsst)

DAY_ROLLOVER_H = {"ts8": 8.0, "lsstCam": 12.0, "monocam": 12.0}
"""UTC hour at which the observing day begins, as obs_lsst has it."""

MJD_DIGITS_S = 1.0
"""What a date and the same as a modified Julian date may differ by: some headers state five decimals of a day."""

_DATES = (("DATE-BEG", "isot"), ("MJD-BEG", "mjd"), ("DATE-OBS", "isot"), ("MJD-OBS", "mjd"), ("MJD", "mjd"))
"""Keywords of the begin of the exposure, and their formats."""


def time_scale(header: DeclaredHeader, camera: str) -> str:
    """Scale of the times: ``tai`` or ``utc``."""
    scale = header.text("TIMESYS").lower()
    if scale not in ("", "utc", "tai"):
        raise header.refuse("TIMESYS", header.value("TIMESYS"), "UTC or TAI")
    return scale or ("tai" if camera in OF_RUBIN else "utc")


def begin_of_exposure(header: DeclaredHeader, camera: str) -> datetime.datetime:
    """First of the keywords that state it.

    TS8 wrote the end of the exposure into ``DATE-OBS`` as long as ``DATE-TRG`` said the same: ``EXPTIME`` is taken
    off then, as obs_lsst does.
    """
    stated = {keyword: _moment(header, keyword, kind) for keyword, kind in _DATES}
    for date, mjd in (("DATE-BEG", "MJD-BEG"), ("DATE-OBS", "MJD-OBS")):
        one, other = stated[date], stated[mjd]
        if one is not None and other is not None and abs((one - other).total_seconds()) > MJD_DIGITS_S:
            allowed = f"{date} as a modified Julian date: {one.isoformat(timespec='seconds')}"
            raise header.refuse(mjd, header.value(mjd), allowed)
    end = stated["DATE-OBS"] if camera == "ts8" else None
    if end is not None and header.text("DATE-TRG") == header.text("DATE-OBS"):
        seconds = header.number("EXPTIME", header.value("EXPTIME"), "seconds, 0 or more", lambda s: s >= 0)
        return end - datetime.timedelta(seconds=seconds)
    begin = next((moment for moment in stated.values() if moment is not None), None)
    if begin is None:
        raise header.refuse("DATE-OBS", None, "YYYY-MM-DDThh:mm:ss.sss, or MJD-OBS")
    return begin


def _moment(header: DeclaredHeader, keyword: str, kind: str) -> datetime.datetime | None:
    value = header.value(keyword)
    if value is None:
        return None
    try:
        text = str(value).rstrip("Z").replace(" ", "T") if kind == "isot" else float(value)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found: datetime.datetime = Time(text, format=kind, scale="utc").to_datetime()
    except (TypeError, ValueError, OverflowError):
        allowed = "YYYY-MM-DDThh:mm:ss.sss" if kind == "isot" else "a modified Julian date"
        raise header.refuse(keyword, value, allowed) from None
    return found


def day_and_sequence(header: DeclaredHeader, camera: str, begin: datetime.datetime) -> tuple[int, int]:
    """``DAYOBS`` and ``SEQNUM``; where absent, the day on which the night began and the seconds since then."""
    day_start = begin - datetime.timedelta(hours=DAY_ROLLOVER_H[camera])
    stated = header.value("DAYOBS")
    derived = int(day_start.strftime("%Y%m%d"))
    day = derived if stated is None else _day(header, stated)
    refuse_other_day(day, begin, derived, header.source)
    value = header.value("SEQNUM")
    if value is None:
        midnight = day_start.replace(hour=0, minute=0, second=0, microsecond=0)
        return day, int((day_start - midnight).total_seconds())
    number = header.number("SEQNUM", value, "an integer from 0 to 99999", lambda n: 0 <= n < 100000)
    if number != int(number):
        raise header.refuse("SEQNUM", value, "an integer from 0 to 99999")
    return day, int(number)


def _day(header: DeclaredHeader, value: Any) -> int:
    digits = str(value).replace("-", "")
    try:
        datetime.datetime.strptime(digits, "%Y%m%d")
    except ValueError:
        raise header.refuse("DAYOBS", value, "a date YYYYMMDD") from None
    return int(digits)


def exposure_id(
    header: DeclaredHeader, camera: str, begin: datetime.datetime, day_obs: int, seq_num: int
) -> int:
    """Number of the exposure, as obs_lsst has it.

    In the cameras the day and the sequence number, moved by 1000 years for each controller that counts for itself. On
    TS8 the same since ``OBSID`` begins with TS_C; before, ``SEQNUM`` repeated within a day, and the digits of
    ``DATE-OBS`` down to tenths of a second are the number.
    """
    numbered = begin > TS8_NUMBERED_SINCE and header.text("OBSID").startswith("TS_C_")
    if camera == "ts8" and not numbered:
        digits = re.sub(r"\D", "", header.text("DATE-OBS")[:21])
        if len(digits) == 15:
            return int(digits)
        return int(begin.strftime("%Y%m%d%H%M%S")) * 10 + begin.microsecond // 100_000
    controller = header.text("CONTRLLR").upper() or "O"
    if controller not in CONTROLLERS:
        raise header.refuse("CONTRLLR", controller, f"one of {', '.join(CONTROLLERS)}")
    if day_obs > LAST_DAY_OF_OWN_COUNT.get(controller, day_obs):
        controller = "O"
    return (day_obs + CONTROLLERS.index(controller) * 10_000_000) * 100_000 + seq_num
