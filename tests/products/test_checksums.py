"""Checksums that are made without turning bytes round are those of astropy."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.products import _fits as io

RNG = np.random.default_rng(5)
DATA = {
    "float": RNG.normal(size=(301, 7)).astype(np.float32),
    "integers of every size": RNG.integers(-(2**31), 2**31, (300, 301)).astype(np.int32),
    "ones in every bit": np.full((3, 5), -1, np.int32),
    "nothing": np.zeros((4, 5), np.int32),
    "order of the file": RNG.normal(size=(5, 7)).astype(">f4"),
    "double": RNG.normal(size=(5, 7)),
    "bytes": RNG.integers(0, 256, (5, 7)).astype(np.uint8),
    "every other column": RNG.normal(size=(5, 14)).astype(np.float32)[:, ::2],
}


@pytest.mark.parametrize("kind", DATA)
def test_a_file_is_that_of_astropy(kind, tmp_path) -> None:
    data = DATA[kind]
    plain, ours = fits.ImageHDU(data.copy(), name="IMAGE"), io.image_hdu("IMAGE", data)
    for name, hdu in (("plain", plain), ("ours", ours)):
        hdu.add_datasum(when="data")
        hdu.add_checksum(when="HDU", override_datasum=True)
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / name)
    assert (tmp_path / "ours").read_bytes() == (tmp_path / "plain").read_bytes()
