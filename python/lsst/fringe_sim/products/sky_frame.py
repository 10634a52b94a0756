"""A simulated night-sky frame of one sensor with its fringes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..array_types import Float32Array
from ..errors import InputError, UnknownNameError, named_units
from . import _fits as io
from .fits_product import DETECTOR, FILTER, MASK, Card, Image, SensorProduct

CORRECTED = "FRINGCOR"
"""Keyword of an exposure from which fringes were subtracted; its value is the number of templates."""

CORRECTED_BY = (CORRECTED, "FRINGE", "FRGSCALE", "FRGFLAG", "SKYFSUB", "FRNGMDL")
"""Keywords that say so, unless they say no: ours; those of the DECam Community Pipeline (template and scale)
and of its like for Mosaic-3; that of fringez, for ZTF."""

_NO = ("", "N", "NO", "F", "FALSE", "NONE", "0", "0.0")

NOISE = "NOISE"  # Keyword of a simulated exposure: whether photon and read noise were added

SKY_UNITS = ("electron", "fraction")
"""Units of a sky frame: electrons in the exposure, or (sky - mean) / mean."""

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


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class SkyFringe(SensorProduct):
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

    image: Float32Array
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

    CARDS = (
        DETECTOR,
        FILTER,
        Card("mean_electrons", "MEANE", "mean sky", "electron", low=0, open_low=True),
        Card("exposure_s", "EXPTIME", "exposure time", "s", low=0, open_low=True),
        Card("airmass", "AIRMASS", "airmass", low=1, high=40),
        Card("hour", "HOUR", "local time; 25 is 1 h after midnight", "h", low=0, high=36),
        Card("quadrature_error", "QUADERR", "quadrature error, fraction of the sky", low=0),
        Card(
            "seed",
            "SEED",
            "seed of the noise; absent: no noise",
            kind=int,
            low=0,
            high=2**63 - 1,
            default=None,
            omit=True,
        ),
    )
    EXTENSIONS = (Image("image", "IMAGE", "{unit}"), MASK)

    def __post_init__(self) -> None:
        if self.unit not in SKY_UNITS:
            raise UnknownNameError("unit", self.unit, SKY_UNITS)
        super().__post_init__()

    def _picture(self) -> tuple[NDArray[Any], str, bool]:
        return 100.0 * self.fraction(), "sky / mean − 1 [%]", True

    def fraction(self) -> Float32Array:
        """Fringe pattern (sky - mean) / mean, whatever the unit."""
        if self.unit == "fraction":
            return self.image
        return (self.image / np.float32(self.mean_electrons) - np.float32(1)).astype(np.float32)

    @classmethod
    def _values(cls, hdus: fits.HDUList, source: str, *, native: bool = True) -> dict[str, Any]:
        unit = io.read_keyword(hdus["IMAGE"].header, "BUNIT", source=source)
        return super()._values(hdus, source, native=native) | {"unit": unit}


def refuse_corrected(header: Mapping[str, Any], source: str | None = None) -> None:
    """Refuse an exposure from which the fringes were taken already, by this package or another (`CORRECTED_BY`).

    Raises
    ------
    InputError
        The header says so.
    """
    for keyword in CORRECTED_BY:
        said = header.get(keyword)
        if said and str(said).strip().upper() not in _NO:
            raise InputError(keyword, said, "an exposure with its fringes", source=source)


def refuse_noiseless(header: Mapping[str, Any], source: str | None = None) -> None:
    """Refuse a simulated exposure without noise where its pixels are weighed by the noise that they should have.

    Raises
    ------
    InputError
        The header says that there is none.
    """
    if is_noiseless(header):
        allowed = "an exposure with photon and read noise: one without is good for templates only"
        raise InputError(NOISE, header[NOISE], allowed, source=source)


def is_noiseless(header: Mapping[str, Any]) -> bool:
    """Whether a header says, as a truth value or in words, that no noise was added."""
    said = header.get(NOISE)
    return said is not None and str(said).strip().upper() in _NO[1:]
