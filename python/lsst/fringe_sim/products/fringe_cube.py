"""Flats of one sensor at many wavelengths: what a thickness fit and a search for effects work on."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sized
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from ..errors import FrameFormatError, InputError, OutOfRangeError, UnknownNameError
from . import _check as check
from . import _fits as io
from .fits_product import FitsProduct
from .fringe_flat import FringeFlat
from .mask import mask_bits

__all__ = ["CUBE_UNITS", "FlatExposures", "FringeCube"]

CUBE_UNITS = ("electron", "relative")
"""Units of a cube: counts in electrons, or counts divided by their mean over the sensor (so near 1)."""

CUBE_MASK = np.int16

_OWN = ("DETNAME", "LAYER")


@dataclass(frozen=True, eq=False)
class FlatExposures:
    """How each plane of a cube was illuminated.

    Parameters
    ----------
    wavelength_nm, bandwidth_fwhm_nm, temperature_k : array-like, shape ``(n_wavelengths,)``
        Wavelength, full width at half maximum, and temperature of the sensor. One number for all wavelengths
        is enough, except for the wavelength itself.
    f_number : array-like, shape ``(n_wavelengths,)``, optional
        Focal ratio; infinite (the default) for a collimated beam.
    level_e : array-like, shape ``(n_wavelengths,)``, optional
        Mean level in electrons; 0 (the default) where it is not known.
    dark_time_s : array-like, shape ``(n_wavelengths,)``, optional
        Time in which charge was gathered, in seconds; 0 (the default) where it is not known.
    """

    wavelength_nm: NDArray[np.float64]
    bandwidth_fwhm_nm: NDArray[np.float64]
    temperature_k: NDArray[np.float64]
    f_number: NDArray[np.float64] = field(default_factory=lambda: np.array(np.inf))
    level_e: NDArray[np.float64] = field(default_factory=lambda: np.array(0.0))
    dark_time_s: NDArray[np.float64] = field(default_factory=lambda: np.array(0.0))

    def __post_init__(self) -> None:
        wavelength = check.as_float_array("wavelength", self.wavelength_nm, 1, np.float64)
        number = wavelength.size
        values = {
            "wavelength_nm": _positive("wavelength", wavelength, number),
            "bandwidth_fwhm_nm": _positive("bandwidth_fwhm", self.bandwidth_fwhm_nm, number, zero=True),
            "temperature_k": _positive("temperature", self.temperature_k, number),
            "f_number": _positive("f_number", self.f_number, number, infinite=True),
            "level_e": _positive("level", self.level_e, number, zero=True),
            "dark_time_s": _positive("dark_time", self.dark_time_s, number, zero=True),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return int(self.wavelength_nm.size)

    def take(self, index: ArrayLike) -> FlatExposures:
        """Exposures at the given positions, in the given order."""
        at = np.asarray(index)
        return FlatExposures(
            self.wavelength_nm[at],
            self.bandwidth_fwhm_nm[at],
            self.temperature_k[at],
            self.f_number[at],
            self.level_e[at],
            self.dark_time_s[at],
        )


def _positive(
    name: str, values: ArrayLike, number: int, *, zero: bool = False, infinite: bool = False
) -> NDArray[np.float64]:
    if np.ndim(values) == 0:
        values = np.full(number, values)
    array = check.as_float_array(name, values, 1, np.float64)
    if array.size != number:
        raise FrameFormatError(name, f"{array.size} values", f"{number}, one for each wavelength")
    good = (array >= 0 if zero else array > 0) & (np.isfinite(array) | (infinite & ~np.isnan(array)))
    if not good.all():
        sign = "not negative" if zero else "positive"
        raise OutOfRangeError(name, float(array[~good][0]), f"{sign}{'' if infinite else ' and finite'}")
    return check.read_only(array.astype(np.float64))


@dataclass(frozen=True, eq=False)
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
        Layer whose thickness that is, as ``epoxy``; needed when ``thickness`` is given.
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

    image: NDArray[np.float32]
    variance: NDArray[np.float32]
    mask: NDArray[np.int16]
    exposures: FlatExposures
    unit: str = "electron"
    thickness: NDArray[np.float32] | None = None
    thickness_sigma: NDArray[np.float32] | None = None
    layer: str = ""
    detector: str = ""
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.unit not in CUBE_UNITS:
            raise UnknownNameError("BUNIT", self.unit, CUBE_UNITS)
        if not isinstance(self.exposures, FlatExposures):
            raise InputError("exposures", type(self.exposures).__name__, "FlatExposures")
        image = check.as_float_array("IMAGE", self.image, 3)
        variance = check.as_float_array("VARIANCE", self.variance, 3)
        mask = check.as_mask("MASK", self.mask, image.shape, CUBE_MASK)
        check.check_shape("VARIANCE", variance, image.shape)
        if len(self.exposures) != image.shape[0]:
            raise FrameFormatError(
                "EXPOSURES", f"{len(self.exposures)} rows", f"{image.shape[0]}, one for each plane of IMAGE"
            )
        check.check_good_pixels("IMAGE", image, mask)
        check.check_good_pixels("VARIANCE", variance, mask, nonnegative=True)
        if self.unit == "relative":
            _refuse_amplitudes(image, mask)
        values = {
            "image": image,
            "variance": variance,
            "mask": mask,
            "thickness": _map("THICKNESS", self.thickness, image.shape[1:]),
            "thickness_sigma": _map("THICKNESS_SIGMA", self.thickness_sigma, image.shape[1:]),
            "layer": check.check_name("LAYER", self.layer, empty=self.thickness is None),
            "detector": check.check_name("detector", self.detector),
            "metadata": io.normalise_metadata(self.metadata, _OWN),
        }
        if self.thickness is None and self.thickness_sigma is not None:
            raise FrameFormatError("THICKNESS", "missing", "a map beside THICKNESS_SIGMA")
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Wavelengths, rows, columns."""
        return (self.image.shape[0], self.image.shape[1], self.image.shape[2])

    @property
    def wavelength_nm(self) -> NDArray[np.float64]:
        """Wavelength of each plane, in nm."""
        return self.exposures.wavelength_nm

    @property
    def level_e(self) -> NDArray[np.float64]:
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
        return FringeCube(
            self.image[at],
            self.variance[at],
            self.mask[at],
            self.exposures.take(at),
            self.unit,
            self.thickness,
            self.thickness_sigma,
            self.layer,
            self.detector,
            self.metadata,
        )

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
        with variance 0, and stay masked. Metadata that all flats share become those of the cube.

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
            metadata={**stack.metadata, **({} if metadata is None else metadata)},
        )

    def _hdus(self, metadata: Mapping[str, Any] | None) -> list[Any]:
        """IMAGE, VARIANCE, MASK, EXPOSURES, and THICKNESS, THICKNESS_SIGMA if they are known."""
        own: list[tuple[str, io.Scalar, str]] = [("DETNAME", self.detector, "sensor")]
        if self.layer:
            own.append(("LAYER", self.layer, "layer of THICKNESS"))
        hdus = [
            io.primary_hdu("FringeCube", own, io.merge_metadata(self.metadata, metadata, _OWN)),
            io.image_hdu("IMAGE", self.image, unit=self.unit),
            io.image_hdu(
                "VARIANCE", self.variance, unit="electron2" if self.unit == "electron" else "relative2"
            ),
            io.mask_hdu(self.mask),
            self._exposures_hdu(),
        ]
        for name, data in (("THICKNESS", self.thickness), ("THICKNESS_SIGMA", self.thickness_sigma)):
            if data is not None:
                hdus.append(io.image_hdu(name, data, unit="um", cards=[("LAYER", self.layer, "layer")]))
        return hdus

    def _exposures_hdu(self) -> fits.BinTableHDU:
        rows = self.exposures
        return io.bintable_hdu(
            "EXPOSURES",
            [
                ("wavelength", rows.wavelength_nm, "nm"),
                ("bandwidth_fwhm", rows.bandwidth_fwhm_nm, "nm"),
                ("temperature", rows.temperature_k, "K"),
                ("f_number", rows.f_number, None),
                ("level", rows.level_e, "electron"),
                ("dark_time", rows.dark_time_s, "s"),
            ],
        )

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
        source = str(path)
        with io.open_fits(path, "FringeCube", memmap=memmap, verify=not memmap) as hdus:
            header = hdus[0].header
            image = io.read_image(hdus, "IMAGE", source=source, native=not memmap)
            variance = io.read_image(hdus, "VARIANCE", source=source, native=not memmap)
            mask = io.read_mask(hdus, source=source, native=not memmap)
            if mask.ndim == 2 and image.ndim == 3 and mask.shape == image.shape[1:]:
                mask = np.broadcast_to(mask, image.shape)
            maps = {
                name: io.read_image(hdus, name, source=source) if name in hdus else None
                for name in ("THICKNESS", "THICKNESS_SIGMA")
            }
            return cls(
                image=image,
                variance=variance,
                mask=_mask_what_is_no_number(image, variance, mask),
                exposures=_read_exposures(hdus, source),
                unit=io.read_keyword(hdus["IMAGE"].header, "BUNIT", source=source),
                thickness=maps["THICKNESS"],
                thickness_sigma=maps["THICKNESS_SIGMA"],
                layer=_read_layer(hdus),
                detector=header.get("DETNAME", ""),
                metadata=io.read_metadata(header, _OWN),
            )


