"""What a sensor shows without light and beyond its overscan: the mean of its bias frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..array_types import Float32Array
from ..errors import InputError
from . import _check as check
from .fits_product import DETECTOR, MASK, Card, Extension, Image, SensorProduct


class _NoiseTable(Extension):
    """Read noise by amplifier."""

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:
        given = check.check_mapping(self.field, getattr(product, self.field))
        noise = {
            check.check_name("amplifier", name, empty=False): check.check_number(
                f"noise of {name}", value, low=0, unit="adu"
            )
            for name, value in given.items()
        }
        if not noise:
            raise InputError(self.field, "no amplifier", "the noise of one amplifier at least")
        return {self.field: MappingProxyType(noise)}

    def hdu(self, product: Any) -> fits.BinTableHDU:
        known = getattr(product, self.field)
        names, noise = np.array(list(known)), np.array(list(known.values()))
        columns = [
            fits.Column(name="amplifier", array=names, format=f"{names.dtype.itemsize // 4}A"),
            fits.Column(name="noise", array=noise, format="D", unit="adu"),
        ]
        return fits.BinTableHDU.from_columns(columns, name=self.name)

    def read(self, hdus: fits.HDUList, source: str, native: bool) -> dict[str, Any]:
        rows = self.table(hdus, source)
        pairs = zip(rows["amplifier"], rows["noise"], strict=True)
        return {self.field: {str(name): float(value) for name, value in pairs}}


@dataclass(frozen=True, eq=False, repr=False)
class CombinedBias(SensorProduct):
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

    image: Float32Array
    mask: NDArray[np.int32]
    noise_adu: Mapping[str, float]
    n_frames: int
    serial: str
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""

    CARDS = (
        DETECTOR,
        Card("serial", "LSST_NUM", "serial number", kind=str),
        Card("n_frames", "NFRAMES", "bias frames in the mean", kind=int, low=1, high=10**6),
    )
    EXTENSIONS = (Image("image", "IMAGE", "adu", everywhere=True), MASK, _NoiseTable("noise_adu", "NOISE"))
