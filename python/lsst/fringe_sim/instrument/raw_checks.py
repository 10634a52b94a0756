"""What in the header of a raw frame contradicts what it is taken for."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping
from typing import Any

from ..errors import FrameFormatError
from .detector import Detector

__all__ = ["refuse_other_day", "refuse_other_instrument", "refuse_other_vendor"]

OBSERVATION_PREFIX = {"lsstCam": "MC", "ts8": "TS"}
"""First letters of ``OBSID``: main camera, test stand. CC is ComCam, AT the auxiliary telescope."""

SIMULATORS = ("PHOSIM", "IMSIM")

FULL_SHAPE = {"e2v": (4004, 4096), "itl": (4000, 4072)}
"""Rows and columns of a whole sensor, by vendor."""

MOST_DAYS = 1
"""Days that ``DAYOBS`` may be off: when it begins has changed with time and place."""


def refuse_other_instrument(text: Mapping[str, str], camera: str, source: str) -> None:
    """Refuse frames of another camera that calls itself by the same name, and those of other simulators.

    Parameters
    ----------
    text : mapping
        ``OBSID``, ``TESTTYPE``, ``CREATOR`` and ``CONTRLLR``, empty where the header has none.
    camera : `str`
        What the frame is taken for.
    source : `str`
        File, for the message.

    Raises
    ------
    FrameFormatError
        It is something else.
    """
    match = re.fullmatch(r"([A-Z]{2})_[A-Z]_\d{8}_\d+", text["OBSID"])
    wanted = OBSERVATION_PREFIX.get(camera)
    if match and wanted and match.group(1) != wanted:
        allowed = f"{wanted}_… of {camera}: this is a frame of another instrument"
        raise FrameFormatError("OBSID", text["OBSID"], allowed, source=source)
    for keyword in ("CREATOR", "TESTTYPE"):
        if text[keyword].upper().startswith(SIMULATORS):
            allowed = "a frame of the instrument, not of another simulator of it"
            raise FrameFormatError(keyword, text[keyword], allowed, source=source)
    if text["CONTRLLR"].upper() == "H":
        raise FrameFormatError("CONTRLLR", "H", "the controller of a camera; H is PhoSim", source=source)


def refuse_other_day(stated: int, begin: datetime.datetime, derived: int, source: str) -> None:
    """Refuse a ``DAYOBS`` that is not the day of the exposure.

    Raises
    ------
    FrameFormatError
        More than a day lies between them.
    """
    days = [datetime.datetime.strptime(str(day), "%Y%m%d") for day in (stated, derived)]
    if abs((days[0] - days[1]).days) > MOST_DAYS:
        allowed = f"{derived} or a day from it: the exposure began {begin.isoformat(timespec='seconds')}"
        raise FrameFormatError("DAYOBS", stated, allowed, source=source)


def refuse_other_vendor(maker: Any, sensor: Detector, shape: tuple[int, int], source: str) -> None:
    """Refuse a sensor of one vendor in a place where the table has one of the other.

    Parameters
    ----------
    maker : `object`
        ``CCD_MANU``, `None` if absent.
    sensor : `Detector`
        What the table has there.
    shape : `tuple` [`int`, `int`]
        Rows and columns of the frame; a cut-down sensor has no size of its own.
    source : `str`
        File, for the message.

    Raises
    ------
    FrameFormatError
        The vendors differ.
    """
    vendor = sensor.vendor.lower()
    stated = str(maker).strip().lower()
    where = f"of {sensor.name}, {sensor.vendor}"
    if stated in FULL_SHAPE and vendor in FULL_SHAPE and stated != vendor:
        raise FrameFormatError("CCD_MANU", maker, f"the maker {where}", source=source)
    if vendor in FULL_SHAPE and shape in {size for name, size in FULL_SHAPE.items() if name != vendor}:
        rows, columns = FULL_SHAPE[vendor]
        found = f"{shape[1]} x {shape[0]} pixels"
        raise FrameFormatError(
            "DETSIZE", found, f"{columns} x {rows} {where}, or a part of it", source=source
        )
