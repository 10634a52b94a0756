"""Thickness of one layer at every pixel of a sensor, with what is known of its certainty."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FrameFormatError, OutOfRangeError
from . import _check as check
from . import _fits as io
from .fits_product import FitsProduct

__all__ = ["ThicknessMap"]

_OWN = ("DETNAME", "LAYER")


@dataclass(frozen=True, eq=False)
class ThicknessMap(FitsProduct):
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

    def __post_init__(self) -> None:
        value = check.as_float_array("VALUE", self.value, 2)
        mask = check.as_mask("MASK", self.mask, value.shape)
        check.check_good_pixels("VALUE", value, mask)
        good = mask == 0
        if bool(np.any((value <= 0) & good)):
            raise OutOfRangeError("VALUE", float(value[good].min()), "a positive thickness in um")
        values: dict[str, Any] = {
            "value": value,
            "mask": mask,
            "layer": check.check_name("layer", self.layer, empty=False),
            "detector": check.check_name("detector", self.detector),
            "metadata": io.normalise_metadata(self.metadata, _OWN),
            "n_wavelengths": _counts(self.n_wavelengths, value.shape),
        }
        for name in ("sigma", "chi2", "slip_probability"):
            array = check.as_float_array(name.upper(), getattr(self, name), 2)
            check.check_shape(name.upper(), array, value.shape)
            check.check_good_pixels(name.upper(), array, mask, nonnegative=True)
            values[name] = array
        if bool(np.any((values["slip_probability"] > 1) & good)):
            worst = float(values["slip_probability"][good].max())
            raise OutOfRangeError("SLIP_PROBABILITY", worst, "0 to 1")
        for name, item in values.items():
            object.__setattr__(self, name, item)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return (self.value.shape[0], self.value.shape[1])

    def _hdus(self, metadata: Mapping[str, Any] | None) -> list[Any]:
        """VALUE, SIGMA, CHI2, SLIP_PROBABILITY, MASK and, if known, N_WAVELENGTHS."""
        own: list[tuple[str, io.Scalar, str]] = [
            ("DETNAME", self.detector, "sensor"),
            ("LAYER", self.layer, "layer"),
        ]
        hdus = [
            io.primary_hdu("ThicknessMap", own, io.merge_metadata(self.metadata, metadata, _OWN)),
            io.image_hdu("VALUE", self.value, unit="um"),
            io.image_hdu("SIGMA", self.sigma, unit="um"),
            io.image_hdu("CHI2", self.chi2, unit=""),
            io.image_hdu("SLIP_PROBABILITY", self.slip_probability, unit=""),
            io.mask_hdu(self.mask),
        ]
        if self.n_wavelengths is not None:
            hdus.append(io.image_hdu("N_WAVELENGTHS", self.n_wavelengths, unit=""))
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
        with io.open_fits(path, "ThicknessMap") as hdus:
            header = hdus[0].header
            counts = None
            if "N_WAVELENGTHS" in hdus:
                counts = io.read_image(hdus, "N_WAVELENGTHS", source=source)
            return cls(
                value=io.read_image(hdus, "VALUE", source=source),
                sigma=io.read_image(hdus, "SIGMA", source=source),
                chi2=io.read_image(hdus, "CHI2", source=source),
                slip_probability=io.read_image(hdus, "SLIP_PROBABILITY", source=source),
                mask=io.read_mask(hdus, source=source),
                layer=io.read_keyword(header, "LAYER", source=source),
                detector=header.get("DETNAME", ""),
                n_wavelengths=counts,
                metadata=io.read_metadata(header, _OWN),
            )


def _counts(values: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.int32] | None:
    if values is None:
        return None
    array = np.asarray(values)
    if array.dtype.kind not in "iu":
        raise FrameFormatError("N_WAVELENGTHS", f"dtype {array.dtype}", "integers")
    check.check_shape("N_WAVELENGTHS", array, shape)
    if bool(np.any(array < 0)) or bool(np.any(array > 2**31 - 1)):
        raise OutOfRangeError("N_WAVELENGTHS", int(array.min()), "0 or more")
    return check.read_only(array.astype(np.int32, copy=False))
