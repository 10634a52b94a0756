"""Raw frames in the LSST layout: one image HDU per amplifier, integer ADU.

The geometry of each amplifier comes from its ``DATASEC``, ``DETSEC`` and ``DETSIZE`` alone, so that an older
sensor or a cut-down one reads as well as a 4k × 4k one. What a header lacks is derived where the rest decides it,
else refused with one `FrameFormatError` that names file, keyword, value and what is allowed. Nothing here touches
pixel values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from astropy.io import fits

from ..errors import FrameFormatError, InputError, UnknownNameError
from ..resources import DAMAGE, first_line, open_user_fits
from .camera import Camera
from .header_keywords import is_unknown
from .raw_checks import refuse_binning, refuse_other_unit, refuse_other_vendor
from .raw_header import header_value
from .raw_layout import N_AMPLIFIERS, AmplifierLayout, Section, amplifier_layouts, image_shape
from .raw_metadata import OBSERVATION_TYPES, RawMetadata
from .stated_facts import NO_READING_C, refuse_contradictions

__all__ = [
    "N_AMPLIFIERS",
    "OBSERVATION_TYPES",
    "RawAmplifier",
    "RawFrame",
    "RawMetadata",
    "Section",
    "read_raw_header",
    "read_raw_metadata",
]

MOST_SHOWN = 12  # Keywords that a note names


@dataclasses.dataclass(frozen=True, eq=False)
class RawAmplifier(AmplifierLayout):
    """One amplifier of a raw frame, and where its pixels belong; see `AmplifierLayout`.

    Attributes
    ----------
    data : `numpy.ndarray` [y, x]
        The whole raw image, ADU, integer, in read-out order: prescan, imaging section and overscan.
    """

    data: npt.NDArray[np.integer[Any]]

    def oriented(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return an image of the imaging section as it lies in the assembled CCD.

        Parameters
        ----------
        image : `numpy.ndarray` [y, x]
            Image of the size of the imaging section, read-out order.

        Returns
        -------
        oriented : `numpy.ndarray` [y, x]
            A view, flipped where the amplifier is.
        """
        return image[:: -1 if self.flip_y else 1, :: -1 if self.flip_x else 1]


@dataclasses.dataclass(frozen=True, eq=False)
class RawFrame:
    """One sensor, one exposure, as it was read out.

    Attributes
    ----------
    amplifiers : `tuple` [`RawAmplifier`, ...]
        The amplifiers, in the order of the file; together they cover the assembled CCD exactly once.
    detector_shape : `tuple` [`int`, `int`]
        Rows and columns of the assembled, trimmed CCD.
    header : `astropy.io.fits.Header`
        Primary header; temperature and wavelength that it lacks are added from the test conditions.
    metadata : `RawMetadata`
        What the headers say about the exposure.
    """

    amplifiers: tuple[RawAmplifier, ...]
    detector_shape: tuple[int, int]
    header: fits.Header
    metadata: RawMetadata

    @classmethod
    def read(cls, path: str | Path) -> RawFrame:
        """Read a raw frame with its pixels.

        Raises
        ------
        FrameFormatError
            The file is not a complete raw frame in the LSST layout; one message says what is wrong.
        UnknownNameError
            The sensor that the header names is not in the camera.
        """
        source = str(path)
        with _open_fits(source) as hdus:
            header = _merged_header(hdus, source)
            metadata = _with_unused(RawMetadata.from_header(header, source=source), hdus)
            layouts, shape = amplifier_layouts(hdus, source)
            _refuse_other_pixels(header, metadata, shape)
            amplifiers = tuple(
                RawAmplifier(data=_integer_pixels(hdus[layout.hdu], source), **vars(layout))
                for layout in layouts
            )
            return cls(amplifiers, shape, header, metadata)

    def amplifier(self, name: str) -> RawAmplifier:
        """Return one amplifier by name.

        Raises
        ------
        UnknownNameError
            The frame has no such amplifier.
        """
        for amp in self.amplifiers:
            if amp.name == name:
                return amp
        raise UnknownNameError(
            "amplifier", name, (amp.name for amp in self.amplifiers), source=self.metadata.source
        )


def read_raw_header(path: str | Path) -> fits.Header:
    """Check a raw frame and read its header, but not its pixels.

    Everything that `RawFrame.read` refuses is refused here too, as far as headers and the length of the file show it.

    Returns
    -------
    header : `astropy.io.fits.Header`
        Primary header; temperature and wavelength that it lacks are added from the test conditions.

    Raises
    ------
    FrameFormatError
        The file is not a complete raw frame in the LSST layout.
    UnknownNameError
        The sensor that the header names is not in the camera.
    """
    return _read_without_pixels(path)[0]


