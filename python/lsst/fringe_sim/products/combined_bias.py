"""What a sensor shows without light and beyond its overscan: the mean of its bias frames."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..errors import FrameFormatError, InputError
from . import _check as check
from . import _fits as io
from .fits_product import FitsProduct

__all__ = ["CombinedBias"]

_OWN = ("NFRAMES", "LSST_NUM", "DETNAME")


@dataclass(frozen=True, eq=False)
class CombinedBias(FitsProduct):
    """Mean of overscan-corrected bias frames of one sensor, assembled.

    Parameters
    ----------
    image : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Structure that the overscan does not see, in ADU; 0 where nothing is known.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`; 0 is good.
    noise_adu : `Mapping` [`str`, `float`]
        Read noise of one frame by amplifier, in ADU.
    n_frames : `int`
        Number of frames in the mean.
    serial : `str`
        Serial number of the sensor; empty if not known.
    metadata : `Mapping`
        Further header keywords.
    detector : `str`
        Name of the sensor; empty if not known.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or a pixel without a number.
    InputError, OutOfRangeError
        No frames, noises that are no numbers, metadata that a header cannot hold.
    """

    image: NDArray[np.float32]
    mask: NDArray[np.int32]
    noise_adu: Mapping[str, float]
    n_frames: int
    serial: str
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""

    def __post_init__(self) -> None:
        image = check.as_float_array("IMAGE", self.image, 2)
        check.check_good_pixels("IMAGE", image)
        noise = {
            check.check_name("amplifier", name, empty=False): check.check_number(
                f"noise of {name}", value, low=0
            )
            for name, value in check.check_mapping("noise_adu", self.noise_adu).items()
        }
        if not noise:
            raise InputError("noise_adu", "no amplifier", "the noise of one amplifier at least")
        values = {
            "image": image,
            "mask": check.as_mask("MASK", self.mask, image.shape),
            "noise_adu": MappingProxyType(noise),
            "n_frames": check.check_whole_number("n_frames", self.n_frames, low=1, high=10**6),
            "serial": check.check_name("serial", self.serial),
            "detector": check.check_name("detector", self.detector),
            "metadata": io.normalise_metadata(self.metadata, _OWN),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return (self.image.shape[0], self.image.shape[1])

    def _hdus(self, metadata: Mapping[str, Any] | None) -> list[Any]:
        """IMAGE and MASK extensions and the table NOISE."""
        own: list[tuple[str, io.Scalar, str]] = [
            ("DETNAME", self.detector, "sensor"),
            ("LSST_NUM", self.serial, "serial number"),
            ("NFRAMES", self.n_frames, "bias frames in the mean"),
        ]
        hdus = [
            io.primary_hdu("CombinedBias", own, io.merge_metadata(self.metadata, metadata, _OWN)),
            io.image_hdu("IMAGE", self.image, unit="adu"),
            io.mask_hdu(self.mask),
            self._noise_hdu(),
        ]
        return hdus

    def _noise_hdu(self) -> fits.BinTableHDU:
        names, noise = np.array(list(self.noise_adu)), np.array(list(self.noise_adu.values()))
        return fits.BinTableHDU.from_columns(
            [
                fits.Column(name="amplifier", array=names, format=f"{names.dtype.itemsize // 4}A"),
                fits.Column(name="noise", array=noise, format="D", unit="adu"),
            ],
            name="NOISE",
        )

    @classmethod
    def read_fits(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `write_fits` wrote.

        Raises
        ------
        InputError
            No such file, another product, or a damaged file; the message names the file.
        """
        source = str(path)
        with io.open_fits(path, "CombinedBias") as hdus:
            header = hdus[0].header
            if "NOISE" not in hdus or not isinstance(hdus["NOISE"], fits.BinTableHDU):
                raise FrameFormatError("extension", "no NOISE", "a binary table named NOISE", source=source)
            table = hdus["NOISE"].data
            return cls(
                image=io.read_image(hdus, "IMAGE", source=source),
                mask=io.read_mask(hdus, source=source),
                noise_adu={
                    str(name): float(value)
                    for name, value in zip(table["amplifier"], table["noise"], strict=True)
                },
                n_frames=io.read_keyword(header, "NFRAMES", source=source),
                serial=io.read_keyword(header, "LSST_NUM", source=source),
                detector=header.get("DETNAME", ""),
                metadata=io.read_metadata(header, _OWN),
            )
