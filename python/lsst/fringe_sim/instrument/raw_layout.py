"""Where the pixels of a raw frame belong: sections of its amplifiers, and the checks that they make one sensor.

The y sense of ``DETSEC`` is swapped between the two rows of amplifiers in real files (DM-36115): ``Segment1x``
stands in the upper half of the assembled CCD but is written with the lower rows of ``DETSIZE``. The names of the
amplifiers tell which sense a file uses.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from astropy.io import fits

from ..errors import FrameFormatError
from .raw_checks import refuse_other_unit
from .raw_header import header_value

N_AMPLIFIERS = 16  # Outputs of an LSST science sensor


@dataclasses.dataclass(frozen=True)
class Section:
    """A FITS section ``[x1:x2,y1:y2]``: inclusive, counted from 1; reversed where an axis runs backwards."""

    x1: int
    x2: int
    y1: int
    y2: int

    @classmethod
    def parse(cls, text: object, *, keyword: str = "section", source: str | None = None) -> Section:
        """Read a section from a header value."""
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


@dataclasses.dataclass(frozen=True)
class AmplifierLayout:
    """Everything of a `RawAmplifier` but its pixels.

    Serial prescan lies left of the imaging section, serial overscan right of it, both over the imaging rows; parallel
    overscan lies above it over the imaging columns. A region that the frame does not have is empty.
    """

    name: str  # ``C00`` … ``C17``
    channel: int  # from 1, in the order of the file
    hdu: int  # number of the FITS HDU
    datasec: Section  # as the header has it
    detsec: Section
    imaging: tuple[slice, slice]  # region of the raw image, as the following ones
    serial_prescan: tuple[slice, slice]
    serial_overscan: tuple[slice, slice]
    parallel_overscan: tuple[slice, slice]
    destination: tuple[slice, slice]  # of the imaging section in the assembled CCD, after the flips
    flip_y: bool  # whether the imaging section is reversed when the CCD is assembled
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


def amplifier_layouts(
    hdus: Sequence[Any], source: str, *, lsst: bool = True
) -> tuple[tuple[AmplifierLayout, ...], tuple[int, int]]:
    """Layout of every amplifier, and rows and columns of the assembled CCD.

    ``lsst``: 16 amplifiers, named as those of LSST sensors; else any number of them, with names of their own.
    """
    images = [(number, hdu) for number, hdu in enumerate(hdus) if number > 0 and _is_image(hdu)]
    if lsst and len(images) != N_AMPLIFIERS:
        allowed = f"{N_AMPLIFIERS} of an LSST sensor; flats of another camera name it in INSTRUME"
        raise FrameFormatError("number of amplifier HDUs", len(images), allowed, source=source)
    sections = [
        _read_sections(number, hdu, order, source, lsst)
        for order, (number, hdu) in enumerate(images, start=1)
    ]
    _refuse_repeated([amp.name for amp in sections], source)
    shape = _detector_shape(hdus[0].header, [hdu.header for _, hdu in images], sections, source)
    for amp in sections:
        _refuse_outside(f"{amp.name} DETSEC", amp.detsec, shape, source)
    mirrored = lsst and _detsec_is_mirrored(sections, shape, source)
    _refuse_gaps(sections, shape, source)
    return tuple(_layout(amp, shape, mirrored) for amp in sections), shape


def _is_image(hdu: Any) -> bool:
    return isinstance(hdu, fits.ImageHDU | fits.CompImageHDU) and hdu.header.get("NAXIS") == 2


def image_shape(hdu: Any, source: str) -> tuple[int, int]:
    """Rows and columns that a header states."""
    shape = tuple(hdu.header.get(keyword) for keyword in ("NAXIS2", "NAXIS1"))
    if not all(isinstance(size, int) and size > 0 for size in shape):
        raise FrameFormatError(f"{hdu.name} NAXIS2, NAXIS1", shape, "positive integers", source=source)
    return shape[0], shape[1]


def _read_sections(number: int, hdu: Any, order: int, source: str, lsst: bool) -> _Sections:
    channel = _channel(hdu.header, order, source) if lsst else order
    name = _amplifier_name(hdu.name, channel) if lsst else hdu.name or f"A{order}"
    raw_shape = image_shape(hdu, source)
    datasec, detsec = (
        Section.parse(header_value(hdu.header, keyword), keyword=f"{name} {keyword}", source=source)
        for keyword in ("DATASEC", "DETSEC")
    )
    if datasec.flip_x or datasec.flip_y:
        raise FrameFormatError(f"{name} DATASEC", str(datasec), "increasing limits", source=source)
    _refuse_outside(f"{name} DATASEC", datasec, raw_shape, source)
    if datasec.shape != detsec.shape:
        raise FrameFormatError(
            f"{name} DETSEC", str(detsec), f"a section of the size of DATASEC {datasec}", source=source
        )
    _refuse_changed_pixels(hdu.header, name, source)
    _refuse_other_overscan(hdu.header, name, datasec, source)
    if hdu.header["BITPIX"] < 0:
        raise FrameFormatError(
            f"{name} BITPIX", hdu.header["BITPIX"], "8, 16, 32 or 64: integer ADU", source=source
        )
    return _Sections(name, channel, number, raw_shape, datasec, detsec)


def _refuse_other_overscan(header: Mapping[str, Any], name: str, datasec: Section, source: str) -> None:
    """Overscan is what lies right of ``DATASEC``; a header that says otherwise is refused."""
    value = header_value(header, "BIASSEC")
    if value is None:
        return
    rows, columns = Section.parse(value, keyword=f"{name} BIASSEC", source=source).slices
    if _overlap(rows, datasec.slices[0]) and _overlap(columns, datasec.slices[1]):
        allowed = f"a section without pixels of DATASEC {datasec}"
        raise FrameFormatError(f"{name} BIASSEC", value, allowed, source=source)


def _refuse_changed_pixels(header: Mapping[str, Any], name: str, source: str) -> None:
    """Pixels must be those of the sensor, and numbers those of the converter."""
    binning = header_value(header, "CCDSUM")
    if binning is not None and str(binning).split() != ["1", "1"]:
        raise FrameFormatError(f"{name} CCDSUM", binning, "1 1: pixels that are not binned", source=source)
    scale = header_value(header, "BSCALE")
    if scale not in (None, 1):
        raise FrameFormatError(f"{name} BSCALE", scale, "1: ADU as they were read", source=source)
    refuse_other_unit(header_value(header, "BUNIT"), f"{name} ", source)
    blank = header_value(header, "BLANK")
    if blank is not None and header.get("BITPIX", 0) > 0:
        raise FrameFormatError(f"{name} BLANK", blank, "no such card: every pixel has its ADU", source=source)


def _channel(header: Mapping[str, Any], order: int, source: str) -> int:
    value = header_value(header, "CHANNEL")
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
    stated = [header_value(header, "DETSIZE") for header in (*headers, primary)]
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


def _layout(amp: _Sections, shape: tuple[int, int], mirrored: bool) -> AmplifierLayout:
    rows, columns = amp.datasec.slices
    placed = amp.detsec.mirrored_y(shape[0]) if mirrored else amp.detsec
    return AmplifierLayout(
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
