"""Raw frames in the LSST layout: one image HDU per amplifier, integer ADU.

Two things are taken from a file. The *geometry* of each amplifier comes from its ``DATASEC``, ``DETSEC`` and
``DETSIZE`` alone, so that an older sensor or a cut-down one reads as well as a 4k × 4k one. The *metadata* come
from the primary header. What a header lacks is derived where the rest decides it, else refused with one
`FrameFormatError` that names file, keyword, value and what is allowed. Nothing here touches pixel values.

The y sense of ``DETSEC`` is swapped between the two rows of amplifiers in real files (DM-36115): ``Segment1x``
stands in the upper half of the assembled CCD but is written with the lower rows of ``DETSIZE``. The names of the
amplifiers tell which sense a file uses.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from astropy.io import fits
from astropy.time import Time

from ..errors import FrameFormatError, InputError, UnknownNameError
from .camera import Camera, Detector

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

N_AMPLIFIERS = 16
"""Outputs of an LSST science sensor."""

OBSERVATION_TYPES: Mapping[str, str] = {
    "BIAS": "bias",
    "ZERO": "bias",
    "DARK": "dark",
    "FLAT": "flat",
    "LAMBDA": "flat",
    "SFLAT": "flat",
    "CBP": "cbp",
    "CCOB": "ccob",
    "FE55": "fe55",
    "PPUMP": "ppump",
    "SPOT": "spot",
    "ACQ": "acq",
    "CWFS": "cwfs",
    "ENGTEST": "engtest",
    "FOCUS": "focus",
    "INDEXING": "indexing",
    "OBJECT": "science",
    "SCIENCE": "science",
    "SKYEXP": "science",
    "STUTTERED": "stuttered",
    "TRAP": "trap",
    "OTHER": "other",
}
"""Observation type by the value of ``IMGTYPE``."""

WITHOUT_LIGHT = frozenset({"bias", "dark"})
"""Observation types whose ``MONOWL`` is left over from another exposure."""

WAVELENGTH_RANGE_NM = (200.0, 1300.0)
"""Wavelengths to which a silicon CCD and its monochromator can be set."""

TEMPERATURE_RANGE_C = (-200.0, 60.0)
"""Temperatures that a CCD can have while it is read; a value in kelvin falls outside."""

ZERO_CELSIUS_K = 273.15

CONTROLLERS = "OCHPQS"
"""Data-acquisition controllers of the LSST Camera; the place adds thousands of years to the exposure number."""

DAY_ROLLOVER_H = {"ts8": 8.0, "lsstCam": 12.0, "monocam": 12.0}
"""UTC hour at which the observing day begins, as obs_lsst has it."""


@dataclasses.dataclass(frozen=True)
class Section:
    """A FITS section ``[x1:x2,y1:y2]``: inclusive, counted from 1; reversed where an axis runs backwards."""

    x1: int
    x2: int
    y1: int
    y2: int

    @classmethod
    def parse(cls, text: object, *, keyword: str = "section", source: str | None = None) -> Section:
        """Read a section from a header value.

        Raises
        ------
        FrameFormatError
            The value is not ``[x1:x2,y1:y2]`` with integers from 1 on.
        """
        match = _SECTION.fullmatch(text) if isinstance(text, str) else None
        bounds = [int(group) for group in match.groups()] if match else []
        if not bounds or min(bounds) < 1:
            raise FrameFormatError(
                keyword, text, "[x1:x2,y1:y2] with integers counted from 1", source=source
            ) from None
        return cls(*bounds)

    @property
    def flip_x(self) -> bool:
        """Whether x runs backwards."""
        return self.x1 > self.x2

    @property
    def flip_y(self) -> bool:
        """Whether y runs backwards."""
        return self.y1 > self.y2

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return abs(self.y2 - self.y1) + 1, abs(self.x2 - self.x1) + 1

    @property
    def slices(self) -> tuple[slice, slice]:
        """The section as ``[y, x]`` slices, without its direction."""
        return (
            slice(min(self.y1, self.y2) - 1, max(self.y1, self.y2)),
            slice(min(self.x1, self.x2) - 1, max(self.x1, self.x2)),
        )

    def mirrored_y(self, n_rows: int) -> Section:
        """Return the section with y counted from the other end of ``n_rows`` rows."""
        return Section(self.x1, self.x2, n_rows + 1 - self.y1, n_rows + 1 - self.y2)

    def __str__(self) -> str:
        return f"[{self.x1}:{self.x2},{self.y1}:{self.y2}]"


_SECTION = re.compile(r"\s*\[\s*(\d{1,9})\s*:\s*(\d{1,9})\s*,\s*(\d{1,9})\s*:\s*(\d{1,9})\s*\]\s*", re.ASCII)


@dataclasses.dataclass(frozen=True, eq=False)
class RawAmplifier:
    """One amplifier of a raw frame, and where its pixels belong.

    Attributes
    ----------
    name : `str`
        ``C00`` … ``C17``.
    channel : `int`
        Number, from 1, in the order of the file.
    hdu : `int`
        Number of the FITS HDU.
    data : `numpy.ndarray` [y, x]
        The whole raw image, ADU, integer, in read-out order: prescan, imaging section and overscan.
    datasec, detsec : `Section`
        ``DATASEC`` and ``DETSEC`` as the header has them.
    imaging, serial_prescan, serial_overscan, parallel_overscan : `tuple` [`slice`, `slice`]
        Regions of ``data``. Serial prescan lies left of the imaging section, serial overscan right of it, both
        over the imaging rows; parallel overscan lies above it over the imaging columns. A region that the frame
        does not have is empty.
    destination : `tuple` [`slice`, `slice`]
        Where the imaging section belongs in the assembled CCD, after the flips.
    flip_y, flip_x : `bool`
        Whether the imaging section is reversed along that axis when the CCD is assembled.
    """

    name: str
    channel: int
    hdu: int
    data: npt.NDArray[np.integer[Any]]
    datasec: Section
    detsec: Section
    imaging: tuple[slice, slice]
    serial_prescan: tuple[slice, slice]
    serial_overscan: tuple[slice, slice]
    parallel_overscan: tuple[slice, slice]
    destination: tuple[slice, slice]
    flip_y: bool
    flip_x: bool

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


@dataclasses.dataclass(frozen=True)
class RawMetadata:
    """What the headers of a raw frame say about the exposure.

    Attributes
    ----------
    source : `str`
        File from which this was read.
    camera : `str`
        ``ts8``, ``lsstCam`` or ``monocam``.
    observation_type : `str`
        ``bias``, ``flat``, ``dark``, ``science``, …
    test_type : `str`
        ``TESTTYPE``, lower case (``lambda``); empty if absent.
    wavelength_nm : `float` or `None`
        Wavelength of the monochromator; `None` without light (bias, dark) and for flats of white light.
    bandpass_nm : `float` or `None`
        Width to which the monochromator's slits were set, if the header states one.
    exposure_time_s, dark_time_s : `float`
        Time with the shutter open, and time since the CCD was cleared.
    temperature_k : `float` or `None`
        Temperature of the CCD; `None` if no header states it.
    temperature_source : `str`
        Keyword from which the temperature came (``CCDTEMP``, ``SENSTEMP``, ``TEMP_SET``); empty if none.
    raft, slot : `str`
        Place of the sensor: ``R11``/``S01`` in LSSTCam, ``RTM-020``/``S01`` on TS8.
    serial : `str`
        Serial number of the sensor (``LSST_NUM`` without ``-Dev``); empty if absent.
    detector : `int`
        Number of the sensor in its camera.
    filter_name : `str`
        Name of the filter; empty if the header states none.
    run : `str`
        ``RUNNUM``; empty if absent.
    date_obs : `datetime.datetime`
        Start of the exposure as the header has it, without time zone.
    day_obs : `int`
        Observing day, ``YYYYMMDD``.
    seq_num : `int`
        Number of the exposure within the day; seconds since the day began where the header states none.
    exposure_id : `int`
        Number of the exposure, the same for all sensors read together.
    """

    source: str
    camera: str
    observation_type: str
    test_type: str
    wavelength_nm: float | None
    bandpass_nm: float | None
    exposure_time_s: float
    dark_time_s: float
    temperature_k: float | None
    temperature_source: str
    raft: str
    slot: str
    serial: str
    detector: int
    filter_name: str
    run: str
    date_obs: datetime.datetime
    day_obs: int
    seq_num: int
    exposure_id: int

    def require_wavelength_nm(self) -> float:
        """Return the wavelength of a monochromatic flat.

        Raises
        ------
        FrameFormatError
            The frame has none: a bias, a dark, or a flat of white light.
        """
        if self.wavelength_nm is None:
            raise FrameFormatError(
                "MONOWL",
                None,
                f"the wavelength of the monochromator in nm (this is a {self.observation_type} frame)",
                source=self.source,
            )
        return self.wavelength_nm

    def require_temperature_k(self) -> float:
        """Return the temperature of the CCD.

        Raises
        ------
        FrameFormatError
            No header states it.
        """
        if self.temperature_k is None:
            raise FrameFormatError("CCDTEMP", None, "the temperature of the CCD in °C", source=self.source)
        return self.temperature_k

    @classmethod
    def from_header(cls, header: Mapping[str, Any], *, source: str) -> RawMetadata:
        """Interpret the header of a raw frame.

        Parameters
        ----------
        header : `~collections.abc.Mapping`
            Primary header, with what it lacks of the test conditions (`read_raw_header`).
        source : `str`
            Name of the file, for messages.

        Raises
        ------
        FrameFormatError
            A keyword is absent and cannot be derived, or has a value that is not allowed.
        UnknownNameError
            The sensor that the header names is not in the camera.
        """
        return _interpret(_Header(header, source))


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
            header = _merged_header(hdus)
            metadata = RawMetadata.from_header(header, source=source)
            layouts, shape = _amplifier_layouts(hdus, source)
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

    Everything that `RawFrame.read` refuses about the layout is refused here too, as far as headers and the
    length of the file show it.

    Returns
    -------
    header : `astropy.io.fits.Header`
        Primary header; temperature and wavelength that it lacks are added from the test conditions.

    Raises
    ------
    FrameFormatError
        The file is not a complete raw frame in the LSST layout.
    """
    source = str(path)
    with _open_fits(source) as hdus:
        _amplifier_layouts(hdus, source)
        return _merged_header(hdus)


