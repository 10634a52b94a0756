"""Raw files of a mock sensor: times, headers and the LSST layout on disk."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..files import all_or_nothing
from ..instrument.camera import Amplifier, Camera, Detector
from .readout import raw_segment

__all__ = ["Clock", "primary_header", "write_frame"]

EXPOSURE_BASE_S = 12.0
"""Exposure time at 800 nm [s]."""

READOUT_S = 40
"""Time between two exposures [s]."""

DAY_ROLLOVER_H = 8
"""UTC hour at which the observing day of the test stand begins."""


class Clock:
    """Times of successive exposures."""

    def __init__(self, start: datetime.datetime) -> None:
        self._now = start

    def next(self, wavelength_nm: float | None) -> tuple[datetime.datetime, float]:
        """Start and length [s] of the next exposure."""
        start, length = self._now, exposure_time(wavelength_nm)
        self._now = start + datetime.timedelta(seconds=math.ceil(length) + READOUT_S)
        return start, length


def exposure_time(wavelength_nm: float | None) -> float:
    """Time that a lamp and a sensor that both fade towards the infrared need for one level [s]."""
    if wavelength_nm is None:
        return 0.0
    return round(EXPOSURE_BASE_S * math.exp(max(wavelength_nm - 800.0, 0.0) / 120.0), 3)


def primary_header(
    camera: str,
    sensor: Detector,
    celsius: float,
    wavelength_nm: float | None,
    number: int,
    start: datetime.datetime,
    exposure_s: float,
) -> fits.Header:
    """Primary header of one frame, as the test stands and the camera write them.

    ``celsius``: temperature that the set-up states [°C]. ``wavelength_nm``: setting of the monochromator;
    `None` for a bias.
    """
    header = fits.Header()
    day = (start - datetime.timedelta(hours=DAY_ROLLOVER_H)).strftime("%Y%m%d")
    stamp = start.strftime("%Y%m%d%H%M%S")
    kind = "bias_bias_000" if wavelength_nm is None else f"lambda_flat_{round(wavelength_nm):04d}"
    rows, columns = sensor.shape
    cards: list[tuple[str, Any, str]] = [
        ("DATE-OBS", start.isoformat(timespec="milliseconds"), "start of the exposure"),
        ("ORIGIN", "lsst.fringe_sim", "simulated frame"),
        ("RUNNUM", "0001M", "run"),
        *_camera_cards(camera, sensor),
        ("CCD_MANU", sensor.vendor.upper(), "maker of the sensor"),
        ("LSST_NUM", sensor.serial, "serial number of the sensor"),
        ("RAFTNAME", sensor.raft_serial, "serial number of the raft"),
        ("SLOTNAME", sensor.slot, "slot within the raft"),
        ("CCDSLOT", sensor.slot, "slot within the raft"),
        ("TESTTYPE", "BIAS" if wavelength_nm is None else "LAMBDA", "kind of acquisition"),
        ("IMGTYPE", "BIAS" if wavelength_nm is None else "FLAT", "kind of image"),
        ("DAYOBS", day, "observing day"),
        ("SEQNUM", number + 1, "number within the sequence"),
        ("DETSIZE", f"[1:{columns},1:{rows}]", "assembled sensor"),
        ("TEMP_SET", celsius, "[degC] set point"),
        ("CCDTEMP", celsius, "[degC] measured temperature"),
        ("EXPTIME", exposure_s, "[s] exposure time"),
        ("DARKTIME", exposure_s, "[s] time since the sensor was cleared"),
        ("FILENAME", f"{sensor.serial}_{kind}_{stamp}.fits", ""),
    ]
    if wavelength_nm is not None:
        cards.append(("MONOWL", wavelength_nm, "[nm] wavelength of the monochromator"))
    for card in cards:
        header.append(card, end=True)
    return header


def _camera_cards(camera: str, sensor: Detector) -> list[tuple[str, Any, str]]:
    if camera == "ts8":
        place = _place_in_lsstcam(sensor.serial)
        return [("TSTAND", "TS8", "test stand")] + (
            [("RAFTBAY", place.raft, "place of the raft in LSSTCam")] if place is not None else []
        )
    return [("INSTRUME", camera, "instrument"), ("RAFTBAY", sensor.raft, "raft bay")]


def _place_in_lsstcam(serial: str) -> Detector | None:
    for sensor in Camera.from_name("lsstCam").science:
        if sensor.serial == serial:
            return sensor
    return None


def write_frame(
    path: Path, header: fits.Header, sensor: Detector, images: Sequence[NDArray[np.int32]]
) -> None:
    """Write one frame; the file appears under its name only when it is complete."""
    hdus = fits.HDUList([fits.PrimaryHDU(header=header)])
    for amp, image in zip(sensor.amplifiers, images, strict=True):
        hdus.append(fits.ImageHDU(image, header=_amplifier_header(amp, sensor.shape)))
    with all_or_nothing(path) as part, open(part, "wb") as stream:
        hdus.writeto(stream)


def _amplifier_header(amp: Amplifier, shape: tuple[int, int]) -> fits.Header:
    """Header of one amplifier, with the y sense of DETSEC swapped as in real files (DM-36115)."""
    segment = raw_segment(amp)
    x = (amp.x0 + 1, amp.x0 + amp.width)
    y = (shape[0] - amp.y0, shape[0] - amp.y0 - amp.height + 1)
    detsec_x = x[::-1] if amp.flip_x else x
    detsec_y = y[::-1] if amp.flip_y else y
    data_x = (segment.data_x0 + 1, segment.data_x0 + amp.width)
    data_y = (segment.data_y0 + 1, segment.data_y0 + amp.height)
    header = fits.Header()
    header["EXTNAME"] = segment.extname
    header["CHANNEL"] = amp.channel
    header["CCDSUM"] = "1 1"
    header["DATASEC"] = f"[{data_x[0]}:{data_x[1]},{data_y[0]}:{data_y[1]}]"
    header["DETSEC"] = f"[{detsec_x[0]}:{detsec_x[1]},{detsec_y[0]}:{detsec_y[1]}]"
    header["DETSIZE"] = f"[1:{shape[1]},1:{shape[0]}]"
    return header
