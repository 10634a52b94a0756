"""The layout that afw expects of an exposure, checked on the bytes of the file without any FITS library."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from product_makers import frame

BLOCK = 2880


def read_headers(content: bytes) -> list[tuple[dict[str, str], int]]:
    """Cards of each HDU as text, and where its data start; every value as it stands before the comment."""
    found = []
    at = 0
    while at < len(content):
        cards: dict[str, str] = {}
        while True:
            card = content[at : at + 80].decode("ascii")
            at += 80
            if card.rstrip() == "END":
                break
            key, _, rest = card.partition("=")
            key = key.removeprefix("HIERARCH").strip()
            assert key not in cards
            cards[key] = rest.split(" / ")[0].strip()
        at = -(-at // BLOCK) * BLOCK
        found.append((cards, at))
        pixels = 1
        for axis in range(int(cards["NAXIS"])):
            pixels *= int(cards[f"NAXIS{axis + 1}"])
        if int(cards["NAXIS"]):
            at += -(-pixels * abs(int(cards["BITPIX"])) // 8 // BLOCK) * BLOCK
    return found


@pytest.fixture
def written(tmp_path: Path) -> tuple[bytes, list[tuple[dict[str, str], int]]]:
    frame(metadata={"DATE-AVG": "2022-03-04T05:06:07"}).write_fits(tmp_path / "fringe.fits")
    content = (tmp_path / "fringe.fits").read_bytes()
    assert len(content) % BLOCK == 0
    return content, read_headers(content)


def test_primary_hdu_is_empty_and_says_what_the_file_is(written) -> None:  # type: ignore[no-untyped-def]
    primary = written[1][0][0]
    assert primary["SIMPLE"] == "T"
    assert primary["NAXIS"] == "0"
    assert primary["EXPINFO_V"] == "1"
    assert primary["FILTER"] == "'y_10    '"
    assert primary["OBSTYPE"] == "'fringe  '"
    assert primary["CALIB_CREATION_DATE"] == "'2022-03-04'"
    assert primary["CALIB_CREATION_TIME"] == "'05:06:07'"
    assert primary["CALIB_CREATION_DATETIME"] == "'2022-03-04T05:06:07'"
    assert primary["TIMESYS"] == "'TAI     '"
    assert "AR_HDU" not in primary


def test_no_time_scale_is_claimed_without_a_time(tmp_path: Path) -> None:
    frame().write_fits(tmp_path / "fringe.fits")
    assert "TIMESYS" not in read_headers((tmp_path / "fringe.fits").read_bytes())[0][0]


def test_image_mask_variance_in_this_order(written) -> None:  # type: ignore[no-untyped-def]
    extensions = [cards for cards, _ in written[1][1:]]
    assert [cards["EXTTYPE"].strip("' ") for cards in extensions] == ["IMAGE", "MASK", "VARIANCE"]
    assert [cards["BITPIX"] for cards in extensions] == ["-32", "32", "-32"]
    for cards in extensions:
        assert cards["XTENSION"] == "'IMAGE   '"
        assert cards["INHERIT"] == "T"
        assert (cards["NAXIS1"], cards["NAXIS2"]) == ("4", "3")
        assert "BZERO" not in cards
        assert "BSCALE" not in cards
        assert [float(cards[key]) for key in ("CRPIX1A", "CRPIX2A", "CRVAL1A", "CRVAL2A")] == [1, 1, 5, 7]


def test_mask_planes_are_named_in_the_mask_only(written) -> None:  # type: ignore[no-untyped-def]
    _, image, mask, variance = (cards for cards, _ in written[1])
    assert mask["MP_BAD"] == "0"
    assert mask["MP_NO_DATA"] == "8"
    assert not [key for key in (*image, *variance) if key.startswith("MP_")]


def test_pixels_are_big_endian_rows_from_the_bottom(written) -> None:  # type: ignore[no-untyped-def]
    content, hdus = written
    expected = frame()
    for (_, at), data, code in zip(
        hdus[1:], (expected.image, expected.mask, expected.variance), "fif", strict=True
    ):
        stored = np.array(struct.unpack(f">12{code}", content[at : at + 48])).reshape(3, 4)
        np.testing.assert_array_equal(stored, data)