@dataclass
class _Stack:
    """Planes of a cube while they come in."""

    image: NDArray[np.float32]
    variance: NDArray[np.float32]
    mask: NDArray[np.int16]
    detector: str
    metadata: dict[str, Any]
    rows: list[tuple[float, ...]] = field(default_factory=list)

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
    def wavelength_nm(self) -> NDArray[np.float64]:
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
        plane = len(self.rows)
        if plane == len(self.image):
            raise InputError("flats", f"more than {plane}", f"{plane}, as announced")
        self.image[plane] = np.nan_to_num(flat.image + np.float32(1), nan=1, posinf=1, neginf=1)
        self.variance[plane] = np.nan_to_num(flat.variance, nan=0, posinf=0, neginf=0)
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


def _map(name: str, values: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
    if values is None:
        return None
    array = check.as_float_array(name, values, 2)
    check.check_shape(name, array, shape)
    if bool(np.any(array < 0)):
        raise OutOfRangeError(name, float(np.nanmin(array)), "0 or more, in um")
    return array


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


def _read_exposures(hdus: fits.HDUList, source: str) -> FlatExposures:
    if "EXPOSURES" not in hdus or not isinstance(hdus["EXPOSURES"], fits.BinTableHDU):
        raise FrameFormatError("extension", "no EXPOSURES", "a binary table named EXPOSURES", source=source)
    table = hdus["EXPOSURES"].data
    names = {str(name).lower(): str(name) for name in table.names}
    absent = {"f_number": np.inf, "level": 0.0, "dark_time": 0.0}
    columns: list[NDArray[Any]] = []
    for name in ("wavelength", "bandwidth_fwhm", "temperature", "f_number", "level", "dark_time"):
        if name in names:
            columns.append(np.array(table[names[name]]))
        elif name in absent:
            columns.append(np.array(absent[name]))
        else:
            raise FrameFormatError("EXPOSURES", f"no column {name}", "a column of that name", source=source)
    return FlatExposures(*columns)


def _read_layer(hdus: fits.HDUList) -> str:
    """Name of the layer: from the primary header, or from that of the map."""
    for header in (hdus[0].header, *(hdus[name].header for name in ("THICKNESS",) if name in hdus)):
        if "LAYER" in header:
            return str(header["LAYER"])
    return ""
