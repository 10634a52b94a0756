"""Flats of any sensor, one image in one FITS file each: what there is before a camera has a layout of its own."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameFormatError, InputError, OutOfRangeError, named_units
from ..resources import open_user_fits, refuse_damage
from .fringe_cube import FringeCube
from .mask import mask_bits

__all__ = ["PlainImage", "is_plain", "read_plain_flats"]

WAVELENGTH = ("MONOWL", "WAVELEN", "WAVELNTH")
"""Keywords of the wavelength [nm]; the first that is there counts."""

ELECTRONS = ("electron", "electrons", "e-", "e")
ADU = ("adu", "dn", "count", "counts")
RANGE_NM = (200.0, 1300.0)
ZERO_CELSIUS_K = 273.15


@dataclass(frozen=True, eq=False)
class PlainImage:
    """One image and what its header says of it.

    Attributes
    ----------
    source : `str`
        The file.
    kind : `str`
        ``IMGTYPE`` in lower case; ``flat`` where it is absent.
    electrons : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Counts in electrons.
    read_noise_e : `float`
        Read noise in electrons; 0 where it is not stated.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`: pixels without a number, or at ``SATURATE`` and above.
    header : mapping
        The header, with that of the primary HDU below it.
    """

    source: str
    kind: str
    electrons: NDArray[np.float32]
    read_noise_e: float
    mask: NDArray[np.int32]
    header: dict[str, Any]

    @classmethod
    def read(cls, path: str | Path) -> PlainImage:
        """Read one file.

        Raises
        ------
        FrameFormatError
            Damaged, not one image, or counts in a unit that is not known.
        """
        source = str(path)
        with _opened(source) as hdus:
            images = _images(hdus)
            if len(images) != 1:
                raise FrameFormatError("images", len(images), "one with two axes", source=source)
            hdu = images[0]
            header = {**hdus[0].header, **hdu.header}
            counts = np.asarray(hdu.data, dtype=np.float32)
        gain = _gain(header, source)
        mask = np.where(np.isfinite(counts), 0, mask_bits("NO_DATA")).astype(np.int32)
        full = header.get("SATURATE")
        if full is not None:
            mask[counts >= _number(full, "SATURATE", source)] |= mask_bits("SAT")
        noise = _number(header.get("RDNOISE", 0.0), "RDNOISE", source)
        kind = str(header.get("IMGTYPE", "flat")).strip().lower()
        return cls(source, kind, counts * np.float32(gain), noise, mask, header)

    @property
    def wavelength_nm(self) -> float:
        """Wavelength of the light [nm]; errors as of `read_plain_flats`."""
        name = next((name for name in WAVELENGTH if name in self.header), None)
        if name is None:
            allowed = f"the wavelength in nm as {' or '.join(WAVELENGTH)}"
            raise FrameFormatError(WAVELENGTH[0], "missing", allowed, source=self.source)
        value = _number(self.header[name], name, self.source)
        if not RANGE_NM[0] <= value <= RANGE_NM[1]:
            allowed = f"{RANGE_NM[0]:g} to {RANGE_NM[1]:g}, in nm"
            raise OutOfRangeError(name, value, allowed, source=self.source)
        return value

    @property
    def temperature_k(self) -> float | None:
        """Temperature of the sensor [K] by ``TEMPK``, or ``CCDTEMP`` in °C; `None` where neither is there."""
        if "TEMPK" in self.header:
            return _number(self.header["TEMPK"], "TEMPK", self.source)
        if "CCDTEMP" in self.header:
            return _number(self.header["CCDTEMP"], "CCDTEMP", self.source) + ZERO_CELSIUS_K
        return None


def is_plain(path: str | Path) -> bool:
    """Whether a file holds exactly one image, as no frame with an image for each of its amplifiers does.

    Raises
    ------
    FrameFormatError
        The file is no FITS file, or is damaged.
    """
    with _opened(str(path)) as hdus:
        return len(_images(hdus)) == 1


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
    none, the flats are taken as bias-subtracted. ``RDNOISE`` [electrons] adds to the noise of the electrons.

    Parameters
    ----------
    paths : iterable of path-like
        The files, one image each.
    temperature_k : `float`
        Temperature of the sensor where the headers do not state it [K].
    bandwidth_fwhm_nm, f_number : `float`
        Line width of the light [nm], and its focal ratio, infinite for a parallel beam.
    detector : `str`, optional
        Name of the sensor.

    Returns
    -------
    cube : `FringeCube`
        In electrons, sorted by wavelength. Its metadata say how many bias images were subtracted (``NBIAS``).

    Raises
    ------
    FrameFormatError
        A file that is not one image, of another shape than the others, without its wavelength or unit.
    OutOfRangeError
        A wavelength outside 200 to 1300 nm.
    InputError
        No flats among them.
    """
    images = [PlainImage.read(path) for path in paths]
    biases = [image for image in images if image.kind in ("bias", "zero")]
    flats = [image for image in images if "flat" in image.kind]
    if not flats:
        kinds = ", ".join(sorted({image.kind for image in images})) or "no image"
        raise InputError("flats", kinds, "one flat or more (IMGTYPE FLAT)")
    _refuse_other_shapes(images)
    flats.sort(key=lambda flat: flat.wavelength_nm)
    level = np.mean([bias.electrons for bias in biases], axis=0) if biases else np.float32(0.0)
    stated = [flat.temperature_k for flat in flats]
    electrons = np.stack([flat.electrons - level for flat in flats])
    noise = np.array([flat.read_noise_e for flat in flats])[:, np.newaxis, np.newaxis]
    return FringeCube.from_arrays(
        electrons,
        [flat.wavelength_nm for flat in flats],
        np.maximum(electrons, 1.0) + noise**2 * (1.0 + (1.0 / len(biases) if biases else 0.0)),
        np.stack([flat.mask for flat in flats]),
        bandwidth_fwhm_nm=bandwidth_fwhm_nm,
        temperature_k=[temperature_k if found is None else found for found in stated],
        f_number=f_number,
        detector=detector,
        metadata={"NBIAS": len(biases)},
    )


@contextmanager
def _opened(source: str) -> Iterator[Any]:
    with (
        refuse_damage("file", "a complete FITS file", source),
        open_user_fits(source, warning="truncated", memmap=False) as hdus,
    ):
        yield hdus


def _images(hdus: Sequence[Any]) -> list[Any]:
    """HDUs that hold an image with two axes."""
    return [hdu for hdu in hdus if getattr(hdu, "is_image", False) and len(hdu.shape) == 2]


def _gain(header: dict[str, Any], source: str) -> float:
    """Electrons for each count."""
    unit = str(header.get("BUNIT", "")).strip().lower()
    if unit in ELECTRONS:
        return 1.0
    if unit not in ADU:
        allowed = "electron, or adu with the GAIN in electrons for each"
        raise FrameFormatError("BUNIT", unit or "missing", allowed, source=source)
    if "GAIN" not in header:
        raise FrameFormatError("GAIN", "missing", "electrons for each ADU", source=source)
    gain = _number(header["GAIN"], "GAIN", source)
    if not gain > 0.0:
        raise OutOfRangeError("GAIN", gain, "a positive number of electrons for each ADU", source=source)
    return gain


def _number(value: Any, name: str, source: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise FrameFormatError(name, value, "a number", source=source)
    return float(value)


def _refuse_other_shapes(images: Sequence[PlainImage]) -> None:
    first = images[0]
    for image in images:
        if image.electrons.shape != first.electrons.shape:
            allowed = f"{first.electrons.shape}, that of {first.source}"
            raise FrameFormatError("shape", image.electrons.shape, allowed, source=image.source)
