"""Raw frames for tests, written from an assembled image and the table of the raw layout.

Independent of the reader: it follows `Amplifier` (position and flips from the shipped table), and writes
``DATASEC``, ``DETSEC`` and ``DETSIZE`` with the y sense that real files have.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Amplifier, Camera, Detector

PRESCAN, SERIAL, PARALLEL = 1000, 2000, 3000  # Values of the pixels outside the imaging sections

TS8_HEADER: dict[str, Any] = {
    "TSTAND": "TS8",
    "DATE-OBS": "2018-07-24T10:28:45.342",
    "MJD-OBS": 58323.43663590262,
    "RUNNUM": "6006D",
    "LSST_NUM": "E2V-CCD250-321",
    "RAFTNAME": "LCA-11021_RTM-020",
    "TESTTYPE": "LAMBDA",
    "IMGTYPE": "FLAT",
    "SEQNUM": 17,
    "CCDTEMP": -90.5,
    "MONOWL": 960.03,
    "EXPTIME": 21.9,
    "MONOCH-WAVELENG": 675.0,
    "MONOCH-BANDPASS": 0.0,
}

LSSTCAM_HEADER: dict[str, Any] = {
    "INSTRUME": "lsstCam",
    "DATE-OBS": "2021-12-13T04:58:56.398",
    "RAFTBAY": "R11",
    "CCDSLOT": "S01",
    "LSST_NUM": "E2V-CCD250-321",
    "RAFTNAME": "LCA-11021_RTM-020",
    "CONTRLLR": "C",
    "DAYOBS": "20211212",
    "SEQNUM": 310,
    "OBSID": "MC_C_20211212_000310",
    "IMGTYPE": "FLAT",
    "TESTTYPE": "FLAT",
    "FILTER": "y_10",
    "EXPTIME": 15.0,
    "DARKTIME": 15.2,
    "CCDTEMP": -100.168,
}


def result_or_refusal(function: Callable[[], Any]) -> tuple[Any, str]:
    """What a function returns, or the message with which it refuses its input."""
    try:
        return function(), ""
    except InputError as error:
        return None, str(error)


def small_detector(vendor: str = "e2v", shape: tuple[int, int] = (24, 40)) -> Detector:
    name = {"e2v": "R11_S01", "ITL": "R01_S00"}[vendor]
    return Camera.from_name("lsstCam").detector(name).cut_down(shape)


def header_with(
    changes: Mapping[str, Any] | None = None, base: Mapping[str, Any] = TS8_HEADER
) -> dict[str, Any]:
    """The header with some values changed; `None` takes a keyword out. Another date takes the Julian one out."""
    changes = changes or {}
    merged = {**base, **({} if changes.get("DATE-OBS") is None else {"MJD-OBS": None}), **changes}
    return {keyword: value for keyword, value in merged.items() if value is not None}


def detsec(amp: Amplifier, n_rows: int) -> str:
    """``DETSEC`` as real files have it: y counted from the top of the assembled CCD."""
    x = [amp.x0 + 1, amp.x0 + amp.width]
    y = [n_rows - amp.y0, n_rows - amp.y0 - amp.height + 1]
    if amp.flip_x:
        x.reverse()
    if amp.flip_y:
        y.reverse()
    return f"[{x[0]}:{x[1]},{y[0]}:{y[1]}]"


def amplifier_hdu(amp: Amplifier, image: np.ndarray, n_rows: int, n_columns: int) -> fits.ImageHDU:
    assert amp.raw is not None
    y0, x0 = amp.raw.data_y0, amp.raw.data_x0
    raw = np.full(amp.raw.shape, PRESCAN, dtype=np.int32)
    raw[y0 : y0 + amp.height, x0 + amp.width :] = SERIAL
    raw[y0 + amp.height :, :] = PARALLEL
    section = image[amp.section]
    if amp.flip_y:
        section = section[::-1]
    if amp.flip_x:
        section = section[:, ::-1]
    raw[y0 : y0 + amp.height, x0 : x0 + amp.width] = section
    hdu = fits.ImageHDU(raw, name=amp.raw.extname)
    hdu.header["CHANNEL"] = amp.channel
    hdu.header["DATASEC"] = f"[{x0 + 1}:{x0 + amp.width},{y0 + 1}:{y0 + amp.height}]"
    hdu.header["DETSEC"] = detsec(amp, n_rows)
    hdu.header["DETSIZE"] = f"[1:{n_columns},1:{n_rows}]"
    return hdu


def raw_hdus(
    image: np.ndarray, detector: Detector, changes: Mapping[str, Any] | None = None, **kwargs: Any
) -> fits.HDUList:
    """HDUs of a raw frame; ``changes`` are to the primary header."""
    primary = fits.PrimaryHDU()
    for keyword, value in header_with(changes, **kwargs).items():
        primary.header[keyword if len(keyword) <= 8 else f"HIERARCH {keyword}"] = value
    amplifiers = [amplifier_hdu(amp, image, *detector.shape) for amp in detector.amplifiers]
    return fits.HDUList([primary, *amplifiers])


def random_image(detector: Detector, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(20_000, 60_000, detector.shape, dtype=np.int32)


def write_raw(
    path: Path, changes: Mapping[str, Any] | None = None, *, detector: Detector | None = None, **kwargs: Any
) -> Path:
    """Write a small raw frame of random pixels."""
    detector = detector or small_detector()
    raw_hdus(random_image(detector), detector, changes, **kwargs).writeto(path)
    return path