def read_raw_metadata(path: str | Path) -> RawMetadata:
    """Check a raw frame and read its metadata, but not its pixels.

    Raises
    ------
    FrameFormatError
        The file is not a complete raw frame in the LSST layout.
    UnknownNameError
        The sensor that the header names is not in the camera.
    """
    return RawMetadata.from_header(read_raw_header(path), source=str(path))


# Reading the file -----------------------------------------------------------------------------------------


@contextmanager
def _open_fits(source: str) -> Iterator[fits.HDUList]:
    """Open a file with all headers read; whatever FITS trouble there is becomes one `FrameFormatError`."""
    if not Path(source).is_file():
        raise FrameFormatError("file", source, "an existing FITS file")
    try:
        with warnings.catch_warnings():
            # astropy warns of a file that is too short, and goes on.
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message=".*truncated.*")
            with fits.open(source, memmap=False, lazy_load_hdus=False) as hdus:
                yield hdus
    except InputError:
        raise
    except (
        OSError,
        EOFError,
        TypeError,
        ValueError,
        KeyError,
        IndexError,
        Warning,
        fits.VerifyError,
    ) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FrameFormatError(
            "file", Path(source).name, f"a complete FITS file ({reason})", source=source
        ) from error


_CONDITION_HDUS = ("TEST_COND", "REB_COND")
_CONDITIONS = ("MONOWL", "CCDTEMP", "SENSTEMP", "TEMP_SET")


