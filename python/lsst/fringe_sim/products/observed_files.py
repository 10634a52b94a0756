"""FITS files of observed frames, as pipelines write them, and the same files with corrected pixels.

What pipelines do not agree on is said once in `_Layout`: where masks and variances are, and what their numbers mean.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..array_types import BoolArray, Float32Array
from ..errors import FrameFormatError, InputError, printable_name, to_number
from ..instrument.raw_header import header_value
from ..resources import complete_fits, open_user_fits, refuse_damage
from ._fits import write_summed
from .afw_background import afw_background, is_afw_background
from .file_keywords import FILTER_NAMES, PLACE_NAMES, SENSOR_NAMES, declared_names
from .image_archive import (
    IMAGE,
    address_again,
    archive_cards,
    archive_planes,
    archived_background,
    is_archive,
    origin_of,
)
from .mask import MASK_PLANES, mask_bits
from .observed_frame import ObservedFrame

UNCORRECTED = "UNCORRECTED"  # End of the name of an extension that is 1 where a template has no value

IntArray = NDArray[np.int32]

_MASKS = ("MASK", "DQ", "BPM")
_VARIANCES = ("VARIANCE", "VAR")
_INVERSES = ("WEIGHT", "WHT", "IVAR")
_ERRORS = ("ERR", "ERROR", "UNCERT", "SIGMA")
_NOT_SKY = (*_MASKS, *_VARIANCES, *_INVERSES, *_ERRORS, UNCORRECTED)

_DECLARED = declared_names("observed frame")
_DETECTORS = (*SENSOR_NAMES[:4], "EXTNAME", *SENSOR_NAMES[4:])

_DECAM_CODES_SINCE = (3, 5, 0)
"""Version of the DECam Community Pipeline from which a mask holds codes, before which it holds bits."""

_DECAM_CODES = {1: "BAD", 2: "NO_DATA", 3: "SAT", 4: "SAT", 5: "CR", 6: "SUSPECT", 7: "SUSPECT", 8: "SUSPECT"}
"""Bad pixel, no value, saturated, bleed trail, cosmic ray, low weight, transient, long streak."""

_DECAM_BITS = {0: "BAD", 1: "SAT", 2: "INTRP", 4: "CR", 6: "SAT", 7: "SUSPECT"}
"""Bad pixel, saturated, interpolated, cosmic ray, bleed trail, transient."""

_ZTF_BITS = {
    1: "DETECTED",
    11: "DETECTED",
    8: "SAT",
    10: "NO_DATA",
    0: "SUSPECT",
    5: "SUSPECT",
    12: "SUSPECT",
}
"""Source, source of the PSF catalogue, saturated, no number, track, ghost, halo; all others are bad pixels."""

_BITS = 63  # Of a mask that is read as integers with a sign

_HARMLESS = ("NOT_DEBLENDED", "INEXACT_PSF", "SENSOR_EDGE", "INJECTED", "INJECTED_CORE", "STREAK_FIT")
"""Planes of Rubin's masks that say nothing against the background of a pixel."""


@dataclass(frozen=True)
class ObservedImage:
    """One image of a file, read when it is wanted."""

    path: Path
    index: int  # Number of the HDU
    name: str  # Name of the HDU, or the stem of the file

    def read(self, background: Path | None = None) -> ObservedFrame:
        """Image, mask and variance; ``background``: file with what was subtracted, which is added again."""
        image = self.pixels(background).astype(np.float32, copy=False)
        with complete_fits(self.path) as hdus:
            header = _merged(hdus, self.index)
            layout = _layout_of(self, hdus)
            mask = layout.mask(self, hdus, header)
            variance = layout.variance(self, hdus, header)
        if mask is None:
            mask = np.zeros(image.shape, dtype=np.int32)
        for what, array in (("mask", mask), ("variance", variance)):
            if array is not None and array.shape != image.shape:
                raise FrameFormatError(
                    f"shape of the {what}", array.shape, f"{image.shape}", source=str(self.path)
                )
        known = np.isfinite(image)
        if image[known].size > 1 and np.ptp(image[known]) == 0:
            raise FrameFormatError("pixels", "all equal", "an image of the sky", source=str(self.path))
        mask = mask | np.where(known, 0, mask_bits("NO_DATA")).astype(np.int32)
        return ObservedFrame(
            image=image,
            mask=mask,
            variance=variance,
            unit=_text(header, "BUNIT"),
            metadata={},
            detector=detector_of(header),
            physical_filter=_first_of(header, FILTER_NAMES),
        )

    def pixels(self, background: Path | None = None) -> NDArray[np.floating]:
        """The image in the floating type of the file, whole numbers in single precision.

        ``background``: see `read`.
        """
        with complete_fits(self.path) as hdus:
            stored = hdus[self.index].data
            kind: type[np.floating] = np.float32
            if stored.dtype.kind == "f" and stored.dtype.itemsize > np.dtype(kind).itemsize:
                kind = np.float64
            image: NDArray[np.floating] = np.array(stored, dtype=kind)
            origin = origin_of(hdus) if is_archive(hdus) else None
        if background is not None:
            image += _background(background, self, image.shape, origin)
        return image

    def header(self) -> dict[str, Any]:
        """Keywords of the image, and those of the primary header that it does not have itself."""
        with complete_fits(self.path) as hdus:
            return _merged(hdus, self.index)


