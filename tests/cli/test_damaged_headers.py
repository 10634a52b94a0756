"""Headers that a FITS library stumbles over, or never comes back from, found by ``tests/faults/fuzz.py``."""

import bz2
import gzip
import lzma
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from product_makers import MAKERS
from raw_frame_maker import random_image, raw_hdus, small_detector

from lsst.fringe_sim.cli.inputs import read_section, read_thickness
from lsst.fringe_sim.cli.lab_frames import read_cube
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.cli.provenance import read_header
from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.instrument.raw_frame import RawFrame, read_raw_metadata
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.products import FringeCube, ThicknessMap
from lsst.fringe_sim.products.xarray_export import read_exported
from lsst.fringe_sim.resources import check_axes

CARD = 80


def replaced(content: bytes, keyword: str, value: str, number: int = 0) -> bytes:
    """The file with another value in one of its cards."""
    prefix = f"{keyword:8s}= ".encode()
    place = -1
    for _ in range(number + 1):
        place = content.index(prefix, place + 1)
    return content[:place] + (prefix + value.rjust(20).encode()).ljust(CARD) + content[place + CARD :]


def raw() -> bytes:
    stream = BytesIO()
    raw_hdus(random_image(small_detector()), small_detector()).writeto(stream)
    return stream.getvalue()


def product(name: str, folder: Path) -> bytes:
    path = folder / "sound.fits"
    MAKERS[name]((6, 8)).write_fits(path)
    return path.read_bytes()


SETUP = Setup.from_name("ts8_e2v")

READERS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "raw frame": ("raw", RawFrame.read),
    "raw header": ("raw", read_raw_metadata),
    "map": ("ThicknessMap", ThicknessMap.read_fits),
    "map of anybody": ("ThicknessMap", lambda path: read_thickness(path, SETUP)),
    "cube": ("FringeCube", FringeCube.read_fits),
    "cube of a command": ("FringeCube", lambda path: read_cube(path, SETUP)),
    "provenance": ("FringeCube", read_header),
    "export": ("FringeCube", read_exported),
    "place of a map": ("ThicknessMap", lambda path: read_section(path, small_detector(), (6, 8))),
}


@pytest.mark.parametrize("number", [0, 1, 3], ids=["first", "second", "later"])
@pytest.mark.parametrize("reader", sorted(READERS))
def test_a_header_with_endless_axes_is_refused_at_once(reader: str, number: int, tmp_path: Path) -> None:
    kind, read = READERS[reader]
    sound = raw() if kind == "raw" else product(kind, tmp_path)
    path = tmp_path / "endless.fits"
    path.write_bytes(replaced(sound, "NAXIS", "1234567890", number))
    started = time.process_time()
    with pytest.raises(FrameFormatError, match=r"NAXIS = 1234567890'?; allowed: at most 999 axes"):
        read(str(path))
    assert time.process_time() - started < 5.0


def test_a_column_without_a_name_is_a_damage(tmp_path: Path) -> None:
    path = tmp_path / "column.fits"
    path.write_bytes(replaced(product("FringeCube", tmp_path), "TTYPE1", "0"))
    with pytest.raises(FrameFormatError):
        FringeCube.read_fits(path)


@pytest.mark.parametrize("value", ["1", "0.0", "-1", "'text'", "T"])
def test_a_cube_with_other_axes_than_it_has_is_refused(value: str, tmp_path: Path) -> None:
    path = tmp_path / "cube.fits"
    path.write_bytes(replaced(product("FringeCube", tmp_path), "NAXIS", value))
    with pytest.raises(FrameFormatError):
        read_cube(str(path), SETUP)
    assert run(["fit", str(path), "--out", str(tmp_path / "out")]) == 1


@pytest.mark.parametrize(("keyword", "value"), [("PCOUNT", "-9999"), ("GCOUNT", "-1"), ("NAXIS2", "-12")])
@pytest.mark.parametrize("reader", sorted(READERS))
def test_data_of_a_negative_size_lead_nowhere(reader: str, keyword: str, value: str, tmp_path: Path) -> None:
    """The next header would be in front of them, and again."""
    kind, read = READERS[reader]
    path = tmp_path / "negative.fits"
    sound = raw() if kind == "raw" else product(kind, tmp_path)
    path.write_bytes(replaced(sound, keyword, value))
    with pytest.raises(FrameFormatError, match=f"{keyword} = {value}"):
        read(str(path))


@pytest.mark.parametrize("reader", sorted(READERS))
def test_more_pixels_than_any_memory_holds_are_a_damage(reader: str, tmp_path: Path) -> None:
    kind, read = READERS[reader]
    sound = raw() if kind == "raw" else product(kind, tmp_path)
    path = tmp_path / "huge.fits"
    path.write_bytes(replaced(sound, "NAXIS1", "9999999999999999"))
    if reader == "provenance":
        read(str(path))  # the header alone
        return
    with pytest.raises(FrameFormatError):
        read(str(path))


@pytest.mark.parametrize("compress", [bytes, gzip.compress, bz2.compress, lzma.compress])
@pytest.mark.parametrize("card", [("NAXIS", "1000"), ("TFIELDS", "+0012345")])
def test_what_is_endless_is_seen_wherever_it_stands(
    compress: Callable[[bytes], bytes], card: tuple[str, str]
) -> None:
    """Also across the pieces in which a file is read; text like it that is no card is none."""
    keyword, value = card
    line = f"{keyword:8s}= {value:>20s}".ljust(CARD).encode()
    long = b" " * (CARD * 52_428)  # what fits into one piece and a little more
    for before in (b"", long[:-CARD], long, long + long):
        stream = BytesIO(compress(before + line + b" " * 100))
        with pytest.raises(FrameFormatError, match=f"{keyword}"):
            check_axes(stream, "somewhere")
    harmless = BytesIO(compress(long + b"x" + line + f"{keyword:8s}= {999:20d}".encode()))
    check_axes(harmless, "somewhere")
    assert harmless.tell() == 0


@pytest.mark.parametrize("compress", [bytes, gzip.compress])
def test_only_headers_are_looked_at(compress: Callable[[bytes], bytes]) -> None:
    """Pixels may look like a card; behind them a header is seen again, and behind a strange header everything."""
    card = f"{'NAXIS':8s}= {1000:>20d}".ljust(CARD).encode()
    pixels = np.frombuffer(card * 72, dtype=np.uint8).reshape(10, -1)
    sound = BytesIO()
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(pixels), fits.ImageHDU(pixels)]).writeto(sound)
    check_axes(BytesIO(compress(sound.getvalue())), "somewhere")
    endless = sound.getvalue() + b"XTENSION= 'IMAGE   '".ljust(CARD) + card
    strange = sound.getvalue().replace(
        b"NAXIS   =                    2", b"NAXIS   =                    ?", 1
    )
    for spoilt in (endless, strange):
        with pytest.raises(FrameFormatError, match="NAXIS"):
            check_axes(BytesIO(compress(spoilt)), "somewhere")


def test_sound_files_pass(tmp_path: Path) -> None:
    path = tmp_path / "sound.fits.gz"
    fits.PrimaryHDU(np.ones((5, 7), np.float32)).writeto(path)
    assert read_thickness(path, SETUP).shape == (5, 7)
