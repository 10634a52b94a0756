"""A prepared monochromatic flat field: the fringe pattern of one sensor at one wavelength."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..array_types import Float32Array
from ..errors import named_units
from .fits_product import DETECTOR, MASK, Card, Image, SensorProduct


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class FringeFlat(SensorProduct):
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

    image: Float32Array
    variance: Float32Array
    mask: NDArray[np.int32]
    wavelength_nm: float
    bandwidth_fwhm_nm: float
    temperature_k: float
    level_e: float
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    f_number: float = math.inf
    dark_time_s: float = 0.0

    CARDS = (
        DETECTOR,
        Card("wavelength_nm", "WAVELEN", "wavelength", "nm", low=0, open_low=True),
        Card("bandwidth_fwhm_nm", "BANDFWHM", "full width at half maximum", "nm", low=0),
        Card("temperature_k", "TEMPK", "temperature of the sensor", "K", low=0, open_low=True),
        Card("level_e", "LEVELE", "mean level before division", "electron", low=0, open_low=True),
        Card(
            "f_number",
            "FNUMBER",
            "focal ratio; absent: collimated",
            low=0,
            open_low=True,
            default=math.inf,
            omit=True,
        ),
        Card(
            "dark_time_s",
            "DARKTIME",
            "time of gathering charge; absent: not known",
            "s",
            low=0,
            default=0.0,
            omit=True,
        ),
    )
    EXTENSIONS = (Image("image", "IMAGE"), MASK, Image("variance", "VARIANCE", nonnegative=True))
