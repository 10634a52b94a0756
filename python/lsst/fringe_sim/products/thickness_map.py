"""Thickness of one layer at every pixel of a sensor, with what is known of its certainty."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..array_types import Float32Array, FloatArray
from ..errors import FrameFormatError, InputError, OutOfRangeError
from ..instrument.setup import Setup
from ..resources import open_user_fits, refuse_damage
from . import _check as check
from . import _fits as io
from .fits_product import DETECTOR, MASK, Card, Image, SensorProduct
from .flat_fit import FlatFit, FlatTable
from .mask import mask_bits

UNKNOWN_SIGMA_UM = 0.003  # Uncertainty of a map that states none

THICKNESS_LIMITS_UM = (0.5, 1000.0)
"""Layers that make fringes in a sensor: a map in nm or mm that does not say so lies outside."""


ORDER_UM = 0.35
"""An order of the fringes of glue, 1000 nm / (2 × 1.45), in which a map without any meaning is uncertain [µm]."""


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
        Name of the layer, as ``adhesive``.
    metadata : `Mapping`
        Further header keywords.
    n_wavelengths : `numpy.ndarray`, int32, shape ``(ny, nx)``, optional
        Number of wavelengths that each pixel was fitted with.
    detector : `str`
        Name of the sensor; empty if not known.
    flats : `FlatFit`, optional
        What the fit learned about each flat: contrast, wavelength, misfit.
    contrast_map : `numpy.ndarray`, float32, optional
        Contrast in blocks of the sensor over that of the whole; NaN where it is not known.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or good pixels without a number.
    OutOfRangeError
        A thickness that is not positive, or a probability outside 0 to 1, in a good pixel.
    InputError
        No layer, or metadata that a header cannot hold.
    """

    value: Float32Array
    sigma: Float32Array
    chi2: Float32Array
    slip_probability: Float32Array
    mask: NDArray[np.int32]
    layer: str
    metadata: Mapping[str, Any] = field(default_factory=dict)
    n_wavelengths: NDArray[np.int32] | None = None
    detector: str = ""
    flats: FlatFit | None = None
    contrast_map: Float32Array | None = None

    CARDS = (DETECTOR, Card("layer", "LAYER", "layer", kind=str, empty=False))
    EXTENSIONS = (
        Image("value", "VALUE", "um"),
        Image("sigma", "SIGMA", "um", nonnegative=True),
        Image("chi2", "CHI2", nonnegative=True),
        Image("slip_probability", "SLIP_PROBABILITY", nonnegative=True),
        MASK,
        _Counts("n_wavelengths", "N_WAVELENGTHS", optional=True),
        FlatTable("flats", "FLATS"),
        Image("contrast_map", "CONTRAST_MAP", gaps=True, optional=True, on_sensor=False),
    )

    def facts(self) -> dict[str, Any]:
        """What every product states; range and median uncertainty of the thickness, which a mask may hide."""
        known, sigma = self.known_um(), self.sigma[self.mask == 0]
        if not sigma.size:
            return {**super().facts(), "thickness": "none is known"}
        span = f"{np.nanmin(known):.3f} to {np.nanmax(known):.3f} µm"
        return {**super().facts(), "thickness": span, "median σ": f"{1e3 * np.median(sigma):.2g} nm"}

    def _picture(self) -> tuple[NDArray[Any], str, bool]:
        return self.value, f"{self.layer} [µm]", False

    @property
    def contrast(self) -> FloatArray | None:
        """Fringe amplitude over that of the model at each wavelength; `None` if the fit did not learn it."""
        return None if self.flats is None else self.flats.contrast

    @property
    def contrast_sigma(self) -> FloatArray | None:
        """Standard uncertainty of `contrast`."""
        return None if self.flats is None else self.flats.contrast_sigma

    @classmethod
    def read_any(cls, path: str | os.PathLike[str], layer: str | None = None) -> Self:
        """Read a thickness map that this package, or anybody else, has written.

        The map is the first image of the file, in the unit of length that its BUNIT states, in µm without BUNIT.
        Pixels without a positive number, and in a file from elsewhere those that an extension MASK marks, become
        NO_DATA. Where no extension SIGMA states an uncertainty it is `UNKNOWN_SIGMA_UM`.

        Parameters
        ----------
        path : path-like
            The file.
        layer : `str`, optional
            Layer that the map must be of, where the file says which it is (LAYER), and is taken for where not.

        Raises
        ------
        InputError
            No such file.
        FrameFormatError
            A damaged file, another product, no two-dimensional image, a unit that is no length, or numbers that are
            no thickness in it: the median is within `THICKNESS_LIMITS_UM`.
        """
        source = str(path)
        if not Path(path).is_file():
            raise InputError("file", source, "an existing FITS file")
        with (
            refuse_damage("file", "a complete FITS file", source),
            open_user_fits(path, warning="truncated") as hdus,
        ):
            product = hdus[0].header.get(io.PRODUCT_KEY, "")
            if product == cls.__name__ and _unit_of(hdus, 1) == "um":
                found = cls.read_fits(path)
            elif product in ("", cls.__name__):
                found = cls(**_from_elsewhere(hdus, layer, source))
            else:
                raise FrameFormatError(io.PRODUCT_KEY, product, cls.__name__, source=source)
        found._refuse_nothing_known(source)
        return found if layer is None else found.of_layer(layer, source)

    def _refuse_nothing_known(self, source: str) -> None:
        """Refuse a map without a good pixel, and one less certain than the order of its fringes."""
        good = self.mask == 0
        if not good.any():
            allowed = "one or more: every pixel is masked"
            raise FrameFormatError("good pixels of the thickness map", 0, allowed, source=source)
        middle = float(np.median(self.sigma[good]))
        if not middle < ORDER_UM:
            allowed = f"less than {ORDER_UM:g} µm, an order of its fringes: state the unit of SIGMA in BUNIT"
            raise FrameFormatError("median of SIGMA [µm]", middle, allowed, source=source)

    def of_layer(self, layer: str, source: str | None = None) -> Self:
        """The map itself, if it is of this layer.

        Raises
        ------
        InputError
            It is of another.
        """
        if self.layer != layer:
            where = source or self.detector or None
            raise InputError("layer of the thickness map", self.layer, layer, source=where)
        return self

    def of_setup(self, setup: Setup, source: str | None = None, layer: str | None = None) -> Self:
        """The map itself, if it is not of another vendor's sensor, and of one layer, by default the varying one.

        Raises
        ------
        InputError
            It is something else.
        """
        setup.refuse_vendor_of(self.detector, source or self.detector)
        return self.of_layer(layer or setup.varying, source)

    def known_um(self) -> Float32Array:
        """Thickness [µm], NaN where there is none; what a mask only doubts keeps its value."""
        missing = self.mask & mask_bits("NO_DATA")
        return np.where(missing, np.float32(np.nan), self.value).astype(np.float32)

    def _check(self) -> None:
        good = self.mask == 0
        if bool(np.any((self.value <= 0) & good)):
            raise OutOfRangeError("VALUE", float(self.value[good].min()), "a positive thickness in um")
        if bool(np.any((self.slip_probability > 1) & good)):
            worst = float(self.slip_probability[good].max())
            raise OutOfRangeError("SLIP_PROBABILITY", worst, "0 to 1")