def _merged_header(hdus: Sequence[Any]) -> fits.Header:
    """Primary header, and from the test conditions what it lacks."""
    header = hdus[0].header.copy()
    for hdu in hdus[1:]:
        if hdu.name in _CONDITION_HDUS:
            for keyword in _CONDITIONS:
                if _value(header, keyword) is None and _value(hdu.header, keyword) is not None:
                    header[keyword] = (hdu.header[keyword], f"from {hdu.name}")
    return header


def _integer_pixels(hdu: Any, source: str) -> npt.NDArray[np.integer[Any]]:
    data = hdu.data
    if data is None or data.shape != _image_shape(hdu, source):
        found = None if data is None else data.shape
        raise FrameFormatError(f"{hdu.name} pixels", found, "a complete image", source=source)
    if data.dtype.kind not in "iu":
        raise FrameFormatError(f"{hdu.name} BITPIX", data.dtype.name, "integer ADU", source=source)
    return data if data.dtype.isnative else data.astype(data.dtype.newbyteorder("="))


# Geometry -------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _AmplifierLayout:
    """Everything of a `RawAmplifier` but its pixels."""

    name: str
    channel: int
    hdu: int
    datasec: Section
    detsec: Section
    imaging: tuple[slice, slice]
    serial_prescan: tuple[slice, slice]
    serial_overscan: tuple[slice, slice]
    parallel_overscan: tuple[slice, slice]
    destination: tuple[slice, slice]
    flip_y: bool
    flip_x: bool


