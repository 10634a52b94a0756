from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lsst.fringe_sim.errors import FrameFormatError, UnknownNameError
from lsst.fringe_sim.products import MASK_PLANES, describe_mask, mask_bits
from lsst.fringe_sim.products.mask import ALL_BITS, planes_from_header, remap_mask

AFW_PLANES = {
    "BAD": 0,
    "SAT": 1,
    "INTRP": 2,
    "CR": 3,
    "EDGE": 4,
    "DETECTED": 5,
    "DETECTED_NEGATIVE": 6,
    "SUSPECT": 7,
    "NO_DATA": 8,
}


def test_the_planes_of_afw_keep_their_bits() -> None:
    assert {name: MASK_PLANES[name] for name in AFW_PLANES} == AFW_PLANES
    assert len(set(MASK_PLANES.values())) == len(MASK_PLANES)
    assert min(set(MASK_PLANES.values()) - set(AFW_PLANES.values())) > max(AFW_PLANES.values())


def test_every_plane_fits_into_the_narrow_mask_of_a_cube() -> None:
    assert np.iinfo(np.int16).max >= ALL_BITS


def test_bits_add_up_and_repeat_harmlessly() -> None:
    assert mask_bits() == 0
    assert mask_bits("SAT", "EDGE", "SAT") == 2 + 16


def test_unknown_plane_offers_the_near_one() -> None:
    with pytest.raises(UnknownNameError, match="did you mean NO_DATA"):
        mask_bits("NODATA")


@given(st.permutations(list(MASK_PLANES)), st.data())
def test_remap_follows_names_not_bits(order: list[str], data: st.DataObject) -> None:
    bits = data.draw(st.lists(st.integers(0, 30), min_size=len(order), max_size=len(order), unique=True))
    planes = dict(zip(order, bits, strict=True))
    chosen = data.draw(st.lists(st.sampled_from(order), min_size=6, max_size=6))
    stored = np.array([1 << planes[name] for name in chosen], dtype=np.int32).reshape(2, 3)
    expected = np.array([mask_bits(name) for name in chosen], dtype=np.int32).reshape(2, 3)
    np.testing.assert_array_equal(remap_mask(stored, planes), expected)


@given(arrays(np.int32, (3, 4), elements=st.integers(0, ALL_BITS)))
def test_describe_counts_each_plane(mask: np.ndarray) -> None:
    for name, count in describe_mask(mask).items():
        assert count == sum(bool(value & mask_bits(name)) for value in mask.flat) > 0


def test_a_bit_without_a_name_is_refused() -> None:
    with pytest.raises(FrameFormatError, match="0x4"):
        remap_mask(np.array([[4]]), {"BAD": 0, "SAT": 1})


@pytest.mark.parametrize(
    ("header", "error"),
    [
        ({"MP_COSMIC": 3}, UnknownNameError),
        ({"MP_BAD": 31}, FrameFormatError),
        ({"MP_BAD": True}, FrameFormatError),
        ({"MP_BAD": "0"}, FrameFormatError),
        ({"MP_BAD": 1, "MP_SAT": 1}, FrameFormatError),
    ],
)
def test_headers_that_name_planes_badly(header: dict[str, object], error: type[Exception]) -> None:
    with pytest.raises(error):
        planes_from_header(header)
