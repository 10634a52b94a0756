"""Flats of one sensor at many wavelengths: what a thickness fit and a search for effects work on."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sized
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from ..array_types import Float32Array, FloatArray
from ..errors import FrameFormatError, InputError, OutOfRangeError, UnknownNameError, named_units
from . import _check as check
from . import _fits as io
from .fits_product import DETECTOR, NARROW_MASK, Card, FitsProduct, Image
from .flat_exposures import ExposureTable, FlatExposures
from .fringe_flat import FringeFlat
from .mask import mask_bits
from .same_light import refuse_equal_pixels
from .sky_frame import NOISE, is_noiseless

CUBE_UNITS = ("electron", "relative")
"""Units of a cube: counts in electrons, or counts divided by their mean over the sensor (so near 1)."""

CUBE_MASK = np.int16


class _Map(Image):
    """Thickness, or not a number where it is not known."""

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:
        values = super().check(product, known)
        array = values[self.field]
        if array is not None and bool(np.any(array < 0)):
            raise OutOfRangeError(self.name, float(np.nanmin(array)), "0 or more, in um")
        return values


@dataclass(frozen=True, eq=False, repr=False)
class FringeCube(FitsProduct):
    """Flats of one sensor, one plane for each wavelength, in the order given.

    Parameters
    ----------
    image : `numpy.ndarray`, float32, shape ``(n_wavelengths, ny, nx)``
        Counts, in ``unit``. May be memory-mapped and big-endian: convert what you take out of it.
    variance : `numpy.ndarray`, float32, shape of ``image``
        Variance, in the square of ``unit``.
    mask : `numpy.ndarray`, int16, shape of ``image``
        Planes of `MASK_PLANES`; 0 is good. Narrower than other masks: it is as large as the image.
    exposures : `FlatExposures`
        Illumination of each plane.
    unit : `str`
        ``electron``, or ``relative``: counts over their mean, so near 1.
    thickness, thickness_sigma : `numpy.ndarray`, float32, shape ``(ny, nx)``, optional
        Known thickness of ``layer`` and its uncertainty, in µm; not a number where not known.
    layer : `str`
        Layer whose thickness that is, as ``adhesive``; needed when ``thickness`` is given.
    detector : `str`
        Name of the sensor; empty if not known.
    metadata : `Mapping`
        Further header keywords.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or good pixels without a number.
    InputError
        An unknown unit, a thickness without the name of its layer, metadata that a header cannot hold.
    """

    image: Float32Array
    variance: Float32Array
    mask: NDArray[np.int16]
    exposures: FlatExposures
    unit: str = "electron"
    thickness: Float32Array | None = None
    thickness_sigma: Float32Array | None = None
    layer: str = ""
    detector: str = ""
    metadata: Mapping[str, Any] = field(default_factory=dict)

    CARDS = (DETECTOR, Card("layer", "LAYER", "layer of THICKNESS", kind=str, default="", omit=True))
    EXTENSIONS = (
        Image("image", "IMAGE", "{unit}", ndim=3),
        Image("variance", "VARIANCE", "{unit}2", ndim=3, nonnegative=True),
        NARROW_MASK,
        ExposureTable("exposures", "EXPOSURES"),
        _Map("thickness", "THICKNESS", "um", gaps=True, optional=True),
        _Map("thickness_sigma", "THICKNESS_SIGMA", "um", gaps=True, optional=True),
    )

    def __post_init__(self) -> None:
        if self.unit not in CUBE_UNITS:
            raise UnknownNameError("BUNIT", self.unit, CUBE_UNITS)
        super().__post_init__()

    def _check(self) -> None:
        for wavelength in np.unique(self.wavelength_nm):
            (planes,) = np.nonzero(self.wavelength_nm == wavelength)
            if len(planes) > 1:
                refuse_equal_pixels(f"flats at {wavelength:g} nm", list(self.image[planes]))
        if self.unit == "relative":
            _refuse_amplitudes(self.image, self.mask)
        if self.thickness is not None:
            check.check_name("LAYER", self.layer, empty=False)
        elif self.thickness_sigma is not None:
            raise FrameFormatError("THICKNESS", "missing", "a map beside THICKNESS_SIGMA")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Wavelengths, rows, columns."""
        return (self.image.shape[0], self.image.shape[1], self.image.shape[2])

    @property
    def wavelength_nm(self) -> FloatArray:
        """Wavelength of each plane, in nm."""
        return self.exposures.wavelength_nm

    @property
    def level_e(self) -> FloatArray:
        """Mean of the good pixels of each plane [electrons]; 0 where it is not known."""
        if self.unit != "electron":
            return self.exposures.level_e
        good = self.mask == 0
        return np.array(
            [
                np.mean(plane, where=use, dtype=np.float64) if use.any() else 0.0
                for plane, use in zip(self.image, good, strict=True)
            ]
        )

    def take(self, index: ArrayLike) -> FringeCube:
        """Cube of the planes at the given positions, in the given order."""
        at = np.asarray(index)
        image, variance, mask = self.image[at], self.variance[at], self.mask[at]
        return replace(self, image=image, variance=variance, mask=mask, exposures=self.exposures.take(at))

    @classmethod
    @named_units
    def from_arrays(
        cls,
        images: ArrayLike,
        wavelength_nm: Any,
        variance: Any = None,
        mask: ArrayLike | None = None,
        *,
        bandwidth_fwhm_nm: Any = 2.0,
        temperature_k: Any = 183.15,
        f_number: Any = np.inf,
        **fields: Any,
    ) -> Self:
        """Cube from plain arrays, or from arrays with astropy units.

        Parameters
        ----------
        images : array-like, shape ``(n_wavelengths, ny, nx)``
            Counts, in ``unit``: electrons unless ``unit="relative"``. Pixels without a number are masked as NO_DATA.
        wavelength_nm : array-like, shape ``(n_wavelengths,)``
            Wavelength of each image, in nm; in any order.
        variance : array-like, shape of ``images``, optional
            Variance, in the square of ``unit``. By default that of counted electrons, which relative counts do not
            tell.
        mask : array-like, integer, optional
            Planes of `MASK_PLANES`, 0 is good; one ``(ny, nx)`` may stand for all wavelengths.
        bandwidth_fwhm_nm, temperature_k, f_number : array-like, optional
            As of `FlatExposures`; by default the light and the sensor of the published flats: 2 nm, 183.15 K,
            collimated.
        **fields
            Further fields of the cube: ``unit``, ``detector``, ``thickness``, ``layer``, ``metadata``.

        Raises
        ------
        InputError
            Shapes that do not belong together, numbers that cannot be, relative counts without their variance.
        """
        unit = fields.get("unit", "electron")
        image = check.as_float_array("images", images, 3, unit="electron" if unit == "electron" else "")
        if variance is None and unit != "electron":
            raise InputError("variance", None, f"an array: counts in {unit} do not tell their noise")
        # Counts below one are read noise: no variance of zero, which would weigh without bound.
        spread = np.maximum(image, 1.0) if variance is None else variance
        known = np.zeros(image.shape, CUBE_MASK) if mask is None else np.asarray(mask)
        if known.shape == image.shape[1:]:
            known = np.broadcast_to(known, image.shape)
        return cls(
            image,
            spread,
            _mask_what_is_no_number(image, np.asarray(spread), known),
            FlatExposures(wavelength_nm, bandwidth_fwhm_nm, temperature_k, f_number),
            **fields,
        )

    def facts(self) -> dict[str, Any]:
        """What every product states, and the wavelengths."""
        return {**super().facts(), "wavelengths [nm]": ", ".join(f"{one:g}" for one in self.wavelength_nm)}

    def _picture(self) -> tuple[NDArray[Any], str, bool]:
        middle = len(self.image) // 2
        image = np.where(self.mask[middle] == 0, self.image[middle], np.nan)
        label = f"{self.wavelength_nm[middle]:g} nm, counts / mean − 1 [%]"
        return 100.0 * (image / np.nanmean(image) - 1.0), label, True

    def __repr__(self) -> str:
        low, high = self.wavelength_nm.min(), self.wavelength_nm.max()
        return f"{super().__repr__()[:-1]}, {low:g} to {high:g} nm, {self.unit})"

    @classmethod
    def from_flats(
        cls,
        flats: Iterable[FringeFlat],
        metadata: Mapping[str, Any] | None = None,
        *,
        number: int | None = None,
    ) -> Self:
        """Stack prepared flats into a relative cube, sorted by wavelength.

        Equal wavelengths keep the order in which they are given. Masked pixels without a number become 1
        with variance 0, and stay masked. Metadata that all flats share become those of the cube; it has no noise if
        one of them has none.

        Parameters
        ----------
        flats : iterable of `FringeFlat`
            Flats of one sensor. Only one is held at a time if they come from a generator.
        metadata : `Mapping`, optional
            Further header keywords, which win over those of the flats.
        number : `int`, optional
            How many flats there are; needed if ``flats`` cannot tell.

        Raises
        ------
        InputError
            No flats at all, or not as many as announced.
        FrameFormatError
            Flats of different shapes or different sensors.
        """
        stack = _Stack.of(flats, len(flats) if isinstance(flats, Sized) else number)
        order = np.argsort(stack.wavelength_nm, kind="stable")
        in_order = bool(np.all(np.diff(order) == 1))
        planes: Any = slice(None) if in_order else order
        return cls(
            stack.image[planes],
            stack.variance[planes],
            stack.mask if stack.one_mask else stack.mask[planes],
            FlatExposures(*np.array(stack.rows)[order].T),
            "relative",
            detector=stack.detector,
            metadata={
                **stack.metadata,
                **({NOISE: False} if stack.noiseless else {}),
                **({} if metadata is None else metadata),
            },
        )

    def _extension_cards(self, name: str) -> list[tuple[str, Any, str]]:
        return [("LAYER", self.layer, "layer")] if name.startswith("THICKNESS") else []

    @classmethod
    def read_fits(cls, path: str | os.PathLike[str], *, memmap: bool = False) -> Self:
        """Read a cube, from this package or from elsewhere.

        Good pixels that hold no number (or no variance) are masked as NO_DATA. A mask ``[y, x]`` holds for
        every wavelength.

        Parameters
        ----------
        path : path-like
            The file.
        memmap : `bool`, optional
            Leave images and masks on disk until touched; the checksums are then not compared.

        Raises
        ------
        InputError
            No such file, a missing extension or column, a wrong unit; the message names the file.
        """
        with io.open_fits(path, cls.__name__, memmap=memmap, verify=not memmap) as hdus:
            return cls(**cls._values(hdus, str(path), native=not memmap))

    @classmethod
    def _values(cls, hdus: fits.HDUList, source: str, *, native: bool = True) -> dict[str, Any]:
        values = super()._values(hdus, source, native=native)
        image, mask = values["image"], values["mask"]
        if mask.ndim == 2 and image.ndim == 3 and mask.shape == image.shape[1:]:
            mask = np.broadcast_to(mask, image.shape)
        of_map = str(hdus["THICKNESS"].header.get("LAYER", "")) if "THICKNESS" in hdus else ""
        return values | {
            "mask": _mask_what_is_no_number(image, values["variance"], mask),
            "unit": io.read_keyword(hdus["IMAGE"].header, "BUNIT", source=source),
            "layer": values["layer"] or of_map,
        }


