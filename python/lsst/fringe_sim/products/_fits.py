"""How products meet the disk: headers that come back bit for bit, and files that are whole or absent.

A file is written under a temporary name in its own folder and then renamed, so that a reader never sees half
of one. Two writes of the same product give the same bytes: nothing in them comes from the clock.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..errors import FrameFormatError, InputError
from ..files import all_or_nothing
from ..resources import open_user_fits, refuse_damage
from ._check import check_mapping, read_only
from .mask import mask_plane_cards, planes_from_header, remap_mask
from .sensor_section import SECTION_KEYWORDS, SensorSection

Scalar = bool | int | float | str | None

PRODUCT_KEY = "PRODUCT"
VERSION_KEY = "PRODVER"
PRODUCT_VERSION = 1
EXTENSIONS_KEY = "NEXTEND"

# Keywords that describe the bytes of the file rather than the product.
_STRUCTURAL = re.compile(
    r"SIMPLE|XTENSION|BITPIX|NAXIS\d*|EXTEND|PCOUNT|GCOUNT|GROUPS|BSCALE|BZERO|BLANK|TFIELDS|THEAP"
    r"|T(FORM|TYPE|UNIT|NULL|SCAL|ZERO|DIM|DISP)\d+|CHECKSUM|DATASUM|END|CONTINUE|COMMENT|HISTORY|LONGSTRN"
    r"|EXTNAME|EXTVER|EXTLEVEL|EXTTYPE|INHERIT|HIERARCH.*|Z(IMAGE|CMPTYPE|BITPIX|NAXIS\d*|TILE\d+)|MP_.*"
    rf"|{PRODUCT_KEY}|{VERSION_KEY}|{EXTENSIONS_KEY}|"
)
_KEYWORD = re.compile(r"[A-Z0-9_\-]+( [A-Z0-9_\-]+)*")
_LONGEST_KEYWORD = 50


def normalise_metadata(metadata: Mapping[str, Any] | None, own: Sequence[str] = ()) -> Mapping[str, Scalar]:
    """Freeze a mapping of header keywords, and make sure that a FITS header can hold it.

    Keywords are upper-cased; numpy scalars become Python ones; blanks at the end of a text are dropped, as
    FITS does.
    """
    result: dict[str, Scalar] = {}
    for key, value in check_mapping("metadata", {} if metadata is None else metadata).items():
        keyword = _normalise_keyword(key)
        if keyword in own:
            raise InputError("metadata keyword", key, "a keyword that the product does not write itself")
        result[keyword] = _normalise_value(keyword, value)
    return MappingProxyType(result)


def merge_metadata(
    first: Mapping[str, Any], second: Mapping[str, Any] | None, own: Sequence[str]
) -> Mapping[str, Scalar]:
    """Join two mappings, the second winning."""
    return MappingProxyType({**normalise_metadata(first, own), **normalise_metadata(second, own)})


def _normalise_keyword(key: object) -> str:
    keyword = key.strip().upper() if isinstance(key, str) else ""
    if not _KEYWORD.fullmatch(keyword) or len(keyword) > _LONGEST_KEYWORD:
        raise InputError(
            "metadata keyword", key, f"words of A-Z 0-9 _ -, at most {_LONGEST_KEYWORD} characters"
        )
    if _STRUCTURAL.fullmatch(keyword):
        raise InputError("metadata keyword", key, "a keyword that does not describe the file itself")
    return keyword


def _normalise_value(keyword: str, value: object) -> Scalar:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"metadata[{keyword}]", value, "a finite number (FITS has no other)")
    if isinstance(value, str):
        value = value.rstrip(" ")
    if value is not None and not isinstance(value, bool | int | float | str):
        raise InputError(f"metadata[{keyword}]", value, "text, a number, a truth value or None")
    if isinstance(value, int) and abs(value) >= 2**63:
        raise InputError(f"metadata[{keyword}]", value, "a whole number of at most 63 bits")
    try:
        returned = fits.Card.fromstring(_card(keyword, value).image).value
    except (ValueError, fits.VerifyError) as error:
        raise InputError(f"metadata[{keyword}]", value, f"what a FITS header can hold ({error})") from None
    returned = None if isinstance(returned, fits.card.Undefined) else returned
    if type(returned) is not type(value) or returned != value:
        raise InputError(f"metadata[{keyword}]", value, "what a FITS header can hold and give back")
    return value


def _card(keyword: str, value: Scalar, comment: str = "") -> fits.Card:
    """Header card whose value is read back exactly.

    astropy cuts a float at twenty characters; those that need more are written in FITS free format.
    """
    plain = len(keyword) <= 8 and " " not in keyword
    if isinstance(value, float):
        text = repr(value).upper()
        if len(text) > 20:
            head = f"{keyword:<8}= " if plain else f"HIERARCH {keyword} = "
            return fits.Card.fromstring(f"{head}{text}".ljust(80))
    return fits.Card(keyword if plain else f"HIERARCH {keyword}", value, comment)


def primary_hdu(
    product: str, own: Sequence[tuple[str, Scalar, str]], metadata: Mapping[str, Scalar]
) -> fits.PrimaryHDU:
    """Empty primary HDU: what the product is, its own scalars, then the metadata."""
    hdu = fits.PrimaryHDU()
    hdu.header.append(fits.Card(PRODUCT_KEY, product, "class of lsst.fringe_sim.products"))
    hdu.header.append(fits.Card(VERSION_KEY, PRODUCT_VERSION, "layout of that class"))
    for keyword, value, comment in own:
        hdu.header.append(_card(keyword, value, comment))
    for keyword, value in metadata.items():
        hdu.header.append(_card(keyword, value))
    return hdu


class _SteadyImage(fits.ImageHDU):
    """Image whose data do not change: the sum over them is made once, and without turning their bytes round.

    astropy makes it twice for the two checksums of an HDU, each time from a copy in the order of the file.
    """

    def _calculate_datasum(self) -> np.uint32:
        found: np.uint32 | None = getattr(self, "_sum_of_data", None)
        if found is None:
            found = _sum_of_words(self.data) if self._has_data else None
            self._sum_of_data = found = super()._calculate_datasum() if found is None else found
        return found


def _sum_of_words(data: NDArray[Any]) -> np.uint32 | None:
    """Ones-complement sum of numbers of four bytes in the order of the machine; `None` for all others.

    Such a sum of words in the order of the file is that of the numbers themselves.
    """
    if data.dtype.itemsize != 4 or data.dtype.kind not in "if" or not data.dtype.isnative:
        return None
    if not data.flags.c_contiguous:
        return None
    total = int(data.reshape(-1).view(np.uint32).sum(dtype=np.uint64))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return np.uint32(total)


def image_hdu(
    name: str, data: NDArray[Any], *, unit: str | None = None, cards: Sequence[tuple[str, Any, str]] = ()
) -> fits.ImageHDU:
    """Image extension; ``data`` is not copied and not changed."""
    # Astropy swaps the bytes of writeable arrays in place.
    hdu = _SteadyImage(read_only(data), name=name)
    if unit is not None:
        hdu.header["BUNIT"] = unit
    for card in cards:
        hdu.header.append(fits.Card(*card))
    return hdu


def mask_hdu(
    data: NDArray[Any], name: str = "MASK", *, cards: Sequence[tuple[str, Any, str]] = ()
) -> fits.ImageHDU:
    """Mask extension whose header names the planes."""
    return image_hdu(name, data, cards=[*cards, *mask_plane_cards()])


def bintable_hdu(name: str, columns: Sequence[tuple[str, NDArray[Any], str | None]]) -> fits.BinTableHDU:
    """Binary table of float64 columns: (name, values, unit)."""
    return fits.BinTableHDU.from_columns(
        [
            fits.Column(name=label, array=np.asarray(values, dtype=np.float64), format="D", unit=unit)
            for label, values, unit in columns
        ],
        name=name,
    )


def write_hdus(
    path: str | os.PathLike[str], hdus: Sequence[Any], section: SensorSection | None = None
) -> None:
    """Write HDUs to ``path``: checksummed, repeatable to the byte, and all or nothing.

    ``path``: file to write; an existing one is replaced when the new one is complete. ``section``: pixels of
    the sensor that the first image shows, and every other of its size: their world coordinates are added, and
    the section itself to the primary header.
    """
    target = existing_folder(path)
    hdus[0].header[EXTENSIONS_KEY] = (len(hdus) - 1, "number of extensions")
    if section is not None:
        _add_world_coordinates(hdus, section)
    write_summed(target, hdus, verify="exception")


def write_summed(
    target: Path, hdus: Sequence[Any], verify: str = "fix", *, finish: Callable[[Path], None] | None = None
) -> None:
    """Write HDUs with their checksums, in which nothing is of the clock; ``verify`` as of astropy.

    ``finish`` is called with the path of the file before it is where it belongs.
    """
    whole = fits.HDUList(list(hdus))
    whole.update_extend()
    for hdu in whole:
        hdu.verify(verify)
        hdu.add_datasum(when="data unit checksum")
        hdu.add_checksum(when="HDU checksum", override_datasum=True)
    with all_or_nothing(target) as temporary:
        with open(temporary, "wb") as stream:
            whole.writeto(stream, output_verify=verify)
        if finish is not None:
            finish(Path(temporary))


def existing_folder(path: str | os.PathLike[str]) -> Path:
    """Path of a file to be written."""
    target = Path(path)
    if not target.parent.is_dir():
        raise InputError("folder", str(target.parent), "an existing folder", source=str(target))
    return target


def _add_world_coordinates(hdus: Sequence[Any], section: SensorSection) -> None:
    hdus[0].header[SECTION_KEYWORDS[0]] = (section.keyword, "pixels of the sensor, from 1")
    images = [hdu for hdu in hdus[1:] if hdu.is_image and len(hdu.shape) >= 2]
    for hdu in images:
        if hdu.shape[-2:] == images[0].shape[-2:]:
            hdu.header.update(section.cards(hdu.shape))


@contextlib.contextmanager
def open_fits(
    path: str | os.PathLike[str], product: str, *, memmap: bool = False, verify: bool = True
) -> Iterator[fits.HDUList]:
    """Open a product for reading.

    ``product``: class the file must hold; a file that does not say what it is is accepted. ``verify``: compare
    the checksums, which reads the whole file.
    """
    source = str(path)
    if not Path(path).is_file():
        raise InputError("file", source, "an existing FITS file")
    with (
        refuse_damage("FITS file", "an undamaged FITS file", source),
        open_user_fits(path, warning="error", memmap=memmap, checksum=verify, lazy_load_hdus=False) as hdus,
    ):
        _check_product(hdus[0].header, product, source)
        _check_complete(hdus, source)
        yield hdus


def _check_product(header: fits.Header, product: str, source: str) -> None:
    found = header.get(PRODUCT_KEY, product)
    if found != product:
        raise FrameFormatError(PRODUCT_KEY, found, product, source=source)
    version = header.get(VERSION_KEY, PRODUCT_VERSION)
    if version != PRODUCT_VERSION:
        raise FrameFormatError(VERSION_KEY, version, str(PRODUCT_VERSION), source=source)


def _check_complete(hdus: fits.HDUList, source: str) -> None:
    """Refuse a file of ours that lost an extension, or a checksum and with it what would show damage."""
    header = hdus[0].header
    if PRODUCT_KEY not in header:
        return
    found = len(hdus) - 1
    if header.get(EXTENSIONS_KEY) != found:
        allowed = f"{header.get(EXTENSIONS_KEY)}, as {EXTENSIONS_KEY} says"
        raise FrameFormatError("number of extensions", found, allowed, source=source)
    for hdu in hdus:
        for keyword in ("CHECKSUM", "DATASUM"):
            if keyword not in hdu.header:
                raise FrameFormatError(f"{keyword} of {hdu.name}", "missing", "a checksum", source=source)


def read_metadata(header: fits.Header, own: Sequence[str]) -> dict[str, Scalar]:
    """Metadata of a primary header: everything but the structure and the product's ``own`` keywords."""
    return {
        keyword: header[keyword]
        for keyword in header
        if keyword not in own and not _STRUCTURAL.fullmatch(keyword)
    }