def observed_images(path: Path) -> list[ObservedImage]:
    """The images of the sky in a file: all of two axes that are no mask, variance or weight."""
    printable_name("name of a file", path.name)
    with complete_fits(path) as hdus:
        found = [
            ObservedImage(path, number, hdu.name if number and hdu.name else path.name.partition(".")[0])
            for number, hdu in enumerate(hdus)
            if hdu.is_image and len(hdu.shape) == 2 and not hdu.name.upper().endswith(_NOT_SKY)
            if not is_archive(hdus) or hdu.name == IMAGE
        ]
        for image in found:
            _refuse_two_statements(hdus, image, alone=len(found) == 1)
        sensors = [detector_of(_merged(hdus, image.index)) for image in found]
    if not found:
        raise FrameFormatError("images", 0, "one or more of two axes (y, x)", source=str(path))
    for image, sensor in zip(found, sensors, strict=True):
        printable_name("sensor", sensor or "none", source=str(path))
        if sensors.count(sensor) > 1:
            named = f"{sensor or 'none'} in HDU {image.index}"
            allowed = f"a name for each sensor of a file ({', '.join(_DETECTORS)})"
            raise FrameFormatError("sensor", named, allowed, source=str(path))
    return found


def detector_of(header: Mapping[str, Any]) -> str:
    """Name of the sensor that a header states; empty if it states none."""
    place = filter(None, (_text(header, keyword) for keyword in PLACE_NAMES))
    return _first_of(header, _DETECTORS) or "_".join(place)


def write_images(
    source: Path,
    target: Path,
    images: Mapping[int, NDArray[Any]],
    cards: Mapping[int, Mapping[str, Any]],
    uncorrected: Mapping[int, BoolArray],
    primary: Mapping[str, Any],
    *,
    added: bool = False,
) -> None:
    """Write a file again with other pixels; all else in it stays, and no image is compressed with loss.

    ``images``, ``cards`` and ``uncorrected`` are by number of the HDU: new pixels, keywords (values alone or with
    comments; `None` removes one), and the pixels that are as they were, named in an extension of their own.
    ``primary``: keywords of the primary header. ``added``: the pixels have a background that was subtracted before.
    """
    with complete_fits(source) as hdus, _as_stored(source) as stored:
        made, flags = [], []
        for number, hdu in enumerate(hdus):
            if hdu.name.endswith(UNCORRECTED):
                continue
            if number not in images:
                made.append(stored[number])
                continue
            header = hdu.header.copy()
            _set_cards(header, cards[number])
            kind = fits.PrimaryHDU if number == 0 else fits.ImageHDU
            made.append(kind(images[number], header))
            if uncorrected[number].any():
                name = f"{hdu.name}_{UNCORRECTED}" if number and hdu.name else UNCORRECTED
                flags.append(fits.ImageHDU(uncorrected[number].astype(np.uint8), name=name))
        _set_cards(made[0].header, primary)
        finish = partial(address_again, added=added) if is_archive(hdus) else None
        write_summed(target, made + flags, finish=finish)


@contextmanager
def _as_stored(source: Path) -> Iterator[fits.HDUList]:
    """The file, with compressed images as the tables that they are stored as."""
    with (
        refuse_damage("file", "a complete FITS file", str(source)),
        open_user_fits(source, warning="truncated", disable_image_compression=True) as hdus,
    ):
        yield hdus


def _set_cards(header: fits.Header, cards: Mapping[str, Any]) -> None:
    for keyword, value in cards.items():
        if value is None:
            header.remove(keyword, ignore_missing=True)
        else:
            header[keyword] = value


def _merged(hdus: fits.HDUList, index: int) -> dict[str, Any]:
    told = archive_cards(hdus) if is_archive(hdus) else {}
    return {**dict(hdus[0].header), **dict(hdus[index].header), **told}


