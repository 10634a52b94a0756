"""What in the header of a raw frame contradicts what it is taken for."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping
from typing import Any

from ..errors import FrameFormatError, UnknownNameError
from .camera import Camera
from .detector import Detector

OBSERVATION_PREFIX = {"lsstCam": "MC", "ts8": "TS"}
"""First letters of ``OBSID``: main camera, test stand. CC is ComCam, AT the auxiliary telescope."""

SIMULATORS = ("PHOSIM", "IMSIM")

MODELS = {"CCD250": "e2v", "3800C": "itl"}  # Vendor by ``CCD_TYPE``

COUNTS = frozenset({"", "adu", "dn", "count", "counts"})
"""What ``BUNIT`` may say of numbers of the converter, without regard to case."""

WITHOUT_FLATS = frozenset({"BIAS", "ZERO", "DARK", "FE55", "PPUMP", "TRAP"})
"""Values of ``TESTTYPE`` of tests whose frames are no flats: no light, X-rays, or charge that was moved."""

FULL_SHAPE = {"e2v": (4004, 4096), "itl": (4000, 4072)}  # Rows and columns of a whole sensor, by vendor
MOST_DAYS = 1  # Days that ``DAYOBS`` may be off: when it begins has changed with time and place


def refuse_other_instrument(text: Mapping[str, str], camera: str, source: str) -> None:
    """Refuse frames of another camera that calls itself by the same name, and those of other simulators."""
    match = re.fullmatch(r"([A-Z]{2})_[A-Z]_\d{8}_\d+", text["OBSID"])
    wanted = OBSERVATION_PREFIX.get(camera)
    if match and wanted and match.group(1) != wanted:
        allowed = f"{wanted}_… of {camera}: this is a frame of another instrument"
        raise FrameFormatError("OBSID", text["OBSID"], allowed, source=source)
    if wanted and text["CAMCODE"] not in ("", wanted):
        allowed = f"{wanted} of {camera}: this is a frame of another instrument"
        raise FrameFormatError("CAMCODE", text["CAMCODE"], allowed, source=source)
    for keyword in ("CREATOR", "TESTTYPE"):
        if text[keyword].upper().startswith(SIMULATORS):
            allowed = "a frame of the instrument, not of another simulator of it"
            raise FrameFormatError(keyword, text[keyword], allowed, source=source)
    if text["CONTRLLR"].upper() == "H":
        raise FrameFormatError("CONTRLLR", "H", "the controller of a camera; H is PhoSim", source=source)


def refuse_other_day(stated: int, begin: datetime.datetime, derived: int, source: str) -> None:
    """Refuse a ``DAYOBS`` that is not the day of the exposure."""
    days = [datetime.datetime.strptime(str(day), "%Y%m%d") for day in (stated, derived)]
    if abs((days[0] - days[1]).days) > MOST_DAYS:
        allowed = f"{derived} or a day from it: the exposure began {begin.isoformat(timespec='seconds')}"
        raise FrameFormatError("DAYOBS", stated, allowed, source=source)


def refuse_binning(header: Mapping[str, Any], source: str) -> None:
    """Refuse ``BINX`` and ``BINY`` other than 1."""
    for keyword in ("BINX", "BINY"):
        if header[keyword] not in (None, 1):
            raise FrameFormatError(keyword, header[keyword], "1: pixels that are not binned", source=source)


def refuse_other_unit(unit: Any, where: str, source: str) -> None:
    """Refuse a ``BUNIT`` that is not that of numbers of the converter."""
    if str(unit or "").strip().lower() not in COUNTS:
        raise FrameFormatError(f"{where}BUNIT", unit, "adu", source=source)


def refuse_stutter(rows: Any, observation_type: str, source: str) -> None:
    """Refuse charge that was moved during an exposure which does not say so."""
    if rows not in (None, 0) and observation_type != "stuttered":
        raise FrameFormatError("STUTTER ROWS", rows, f"0 in a {observation_type} frame", source=source)


def refuse_no_flat(test_type: str, exposure_time_s: float, source: str) -> None:
    """Refuse a monochromatic flat of a test that takes none, and one without light."""
    if test_type.upper() in WITHOUT_FLATS:
        allowed = f"a test with flats in it, as IMGTYPE says that this is one; {test_type} takes none"
        raise FrameFormatError("TESTTYPE", test_type, allowed, source=source)
    if exposure_time_s == 0.0:
        raise FrameFormatError("EXPTIME", exposure_time_s, "more than 0 s for a flat", source=source)


def refuse_other_sensor(table: Camera, place: str, serial: str, source: str) -> None:
    """Refuse a serial number that the table of the camera has at another place.

    One that it does not have is no contradiction: early frames of the LSST Camera are of other sensors.
    """
    try:
        at_place, of_serial = table.detector(place), table.detector(serial)
    except UnknownNameError:
        return
    if at_place.id != of_serial.id:
        allowed = f"{at_place.serial}, which is at {place}; {serial} is at {of_serial.name}"
        raise FrameFormatError("LSST_NUM", serial, allowed, source=source)


def refuse_other_vendor(
    maker: Any, model: Any, sensor: Detector, shape: tuple[int, int], source: str
) -> None:
    """Refuse a sensor of one vendor in a place where the table has one of the other."""
    vendor = sensor.vendor.lower()
    stated = str(maker).strip().lower()
    where = f"of {sensor.name}, {sensor.vendor}"
    if stated in FULL_SHAPE and vendor in FULL_SHAPE and stated != vendor:
        raise FrameFormatError("CCD_MANU", maker, f"the maker {where}", source=source)
    made_by = MODELS.get(str(model).strip().upper())
    if made_by is not None and vendor in FULL_SHAPE and made_by != vendor:
        raise FrameFormatError("CCD_TYPE", model, f"the model {where}", source=source)
    if vendor in FULL_SHAPE and shape in {size for name, size in FULL_SHAPE.items() if name != vendor}:
        rows, columns = FULL_SHAPE[vendor]
        found = f"{shape[1]} x {shape[0]} pixels"
        raise FrameFormatError(
            "DETSIZE", found, f"{columns} x {rows} {where}, or a part of it", source=source
        )
