"""A prepared monochromatic flat field: the fringe pattern of one sensor at one wavelength."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from . import _check as check
from . import _fits as io
from .fits_product import FitsProduct

__all__ = ["FringeFlat"]

_OWN = ("DETNAME", "WAVELEN", "BANDFWHM", "TEMPK", "LEVELE", "FNUMBER", "DARKTIME")


@dataclass(frozen=True, eq=False)
class FringeFlat(FitsProduct):
    """Fringe pattern of one sensor under monochromatic light.

    Parameters
    ----------
    image : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Fringe amplitude, counts / mean - 1; finite where the mask is 0.
    variance : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Variance of ``image``; finite and not negative where the mask is 0.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`; 0 is good.
    wavelength_nm : `float`
        Wavelength of the light, in nm.
    bandwidth_fwhm_nm : `float`
        Full width at half maximum of the light, in nm; 0 for a line.
    temperature_k : `float`
        Temperature of the sensor, in K.
    level_e : `float`
        Mean level of the flat before division, in electrons.
    metadata : `Mapping`
        Further header keywords.
    detector : `str`
        Name of the sensor, as ``R11_S01``; empty if not known.
    f_number : `float`
        Focal ratio of the light; infinite for a collimated beam.
    dark_time_s : `float`
        Time in which charge was gathered, in s; 0 if not known.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or good pixels without a number.
    OutOfRangeError, InputError
        A scalar that is not physical, or metadata that a header cannot hold.
    """

    image: NDArray[np.float32]
    variance: NDArray[np.float32]
    mask: NDArray[np.int32]
    wavelength_nm: float
    bandwidth_fwhm_nm: float
    temperature_k: float
    level_e: float
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    f_number: float = math.inf
    dark_time_s: float = 0.0

    def __post_init__(self) -> None:
        image = check.as_float_array("IMAGE", self.image, 2)
        variance = check.as_float_array("VARIANCE", self.variance, 2)
        mask = check.as_mask("MASK", self.mask, image.shape)
        check.check_shape("VARIANCE", variance, image.shape)
        check.check_good_pixels("IMAGE", image, mask)
        check.check_good_pixels("VARIANCE", variance, mask, nonnegative=True)
        values = {
            "image": image,
            "variance": variance,
            "mask": mask,
            "wavelength_nm": check.check_number("wavelength_nm", self.wavelength_nm, low=0, open_low=True),
            "bandwidth_fwhm_nm": check.check_number("bandwidth_fwhm_nm", self.bandwidth_fwhm_nm, low=0),
            "temperature_k": check.check_number("temperature_k", self.temperature_k, low=0, open_low=True),
            "level_e": check.check_number("level_e", self.level_e, low=0, open_low=True),
            "f_number": check.check_number("f_number", self.f_number, low=0, open_low=True, allow_inf=True),
            "dark_time_s": check.check_number("dark_time_s", self.dark_time_s, low=0),
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
        """IMAGE, MASK and VARIANCE extensions."""
        own: list[tuple[str, io.Scalar, str]] = [
            ("DETNAME", self.detector, "sensor"),
            ("WAVELEN", self.wavelength_nm, "[nm] wavelength"),
            ("BANDFWHM", self.bandwidth_fwhm_nm, "[nm] full width at half maximum"),
            ("TEMPK", self.temperature_k, "[K] temperature of the sensor"),
            ("LEVELE", self.level_e, "[electron] mean level before division"),
        ]
        if math.isfinite(self.f_number):
            own.append(("FNUMBER", self.f_number, "focal ratio; absent: collimated"))
        if self.dark_time_s > 0:
            own.append(("DARKTIME", self.dark_time_s, "[s] time of gathering charge; absent: not known"))
        hdus = [
            io.primary_hdu("FringeFlat", own, io.merge_metadata(self.metadata, metadata, _OWN)),
            io.image_hdu("IMAGE", self.image, unit=""),
            io.mask_hdu(self.mask),
            io.image_hdu("VARIANCE", self.variance, unit=""),
        ]
        return hdus

    @classmethod
    def read_fits(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `write_fits` wrote.

        Raises
        ------
        InputError
            No such file, another product, or a damaged file; the message names the file.
        """
        source = str(path)
        with io.open_fits(path, "FringeFlat") as hdus:
            header = hdus[0].header
            return cls(
                image=io.read_image(hdus, "IMAGE", source=source),
                variance=io.read_image(hdus, "VARIANCE", source=source),
                mask=io.read_mask(hdus, source=source),
                wavelength_nm=io.read_keyword(header, "WAVELEN", source=source),
                bandwidth_fwhm_nm=io.read_keyword(header, "BANDFWHM", source=source),
                temperature_k=io.read_keyword(header, "TEMPK", source=source),
                level_e=io.read_keyword(header, "LEVELE", source=source),
                detector=header.get("DETNAME", ""),
                f_number=header.get("FNUMBER", math.inf),
                dark_time_s=header.get("DARKTIME", 0.0),
                metadata=io.read_metadata(header, _OWN),
            )