def _refuse_two_statements(hdus: fits.HDUList, image: ObservedImage, *, alone: bool) -> None:
    """Refuse an image whose header contradicts the primary one, in its sensor too if it is the only image."""
    for keyword in ("BUNIT", *FILTER_NAMES, *(SENSOR_NAMES if alone else ())):
        first, own = (_text(hdus[number].header, keyword) for number in (0, image.index))
        if first and own and first.casefold() != own.casefold():
            allowed = "the same in the primary header and in that of the image"
            raise FrameFormatError(keyword, f"{first} and {own}", allowed)


def _text(header: Mapping[str, Any], keyword: str) -> str:
    """Value of a declared keyword; empty if there is none."""
    value = header_value(header, keyword, _DECLARED)
    return "" if value is None else str(value)


def _first_of(header: Mapping[str, Any], keywords: tuple[str, ...]) -> str:
    values = (_text(header, keyword) for keyword in keywords)
    return next((value for value in values if value and value.upper() not in ("IMAGE", "SCI", "PRIMARY")), "")


@dataclass(frozen=True)
class _Layout:
    """Where a pipeline puts masks and variances."""

    mask: Callable[[ObservedImage, fits.HDUList, Mapping[str, Any]], IntArray | None]
    variance: Callable[[ObservedImage, fits.HDUList, Mapping[str, Any]], Float32Array | None]


def _layout_of(image: ObservedImage, hdus: fits.HDUList) -> _Layout:
    if is_archive(hdus):
        return _Layout(_archive_mask, _own_variance)
    if _sibling(image.path, "_ood") is not None or _sibling(image.path, "_oow") is not None:
        return _Layout(_decam_mask, _decam_variance)
    if "sciimg" in image.path.name:
        return _Layout(_ztf_mask, lambda *_: None)
    return _Layout(_own_mask, _own_variance)


def _sibling(path: Path, kind: str) -> Path | None:
    """The file of another kind beside this one, as c4d_…_ood_z_v1.fits.fz beside c4d_…_ooi_z_v1.fits.fz."""
    other = path.with_name(re.sub(r"_ooi(?=[_.])", kind, path.name))
    return other if other != path and other.is_file() else None


def _background(
    path: Path, image: ObservedImage, shape: tuple[int, ...], origin: tuple[int, int] | None
) -> NDArray[Any]:
    """What was subtracted: an image, or what Rubin's packages draw one from."""
    with complete_fits(path) as hdus:
        if is_archive(hdus):
            return archived_background(path, origin, shape)
        if not is_afw_background(hdus):
            return _companion(path, image, shape)
        drawn = afw_background(hdus)
    if drawn.shape != shape:
        raise FrameFormatError("background", drawn.shape, f"one of shape {shape}", source=str(path))
    return drawn


def _companion(path: Path, image: ObservedImage, shape: tuple[int, ...] | None = None) -> NDArray[Any]:
    """The image of the same name in another file, or the one of the same number."""
    with complete_fits(path) as hdus:
        own = image.name in hdus and image.index > 0
        index = image.name if own else min(image.index, len(hdus) - 1)
        if hdus[index].data is None:
            index = next((n for n, hdu in enumerate(hdus) if hdu.is_image and hdu.data is not None), 0)
        data = hdus[index].data
        if data is None or (shape is not None and data.shape != shape):
            found = None if data is None else data.shape
            raise FrameFormatError("image", found, f"one of shape {shape}", source=str(path))
        return np.array(data)


def _named(planes: Mapping[int, str], stored: NDArray[Any], *, bits: bool, others: str = "BAD") -> IntArray:
    """Mask of this package from bits or codes of another."""
    mask = np.zeros(stored.shape, dtype=np.int32)
    rest = _whole(stored)
    for number, name in planes.items():
        chosen = (rest >> number & 1) == 1 if bits else rest == number
        mask[chosen] |= mask_bits(name)
        rest = rest & ~(1 << number) if bits else np.where(chosen, 0, rest)
    mask[rest != 0] |= mask_bits(others)
    return mask


def _whole(stored: NDArray[Any]) -> NDArray[np.int64]:
    """Bits or codes of a mask, which another type may hold but no fraction."""
    if stored.dtype.kind == "f" and not np.array_equal(stored, np.rint(stored)):
        raise FrameFormatError("mask", f"fractions in {stored.dtype}", "whole numbers, bits or codes")
    return stored.astype(np.int64)


def _decam_mask(image: ObservedImage, _: fits.HDUList, header: Mapping[str, Any]) -> IntArray | None:
    path = _sibling(image.path, "_ood")
    if path is None:
        return None
    stored = _companion(path, image)
    digits = re.findall(r"\d+", _text(header, "PLVER"))
    version = tuple(int(part) for part in digits[:3])
    if version and version < _DECAM_CODES_SINCE:
        return _named(_DECAM_BITS, stored, bits=True)
    return _named(_DECAM_CODES, stored, bits=False)