@dataclasses.dataclass(frozen=True)
class _Sections:
    """Sections of one amplifier as its header has them."""

    name: str
    channel: int
    hdu: int
    raw_shape: tuple[int, int]
    datasec: Section
    detsec: Section


def _amplifier_layouts(
    hdus: Sequence[Any], source: str
) -> tuple[tuple[_AmplifierLayout, ...], tuple[int, int]]:
    """Layout of every amplifier, and rows and columns of the assembled CCD."""
    images = [(number, hdu) for number, hdu in enumerate(hdus) if number > 0 and _is_image(hdu)]
    if len(images) != N_AMPLIFIERS:
        raise FrameFormatError("number of amplifier HDUs", len(images), str(N_AMPLIFIERS), source=source)
    sections = [
        _read_sections(number, hdu, order, source) for order, (number, hdu) in enumerate(images, start=1)
    ]
    _refuse_repeated([amp.name for amp in sections], source)
    shape = _detector_shape(hdus[0].header, [hdu.header for _, hdu in images], sections, source)
    for amp in sections:
        _refuse_outside(f"{amp.name} DETSEC", amp.detsec, shape, source)
    mirrored = _detsec_is_mirrored(sections, shape, source)
    _refuse_gaps(sections, shape, source)
    return tuple(_layout(amp, shape, mirrored) for amp in sections), shape


def _is_image(hdu: Any) -> bool:
    return isinstance(hdu, fits.ImageHDU | fits.CompImageHDU) and hdu.header.get("NAXIS") == 2


def _image_shape(hdu: Any, source: str) -> tuple[int, int]:
    shape = tuple(hdu.header.get(keyword) for keyword in ("NAXIS2", "NAXIS1"))
    if not all(isinstance(size, int) and size > 0 for size in shape):
        raise FrameFormatError(f"{hdu.name} NAXIS2, NAXIS1", shape, "positive integers", source=source)
    return shape[0], shape[1]


def _read_sections(number: int, hdu: Any, order: int, source: str) -> _Sections:
    channel = _channel(hdu.header, order, source)
    name = _amplifier_name(hdu.name, channel)
    raw_shape = _image_shape(hdu, source)
    datasec, detsec = (
        Section.parse(_value(hdu.header, keyword), keyword=f"{name} {keyword}", source=source)
        for keyword in ("DATASEC", "DETSEC")
    )
    if datasec.flip_x or datasec.flip_y:
        raise FrameFormatError(f"{name} DATASEC", str(datasec), "increasing limits", source=source)
    _refuse_outside(f"{name} DATASEC", datasec, raw_shape, source)
    if datasec.shape != detsec.shape:
        raise FrameFormatError(
            f"{name} DETSEC", str(detsec), f"a section of the size of DATASEC {datasec}", source=source
        )
    if hdu.header.get("BITPIX", 0) < 0:
        raise FrameFormatError(
            f"{name} BITPIX", hdu.header["BITPIX"], "8, 16, 32 or 64: integer ADU", source=source
        )
    return _Sections(name, channel, number, raw_shape, datasec, detsec)