@dataclass
class _Stack:
    """Planes of a cube while they come in."""

    image: Float32Array
    variance: Float32Array
    mask: NDArray[np.int16]
    detector: str
    metadata: dict[str, Any]
    rows: list[tuple[float, ...]] = field(default_factory=list)
    noiseless: bool = False  # whether any flat is

    @classmethod
    def of(cls, flats: Iterable[FringeFlat], number: int | None) -> _Stack:
        stack: _Stack | None = None
        for flat in flats:
            if stack is None:
                if number is None:
                    raise InputError("number", None, "the number of flats, for an iterable without length")
                cube = (number, *flat.shape)
                image, variance = np.empty(cube, np.float32), np.empty(cube, np.float32)
                mask = np.broadcast_to(flat.mask.astype(CUBE_MASK), cube)
                stack = cls(image, variance, mask, flat.detector, dict(flat.metadata))
            stack.add(flat)
        if stack is None:
            raise InputError("flats", "none", "at least one flat")
        if len(stack.rows) != number:
            raise InputError("flats", len(stack.rows), f"{number}, as announced")
        return stack

    @property
    def wavelength_nm(self) -> FloatArray:
        return np.array([row[0] for row in self.rows])

    @property
    def one_mask(self) -> bool:
        """Whether all flats so far have the same mask."""
        return self.mask.strides[0] == 0

    def add(self, flat: FringeFlat) -> None:
        name, shape = f"flat at {flat.wavelength_nm:g} nm", self.image.shape[1:]
        if flat.shape != shape:
            raise FrameFormatError(name, f"shape {flat.shape}", f"shape {shape}")
        if flat.detector != self.detector:
            raise FrameFormatError(
                name, f"sensor {flat.detector or 'unnamed'}", f"sensor {self.detector or 'unnamed'}"
            )
        if is_noiseless(flat.metadata):
            self.noiseless = True
        plane = len(self.rows)
        if plane == len(self.image):
            raise InputError("flats", f"more than {plane}", f"{plane}, as announced")
        np.add(flat.image, np.float32(1), out=self.image[plane])
        self.variance[plane] = flat.variance
        for values, instead in ((self.image[plane], 1.0), (self.variance[plane], 0.0)):
            if not (known := np.isfinite(values)).all():
                values[~known] = instead
        self._add_mask(plane, flat.mask)
        self.metadata = {
            keyword: value
            for keyword, value in self.metadata.items()
            if keyword in flat.metadata and flat.metadata[keyword] == value
        }
        self.rows.append(
            (
                flat.wavelength_nm, flat.bandwidth_fwhm_nm, flat.temperature_k,
                flat.f_number, flat.level_e, flat.dark_time_s,
            )
        )  # fmt: skip

    def _add_mask(self, plane: int, mask: NDArray[Any]) -> None:
        """Keep one mask for all wavelengths until one has another: the fifth part of a cube."""
        if np.array_equal(self.mask[plane], mask):
            return
        if self.one_mask:
            self.mask = np.array(self.mask)
        self.mask[plane] = mask


def _refuse_amplitudes(image: NDArray[Any], mask: NDArray[Any]) -> None:
    """Refuse counts/mean - 1 where counts/mean belongs: a fit would run on either, and be wrong on one."""
    plane = next((k for k in range(image.shape[0]) if (mask[k] == 0).any()), None)
    if plane is None:
        return
    middle = float(np.median(image[plane][mask[plane] == 0]))
    if not 0.5 < middle < 2:
        raise OutOfRangeError("IMAGE (relative)", middle, "counts over their mean, with a median near 1")


def _mask_what_is_no_number(image: NDArray[Any], variance: NDArray[Any], mask: NDArray[Any]) -> NDArray[Any]:
    if not image.shape == variance.shape == mask.shape or image.ndim != 3:
        return mask  # the constructor says what is wrong
    result = mask
    for plane in range(image.shape[0]):
        wrong = ~(np.isfinite(image[plane]) & np.isfinite(variance[plane])) & (mask[plane] == 0)
        if wrong.any():
            if result is mask:
                result = np.array(mask, dtype=CUBE_MASK)
            result[plane][wrong] |= mask_bits("NO_DATA")
    return result
