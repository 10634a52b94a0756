"""A fringe template in the layout that afw reads as an exposure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..array_types import Float32Array
from ..errors import InputError, OutOfRangeError
from . import _fits as io
from .fits_product import DETECTOR, MASK, Card, Image, SensorProduct

_DATETIME = re.compile(r"(\d{4}-\d{2}-\d{2})T(\d{2}:\d{2}:\d{2}(?:\.\d+)?)")


@dataclass(frozen=True, eq=False, repr=False)
class FringeFrame(SensorProduct):
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

    image: Float32Array
    mask: NDArray[np.int32]
    variance: Float32Array
    physical_filter: str
    creation_datetime: str
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    xy0: tuple[int, int] = (0, 0)

    def _picture(self) -> tuple[NDArray[Any], str, bool]:
        return 100.0 * self.image, "sky / mean − 1 [%]", True

    CARDS = (
        Card("physical_filter", "FILTER", "physical filter", kind=str, empty=False),
        DETECTOR,
        Card("creation_datetime", "CALIB_CREATION_DATETIME", "", kind=str),
    )
    RESERVED = ("EXPINFO_V", "OBSTYPE", "TIMESYS", "CALIB_CREATION_DATE", "CALIB_CREATION_TIME")
    EXTENSIONS = (
        Image("image", "IMAGE", None, everywhere=True),
        MASK,
        Image("variance", "VARIANCE", None, everywhere=True, nonnegative=True),
    )

    def _check(self) -> None:
        _check_zero_mean(self.image, self.mask)
        if not _DATETIME.fullmatch(self.creation_datetime):
            raise InputError("creation_datetime", self.creation_datetime, "YYYY-MM-DDThh:mm:ss")
        if len(self.xy0) != 2 or not all(isinstance(item, int) for item in self.xy0):
            raise InputError("xy0", self.xy0, "two whole numbers x, y")
        object.__setattr__(self, "xy0", (int(self.xy0[0]), int(self.xy0[1])))

    def _primary_cards(self, metadata: Mapping[str, io.Scalar]) -> list[tuple[str, io.Scalar, str]]:
        """The order that afw has, and what it asks for besides."""
        name, detector, created = super()._primary_cards(metadata)
        date, _, time = self.creation_datetime.partition("T")
        return [
            ("EXPINFO_V", 1, ""),
            name,
            ("OBSTYPE", "fringe", "kind of calibration"),
            detector,
            ("CALIB_CREATION_DATE", date, ""),
            ("CALIB_CREATION_TIME", time, ""),
            created,
            *([("TIMESYS", "TAI", "afw reads DATE-AVG in this scale")] if "DATE-AVG" in metadata else []),
        ]

    def _extension_cards(self, name: str) -> list[tuple[str, Any, str]]:
        cards: list[tuple[str, Any, str]] = [
            ("INHERIT", True, "primary header holds for this HDU"),
            ("EXTTYPE", name, "part of an afw masked image"),
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
    def _values(cls, hdus: fits.HDUList, source: str, *, native: bool = True) -> dict[str, Any]:
        x, y = (int(hdus["IMAGE"].header.get(f"CRVAL{axis}A", 0)) for axis in (1, 2))
        return super()._values(hdus, source, native=native) | {"xy0": (x, y)}


def _check_zero_mean(image: NDArray[Any], mask: NDArray[Any]) -> None:
    good = image[mask == 0].astype(np.float64)
    if good.size and abs(good.mean()) > 1e-6 + 1e-3 * good.std():
        raise OutOfRangeError("mean of IMAGE", float(good.mean()), "0 over the good pixels")