def _channel(header: Mapping[str, Any], order: int, source: str) -> int:
    value = _value(header, "CHANNEL")
    if value is None:
        return order
    if not isinstance(value, int) or not 1 <= value <= N_AMPLIFIERS:
        raise FrameFormatError("CHANNEL", value, f"an integer from 1 to {N_AMPLIFIERS}", source=source)
    return value


def _amplifier_name(extname: str, channel: int) -> str:
    """``Segment10`` is C10; without such a name the channel decides: 1–8 are C10–C17, 9–16 are C07–C00."""
    match = re.fullmatch(r"SEGMENT([01][0-7])", extname.upper())
    if match:
        return f"C{match.group(1)}"
    return f"C1{channel - 1}" if channel <= 8 else f"C0{16 - channel}"


def _refuse_repeated(names: Sequence[str], source: str) -> None:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise FrameFormatError(
            "EXTNAME and CHANNEL", ", ".join(repeated), "one HDU for each amplifier", source=source
        )


def _detector_shape(
    primary: Mapping[str, Any],
    headers: Iterable[Mapping[str, Any]],
    sections: Sequence[_Sections],
    source: str,
) -> tuple[int, int]:
    """Rows and columns of the assembled CCD: ``DETSIZE``, or the extent of all ``DETSEC`` where it is absent."""
    stated = [_value(header, "DETSIZE") for header in (*headers, primary)]
    sizes = {Section.parse(v, keyword="DETSIZE", source=source) for v in stated if v is not None}
    if len(sizes) > 1:
        raise FrameFormatError(
            "DETSIZE", ", ".join(sorted(map(str, sizes))), "one size for all amplifiers", source=source
        )
    if not sizes:
        return (
            max(max(amp.detsec.y1, amp.detsec.y2) for amp in sections),
            max(max(amp.detsec.x1, amp.detsec.x2) for amp in sections),
        )
    (size,) = sizes
    if (size.x1, size.y1) != (1, 1):
        raise FrameFormatError("DETSIZE", str(size), "a section that begins at [1:…,1:…]", source=source)
    return size.shape


def _refuse_outside(keyword: str, section: Section, shape: tuple[int, int], source: str) -> None:
    rows, columns = section.slices
    if rows.stop > shape[0] or columns.stop > shape[1]:
        raise FrameFormatError(
            keyword, str(section), f"a section within [1:{shape[1]},1:{shape[0]}]", source=source
        )


def _detsec_is_mirrored(sections: Sequence[_Sections], shape: tuple[int, int], source: str) -> bool:
    """Whether the y of ``DETSEC`` counts from the top of the assembled CCD (DM-36115).

    ``C1x`` belongs to the upper half of the assembled CCD. If its ``DETSEC`` has the lower rows, the file counts
    from the top.
    """
    mirrored = {
        (amp.detsec.y1 + amp.detsec.y2 < shape[0] + 1) == amp.name.startswith("C1") for amp in sections
    }
    if len(mirrored) > 1:
        raise FrameFormatError(
            "DETSEC",
            "C0x and C1x in the same half",
            "all Segment0x in one half of DETSIZE and all Segment1x in the other",
            source=source,
        )
    return mirrored.pop()


