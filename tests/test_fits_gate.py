"""Headers of files from outside are followed exactly: what stands in data is no header, and what follows is one."""

import bz2
import gzip
import io
import lzma
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim import fits_gate
from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.resources import check_axes

CARD, BLOCK = 80, 2880
HOSTILE = f"{'NAXIS':8s}= {1000:>20d}".ljust(CARD).encode()
MINUS = f"{'PCOUNT':8s}= {-1:>20d}".ljust(CARD).encode()


def header(*cards: str) -> bytes:
    text = "".join(card.ljust(CARD) for card in (*cards, "END"))
    return text.ljust(-(-len(text) // BLOCK) * BLOCK).encode()


def image(bits: int, *axes: int, more: tuple[str, ...] = ()) -> bytes:
    cards = [f"NAXIS{number:<3d}= {size:20d}" for number, size in enumerate(axes, 1)]
    return header(
        "XTENSION= 'IMAGE   '", f"BITPIX  = {bits:20d}", f"NAXIS   = {len(axes):20d}", *cards, *more
    )


def filled(size: int) -> bytes:
    """Data of so many bytes that look like hostile cards, up to the next block."""
    return (HOSTILE * (size // CARD + 1))[:size].ljust(-(-size // BLOCK) * BLOCK, b"\0")


PRIMARY = header(
    "SIMPLE  =                    T", "BITPIX  =                    8", "NAXIS   =                    0"
)
UNITS = [
    (image(8, 100, 3), 300),
    (image(-32, 30, 20, 5), 4 * 3000),
    (image(64, 2880), 8 * 2880),
    (image(16, 36, 40), 2880),
    (image(8, 7, 11, more=(f"PCOUNT  = {123:20d}", "GCOUNT  =                    1")), 77 + 123),
    (image(16, 7, 11, more=(f"PCOUNT  = {5:20d}", "GCOUNT  =                    3")), 2 * 3 * (77 + 5)),
    (image(8, 0, 40), 0),
]


@pytest.mark.parametrize(("unit", "size"), UNITS)
def test_data_are_passed_over_and_what_follows_is_looked_at(unit: bytes, size: int) -> None:
    sound = PRIMARY + unit + filled(size) + image(8, 10) + filled(10)
    check_axes(io.BytesIO(sound), "somewhere")
    for spoilt in (PRIMARY + unit + filled(size) + HOSTILE, sound + HOSTILE, sound + MINUS):
        with pytest.raises(FrameFormatError, match=r"NAXIS = 1000|PCOUNT = -1"):
            check_axes(io.BytesIO(spoilt), "somewhere")


@pytest.mark.parametrize(
    "unit",
    [
        image(8, 100).replace(b"XTENSION=", b"XTENSIOM="),
        image(8, 100, more=("NAXIS1  =                   50",)),
        image(8, 100).replace(b"BITPIX", b"BITPIY"),
        image(8, 100).replace(b"NAXIS   =", b"NAXIZ   ="),
        image(8, 100).replace(b"NAXIS1", b"NAXIS2"),
        image(8, 100).replace(b"                 100", b"               100.0"),
    ],
)
def test_behind_a_strange_header_everything_is_looked_at(unit: bytes) -> None:
    """Twice the same keyword, one that is missing, or a size that is no whole number."""
    check_axes(io.BytesIO(PRIMARY + unit + b" " * BLOCK), "somewhere")
    with pytest.raises(FrameFormatError, match="NAXIS"):
        check_axes(io.BytesIO(PRIMARY + unit + filled(100)), "somewhere")


def test_sizes_beyond_the_file(tmp_path: Path) -> None:
    """A gigabyte at most, or a hundred times what a large file takes."""
    for size, good in ((2**30 - 4 * BLOCK, True), (2**30, False), (2**39, False)):
        file = io.BytesIO(PRIMARY + image(8, size))
        if good:
            check_axes(file, "somewhere")
            assert file.tell() == 0
        else:
            with pytest.raises(FrameFormatError, match="up to 1073741824"):
                check_axes(file, "somewhere")
    sparse = tmp_path / "sparse.fits"
    with open(sparse, "wb") as stream:
        stream.write(PRIMARY)
        stream.truncate(2**31)
    with open(sparse, "rb") as stream, pytest.raises(FrameFormatError, match="2147483648 or more"):
        check_axes(stream, "somewhere")
    with open(sparse, "wb") as stream:
        stream.write(PRIMARY + b" " * 13_000_000)
        stream.truncate(2 * 10**9)
    most = 100 * 512 * sparse.stat().st_blocks
    assert 2**30 < most < 2 * 10**9
    with open(sparse, "rb") as stream, pytest.raises(FrameFormatError, match=f"up to {most}"):
        check_axes(stream, "somewhere")


def tiles(*axes: int) -> bytes:
    """A table that says to be an image of these axes, and its data."""
    usual = image(8, 8, 1, more=("PCOUNT  =                    0", "GCOUNT  =                    1"))
    cards = "".join(f"ZNAXIS{number:<2d}= {size:20d} ".ljust(CARD) for number, size in enumerate(axes, 1))
    end = "END".ljust(CARD)
    return usual.replace(end.encode(), (cards + end).encode())[:BLOCK] + filled(8)


def test_compressed_images_larger_than_the_file() -> None:
    """Four bytes for each of their pixels."""
    small = tiles(16384, 16383)
    check_axes(io.BytesIO(PRIMARY + small + small), "somewhere")
    for large, number in ((tiles(16384, 16385), 16384 * 16385), (tiles(1024, 1024, 1024), 2**30)):
        with pytest.raises(FrameFormatError, match=f"{4 * number} or more"):
            check_axes(io.BytesIO(PRIMARY + small + large), "somewhere")


def zipped(content: bytes) -> bytes:
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.fits", content)
    return whole.getvalue()


@pytest.mark.parametrize("compress", [gzip.compress, bz2.compress, lzma.compress, zipped])
def test_compressed_files_are_read_like_others(compress: Callable[[bytes], bytes]) -> None:
    file = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(np.zeros((30, 40))), fits.ImageHDU(np.zeros((3, 4)))]).writeto(file)
    stream = io.BytesIO(compress(file.getvalue()))
    check_axes(stream, "somewhere")
    assert stream.tell() == 0
    with pytest.raises(FrameFormatError, match="NAXIS"):
        check_axes(io.BytesIO(compress(file.getvalue() + HOSTILE)), "somewhere")


def test_what_compress_has_packed_is_refused() -> None:
    with pytest.raises(FrameFormatError, match=r"\.Z"):
        check_axes(io.BytesIO(b"\x1f\x9d" + b"0" * 100), "somewhere")
    check_axes(io.BytesIO(b""), "somewhere")
    with pytest.raises(FrameFormatError, match="NAXIS = 1000"):
        check_axes(io.BytesIO(HOSTILE), "somewhere")


FIRST = "SIMPLE  =                    T"
PLAIN = {"BITPIX": 16, "NAXIS": 2, "NAXIS1": 10, "NAXIS2": 20}
TABLE = {"BITPIX": 8, "NAXIS": 2, "NAXIS1": 10, "NAXIS2": 20, "PCOUNT": 3000, "GCOUNT": 1}


@pytest.mark.parametrize(
    ("first", "cards", "size"),
    [
        (FIRST, PLAIN, 2880),
        (FIRST, PLAIN | {"NAXIS2": 144}, 2880),
        (FIRST, PLAIN | {"NAXIS2": 145}, 5760),
        (FIRST, PLAIN | {"NAXIS2": 0}, 0),
        (FIRST, {"BITPIX": 8, "NAXIS": 0}, 0),
        (FIRST, {"BITPIX": -64, "NAXIS": 1, "NAXIS1": 361}, 5760),
        ("XTENSION= 'BINTABLE'", TABLE, 5760),
        ("XTENSION= 'BINTABLE'", TABLE | {"PCOUNT": 2680}, 2880),
        ("XTENSION= 'BINTABLE'", TABLE | {"GCOUNT": 2, "BITPIX": 16}, 14400),
        ("XTENSION= 'BINTABLE'", TABLE | {"PCOUNT": -201}, None),
        ("XTENSION= 'BINTABLE'", TABLE | {"PCOUNT": -200}, 0),
        ("SIMPLE  =                    F", PLAIN, None),
        ("HISTORY", PLAIN, None),
        (FIRST, {"NAXIS": 1, "NAXIS1": 10}, None),
        (FIRST, {"BITPIX": 16, "NAXIS1": 10}, None),
        (FIRST, {"BITPIX": 16, "NAXIS": 2, "NAXIS1": 10}, None),
        (FIRST, PLAIN | {"NAXIS1": -1, "NAXIS2": -1}, None),
        (FIRST, PLAIN | {"NAXIS2": "20.0"}, None),
        (FIRST, PLAIN | {"GROUPS": "T"}, None),
        (FIRST, PLAIN | {"naxis1": 10}, None),
        (FIRST, {"BITPIX": 8, "NAXIS": 1, "NAXIS1": (1 << 40) - 1}, 1 << 40),
        (FIRST, {"BITPIX": 8, "NAXIS": 1, "NAXIS1": 1 << 40}, None),
        (FIRST, PLAIN | {"EXPTIME": "a"}, 2880),
    ],
)
def test_what_a_header_says_of_the_size_of_its_data(
    first: str, cards: dict[str, Any], size: int | None
) -> None:
    """In whole blocks of 2880 bytes; nothing where astropy may read it otherwise."""
    lines = [first, *(f"{keyword:<8}= {value:>20} / note" for keyword, value in cards.items()), "END"]
    expected = None if size is None else -(-size // 2880) * 2880
    assert fits_gate._data_size("".join(f"{line:<80}" for line in lines).encode()) == expected
