"""Raw files of a mock sensor: times, headers and the layout on disk."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..files import all_or_nothing
from ..instrument.camera import Amplifier, Camera, Detector, RawSegment
from .readout import BIAS_LEVEL_ADU, raw_segment

EXPOSURE_BASE_S = 12.0  # Exposure time at 800 nm [s]
READOUT_S = 40  # Time between two exposures [s]
DAY_ROLLOVER_H = 8  # UTC hour at which the observing day of the test stand begins


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


LSST_LAYOUT = frozenset({"lsstCam", "ts8", "monocam"})  # Cameras whose raw frames are in the LSST layout
OVERSCAN_PX = 32  # Columns of overscan of an amplifier whose raw layout is not known


def with_raw_layout(sensor: Detector) -> Detector:
    """The sensor with one image for each amplifier, as it lies on the sensor, and overscan to its right."""
    segments = [
        RawSegment(number, amp.name, (amp.height, amp.width + OVERSCAN_PX), 0, 0)
        for number, amp in enumerate(sensor.amplifiers, start=1)
    ]
    amplifiers = zip(sensor.amplifiers, segments, strict=True)
    return replace(sensor, amplifiers=tuple(replace(amp, raw=raw) for amp, raw in amplifiers))


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
        *(_lsst_cards if camera in LSST_LAYOUT else _own_cards)(camera, sensor),
        ("TESTTYPE", "BIAS" if wavelength_nm is None else "LAMBDA", "kind of acquisition"),
        ("IMGTYPE", "BIAS" if wavelength_nm is None else "FLAT", "kind of image"),
        ("DAYOBS", day, "observing day"),
        ("SEQNUM", number + 1, "number within the sequence"),
        ("DETSIZE", f"[1:{columns},1:{rows}]", "assembled sensor"),
        ("TEMP_SET", celsius, "[degC] set point"),
        ("CCDTEMP", celsius, "[degC] measured temperature"),
        ("EXPTIME", exposure_s, "[s] exposure time"),
        ("DARKTIME", exposure_s, "[s] time since the sensor was cleared"),
        ("FILENAME", f"{sensor.serial or sensor.name}_{kind}_{stamp}.fits", ""),
    ]
    if wavelength_nm is not None:
        cards.append(("MONOWL", wavelength_nm, "[nm] wavelength of the monochromator"))
    for card in cards:
        header.append(card, end=True)
    return header


def _own_cards(camera: str, sensor: Detector) -> list[tuple[str, Any, str]]:
    return [
        ("INSTRUME", Path(camera).stem, "instrument"),
        ("DETNAME", sensor.serial or sensor.name, "sensor"),
        ("VENDOR", sensor.vendor, "maker of the sensor"),
    ]


def _lsst_cards(camera: str, sensor: Detector) -> list[tuple[str, Any, str]]:
    return [
        *_camera_cards(camera, sensor),
        ("CCD_MANU", sensor.vendor.upper(), "maker of the sensor"),
        ("LSST_NUM", sensor.serial, "serial number of the sensor"),
        ("RAFTNAME", sensor.raft_serial, "serial number of the raft"),
        ("SLOTNAME", sensor.slot, "slot within the raft"),
        ("CCDSLOT", sensor.slot, "slot within the raft"),
    ]


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
    header_of = _amplifier_header if "LSST_NUM" in header else _own_amplifier_header
    for amp, image in zip(sensor.amplifiers, images, strict=True):
        hdus.append(fits.ImageHDU(image, header=header_of(amp, sensor.shape)))
    with all_or_nothing(path) as part, open(part, "wb") as stream:
        hdus.writeto(stream)


def _amplifier_header(amp: Amplifier, shape: tuple[int, int]) -> fits.Header:
    """Header of one amplifier, with the y sense of DETSEC swapped as in real files (DM-36115)."""
    x = (amp.x0 + 1, amp.x0 + amp.width)
    y = (shape[0] - amp.y0, shape[0] - amp.y0 - amp.height + 1)
    return _sections(amp, shape, x, y)


def _own_amplifier_header(amp: Amplifier, shape: tuple[int, int]) -> fits.Header:
    """Header of one amplifier of a camera that is not of LSST: no table has its gain and noise, so it states them."""
    x, y = (amp.x0 + 1, amp.x0 + amp.width), (amp.y0 + 1, amp.y0 + amp.height)
    header = _sections(amp, shape, x, y)
    header["BUNIT"] = "adu"
    header["GAIN"] = (amp.gain, "[electron/adu]")
    header["RDNOISE"] = (amp.read_noise, "[electron]")
    level, scatter = BIAS_LEVEL_ADU
    header["SATURATE"] = (round(level - 5.0 * scatter + amp.saturation), "[adu] with the bias level")
    return header


def _sections(amp: Amplifier, shape: tuple[int, int], x: tuple[int, int], y: tuple[int, int]) -> fits.Header:
    segment = raw_segment(amp)
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
