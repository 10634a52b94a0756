from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st
from product_makers import MAKERS, METADATA, NAMES, SHAPES, cube, flat

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.products import FringeCube

KINDS = st.sampled_from(sorted(MAKERS))


def assert_identical(left: Any, right: Any) -> None:
    assert type(left) is type(right)
    for item in dataclasses.fields(left):
        first, second = getattr(left, item.name), getattr(right, item.name)
        if dataclasses.is_dataclass(first):
            assert_identical(first, second)
        elif isinstance(first, np.ndarray):
            assert first.shape == second.shape
            native = second.astype(second.dtype.newbyteorder("="))
            assert first.dtype == native.dtype
            assert first.tobytes() == native.tobytes()
        elif isinstance(first, Mapping):
            assert {key: (type(value), value) for key, value in first.items()} == {
                key: (type(value), value) for key, value in second.items()
            }
        else:
            assert first == second
            assert type(first) is type(second)


@given(KINDS, SHAPES, st.integers(0, 2**31), METADATA, NAMES)
def test_bit_for_bit(
    kind: str, shape: tuple[int, int], seed: int, metadata: dict[str, Any], detector: str
) -> None:
    product = MAKERS[kind](shape, seed, metadata=metadata, detector=detector)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "product.fits"
        product.write_fits(path)
        assert_identical(product, type(product).read_fits(path))


@pytest.mark.parametrize("kind", sorted(MAKERS))
def test_two_writes_agree_to_the_byte(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    product = MAKERS[kind](metadata={"NOTE": "x"})
    product.write_fits(tmp_path / "a.fits")
    # The clock that astropy stamps checksums with moves on.
    monkeypatch.setattr(fits.hdu.base._ValidHDU, "_get_timestamp", lambda self: "2099-01-01T00:00:00")
    product.write_fits(tmp_path / "b.fits")
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()


@pytest.mark.parametrize("kind", sorted(MAKERS))
def test_what_is_on_disk_is_plain_fits_with_right_checksums(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "product.fits"
    MAKERS[kind]().write_fits(path, {"QFLOAT": -1.2345678901234567e-101})
    with fits.open(path, checksum=True) as hdus:  # warnings are errors here
        hdus.verify("exception")
        assert all("CHECKSUM" in hdu.header and "DATASUM" in hdu.header for hdu in hdus)
        assert hdus[0].header["QFLOAT"] == -1.2345678901234567e-101


@pytest.mark.parametrize("kind", sorted(MAKERS))
def test_metadata_of_the_write_win_and_are_read_back(kind: str, tmp_path: Path) -> None:
    product = MAKERS[kind](metadata={"NOTE": "first", "KEPT": 1})
    product.write_fits(tmp_path / "product.fits", {"note": "second", "LSST BUTLER ID": "x" * 70})
    assert dict(type(product).read_fits(tmp_path / "product.fits").metadata) == {
        "NOTE": "second",
        "KEPT": 1,
        "LSST BUTLER ID": "x" * 70,
    }


@pytest.mark.parametrize("kind", sorted(MAKERS))
def test_products_cannot_be_changed(kind: str) -> None:
    product = MAKERS[kind]()
    for item in dataclasses.fields(product):
        value = getattr(product, item.name)
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(product, item.name, value)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0
    with pytest.raises(TypeError):
        product.metadata["NEW"] = 1


def test_writing_leaves_the_callers_array_as_it_was(tmp_path: Path) -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4) / 100
    before = image.copy()
    flat(image=image, mask=np.zeros((3, 4), int), variance=image).write_fits(tmp_path / "flat.fits")
    assert image.flags.writeable
    np.testing.assert_array_equal(image, before)


def test_a_memory_mapped_cube_holds_the_same_numbers(tmp_path: Path) -> None:
    product = cube()
    product.write_fits(tmp_path / "cube.fits")
    mapped = FringeCube.read_fits(tmp_path / "cube.fits", memmap=True)
    base: Any = mapped.image
    while isinstance(base, np.ndarray) and not isinstance(base, np.memmap):
        base = base.base
    assert isinstance(base, np.memmap) or type(base).__name__ == "mmap"
    assert_identical(product, mapped)


@given(KINDS, st.integers(0, 10**6), st.integers(1, 255))
def test_one_damaged_byte_is_refused_or_harmless(kind: str, at: int, change: int) -> None:
    product = MAKERS[kind]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "product.fits"
        product.write_fits(path)
        content = bytearray(path.read_bytes())
        place = at % len(content)
        content[place] ^= change
        path.write_bytes(content)
        try:
            back = type(product).read_fits(path)
        except InputError as error:
            source = error.source
        else:  # a blank behind the END of a header
            assert_identical(product, back)
            source = str(path)
    assert source == str(path)


@pytest.mark.parametrize(
    "scale", [{"BZERO": 3.4028235677973366e38}, {"BSCALE": 1e308}, {"BZERO": 1e30}], ids=str
)
@pytest.mark.parametrize("kind", sorted(MAKERS))
def test_scales_beyond_the_numbers_are_refused(kind: str, scale: dict[str, float], tmp_path: Path) -> None:
    """A file without checksums, whose images overflow where astropy scales them."""
    product, path = MAKERS[kind](), tmp_path / "product.fits"
    product.write_fits(path)
    with fits.open(path, mode="update", do_not_scale_image_data=True) as hdus:
        for hdu in hdus:
            hdu.header.update(scale if hdu.is_image and hdu.data is not None else {})
            for card in ("CHECKSUM", "DATASUM"):
                hdu.header.remove(card)
    with pytest.raises(InputError, match=r"product\.fits"):
        type(product).read_fits(path)


@given(KINDS, st.integers(0, 10**6))
def test_a_truncated_file_never_passes(kind: str, length: int) -> None:
    product = MAKERS[kind]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "product.fits"
        product.write_fits(path)
        content = path.read_bytes()
        path.write_bytes(content[: length % len(content)])
        with pytest.raises(InputError) as caught:
            type(product).read_fits(path)
        assert str(path) in str(caught.value)


def test_a_missing_file_and_a_wrong_product_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="an existing FITS file"):
        FringeCube.read_fits(tmp_path / "none.fits")
    flat().write_fits(tmp_path / "flat.fits")
    with pytest.raises(InputError, match="PRODUCT is 'FringeFlat'; allowed: FringeCube"):
        FringeCube.read_fits(tmp_path / "flat.fits")


def test_a_failed_write_leaves_the_old_file_and_no_rubbish(tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "flat.fits"
    flat(wavelength_nm=900.0).write_fits(path)
    before = path.read_bytes()

    def full_disk(*args: Any, **kwargs: Any) -> None:
        args[1].write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fits.HDUList, "writeto", full_disk)
    with pytest.raises(OSError, match="No space"):
        flat(wavelength_nm=910.0).write_fits(path)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["flat.fits"]


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="an existing folder"):
        flat().write_fits(tmp_path / "nowhere" / "flat.fits")