def _refuse_gaps(sections: Sequence[_Sections], shape: tuple[int, int], source: str) -> None:
    """Amplifiers must cover the CCD once: their areas add up, and no two of them overlap."""
    covered = sum(amp.detsec.shape[0] * amp.detsec.shape[1] for amp in sections)
    boxes = [(amp.name, *amp.detsec.slices) for amp in sections]
    for i, (name, rows, columns) in enumerate(boxes):
        for other, other_rows, other_columns in boxes[:i]:
            if _overlap(rows, other_rows) and _overlap(columns, other_columns):
                raise FrameFormatError(
                    "DETSEC", f"{other} and {name} overlap", "sections without common pixels", source=source
                )
    if covered != shape[0] * shape[1]:
        raise FrameFormatError(
            "DETSEC",
            f"{covered} pixels in all",
            f"sections that cover DETSIZE, {shape[1]} × {shape[0]} pixels",
            source=source,
        )


def _overlap(a: slice, b: slice) -> bool:
    return bool(a.start < b.stop and b.start < a.stop)


def _layout(amp: _Sections, shape: tuple[int, int], mirrored: bool) -> _AmplifierLayout:
    rows, columns = amp.datasec.slices
    placed = amp.detsec.mirrored_y(shape[0]) if mirrored else amp.detsec
    return _AmplifierLayout(
        name=amp.name,
        channel=amp.channel,
        hdu=amp.hdu,
        datasec=amp.datasec,
        detsec=amp.detsec,
        imaging=(rows, columns),
        serial_prescan=(rows, slice(0, columns.start)),
        serial_overscan=(rows, slice(columns.stop, amp.raw_shape[1])),
        parallel_overscan=(slice(rows.stop, amp.raw_shape[0]), columns),
        destination=placed.slices,
        flip_y=placed.flip_y,
        flip_x=placed.flip_x,
    )


# Metadata -------------------------------------------------------------------------------------------------


def _value(header: Mapping[str, Any], keyword: str) -> Any:
    """Value of a keyword; `None` if it is absent, undefined or blank."""
    value = header.get(keyword)
    if isinstance(value, fits.card.Undefined) or (isinstance(value, str) and not value.strip()):
        return None
    return value.strip() if isinstance(value, str) else value


@dataclasses.dataclass(frozen=True)
class _Header:
    """Header of a frame, asked for values of a certain kind."""

    cards: Mapping[str, Any]
    source: str

    def value(self, keyword: str) -> Any:
        return _value(self.cards, keyword)

    def text(self, keyword: str) -> str:
        value = self.value(keyword)
        return "" if value is None else str(value)

    def number(self, keyword: str, value: Any, allowed: str, accept: Callable[[float], bool]) -> float:
        """``value`` as a finite number that is accepted, or an error that names the keyword."""
        try:
            number = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not (math.isfinite(number) and accept(number)):
            raise self.refuse(keyword, value, allowed)
        return number

    def refuse(self, keyword: str, value: Any, allowed: str) -> FrameFormatError:
        return FrameFormatError(keyword, value, allowed, source=self.source)


def _interpret(header: _Header) -> RawMetadata:
    camera = _camera(header)
    observation_type = _observation_type(header)
    exposure_time, dark_time = _times(header, observation_type)
    temperature, temperature_source = _temperature(header)
    detector = _detector(header, camera)
    start = _date_obs(header)
    day_obs, seq_num = _day_and_sequence(header, camera, start)
    return RawMetadata(
        source=header.source,
        camera=camera,
        observation_type=observation_type,
        test_type=header.text("TESTTYPE").lower(),
        wavelength_nm=_wavelength(header, observation_type),
        bandpass_nm=_bandpass(header),
        exposure_time_s=exposure_time,
        dark_time_s=dark_time,
        temperature_k=temperature,
        temperature_source=temperature_source,
        raft=detector.raft,
        slot=detector.slot,
        serial=header.text("LSST_NUM").removesuffix("-Dev"),
        detector=detector.id,
        filter_name=_filter_name(header),
        run=header.text("RUNNUM"),
        date_obs=start,
        day_obs=day_obs,
        seq_num=seq_num,
        exposure_id=_exposure_id(header, camera, start, day_obs, seq_num),
    )


_CAMERAS = {
    "LSSTCAM": "lsstCam",
    "LSST_CAMERA": "lsstCam",
    "LSST-TS8": "ts8",
    "TS8": "ts8",
    "MONOCAM": "monocam",
}