def _decam_variance(image: ObservedImage, _: fits.HDUList, __: Mapping[str, Any]) -> Float32Array | None:
    path = _sibling(image.path, "_oow")
    return None if path is None else _inverse(_companion(path, image))


def _ztf_mask(image: ObservedImage, _: fits.HDUList, __: Mapping[str, Any]) -> IntArray | None:
    path = image.path.with_name(image.path.name.replace("sciimg", "mskimg"))
    return _named(_ZTF_BITS, _companion(path, image), bits=True) if path.is_file() else None


def _own_mask(image: ObservedImage, hdus: fits.HDUList, _: Mapping[str, Any]) -> IntArray | None:
    hdu = _beside(hdus, image, _MASKS)
    if hdu is None:
        return None
    bits = {
        str(keyword)[3:]: _bit(str(keyword), bit)
        for keyword, bit in hdu.header.items()
        if str(keyword).startswith("MP_")
    }
    return _of_planes(np.asarray(hdu.data), bits)


def _archive_mask(_: ObservedImage, hdus: fits.HDUList, __: Mapping[str, Any]) -> IntArray | None:
    each = [_of_planes(stored, bits) for stored, bits in archive_planes(hdus)]
    return np.bitwise_or.reduce(each) if each else None


def _of_planes(stored: NDArray[Any], bits: Mapping[str, int]) -> IntArray:
    """Mask of this package from the bits of planes by name."""
    harmless = sum(1 << bit for name, bit in bits.items() if name in _HARMLESS)
    planes = {bit: _plane(name) for name, bit in bits.items() if name not in _HARMLESS}
    return _named(planes, _whole(stored) & ~harmless, bits=True)


def _bit(keyword: str, value: Any) -> int:
    number = to_number(keyword, value)
    if number not in range(_BITS):
        raise InputError(keyword, value, f"a bit of a mask, 0 to {_BITS - 1}")
    return int(number)


def _plane(name: str) -> str:
    if name in MASK_PLANES:
        return name
    return "SUSPECT" if name == "VIGNETTED" else "BAD"


def _own_variance(image: ObservedImage, hdus: fits.HDUList, _: Mapping[str, Any]) -> Float32Array | None:
    variance = _beside(hdus, image, _VARIANCES)
    if variance is not None:
        return np.array(variance.data, dtype=np.float32)
    weight = _beside(hdus, image, _INVERSES)
    if weight is not None:
        return _inverse(weight.data)
    error = _beside(hdus, image, _ERRORS)
    if error is None:
        return None
    # ccdproc says of its UNCERT what it is.
    kind = _text(error.header, "UTYPE").lower()
    if kind.startswith("inverse"):
        return _inverse(error.data)
    values = np.array(error.data, dtype=np.float32)
    return values if kind.startswith("variance") else values**2


def _inverse(weight: NDArray[Any]) -> Float32Array:
    """Variance of an inverse variance; NaN where that is 0, and nothing is known."""
    known = np.asarray(weight, dtype=np.float64)
    return np.divide(1.0, known, out=np.full(known.shape, np.nan), where=known > 0).astype(np.float32)


def _beside(hdus: fits.HDUList, image: ObservedImage, names: tuple[str, ...]) -> Any:
    """HDU with one of these names that belongs to an image: of its version, or that begins with its name.

    `FrameFormatError`: several do, or one has the shape of no image of the file.
    """
    own = hdus[image.index]
    every = {*names, *(f"{own.name}_{name}".upper() for name in names)}
    named = [hdu for hdu in hdus if hdu.name.upper() in every and hdu.is_image]
    near = [hdu for hdu in named if hdu.ver == own.ver] or (named if len(hdus) <= 4 else [])
    found = [hdu for hdu in near if hdu.shape == own.shape]
    if len(found) > 1:
        listed = ", ".join(hdu.name for hdu in found)
        raise FrameFormatError(f"extensions for {image.name}", listed, f"one of {', '.join(names)}")
    others = {hdu.shape for hdu in hdus if hdu.is_image and hdu not in named}
    stray = next((hdu for hdu in near if hdu.shape not in others), None)
    if not found and stray is not None:
        raise FrameFormatError(f"shape of {stray.name}", stray.shape, f"{own.shape}, that of its image")
    return found[0] if found else None


def is_companion(path: Path) -> bool:
    """Whether a file is, by its name, the mask or the weight of a frame and no frame."""
    return re.search(r"_oo[dw][_.]|mskimg|wtimg|rmsimg", path.name) is not None
