"""Thickness of one layer at every pixel of a sensor, with what is known of its certainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameFormatError, OutOfRangeError
from . import _check as check
from .fits_product import DETECTOR, MASK, Card, Image, SensorProduct

__all__ = ["ThicknessMap"]


class _Counts(Image):
    """Image of whole numbers."""

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:
        values = getattr(product, self.field)
        if values is None:
            return {self.field: None}
        array = np.asarray(values)
        if array.dtype.kind not in "iu":
            raise FrameFormatError(self.name, f"dtype {array.dtype}", "integers")
        check.check_shape(self.name, array, known["mask"].shape)
        if bool(np.any(array < 0)) or bool(np.any(array > 2**31 - 1)):
            raise OutOfRangeError(self.name, int(array.min()), "0 or more")
        return {self.field: check.read_only(array.astype(np.int32, copy=False))}


@dataclass(frozen=True, eq=False, repr=False)
class ThicknessMap(SensorProduct):
    """Thickness of one layer, pixel by pixel.

    Parameters
    ----------
    value : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Thickness, in µm; positive where the mask is 0.
    sigma : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Standard uncertainty, in µm.
    chi2 : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Chi-square of the fit per degree of freedom.
    slip_probability : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Probability that the fringe order is wrong, from 0 to 1.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`; 0 is good. Masked pixels may hold no number.
    layer : `str`
        Name of the layer, as ``epoxy``.
    metadata : `Mapping`
        Further header keywords.
    n_wavelengths : `numpy.ndarray`, int32, shape ``(ny, nx)``, optional
        Number of wavelengths that each pixel was fitted with.
    detector : `str`
        Name of the sensor; empty if not known.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or good pixels without a number.
    OutOfRangeError
        A thickness that is not positive, or a probability outside 0 to 1, in a good pixel.
    InputError
        No layer, or metadata that a header cannot hold.
    """

    value: NDArray[np.float32]
    sigma: NDArray[np.float32]
    chi2: NDArray[np.float32]
    slip_probability: NDArray[np.float32]
    mask: NDArray[np.int32]
    layer: str
    metadata: Mapping[str, Any] = field(default_factory=dict)
    n_wavelengths: NDArray[np.int32] | None = None
    detector: str = ""

    CARDS = (DETECTOR, Card("layer", "LAYER", "layer", kind=str, empty=False))
    EXTENSIONS = (
        Image("value", "VALUE", "um"),
        Image("sigma", "SIGMA", "um", nonnegative=True),
        Image("chi2", "CHI2", nonnegative=True),
        Image("slip_probability", "SLIP_PROBABILITY", nonnegative=True),
        MASK,
        _Counts("n_wavelengths", "N_WAVELENGTHS", optional=True),
    )

    def _check(self) -> None:
        good = self.mask == 0
        if bool(np.any((self.value <= 0) & good)):
            raise OutOfRangeError("VALUE", float(self.value[good].min()), "a positive thickness in um")
        if bool(np.any((self.slip_probability > 1) & good)):
            worst = float(self.slip_probability[good].max())
            raise OutOfRangeError("SLIP_PROBABILITY", worst, "0 to 1")