def _camera(header: _Header) -> str:
    """Camera or test stand that took the frame; the place of the sensor tells where nothing says it outright."""
    if header.value("INSTRUME") is not None:
        instrument = header.text("INSTRUME").upper()
        if instrument not in _CAMERAS:
            raise header.refuse("INSTRUME", header.value("INSTRUME"), ", ".join(_CAMERAS))
        return _CAMERAS[instrument]
    if "TS8" in header.text("TSTAND").upper():
        return "ts8"
    if _bay(header) is not None:
        return "lsstCam"
    if _module(header) is not None or header.value("LSST_NUM") is not None:
        return "ts8"
    raise header.refuse(
        "INSTRUME",
        None,
        "lsstCam or MonoCam; or TSTAND = TS8; or RAFTBAY, RAFTNAME or LSST_NUM, which tell it",
    )


def _bay(header: _Header) -> str | None:
    """Raft bay of the LSST Camera, from either keyword that holds it."""
    for keyword in ("RAFTBAY", "RAFTNAME"):
        if re.fullmatch(r"R\d\d", header.text(keyword)):
            return header.text(keyword)
    return None


def _module(header: _Header) -> str | None:
    """Raft module, ``RTM-020``."""
    match = re.search(r"RTM-\d{3}", header.text("RAFTNAME"))
    return match.group(0) if match else None


def _detector(header: _Header, camera: str) -> Detector:
    """The sensor. In a camera its place decides; on the test stand its serial number, for rafts were rebuilt."""
    table = Camera.from_name(camera)
    if len(table.detectors) == 1:
        return table.detectors[0]
    slot = header.text("SLOTNAME") or header.text("CCDSLOT")
    raft = _bay(header) if camera == "lsstCam" else _module(header) or _bay(header)
    place = f"{raft}_{slot}" if raft and slot else ""
    serial = header.text("LSST_NUM")
    keys = [key for key in ((place, serial) if camera == "lsstCam" else (serial, place)) if key]
    if not keys:
        raise header.refuse("LSST_NUM", None, "the serial number of the sensor, or RAFTBAY and CCDSLOT")
    for key in keys:
        try:
            return table.detector(key)
        except UnknownNameError as error:
            unknown = error
    raise unknown.in_source(header.source)


def _observation_type(header: _Header) -> str:
    """From ``IMGTYPE``; where it is absent, from ``TESTTYPE``."""
    keyword = "IMGTYPE" if header.value("IMGTYPE") is not None else "TESTTYPE"
    spelled = header.text(keyword).upper()
    # TESTTYPE carries a suffix with the wavelength: SFLAT_500.
    known = spelled if keyword == "IMGTYPE" else spelled.partition("_")[0]
    if known not in OBSERVATION_TYPES:
        raise header.refuse("IMGTYPE", header.value(keyword), ", ".join(OBSERVATION_TYPES))
    return OBSERVATION_TYPES[known]


def _wavelength(header: _Header, observation_type: str) -> float | None:
    """``MONOWL``. ``MONOCH-WAVELENG`` is not used: it can still hold the value of an earlier exposure."""
    if observation_type in WITHOUT_LIGHT:
        return None
    value = header.value("MONOWL")
    lambda_flat = observation_type == "flat" and header.text("TESTTYPE").upper() == "LAMBDA"
    not_set = value is None or (isinstance(value, int | float) and value <= 0)
    if not_set and not lambda_flat:
        return None
    low, high = WAVELENGTH_RANGE_NM
    return header.number(
        "MONOWL", value, f"a wavelength from {low:g} to {high:g} nm", lambda nm: low <= nm <= high
    )


def _bandpass(header: _Header) -> float | None:
    value = header.value("MONOCH-BANDPASS")
    if value is None:
        return None
    # 0 means that the slits were not set to a width in nm.
    return header.number("MONOCH-BANDPASS", value, "0 or a width in nm", lambda nm: 0 <= nm < 1000) or None


