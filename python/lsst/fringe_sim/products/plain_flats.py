"""Flats of any sensor, one FITS file each: one image, or one for each of its amplifiers, however many."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..array_types import BoolArray, Float32Array
from ..errors import FrameFormatError, InputError, named_units
from ..instrument.raw_header import DeclaredHeader, header_value
from ..instrument.raw_layout import AmplifierLayout, Section, amplifier_layouts
from ..instrument.raw_metadata import TEMPERATURE_RANGE_C, WAVELENGTH_RANGE_NM, ZERO_CELSIUS_K, is_of_lsst
from ..instrument.stated_facts import SAME_CELSIUS, SETTING_NM, Fact, refuse_other_filter
from ..notebook import do_nothing
from ..resources import complete_fits
from .file_keywords import SENSOR_NAMES, declared_names
from .fringe_cube import FringeCube
from .mask import mask_bits
from .same_light import pixels_digest
from .sky_frame import NOISE, refuse_noiseless

DECLARED = declared_names("plain flat")

WAVELENGTHS = ("MONOWL", "WAVELEN", "WAVELNTH")  # Keywords of the wavelength [nm]

ELECTRONS = ("electron", "electrons", "e-", "e")
ADU = ("adu", "dn", "count", "counts")
BIASES = ("bias", "zero")

OF_LSST = ("LSST_NUM", "RAFTNAME", "RAFTBAY", "TSTAND")  # Keywords of raw frames in the LSST layout


@dataclass(frozen=True)
class AmplifierFacts:
    """What belongs to one amplifier, or to all of an image that has no amplifiers of its own."""

    gain: float = 1.0  # electrons for each count
    read_noise_e: float = 0.0  # read noise in electrons; 0 where it is not stated
    full: float = math.inf  # counts at which a pixel is saturated
    layout: AmplifierLayout | None = None  # where its pixels are, and where they belong; `None` of all pixels

    @classmethod
    def _of(cls, header: DeclaredHeader, layout: AmplifierLayout | None = None) -> AmplifierFacts:
        noise, full = header.value("RDNOISE"), header.value("SATURATE")
        return cls(
            gain=_gain(header),
            read_noise_e=header.number("RDNOISE", noise or 0.0, "electrons, 0 or more", lambda e: e >= 0),
            full=math.inf if full is None else header.number("SATURATE", full, "positive", lambda c: c > 0),
            layout=layout,
        )

    @property
    def place(self) -> tuple[slice, slice]:
        """Its pixels in the assembled image."""
        return (slice(None), slice(None)) if self.layout is None else self.layout.destination


@dataclass(frozen=True)
class PlainImage:
    """What the headers of one exposure say; the pixels are read when they are wanted."""

    source: str  # the file
    # ``flat``, ``bias``, or else ``IMGTYPE`` in lower case; ``flat`` where it is absent. Of another kind than
    # these two nothing else is asked for.
    kind: str
    shape: tuple[int, int]  # rows and columns
    detector: str = ""  # name of the sensor; empty if it is not stated
    # wavelength_nm, temperature_k: of a flat; `None` where the temperature is not stated
    wavelength_nm: float | None = None
    temperature_k: float | None = None
    exposure_s: float = 0.0  # 0 where it is not stated
    parts: tuple[AmplifierFacts, ...] = (AmplifierFacts(),)

    @classmethod
    def read(cls, path: str | Path) -> PlainImage | None:
        """Read the headers of one file; `None` if it is neither one image nor one for each amplifier.

        A file with several images is one of amplifiers if ``INSTRUME`` names a camera that is not one of LSST, whose
        frames `RawFrame` reads.
        """
        with complete_fits(path) as hdus:
            images = _images(hdus)
            if len(images) > 1 and _is_of_another_camera(hdus[0].header):
                return cls._of_amplifiers(hdus, str(path))
            if len(images) != 1:
                return None
            (hdu,) = images
            others = () if hdu is hdus[0] else (hdus[0].header,)
            header = DeclaredHeader(hdu.header, str(path), DECLARED, others)
            return cls._of(header, tuple(hdu.shape), None)

    @classmethod
    def _of_amplifiers(cls, hdus: Sequence[Any], source: str) -> PlainImage:
        layouts, shape = amplifier_layouts(hdus, source, lsst=False)
        own = {layout.hdu: hdus[layout.hdu].header for layout in layouts}
        # Each amplifier has its own gain and noise, and all have one exposure.
        parts = [
            AmplifierFacts._of(DeclaredHeader(own[layout.hdu], source, DECLARED, (hdus[0].header,)), layout)
            for layout in layouts
        ]
        header = DeclaredHeader(hdus[0].header, source, DECLARED, tuple(own.values()))
        return cls._of(header, shape, tuple(parts))

    @classmethod
    def _of(
        cls, header: DeclaredHeader, shape: tuple[int, int], parts: tuple[AmplifierFacts, ...] | None
    ) -> PlainImage:
        kind = header.text("IMGTYPE").lower() or "flat"
        kind = "bias" if kind in BIASES else "flat" if "flat" in kind else kind
        if kind not in ("bias", "flat"):
            return cls(header.source, kind, shape)
        if parts is None:
            _refuse_overscan(header, shape)
        stated = header.value("EXPTIME")
        seconds = 0.0 if stated is None else header.seconds_of_light("EXPTIME", stated, kind)
        if stated is not None and seconds == 0 and kind == "flat":
            raise header.refuse("EXPTIME", stated, "more than 0 s for a flat")
        if kind == "flat":
            refuse_noiseless({NOISE: header.value(NOISE)}, header.source)
        return cls(
            source=header.source,
            kind=kind,
            shape=shape,
            detector=next(filter(None, map(header.text, SENSOR_NAMES)), ""),
            wavelength_nm=_wavelength(header) if kind == "flat" else None,
            temperature_k=_temperature(header) if kind == "flat" else None,
            exposure_s=seconds,
            parts=parts or (AmplifierFacts._of(header),),
        )

    def require_wavelength_nm(self) -> float:
        """Wavelength of a flat [nm]."""
        if self.wavelength_nm is None:
            raise InputError("IMGTYPE", self.kind, "flat", source=self.source)
        return self.wavelength_nm

    def _read(self) -> tuple[Float32Array, BoolArray]:
        """Pixels as they stand in the file, after ``BSCALE`` and ``BZERO``, and whether they are saturated.

        Those of amplifiers are put where they belong, less the median of the overscan at their side, if there is one.
        """
        counts = np.empty(self.shape, np.float32)
        full = np.zeros(self.shape, np.bool_)
        with complete_fits(self.source) as hdus:
            for part in self.parts:
                if part.layout is None:
                    (hdu,) = _images(hdus)
                    if tuple(hdu.shape) != self.shape:
                        raise FrameFormatError(
                            "shape", tuple(hdu.shape), f"{self.shape}, as before", source=self.source
                        )
                    counts[:] = hdu.data
                    full[:] = counts >= part.full
                    continue
                image = np.asarray(hdus[part.layout.hdu].data, dtype=np.float32)
                counts[part.place], full[part.place] = _of_amplifier(image, part.layout, part.full)
        return counts, full

    def in_electrons(self, counts: Float32Array) -> Float32Array:
        """Counts times the gain of each amplifier."""
        electrons = np.empty_like(counts)
        for part in self.parts:
            electrons[part.place] = np.float32(part.gain) * counts[part.place]
        return electrons

    def read_noise_e(self) -> Float32Array:
        """Read noise of every pixel [electrons]."""
        noise = np.empty(self.shape, np.float32)
        for part in self.parts:
            noise[part.place] = part.read_noise_e
        return noise


@named_units
def read_plain_flats(
    paths: Iterable[str | Path],
    *,
    temperature_k: float,
    bandwidth_fwhm_nm: float,
    f_number: float = math.inf,
    detector: str = "",
) -> FringeCube:
    """Cube of flats of one file each: one image, or one for each amplifier.

    The wavelength is read from ``MONOWL``, ``WAVELEN`` or ``WAVELNTH`` [nm]. ``BUNIT`` says electrons, or ADU with
    the ``GAIN`` in electrons for each. Images with ``IMGTYPE`` ``bias`` are averaged and subtracted; where there are
    none, the flats are taken as bias-subtracted. Amplifiers, any number of them, have a ``DATASEC`` and a ``DETSEC``
    each, and ``INSTRUME`` names the camera; the median of the overscan, right of ``DATASEC``, is subtracted.
    ``RDNOISE`` [electrons] adds to the noise of the electrons. A copy of a file counts once.

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
        A file that is not one exposure, of another shape than the others, without its wavelength or unit; two of one
        content under different headers.
    InputError
        No flats among them, or flats of several sensors.
    """
    images = []
    for path in paths:
        image = PlainImage.read(path)
        if image is None:
            allowed = "one with two axes, or one for each amplifier and INSTRUME, which names the camera"
            raise FrameFormatError("images", "none or several", allowed, source=str(path))
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
        read = once.read(bias)
        if read is not None:
            level, n_bias = level + bias.in_electrons(read[0]), n_bias + 1
    level /= np.float32(max(n_bias, 1))
    electrons = np.empty((len(flats), *flats[0].shape), np.float32)
    mask = np.zeros(electrons.shape, np.int16)
    kept: list[PlainImage] = []
    for flat in flats:
        read = once.read(flat)
        if read is not None:
            mask[len(kept)][read[1]] = mask_bits("SAT")
            electrons[len(kept)] = flat.in_electrons(read[0]) - level
            kept.append(flat)
    if once.copies:
        note(f"copies of other images, not counted again: {', '.join(once.copies)}")
    electrons, mask = electrons[: len(kept)], mask[: len(kept)]
    variance = np.maximum(electrons, np.float32(1.0))
    for flat, own in zip(kept, variance, strict=True):
        own += flat.read_noise_e() ** 2 * np.float32(1.0 + (1.0 / n_bias if n_bias else 0.0))
    cube = FringeCube.from_arrays(
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
    seconds = np.array([flat.exposure_s for flat in kept])
    return replace(cube, exposures=replace(cube.exposures, dark_time_s=seconds))


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

    def read(self, image: PlainImage) -> tuple[Float32Array, BoolArray] | None:
        """Pixels and whether they are saturated, `None` of a copy; equal pixels under another header are refused.

        Images of one value have no light to tell.
        """
        counts, full = image._read()
        self._advance()
        first = self._seen.setdefault(pixels_digest(counts), image)
        if first is image or np.nanmin(counts) == np.nanmax(counts):
            return counts, full
        if replace(first, source=image.source) != image:
            raise FrameFormatError(
                "pixels", f"those of {first.source}", "light of its own", source=image.source
            )
        self.copies.append(image.source)
        return None


def _is_of_another_camera(header: Any) -> bool:
    """Whether a header names a camera of its own, and nothing in it is of LSST."""
    named = header_value(header, "INSTRUME")
    return named is not None and not is_of_lsst(str(named)) and not any(map(header.get, OF_LSST))


def _of_amplifier(
    image: Float32Array, layout: AmplifierLayout, full: float
) -> tuple[Float32Array, BoolArray]:
    """Pixels of an amplifier as they lie on the sensor, less its overscan; whether they are saturated."""
    flip = slice(None, None, -1 if layout.flip_y else 1), slice(None, None, -1 if layout.flip_x else 1)
    pixels, overscan = image[layout.imaging][flip], image[layout.serial_overscan]
    level = np.float32(np.median(overscan)) if overscan.size else np.float32(0.0)
    return pixels - level, pixels >= full


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