def read_raw_metadata(path: str | Path) -> RawMetadata:
    """Check a raw frame and read its metadata, but not its pixels.

    Raises
    ------
    FrameFormatError
        The file is not a complete raw frame in the LSST layout.
    UnknownNameError
        The sensor that the header names is not in the camera.
    """
    return _read_without_pixels(path)[1]


def _read_without_pixels(path: str | Path) -> tuple[fits.Header, RawMetadata]:
    source = str(path)
    with _open_fits(source) as hdus:
        _, shape = amplifier_layouts(hdus, source)
        header = _merged_header(hdus, source)
        metadata = _with_unused(RawMetadata.from_header(header, source=source), hdus)
    _refuse_other_pixels(header, metadata, shape)
    return header, metadata


def _refuse_other_pixels(header: fits.Header, metadata: RawMetadata, shape: tuple[int, int]) -> None:
    """Pixels must be those of the sensor that the header names, one by one, and as they were read."""
    sensor, source = Camera.from_name(metadata.camera).detector(metadata.detector), metadata.source
    maker, model = header_value(header, "CCD_MANU"), header_value(header, "CCD_TYPE")
    refuse_other_vendor(maker, model, sensor, shape, source)
    refuse_binning({keyword: header_value(header, keyword) for keyword in ("BINX", "BINY")}, source)
    refuse_other_unit(header_value(header, "BUNIT"), "", source)


# Reading the file -----------------------------------------------------------------------------------------


@contextmanager
def _open_fits(source: str) -> Iterator[fits.HDUList]:
    """Open a file with all headers read; whatever FITS trouble there is becomes one `FrameFormatError`."""
    if not Path(source).is_file():
        raise FrameFormatError("file", source, "an existing FITS file")
    try:
        with open_user_fits(source, warning="truncated", lazy_load_hdus=False) as hdus:
            yield hdus
    except InputError as error:
        raise (error if error.source else error.in_source(source)) from None
    except DAMAGE as error:
        raise FrameFormatError(
            "file", Path(source).name, f"a complete FITS file ({first_line(error)})", source=source
        ) from error


_TEMPERATURES = ("CCDTEMP", "SENSTEMP")

_CONDITION_HDUS = ("TEST_COND", "REB_COND")
_CONDITIONS = ("MONOWL", "CCDTEMP", "SENSTEMP", "TEMP_SET")


def _merged_header(hdus: Sequence[Any], source: str) -> fits.Header:
    """Primary header, and from the test conditions what it lacks."""
    header = hdus[0].header.copy()
    named = [
        ("", header),
        *((hdu.name or f"HDU {number}", hdu.header) for number, hdu in enumerate(hdus[1:], 1)),
    ]
    refuse_contradictions(named, header_value, source)
    for hdu in hdus[1:]:
        if hdu.name in _CONDITION_HDUS:
            for keyword in _CONDITIONS:
                value = header_value(hdu.header, keyword)
                if value is None or _is_no_reading(keyword, value):
                    continue
                if header_value(header, keyword) is None:
                    header[keyword] = (value, f"from {hdu.name}")
    return header


def _is_no_reading(keyword: str, value: Any) -> bool:
    return keyword in _TEMPERATURES and isinstance(value, int | float) and value <= NO_READING_C


def _with_unused(metadata: RawMetadata, hdus: Sequence[Any]) -> RawMetadata:
    """What of the headers is not used is said: keywords that nothing depends on, and broken readings."""
    broken = [
        f"{keyword} of {hdu.name} is {value:g} °C, which is no reading: not used"
        for hdu in hdus[1:]
        for keyword in _TEMPERATURES
        if _is_no_reading(keyword, value := header_value(hdu.header, keyword))
    ]
    if broken:
        metadata = dataclasses.replace(metadata, notes=(*metadata.notes, *broken))
    images = [hdu for hdu in hdus if hdu.is_image]  # all of the tables is of the electronics
    unknown = dict.fromkeys(keyword for hdu in images for keyword in hdu.header if is_unknown(keyword))
    if not unknown:
        return metadata
    shown = ", ".join([*unknown][:MOST_SHOWN]) + (" and more" if len(unknown) > MOST_SHOWN else "")
    note = (
        f"keywords that are not used: {shown}; gains and noise are measured, or those of the camera's table"
    )
    return dataclasses.replace(metadata, notes=(*metadata.notes, note))


def _integer_pixels(hdu: Any, source: str) -> npt.NDArray[np.integer[Any]]:
    data = hdu.data
    found = getattr(data, "shape", None)
    if found != image_shape(hdu, source):
        raise FrameFormatError(f"{hdu.name} pixels", found, "a complete image", source=source)
    if data.dtype.kind not in "iu":
        raise FrameFormatError(f"{hdu.name} BITPIX", data.dtype.name, "integer ADU", source=source)
    return data if data.dtype.isnative else data.astype(data.dtype.newbyteorder("="))