def _times(header: _Header, observation_type: str) -> tuple[float, float]:
    """Exposure time and dark time, seconds; a bias without ``EXPTIME`` has none."""
    value = header.value("EXPTIME")
    if value is None and observation_type == "bias":
        value = 0.0
    exposure = header.number("EXPTIME", value, "seconds, 0 or more", lambda s: s >= 0)
    dark = header.value("DARKTIME")
    if dark is None:
        return exposure, exposure
    return exposure, header.number("DARKTIME", dark, "seconds, 0 or more", lambda s: s >= 0)


def _temperature(header: _Header) -> tuple[float | None, str]:
    low, high = TEMPERATURE_RANGE_C
    for keyword in ("CCDTEMP", "SENSTEMP", "TEMP_SET"):
        value = header.value(keyword)
        if value is not None:
            celsius = header.number(
                keyword, value, f"°C from {low:g} to {high:g}", lambda c: low <= c <= high
            )
            return celsius + ZERO_CELSIUS_K, keyword
    return None, ""


def _filter_name(header: _Header) -> str:
    """Filter of the LSST Camera: its parts joined by ``~``, empty places left out."""
    parts = [header.text(keyword) for keyword in ("FILTER", "FILTER1", "FILTER2")]
    named = [part for part in parts if part and part.lower() not in {"empty", "none"}]
    return "~".join(dict.fromkeys(named))


def _date_obs(header: _Header) -> datetime.datetime:
    for keyword, scale in (("DATE-OBS", "isot"), ("MJD-OBS", "mjd"), ("MJD", "mjd")):
        value = header.value(keyword)
        if value is None:
            continue
        try:
            text = str(value).rstrip("Z").replace(" ", "T") if scale == "isot" else float(value)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return Time(text, format=scale, scale="utc").to_datetime()
        except (TypeError, ValueError):
            allowed = "YYYY-MM-DDThh:mm:ss.sss" if scale == "isot" else "a modified Julian date"
            raise header.refuse(keyword, value, allowed) from None
    raise header.refuse("DATE-OBS", None, "YYYY-MM-DDThh:mm:ss.sss, or MJD-OBS")


def _day_and_sequence(header: _Header, camera: str, start: datetime.datetime) -> tuple[int, int]:
    """``DAYOBS`` and ``SEQNUM``; where absent, the day on which the night began and the seconds since then."""
    day_start = start - datetime.timedelta(hours=DAY_ROLLOVER_H[camera])
    stated = header.value("DAYOBS")
    day = int(day_start.strftime("%Y%m%d")) if stated is None else _day(header, stated)
    value = header.value("SEQNUM")
    if value is None:
        midnight = day_start.replace(hour=0, minute=0, second=0, microsecond=0)
        return day, int((day_start - midnight).total_seconds())
    number = header.number("SEQNUM", value, "an integer from 0 to 99999", lambda n: 0 <= n < 100000)
    if number != int(number):
        raise header.refuse("SEQNUM", value, "an integer from 0 to 99999")
    return day, int(number)


def _day(header: _Header, value: Any) -> int:
    digits = str(value).replace("-", "")
    try:
        datetime.datetime.strptime(digits, "%Y%m%d")
    except ValueError:
        raise header.refuse("DAYOBS", value, "a date YYYYMMDD") from None
    return int(digits)


def _exposure_id(header: _Header, camera: str, start: datetime.datetime, day_obs: int, seq_num: int) -> int:
    """Number of the exposure, as obs_lsst has it.

    On TS8 the digits of ``DATE-OBS`` down to tenths of a second: ``SEQNUM`` repeats within a day there. In the
    cameras the day and the sequence number, moved by 1000 years for each controller.
    """
    if camera == "ts8":
        return int(start.strftime("%Y%m%d%H%M%S")) * 10 + start.microsecond // 100_000
    controller = header.text("CONTRLLR").upper() or "O"
    if controller not in CONTROLLERS:
        raise header.refuse("CONTRLLR", controller, f"one of {', '.join(CONTROLLERS)}")
    return (day_obs + CONTROLLERS.index(controller) * 10_000_000) * 100_000 + seq_num