def read_keyword(header: fits.Header, keyword: str, *, source: str) -> Any:
    """Value of a keyword that must be there."""
    if keyword not in header:
        raise FrameFormatError(keyword, "missing", "a value in the header", source=source)
    return header[keyword]


def read_image(hdus: fits.HDUList, name: str, *, source: str, native: bool = True) -> NDArray[Any]:
    """Data of an image extension.

    ``native``: copy into memory in the byte order of the machine; otherwise leave it as it lies in the file.
    """
    if name not in hdus:
        raise FrameFormatError("extension", f"no {name}", f"an image extension named {name}", source=source)
    data = hdus[name].data
    if not isinstance(data, np.ndarray) or data.dtype.names is not None:
        raise FrameFormatError(name, "no image", "an image extension", source=source)
    return np.array(data, dtype=data.dtype.newbyteorder("=")) if native else data


def in_unit(
    field: str, values: NDArray[Any], found: object, unit: str | None, *, source: str
) -> NDArray[Any]:
    """Numbers of a file in the unit that is wanted; a file that states none has it."""
    if not unit or found is None or str(found).strip() in ("", unit):
        return values
    from astropy import units  # rarely needed

    try:
        factor = units.Unit(str(found).strip()).to(unit)
    except (ValueError, TypeError):
        raise FrameFormatError(
            f"unit of {field}", found, f"{unit}, or one that converts to it", source=source
        ) from None
    return values if factor == 1.0 else (values * np.float64(factor)).astype(values.dtype.newbyteorder("="))


def refuse_other_unit(field: str, found: object, unit: str, *, source: str) -> None:
    """Refuse a unit that is not the one wanted, however its power is written; a file may state none."""
    if re.sub(r"[*^() ]", "", str(found or "")) not in ("", re.sub(r"[*^() ]", "", unit)):
        raise FrameFormatError(f"unit of {field}", found, unit or "no unit", source=source)


def read_mask(hdus: fits.HDUList, name: str = "MASK", *, source: str, native: bool = True) -> NDArray[Any]:
    """Mask of an extension, its bits moved to the numbering of `MASK_PLANES`."""
    data = read_image(hdus, name, source=source, native=native)
    if data.dtype.kind not in "iu":
        raise FrameFormatError(name, f"dtype {data.dtype}", "integers", source=source)
    planes = planes_from_header(hdus[name].header, source=source)
    return remap_mask(data, planes, source=source)
