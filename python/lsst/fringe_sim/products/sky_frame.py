"""A simulated night-sky frame of one sensor with its fringes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, UnknownNameError
from . import _check as check
from . import _fits as io
from .fits_product import FitsProduct

__all__ = ["CORRECTED", "SKY_UNITS", "SkyFringe", "refuse_corrected"]

CORRECTED = "FRINGCOR"
"""Keyword of an exposure from which fringes were subtracted; its value is the number of templates."""

SKY_UNITS = ("electron", "fraction")
"""Units of a sky frame: electrons in the exposure, or (sky - mean) / mean."""

_OWN = ("DETNAME", "FILTER", "MEANE", "EXPTIME", "AIRMASS", "HOUR", "SEED", "QUADERR")


_BAND = "BAND "


def band_cards(scale: Mapping[str, float]) -> dict[str, float]:
    """Header keywords that tell what the OH bands were during a frame.

    Parameters
    ----------
    scale : mapping
        Intensity of bands, by name, relative to the reference sky.
    """
    return {f"{_BAND}{name}": float(factor) for name, factor in scale.items()}


def bands_of_header(metadata: Mapping[str, Any]) -> dict[str, float]:
    """What `band_cards` stated; empty if nothing is known."""
    return {key[len(_BAND) :]: float(value) for key, value in metadata.items() if key.startswith(_BAND)}


@dataclass(frozen=True, eq=False)
class SkyFringe(FitsProduct):
    """Night sky seen by one sensor in one exposure.

    Parameters
    ----------
    image : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Sky, in ``unit``; finite where the mask is 0.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`; 0 is good.
    unit : `str`
        ``electron``, or ``fraction``: (sky - mean) / mean.
    mean_electrons : `float`
        Mean sky over the good pixels, in electrons.
    exposure_s : `float`
        Exposure time, in s.
    airmass : `float`
        Airmass, 1 or more.
    hour : `float`
        Local time, in hours since the midnight before the evening: 25 is one hour after midnight.
    seed : `int` or `None`
        Seed of the photon and read noise; `None` for a frame without noise.
    quadrature_error : `float`
        Estimated error of the sums over lines and angles, in units of ``image / mean``.
    metadata : `Mapping`
        Further header keywords.
    detector, physical_filter : `str`
        Sensor and filter; empty if not known.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or good pixels without a number.
    InputError, OutOfRangeError
        An unknown unit, a scalar that is not physical, metadata that a header cannot hold.
    """

    image: NDArray[np.float32]
    mask: NDArray[np.int32]
    unit: str
    mean_electrons: float
    exposure_s: float
    airmass: float
    hour: float
    seed: int | None
    quadrature_error: float
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    physical_filter: str = ""

    def __post_init__(self) -> None:
        if self.unit not in SKY_UNITS:
            raise UnknownNameError("unit", self.unit, SKY_UNITS)
        image = check.as_float_array("IMAGE", self.image, 2)
        mask = check.as_mask("MASK", self.mask, image.shape)
        check.check_good_pixels("IMAGE", image, mask)
        values: dict[str, Any] = {
            "image": image,
            "mask": mask,
            "mean_electrons": check.check_number("mean_electrons", self.mean_electrons, low=0, open_low=True),
            "exposure_s": check.check_number("exposure_s", self.exposure_s, low=0, open_low=True),
            "airmass": check.check_number("airmass", self.airmass, low=1, high=40),
            "hour": check.check_number("hour", self.hour, low=0, high=36),
            "quadrature_error": check.check_number("quadrature_error", self.quadrature_error, low=0),
            "metadata": io.normalise_metadata(self.metadata, _OWN),
            "detector": check.check_name("detector", self.detector),
            "physical_filter": check.check_name("physical_filter", self.physical_filter),
        }
        if self.seed is not None:
            values["seed"] = check.check_whole_number("seed", self.seed, low=0, high=2**63 - 1)
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return (self.image.shape[0], self.image.shape[1])

    def fraction(self) -> NDArray[np.float32]:
        """Fringe pattern (sky - mean) / mean, whatever the unit."""
        if self.unit == "fraction":
            return self.image
        return (self.image / np.float32(self.mean_electrons) - np.float32(1)).astype(np.float32)

    def _hdus(self, metadata: Mapping[str, Any] | None) -> list[Any]:
        """IMAGE and MASK extensions."""
        own: list[tuple[str, io.Scalar, str]] = [
            ("DETNAME", self.detector, "sensor"),
            ("FILTER", self.physical_filter, "physical filter"),
            ("MEANE", self.mean_electrons, "[electron] mean sky"),
            ("EXPTIME", self.exposure_s, "[s] exposure time"),
            ("AIRMASS", self.airmass, "airmass"),
            ("HOUR", self.hour, "[h] local time; 25 is 1 h after midnight"),
            ("QUADERR", self.quadrature_error, "quadrature error, fraction of the sky"),
        ]
        if self.seed is not None:
            own.append(("SEED", self.seed, "seed of the noise; absent: no noise"))
        hdus = [
            io.primary_hdu("SkyFringe", own, io.merge_metadata(self.metadata, metadata, _OWN)),
            io.image_hdu("IMAGE", self.image, unit=self.unit),
            io.mask_hdu(self.mask),
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
        with io.open_fits(path, "SkyFringe") as hdus:
            header = hdus[0].header
            return cls(
                image=io.read_image(hdus, "IMAGE", source=source),
                mask=io.read_mask(hdus, source=source),
                unit=io.read_keyword(hdus["IMAGE"].header, "BUNIT", source=source),
                mean_electrons=io.read_keyword(header, "MEANE", source=source),
                exposure_s=io.read_keyword(header, "EXPTIME", source=source),
                airmass=io.read_keyword(header, "AIRMASS", source=source),
                hour=io.read_keyword(header, "HOUR", source=source),
                seed=header.get("SEED"),
                quadrature_error=io.read_keyword(header, "QUADERR", source=source),
                detector=header.get("DETNAME", ""),
                physical_filter=header.get("FILTER", ""),
                metadata=io.read_metadata(header, _OWN),
            )


def refuse_corrected(header: Mapping[str, Any], source: str | None = None) -> None:
    """Refuse an exposure from which the fringes were taken already.

    Raises
    ------
    InputError
        The header says so.
    """
    if header.get(CORRECTED):
        raise InputError(CORRECTED, header[CORRECTED], "an exposure with its fringes", source=source)