def thickness_span_um(
    thickness_um: NDArray[np.floating], margin_um: float = 1e-3, source: str | None = None
) -> tuple[float, float]:
    """Smallest and largest known thickness of a map, widened so that rounding cannot leave it and it is not empty."""
    known = thickness_um[np.isfinite(thickness_um)]
    if not known.size:
        raise InputError("thickness map", "no known thickness", "one in at least one pixel", source=source)
    return max(float(known.min()) - margin_um, 0.0), float(known.max()) + margin_um


def _unit_of(hdus: fits.HDUList, number: int) -> str:
    return str(hdus[number].header.get("BUNIT", "")).strip() if number < len(hdus) else ""


def _from_elsewhere(hdus: fits.HDUList, layer: str | None, source: str) -> dict[str, Any]:
    """Fields of a map in a file of any layout."""
    number = next((k for k, hdu in enumerate(hdus) if hdu.is_image and hdu.data is not None), -1)
    data = hdus[number].data if number >= 0 else None
    if data is None or data.ndim != 2:
        shape = "no image" if data is None else f"shape {data.shape}"
        raise FrameFormatError("thickness map", shape, "a two-dimensional image in µm", source=source)
    value = io.in_unit("thickness map", data.astype(float), _unit_of(hdus, number), "um", source=source)
    mask = hdus["MASK"].data if "MASK" in hdus else None
    for name in ("MASK", "SIGMA"):
        if name in hdus and hdus[name].shape != value.shape:
            allowed = f"that of the map, {value.shape}"
            raise FrameFormatError(f"shape of {name}", hdus[name].shape, allowed, source=source)
    missing = ~np.isfinite(value) if mask is None else ~np.isfinite(value) | (mask != 0)
    if missing.all():
        raise FrameFormatError("thickness map", "no finite pixel", "a thickness in µm", source=source)
    low, high = THICKNESS_LIMITS_UM
    middle = float(np.median(value[~missing]))
    if not low <= middle <= high:
        allowed = f"{low:g} to {high:g} µm: state the unit in BUNIT"
        raise FrameFormatError("median of the thickness map [µm]", middle, allowed, source=source)
    missing |= ~(np.nan_to_num(value, nan=-1.0) > 0.0)
    sigma = np.full(value.shape, UNKNOWN_SIGMA_UM)
    if "SIGMA" in hdus:
        unit = hdus["SIGMA"].header.get("BUNIT")
        sigma = io.in_unit("SIGMA", hdus["SIGMA"].data.astype(float), unit, "um", source=source)
        missing |= ~(np.isfinite(sigma) & (sigma >= 0.0))
    headers = (hdus[0].header, hdus[number].header)
    return {
        "value": value,
        "sigma": sigma,
        "chi2": np.zeros(value.shape),
        "slip_probability": np.zeros(value.shape),
        "mask": np.where(missing, mask_bits("NO_DATA"), 0),
        "layer": next(
            (str(header["LAYER"]) for header in headers if header.get("LAYER")), layer or "unknown"
        ),
        "detector": str(hdus[0].header.get("DETNAME", "")),
    }
