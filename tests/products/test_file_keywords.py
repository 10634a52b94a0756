"""Keywords of maps, cubes and sky frames are used, checked or refused as `FILE_KEYWORDS` says."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import product_makers as make
import pytest
from astropy.io import fits

from lsst.fringe_sim import products as p
from lsst.fringe_sim.algorithms.pca import fit_pca
from lsst.fringe_sim.cli.inputs import read_section
from lsst.fringe_sim.cli.observed import latest_date
from lsst.fringe_sim.cli.sky import laboratory_contrast, map_header
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.products.file_keywords import FILE_KEYWORDS, FILTER_NAMES, PLACE_NAMES, SENSOR_NAMES
from lsst.fringe_sim.products.observed_files import observed_images
from lsst.fringe_sim.products.sky_frame import CORRECTED_BY

SENSOR = Camera.from_name("lsstCam").detector("R22_S11")
GOOD = np.zeros((3, 4), np.int32)


def with_card(path: Path, keyword: str, value: Any, hdu: int = 0) -> Path:
    """The file with another card, and checksums that fit."""
    with fits.open(path, mode="update", checksum=True) as hdus:
        if value is None:
            del hdus[hdu].header[keyword]
        else:
            hdus[hdu].header[keyword] = value
    return path


def read_map(path: Path) -> Any:
    found = p.ThicknessMap.read_any(path, "epoxy")
    section = read_section(path, SENSOR, found.shape)
    return (
        found.value.tobytes(),
        found.mask.tobytes(),
        str(section),
        laboratory_contrast(map_header(str(path)), str(path)),
    )


def read_cube(path: Path) -> Any:
    cube = p.FringeCube.read_fits(path)
    p.refuse_noiseless(cube.metadata)
    return cube.unit, cube.layer, cube.metadata, cube.mask.tobytes()


def read_sky(path: Path) -> Any:
    """Frames beside one of the model that they have."""
    frame = p.SkyFringe.read_fits(path)
    p.refuse_noiseless(frame.metadata)
    p.refuse_corrected(frame.metadata)
    others = [make.sky(mask=GOOD, number=number, metadata=MODEL) for number in (5, 6)]
    p.SkyFrames([*others, frame], make.thickness(mask=GOOD))
    return frame.fraction().tobytes(), fit_pca([*others, frame], n_components=1).metadata


class Plain:
    """A flat and a bias image of one sensor in one folder."""

    cards: ClassVar[dict[str, Any]] = {
        "IMGTYPE": "FLAT",
        "BUNIT": "adu",
        "GAIN": 0.7,
        "RDNOISE": 5.0,
        "SATURATE": 900.0,
    }

    def write_fits(self, path: Path, cards: dict[str, Any] | None = None) -> None:
        image = np.arange(12, dtype=np.float32).reshape(3, 4) + 890.0
        (path.parent / "bias").mkdir(exist_ok=True)
        others = {"BUNIT": "adu", "GAIN": 0.7, "IMGTYPE": "BIAS"} | dict.fromkeys(SENSOR_NAMES[:1], "S0")
        fits.PrimaryHDU(image - 800.0, fits.Header(others)).writeto(path.parent / "bias" / "b.fits")
        fits.PrimaryHDU(image, fits.Header(self.cards | (cards or {}))).writeto(path)


class Amplifiers:
    """A flat of a sensor with two amplifiers of 3 by 2 pixels and an overscan of one."""

    def write_fits(self, path: Path) -> None:
        first = fits.PrimaryHDU(header=fits.Header({"INSTRUME": "own", "IMGTYPE": "FLAT", "MONOWL": 950.0}))
        images = []
        for number, detsec in enumerate(("[1:2,1:3]", "[4:3,1:3]")):
            pixels = (np.arange(9, dtype=np.int16) ** 2 + 10 * number).reshape(3, 3) + 800
            cards = {"DATASEC": "[1:2,1:3]", "DETSEC": detsec, "DETSIZE": "[1:4,1:3]", "BUNIT": "adu"}
            images.append(fits.ImageHDU(pixels, fits.Header(cards | {"GAIN": 0.7, "RDNOISE": 5.0})))
            images[-1].header["SATURATE"] = 900.0
        fits.HDUList([first, *images]).writeto(path)


def read_amplifiers(path: Path) -> Any:
    return read_plain(path, bias=False)


def read_plain(path: Path, bias: bool = True) -> Any:
    light = {"temperature_k": 183.0, "bandwidth_fwhm_nm": 2.0}
    cube = p.read_plain_flats([path, path.parent / "bias" / "b.fits"][: 1 + bias], **light)
    rows = cube.exposures
    arrays = (cube.image, cube.variance, cube.mask, rows.wavelength_nm, rows.temperature_k, rows.dark_time_s)
    return [array.tobytes() for array in arrays]


class Observed:
    """A frame with its mask and its uncertainty."""

    def write_fits(self, path: Path) -> None:
        image, mask = np.arange(12, dtype=np.float32).reshape(3, 4), np.eye(3, 4, dtype=np.int32)
        parts = [
            fits.ImageHDU(image),
            fits.ImageHDU(mask, name="MASK"),
            fits.ImageHDU(image + 1, name="UNCERT"),
        ]
        parts[1].header["MP_SAT"] = 0
        fits.HDUList([fits.PrimaryHDU(), *parts]).writeto(path)


def read_observed(path: Path) -> Any:
    (image,) = observed_images(path)
    header = image.header()
    p.refuse_corrected(header)
    frame = image.read()
    named = (frame.unit, frame.detector, frame.physical_filter, latest_date([header]))
    return named, frame.mask.tobytes(), frame.variance.tobytes()


MODEL = {"SETUP": "lsst_e2v", "BEAMS": "pixel", "EFFECT0": "roughness.sigma", "EFFVAL0": 2.0, "TABLE0": "a 1"}
"""Cards of a model."""

FILES: dict[str, tuple[Callable[[], Any], Callable[[Path], Any]]] = {
    "thickness map": (lambda: make.thickness(mask=GOOD), read_map),
    "fringe cube": (lambda: make.cube(mask=np.zeros((2, 3, 4), np.int32)), read_cube),
    "sky frame": (lambda: make.sky(mask=GOOD, metadata=MODEL), read_sky),
    "plain flat": (Plain, read_plain),
    "flat of amplifiers": (Amplifiers, read_amplifiers),
    "observed frame": (Observed, read_observed),
    "any product": (
        lambda: make.thickness(mask=np.eye(3, 4, dtype=np.int32) * p.mask_bits("SLIP")),
        read_map,
    ),
}

VALUES: dict[tuple[str, str], tuple[int, tuple[Any, ...]]] = {
    ("thickness map", "BUNIT"): (1, ("nm", "K")),
    ("thickness map", "LAYER"): (0, ("silicon",)),
    ("thickness map", "DETSEC"): (0, ("[11:14,21:23]", "[11:14,9021:9023]")),
    ("thickness map", "CCDSEC"): (0, ("[11:14,21:23]", "[11:14,9021:9023]")),
    ("fringe cube", "BUNIT"): (1, ("adu", "relative")),
    ("fringe cube", "LAYER"): (0, ("other",)),
    ("fringe cube", "SMOOTHPX"): (0, (1.5,)),
    ("fringe cube", "NOISE"): (0, (False, "F")),
    ("sky frame", "BUNIT"): (1, ("adu",)),
    ("sky frame", "NOISE"): (0, (False, 0, "no")),
    ("sky frame", "FRINGCOR"): (0, (2,)),
    ("sky frame", "SETUP"): (0, ("hsc",)),
    ("sky frame", "BEAMS"): (0, ("centre",)),
    ("sky frame", "EFFECTn"): (0, ("bandwidth.fwhm",)),
    ("sky frame", "EFFVALn"): (0, (3.0,)),
    ("sky frame", "TABLEn"): (0, ("a 2",)),
    ("sky frame", "RDNOISE"): (0, (7.0,)),
    ("plain flat", "IMGTYPE"): (0, ("DARK", "BIAS")),
    ("plain flat", "MONOWL"): (0, (951.0, 9500.0)),
    ("plain flat", "WAVELEN"): (0, (940.0,)),
    ("plain flat", "WAVELNTH"): (0, (940.0,)),
    ("plain flat", "TEMPK"): (0, (170.0,)),
    ("plain flat", "CCDTEMP"): (0, (-100.0,)),
    ("plain flat", "EXPTIME"): (0, (0.0, -1.0, 7.0)),
    ("plain flat", "FILTER"): (0, ("r_57", "550nm")),
    ("plain flat", "BUNIT"): (0, ("electron", "jansky")),
    ("plain flat", "GAIN"): (0, (0.8, -1.0)),
    ("plain flat", "RDNOISE"): (0, (9.0, -9.0)),
    ("plain flat", "NOISE"): (0, (False, "F")),
    ("plain flat", "SATURATE"): (0, (895.0,)),
    **{("plain flat", name): (0, ("S1",)) for name in SENSOR_NAMES},
    ("plain flat", "DATASEC"): (0, ("[2:4,1:3]",)),
    ("plain flat", "TRIMSEC"): (0, ("[1:4,1:2]", "words")),
    ("flat of amplifiers", "INSTRUME"): (0, ("LSST_CAMERA",)),
    ("flat of amplifiers", "DATASEC"): (1, ("[2:3,1:3]", "[1:3,1:3]")),
    ("flat of amplifiers", "DETSEC"): (1, ("[2:1,1:3]", "[3:4,1:3]")),
    ("flat of amplifiers", "DETSIZE"): (1, ("[1:5,1:3]",)),
    ("flat of amplifiers", "BUNIT"): (1, ("electron",)),
    ("flat of amplifiers", "GAIN"): (1, (0.8, -1.0)),
    ("flat of amplifiers", "RDNOISE"): (1, (9.0, -9.0)),
    ("flat of amplifiers", "SATURATE"): (1, (810.0,)),
    ("observed frame", "BUNIT"): (1, ("adu",)),
    **{
        ("observed frame", name): (1, ("S1",))
        for name in (*SENSOR_NAMES, "EXTNAME", *PLACE_NAMES, *FILTER_NAMES)
    },
    **{("observed frame", name): (1, (True, "fringe.fits")) for name in CORRECTED_BY},
    ("observed frame", "DATE-OBS"): (1, ("2026-01-02T03:04:05",)),
    ("observed frame", "OBSDATE"): (0, ("2026-01-02T03:04:05",)),
    ("observed frame", "UTYPE"): (3, ("variance",)),
    ("observed frame", "MP_<plane>"): (2, (1, 99)),
    ("any product", "PRODUCT"): (0, ("SkyFringe",)),
    ("any product", "PRODVER"): (0, (7,)),
    ("any product", "NEXTEND"): (0, (3,)),
    ("any product", "MP_<plane>"): (5, (17,)),
}
"""HDU and other values."""


TRIED = [item for item in FILE_KEYWORDS if item.name not in ("PLVER", "DATAMODL", "MSKNn", "MSKMn")]
"""Bits and codes of two versions, and files of ``lsst.images``, are in tests/products/test_observed_files.py."""


@pytest.mark.parametrize("case", TRIED, ids=[f"{item.file} {item.name}" for item in TRIED])
def test_another_value_has_the_declared_consequence(case: Any, tmp_path: Path) -> None:
    maker, reader = FILES[case.file]
    maker().write_fits(tmp_path / "former.fits")
    if case.name in ("CHECKSUM", "DATASUM"):
        assert_checksums_are_compared(tmp_path / "former.fits", case.name)
        return
    if case.name.startswith("CONTR"):
        both = {"CONTRAST": 0.2, "CONTRSIG": 0.01}
        maker().write_fits(tmp_path / "former.fits", both)
        hdu, values = 0, (0.4,)
    else:
        hdu, values = VALUES[case.file, case.name]
    if case.file == "plain flat":
        (tmp_path / "bias" / "b.fits").unlink()
        (tmp_path / "former.fits").unlink()
        # Of several keywords of one thing, the former file has only the one that is asked for.
        same = {"WAVELEN": 950.0, "WAVELNTH": 950.0}.get(case.name)
        maker().write_fits(tmp_path / "former.fits", {case.name: same} if same else {"MONOWL": 950.0})
    plane = "MP_SAT" if case.file == "observed frame" else "MP_SLIP"
    keyword = plane if case.name == "MP_<plane>" else case.name.replace("n", "0")
    before = reader(tmp_path / "former.fits")
    outcomes = set()
    for number, value in enumerate(values):
        path = tmp_path / f"{number}.fits"
        path.write_bytes((tmp_path / "former.fits").read_bytes())
        try:
            after = reader(with_card(path, keyword, value, hdu))
            outcomes.add("same" if after == before else "changed")
        except InputError:
            outcomes.add("refused")
    if case.treatment == "used":
        assert outcomes <= {"changed", "refused"}
    else:
        assert outcomes == {"refused"}


def assert_checksums_are_compared(path: Path, keyword: str) -> None:
    content = path.read_bytes()
    place = content.index(keyword.encode(), 2880)
    path.write_bytes(content[: place + 11] + b"9999" + content[place + 15 :])
    with pytest.raises(InputError):
        read_map(path)
    path.write_bytes(content)
    with fits.open(path) as hdus:
        del hdus[1].header[keyword]
        hdus.writeto(path.with_name("without.fits"))
    with pytest.raises(InputError):
        read_map(path.with_name("without.fits"))


def test_every_keyword_is_tried() -> None:
    """Those with a function of their own are CHECKSUM, DATASUM and the contrast."""
    own = {("thickness map", "CONTRAST"), ("thickness map", "CONTRSIG")}
    own |= {("any product", "CHECKSUM"), ("any product", "DATASUM")}
    assert {(item.file, item.name) for item in TRIED} == VALUES.keys() | own
