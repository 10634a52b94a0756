"""Cubes written by other programs, to the published layout only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from lsst.fringe_sim.errors import FrameFormatError, InputError, UnknownNameError
from lsst.fringe_sim.products import FringeCube, mask_bits


def hdus(number: int = 2, shape: tuple[int, int] = (3, 4), unit: str = "electron") -> dict[str, Any]:
    rng = np.random.default_rng(5)
    image = rng.normal(20000, 100, (number, *shape))
    table = Table(
        {
            "wavelength": np.linspace(990, 880, number),
            "bandwidth_fwhm": np.full(number, 2.0),
            "temperature": np.full(number, 183.0),
            "f_number": np.full(number, np.inf),
        }
    )
    image_hdu = fits.ImageHDU(image.astype(np.float32), name="IMAGE")
    image_hdu.header["BUNIT"] = unit
    return {
        "PRIMARY": fits.PrimaryHDU(),
        "IMAGE": image_hdu,
        "VARIANCE": fits.ImageHDU(image, name="VARIANCE"),  # float64
        "MASK": fits.ImageHDU(np.zeros((number, *shape), np.uint8), name="MASK"),
        "EXPOSURES": fits.BinTableHDU(table, name="EXPOSURES"),
    }


def write(path: Path, parts: dict[str, Any]) -> Path:
    fits.HDUList(list(parts.values())).writeto(path)
    return path


def test_a_minimal_cube_is_read(tmp_path: Path) -> None:
    parts = hdus()
    cube = FringeCube.read_fits(write(tmp_path / "cube.fits", parts))
    np.testing.assert_array_equal(cube.image, parts["IMAGE"].data)
    np.testing.assert_array_equal(cube.wavelength_nm, [990, 880])
    assert np.isinf(cube.exposures.f_number).all()
    assert cube.variance.dtype == np.float32
    assert not cube.exposures.level_e.any()
    assert not cube.exposures.dark_time_s.any()


def test_one_pixel_with_many_wavelengths(tmp_path: Path) -> None:
    cube = FringeCube.read_fits(write(tmp_path / "cube.fits", hdus(12, (1, 1))))
    assert cube.shape == (12, 1, 1)


def test_one_wavelength_with_a_thickness(tmp_path: Path) -> None:
    parts = hdus(1)
    parts["THICKNESS"] = fits.ImageHDU(np.full((3, 4), 14.0), name="THICKNESS")
    parts["THICKNESS"].header["LAYER"] = "epoxy"
    cube = FringeCube.read_fits(write(tmp_path / "cube.fits", parts))
    assert cube.layer == "epoxy"
    assert cube.thickness is not None
    assert (cube.thickness == 14).all()


def test_one_mask_for_all_wavelengths(tmp_path: Path) -> None:
    parts = hdus()
    parts["MASK"] = fits.ImageHDU(np.eye(3, 4, dtype=np.int16), name="MASK")
    cube = FringeCube.read_fits(write(tmp_path / "cube.fits", parts))
    np.testing.assert_array_equal(cube.mask, np.broadcast_to(np.eye(3, 4), (2, 3, 4)))


@pytest.mark.parametrize("memmap", [False, True])
def test_pixels_without_a_number_become_no_data(tmp_path: Path, memmap: bool) -> None:
    parts = hdus()
    parts["IMAGE"].data[1, 2, 3] = np.nan
    parts["VARIANCE"].data[0, 0, 0] = np.inf
    cube = FringeCube.read_fits(write(tmp_path / "cube.fits", parts), memmap=memmap)
    expected = np.zeros((2, 3, 4), int)
    expected[1, 2, 3] = expected[0, 0, 0] = mask_bits("NO_DATA")
    np.testing.assert_array_equal(cube.mask, expected)


@pytest.mark.parametrize("name", ["IMAGE", "VARIANCE", "MASK", "EXPOSURES"])
def test_a_missing_extension_is_named(tmp_path: Path, name: str) -> None:
    parts = hdus()
    del parts[name]
    path = write(tmp_path / "cube.fits", parts)
    with pytest.raises(FrameFormatError, match=f"no {name}") as caught:
        FringeCube.read_fits(path)
    assert caught.value.source == str(path)


@pytest.mark.parametrize("name", ["wavelength", "bandwidth_fwhm", "temperature"])
def test_a_missing_column_is_named(tmp_path: Path, name: str) -> None:
    parts = hdus()
    table = Table(parts["EXPOSURES"].data)
    table.remove_column(name)
    parts["EXPOSURES"] = fits.BinTableHDU(table, name="EXPOSURES")
    with pytest.raises(FrameFormatError, match=f"no column {name}"):
        FringeCube.read_fits(write(tmp_path / "cube.fits", parts))


def test_unit_missing_or_unknown(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="BUNIT is 'adu'"):
        FringeCube.read_fits(write(tmp_path / "adu.fits", hdus(unit="adu")))
    parts = hdus()
    del parts["IMAGE"].header["BUNIT"]
    with pytest.raises(FrameFormatError, match="BUNIT is 'missing'"):
        FringeCube.read_fits(write(tmp_path / "none.fits", parts))


def test_shapes_that_disagree_name_the_file(tmp_path: Path) -> None:
    parts = hdus()
    parts["VARIANCE"] = fits.ImageHDU(np.ones((2, 3, 5)), name="VARIANCE")
    path = write(tmp_path / "cube.fits", parts)
    with pytest.raises(InputError, match="VARIANCE is 'shape") as caught:
        FringeCube.read_fits(path)
    assert str(path) in str(caught.value)


def test_a_checksum_of_another_program_is_verified(tmp_path: Path) -> None:
    path = tmp_path / "cube.fits"
    fits.HDUList(list(hdus().values())).writeto(path, checksum=True)
    FringeCube.read_fits(path)
    content = bytearray(path.read_bytes())
    content[-2000] ^= 1
    path.write_bytes(content)
    with pytest.raises(FrameFormatError, match="verification failed"):
        FringeCube.read_fits(path)
