"""Flats of any sensor, one image in one FITS file each: what there is before a camera has a layout of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameFormatError, InputError, named_units
from ..instrument.raw_header import DeclaredHeader
from ..instrument.raw_layout import Section
from ..instrument.raw_metadata import TEMPERATURE_RANGE_C, WAVELENGTH_RANGE_NM, ZERO_CELSIUS_K
from ..instrument.stated_facts import SAME_CELSIUS, SETTING_NM, Fact, refuse_other_filter
from ..notebook import do_nothing
from ..resources import complete_fits
from .file_keywords import SENSOR_NAMES, declared_names
from .fringe_cube import FringeCube
from .mask import mask_bits
from .same_light import pixels_digest
from .sky_frame import NOISE, refuse_noiseless

__all__ = ["PlainImage", "read_plain_flats", "refuse_other_sensors", "stack_plain_flats"]

DECLARED = declared_names("plain flat")

WAVELENGTHS = ("MONOWL", "WAVELEN", "WAVELNTH")
"""Keywords of the wavelength [nm]."""

ELECTRONS = ("electron", "electrons", "e-", "e")
ADU = ("adu", "dn", "count", "counts")
BIASES = ("bias", "zero")


@dataclass(frozen=True)
class PlainImage:
    """What the header of one image says; the pixels are read when they are wanted."""

    source: str  # the file
    # ``flat``, ``bias``, or else ``IMGTYPE`` in lower case; ``flat`` where it is absent. Of another kind than
    # these two nothing else is asked for.
    kind: str
    shape: tuple[int, int]  # rows and columns
    detector: str = ""  # name of the sensor; empty if it is not stated
    # wavelength_nm, temperature_k: of a flat; `None` where the temperature is not stated
    wavelength_nm: float | None = None
    temperature_k: float | None = None
    gain: float = 1.0  # electrons for each count
    read_noise_e: float = 0.0  # read noise in electrons; 0 where it is not stated
    full: float = math.inf  # counts at which a pixel is saturated

    @classmethod
    def read(cls, path: str | Path) -> PlainImage | None:
        """Read the headers of one file; `None` if it does not hold exactly one image.

        Raises
        ------
        FrameFormatError
            No complete FITS file, a header that contradicts itself, or counts in a unit that is not known.
        """
        with complete_fits(path) as hdus:
            images = _images(hdus)
            if len(images) != 1:
                return None
            (hdu,) = images
            others = () if hdu is hdus[0] else (hdus[0].header,)
            header = DeclaredHeader(hdu.header, str(path), DECLARED, others)
            return cls._of(header, tuple(hdu.shape))

    @classmethod
    def _of(cls, header: DeclaredHeader, shape: tuple[int, int]) -> PlainImage:
        kind = header.text("IMGTYPE").lower() or "flat"
        kind = "bias" if kind in BIASES else "flat" if "flat" in kind else kind
        if kind not in ("bias", "flat"):
            return cls(header.source, kind, shape)
        _refuse_overscan(header, shape)
        seconds = header.value("EXPTIME")
        if seconds is not None and header.seconds_of_light("EXPTIME", seconds, kind) == 0 and kind == "flat":
            raise header.refuse("EXPTIME", seconds, "more than 0 s for a flat")
        if kind == "flat":
            refuse_noiseless({NOISE: header.value(NOISE)}, header.source)
        noise, full = header.value("RDNOISE"), header.value("SATURATE")
        return cls(
            source=header.source,
            kind=kind,
            shape=shape,
            detector=next(filter(None, map(header.text, SENSOR_NAMES)), ""),
            wavelength_nm=_wavelength(header) if kind == "flat" else None,
            temperature_k=_temperature(header) if kind == "flat" else None,
            gain=_gain(header),
            read_noise_e=header.number("RDNOISE", noise or 0.0, "electrons, 0 or more", lambda e: e >= 0),
            full=math.inf if full is None else header.number("SATURATE", full, "positive", lambda c: c > 0),
        )

    def require_wavelength_nm(self) -> float:
        """Wavelength of a flat [nm]."""
        if self.wavelength_nm is None:
            raise InputError("IMGTYPE", self.kind, "flat", source=self.source)
        return self.wavelength_nm

    def counts(self) -> NDArray[np.float32]:
        """Pixels as they stand in the file, after ``BSCALE`` and ``BZERO``; NaN where it has ``BLANK``."""
        with complete_fits(self.source) as hdus:
            (hdu,) = _images(hdus)
            return np.array(hdu.data, dtype=np.float32)


@named_units
def read_plain_flats(
    paths: Iterable[str | Path],
    *,
    temperature_k: float,
    bandwidth_fwhm_nm: float,
    f_number: float = math.inf,
    detector: str = "",
) -> FringeCube:
    """Cube of flats that are one image in one file each.

    The wavelength is read from ``MONOWL``, ``WAVELEN`` or ``WAVELNTH`` [nm]. ``BUNIT`` says electrons, or ADU with
    the ``GAIN`` in electrons for each. Images with ``IMGTYPE`` ``bias`` are averaged and subtracted; where there are
    none, the flats are taken as bias-subtracted. ``RDNOISE`` [electrons] adds to the noise of the electrons. A copy
    of a file counts once.

    Parameters
    ----------
    paths : iterable of path-like
        The files, one image each.
    temperature_k : `float`
        Temperature of the sensor where the headers do not state it [K].
    bandwidth_fwhm_nm, f_number : `float`
        Line width of the light [nm], and its focal ratio, infinite for a parallel beam.
    detector : `str`, optional
        Name of the sensor, where the headers do not state it.

    Returns
    -------
    cube : `FringeCube`
        In electrons, sorted by wavelength. Its metadata say how many bias images were subtracted (``NBIAS``).

    Raises
    ------
    FrameFormatError
        A file that is not one image, of another shape than the others, without its wavelength or unit; two of one
        content under different headers.
    InputError
        No flats among them, or flats of several sensors.
    """
    images = []
    for path in paths:
        image = PlainImage.read(path)
        if image is None:
            raise FrameFormatError("images", "none or several", "one with two axes", source=str(path))
        images.append(image)
    return stack_plain_flats(
        images,
        temperature_k=temperature_k,
        bandwidth_fwhm_nm=bandwidth_fwhm_nm,
        f_number=f_number,
        detector=detector,
    )


def stack_plain_flats(
    images: Sequence[PlainImage],
    *,
    temperature_k: float,
    bandwidth_fwhm_nm: float,
    f_number: float,
    detector: str = "",
    advance: Callable[[], None] = do_nothing,
    note: Callable[[str], None] = do_nothing,
) -> FringeCube:
    """See `read_plain_flats`. ``note``: takes a line that names copies; ``advance``: called after each image."""
    flats = sorted(
        (image for image in images if image.kind == "flat"), key=lambda flat: flat.wavelength_nm or 0.0
    )
    biases = [image for image in images if image.kind == "bias"]
    refuse_other_sensors(images)
    once = _Once(advance)
    level, n_bias = np.zeros(flats[0].shape, np.float32), 0
    for bias in biases:
        counts = once.counts(bias)
        if counts is not None:
            level, n_bias = level + np.float32(bias.gain) * counts, n_bias + 1
    level /= np.float32(max(n_bias, 1))
    electrons = np.empty((len(flats), *flats[0].shape), np.float32)
    mask = np.zeros(electrons.shape, np.int16)
    kept: list[PlainImage] = []
    for flat in flats:
        counts = once.counts(flat)
        if counts is not None:
            mask[len(kept)][counts >= flat.full] = mask_bits("SAT")
            electrons[len(kept)] = np.float32(flat.gain) * counts - level
            kept.append(flat)
    if once.copies:
        note(f"copies of other images, not counted again: {', '.join(once.copies)}")
    electrons, mask = electrons[: len(kept)], mask[: len(kept)]
    noise = np.array([flat.read_noise_e for flat in kept], np.float32)[:, np.newaxis, np.newaxis]
    variance = np.maximum(electrons, np.float32(1.0))
    variance += noise**2 * np.float32(1.0 + (1.0 / n_bias if n_bias else 0.0))
    return FringeCube.from_arrays(
        electrons,
        [flat.require_wavelength_nm() for flat in kept],
        variance,
        mask,
        bandwidth_fwhm_nm=bandwidth_fwhm_nm,
        temperature_k=[temperature_k if flat.temperature_k is None else flat.temperature_k for flat in kept],
        f_number=f_number,
        detector=next((flat.detector for flat in kept if flat.detector), detector),
        metadata={"NBIAS": n_bias},
    )


def refuse_other_sensors(images: Sequence[PlainImage]) -> None:
    """Refuse images without flats among them, of several sizes, or of several sensors."""
    if not any(image.kind == "flat" for image in images):
        kinds = ", ".join(sorted({image.kind for image in images})) or "none"
        raise InputError("flats", kinds, "one flat or more (IMGTYPE FLAT)")
    used = [image for image in images if image.kind in ("bias", "flat")]
    first, named = used[0], [image for image in used if image.detector]
    for image in used:
        if image.shape != first.shape:
            allowed = f"{first.shape}, that of {first.source}"
            raise FrameFormatError("shape", image.shape, allowed, source=image.source)
        if image.detector and image.detector != named[0].detector:
            allowed = f"{named[0].detector}, that of {named[0].source}: flats of one sensor"
            raise FrameFormatError("sensor", image.detector, allowed, source=image.source)


class _Once:
    """Pixels of images, each only once."""

    def __init__(self, advance: Callable[[], None]) -> None:
        self._advance = advance
        self._seen: dict[str, PlainImage] = {}
        self.copies: list[str] = []

    def counts(self, image: PlainImage) -> NDArray[np.float32] | None:
        """Pixels, `None` of a copy; equal pixels under another header are refused.

        Images of one value have no light to tell.
        """
        counts = image.counts()
        self._advance()
        if counts.shape != image.shape:
            raise FrameFormatError("shape", counts.shape, f"{image.shape}, as before", source=image.source)
        first = self._seen.setdefault(pixels_digest(counts), image)
        if first is image or np.nanmin(counts) == np.nanmax(counts):
            return counts
        if replace(first, source=image.source) != image:
            raise FrameFormatError(
                "pixels", f"those of {first.source}", "light of its own", source=image.source
            )
        self.copies.append(image.source)
        return None


def _images(hdus: Sequence[Any]) -> list[Any]:
    """HDUs that hold an image with two axes."""
    return [hdu for hdu in hdus if getattr(hdu, "is_image", False) and len(hdu.shape) == 2]


def _wavelength(header: DeclaredHeader) -> float:
    low, high = WAVELENGTH_RANGE_NM
    allowed = f"a number from {low:g} to {high:g}, the wavelength in nm, as {' or '.join(WAVELENGTHS)}"
    stated = {name: value for name in WAVELENGTHS if (value := header.value(name)) is not None}
    if not stated:
        raise header.refuse(WAVELENGTHS[0], "missing", allowed)
    numbers = {
        name: header.number(name, value, allowed, lambda nm: low <= nm <= high)
        for name, value in stated.items()
    }
    Fact("wavelength", WAVELENGTHS, SETTING_NM, "nm").refuse_different(numbers.items(), header.source)
    wavelength = next(iter(numbers.values()))
    refuse_other_filter(header.text("FILTER"), wavelength, header.source)
    return wavelength


def _temperature(header: DeclaredHeader) -> float | None:
    """Temperature of the sensor [K] by ``TEMPK``, or ``CCDTEMP`` in °C; `None` where neither is there."""
    low, high = TEMPERATURE_RANGE_C
    kelvin: dict[str, float] = {}
    for name, zero, unit in (("TEMPK", ZERO_CELSIUS_K, "K"), ("CCDTEMP", 0.0, "°C")):
        value = header.value(name)
        if value is not None:
            allowed = f"{unit} from {low + zero:g} to {high + zero:g}"
            number = header.number(name, value, allowed, lambda t, z=zero: low <= t - z <= high)  # type: ignore[misc]
            kelvin[name] = number - zero + ZERO_CELSIUS_K
    Fact("temperature [K]", (), SAME_CELSIUS, "K").refuse_different(kelvin.items(), header.source)
    return next(iter(kelvin.values()), None)


def _gain(header: DeclaredHeader) -> float:
    """Electrons for each count."""
    unit = header.text("BUNIT").lower()
    if unit in ELECTRONS:
        return 1.0
    if unit not in ADU:
        raise header.refuse(
            "BUNIT", unit or "missing", "electron, or adu with the GAIN in electrons for each"
        )
    value = header.value("GAIN")
    allowed = "a positive number of electrons for each ADU"
    if value is None:
        raise header.refuse("GAIN", "missing", allowed)
    return header.number("GAIN", value, allowed, lambda gain: gain > 0)


def _refuse_overscan(header: DeclaredHeader, shape: tuple[int, int]) -> None:
    """Refuse an image with more pixels than the sensor; one that was trimmed may state where it was."""
    for name in ("DATASEC", "TRIMSEC"):
        value = header.value(name)
        if value is None:
            continue
        rows, columns = Section.parse(value, keyword=name, source=header.source).shape
        if rows < shape[0] or columns < shape[1]:
            allowed = f"the whole image of {shape[1]} x {shape[0]} pixels; trim its overscan"
            raise header.refuse(name, value, allowed)
