"""A fringe template in the layout that afw reads as an exposure."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..errors import InputError, OutOfRangeError
from . import _check as check
from . import _fits as io
from .fits_product import FitsProduct

__all__ = ["FringeFrame"]

_CREATION = ("CALIB_CREATION_DATE", "CALIB_CREATION_TIME", "CALIB_CREATION_DATETIME")
_OWN = ("EXPINFO_V", "FILTER", "OBSTYPE", "DETNAME", "TIMESYS", *_CREATION)
_DATETIME = re.compile(r"(\d{4}-\d{2}-\d{2})T(\d{2}:\d{2}:\d{2}(?:\.\d+)?)")


@dataclass(frozen=True, eq=False)
class FringeFrame(FitsProduct):
    """Zero-mean fractional fringe pattern of one sensor in one filter.

    A sky image with background b and fringe scale s holds ``b * (1 + s * image)``. afw opens the file as an
    ``ExposureF``, which is what ``ip_isr`` asks for.

    Parameters
    ----------
    image : `numpy.ndarray`, float32, shape ``(ny, nx)``
        (sky - background) / background over the trimmed sensor; every pixel a number, mean 0 over the good.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`; 0 is good.
    variance : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Variance of ``image``; every pixel a number.
    physical_filter : `str`
        Filter, as the instrument names it.
    creation_datetime : `str`
        When the calibration was made, as ``YYYY-MM-DDThh:mm:ss``, UTC; passed in, never read from the clock.
    metadata : `Mapping`
        Further header keywords.
    detector : `str`
        Name of the sensor; empty if not known.
    xy0 : `tuple` [`int`, `int`]
        Position x, y of the first pixel on the parent sensor.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or a pixel without a number.
    OutOfRangeError
        A mean over the good pixels that is not 0.
    InputError
        No filter, a malformed date, or metadata that a header cannot hold.
    """

    image: NDArray[np.float32]
    mask: NDArray[np.int32]
    variance: NDArray[np.float32]
    physical_filter: str
    creation_datetime: str
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    xy0: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        image = check.as_float_array("IMAGE", self.image, 2)
        variance = check.as_float_array("VARIANCE", self.variance, 2)
        mask = check.as_mask("MASK", self.mask, image.shape)
        check.check_shape("VARIANCE", variance, image.shape)
        check.check_good_pixels("IMAGE", image)
        check.check_good_pixels("VARIANCE", variance, nonnegative=True)
        _check_zero_mean(image, mask)
        if not isinstance(self.creation_datetime, str) or not _DATETIME.fullmatch(self.creation_datetime):
            raise InputError("creation_datetime", self.creation_datetime, "YYYY-MM-DDThh:mm:ss")
        if len(self.xy0) != 2 or not all(isinstance(item, int) for item in self.xy0):
            raise InputError("xy0", self.xy0, "two whole numbers x, y")
        values = {
            "image": image,
            "variance": variance,
            "mask": mask,
            "physical_filter": check.check_name("physical_filter", self.physical_filter, empty=False),
            "detector": check.check_name("detector", self.detector),
            "xy0": (int(self.xy0[0]), int(self.xy0[1])),
            "metadata": io.normalise_metadata(self.metadata, _OWN),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return (self.image.shape[0], self.image.shape[1])

    def _hdus(self, metadata: Mapping[str, Any] | None) -> list[Any]:
        """The layout of an afw exposure: empty primary HDU, then IMAGE, MASK, VARIANCE."""
        hdus = [
            self._primary_hdu(io.merge_metadata(self.metadata, metadata, _OWN)),
            io.image_hdu("IMAGE", self.image, cards=self._extension_cards("IMAGE")),
            io.mask_hdu(self.mask, cards=self._extension_cards("MASK")),
            io.image_hdu("VARIANCE", self.variance, cards=self._extension_cards("VARIANCE")),
        ]
        return hdus

    def _primary_hdu(self, metadata: Mapping[str, io.Scalar]) -> fits.PrimaryHDU:
        match = _DATETIME.fullmatch(self.creation_datetime)
        assert match is not None  # checked on construction
        own: list[tuple[str, io.Scalar, str]] = [
            ("EXPINFO_V", 1, ""),
            ("FILTER", self.physical_filter, "physical filter"),
            ("OBSTYPE", "fringe", "kind of calibration"),
            ("DETNAME", self.detector, "sensor"),
            ("CALIB_CREATION_DATE", match[1], ""),
            ("CALIB_CREATION_TIME", match[2], ""),
            ("CALIB_CREATION_DATETIME", self.creation_datetime, ""),
        ]
        if "DATE-AVG" in metadata:
            own.append(("TIMESYS", "TAI", "afw reads DATE-AVG in this scale"))
        return io.primary_hdu("FringeFrame", own, metadata)

    def _extension_cards(self, kind: str) -> list[tuple[str, Any, str]]:
        cards: list[tuple[str, Any, str]] = [
            ("INHERIT", True, "primary header holds for this HDU"),
            ("EXTTYPE", kind, "part of an afw masked image"),
            ("WCSNAMEA", "PARENT", "pixel position on the sensor"),
        ]
        for axis, origin in enumerate(self.xy0, start=1):
            cards += [
                (f"CTYPE{axis}A", "LINEAR", ""),
                (f"CRPIX{axis}A", 1.0, "first pixel"),
                (f"CRVAL{axis}A", float(origin), "its position, from 0"),
                (f"CUNIT{axis}A", "PIXEL", ""),
            ]
        return cards

    @classmethod
    def read_fits(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `write_fits` wrote.

        Raises
        ------
        InputError
            No such file, another product, or a damaged file; the message names the file.
        """
        source = str(path)
        with io.open_fits(path, "FringeFrame") as hdus:
            header = hdus[0].header
            image = io.read_image(hdus, "IMAGE", source=source)
            origin = [int(hdus["IMAGE"].header.get(f"CRVAL{axis}A", 0)) for axis in (1, 2)]
            return cls(
                image=image,
                mask=io.read_mask(hdus, source=source),
                variance=io.read_image(hdus, "VARIANCE", source=source),
                physical_filter=io.read_keyword(header, "FILTER", source=source),
                creation_datetime=io.read_keyword(header, "CALIB_CREATION_DATETIME", source=source),
                detector=header.get("DETNAME", ""),
                xy0=(origin[0], origin[1]),
                metadata=io.read_metadata(header, _OWN),
            )


def _check_zero_mean(image: NDArray[Any], mask: NDArray[Any]) -> None:
    good = image[mask == 0].astype(np.float64)
    if good.size and abs(good.mean()) > 1e-6 + 1e-3 * good.std():
        raise OutOfRangeError("mean of IMAGE", float(good.mean()), "0 over the good pixels")
