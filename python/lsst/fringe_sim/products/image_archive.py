"""Files of the package ``lsst.images``: what their tree says of an exposure, and the addresses that a new file needs.

Pixels, mask and variance are images like those of other files. Sensor, filter and date stand in a tree of JSON, in a
table at the end, which the primary header points at.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.time import Time
from numpy.typing import NDArray

from ..errors import FrameFormatError, MissingPackageError

IMAGE = "IMAGE"

_TREE, _INDEX = "JSON", "INDEX"

_PLANES = {"SATURATED": "SAT", "INTERPOLATED": "INTRP", "COSMIC_RAY": "CR", "DETECTION_EDGE": "EDGE"}
"""Planes that afw names otherwise."""


def is_archive(hdus: fits.HDUList) -> bool:
    """Whether ``lsst.images`` wrote a file."""
    return "DATAMODL" in hdus[0].header and _TREE in hdus


def archive_cards(hdus: fits.HDUList) -> dict[str, Any]:
    """Sensor, filter and date of the observation, by the keywords of other files."""
    tree = _tree(hdus)
    seen = tree.get("obs_info") or {}
    sensor = (tree.get("detector") or {}).get("attributes", {}).get("name")
    found = {
        "DETNAME": sensor or seen.get("detector_unique_name"),
        "FILTER": seen.get("physical_filter"),
        "DATE-OBS": None,
    }
    begin = seen.get("datetime_begin")  # Julian date in two parts, TAI
    if begin:
        found["DATE-OBS"] = Time(begin[0], begin[1], format="jd", scale="tai").isot
    return {keyword: value for keyword, value in found.items() if value}


def origin_of(hdus: fits.HDUList) -> tuple[int, int]:
    """Row and column of the sensor at which an image begins."""
    row, column = _tree(hdus)["image"]["yx0"]
    return int(row), int(column)


def archive_planes(hdus: fits.HDUList) -> list[tuple[NDArray[Any], dict[str, int]]]:
    """Images of the mask, and the bits of the planes in each by the names that afw uses."""
    found = []
    for hdu in hdus:
        if hdu.name == "MASK" and hdu.is_image:
            numbers = [key[4:] for key in hdu.header if re.fullmatch(r"MSKN\d+", key)]
            names = {number: str(hdu.header[f"MSKN{number}"]) for number in numbers}
            bits = {
                _PLANES.get(name, name): _bit(hdu.header, f"MSKM{number}") for number, name in names.items()
            }
            found.append((np.asarray(hdu.data), bits))
    return found


def _bit(header: fits.Header, keyword: str) -> int:
    """Number of the bit of a plane."""
    value = int(header[keyword])
    if value <= 0 or value & (value - 1):
        raise FrameFormatError(keyword, value, "a power of 2")
    return value.bit_length() - 1


def archived_background(path: Path, origin: tuple[int, int] | None, shape: tuple[int, ...]) -> NDArray[Any]:
    """What was subtracted from an exposure of ``lsst.images``, drawn by that package.

    ``path``: the exposure, a map of backgrounds, or one background; ``origin``: row and column of the sensor at
    which the image begins; `None` for those at which the background does; ``shape``: shape of the image. Raises
    `MissingPackageError`: ``lsst.images`` is not installed. Raises `FrameFormatError`: nothing was subtracted, or
    the background does not cover the image.
    """
    try:
        from lsst.images import Box
        from lsst.images.serialization import open_archive
    except ImportError:
        raise MissingPackageError("a background of lsst.images", "lsst.images", "lsst-images") from None
    with open_archive(str(path)) as reader:
        # Of an exposure the backgrounds alone.
        whole = hasattr(reader.get_tree(), "backgrounds")
        found = reader.get_component("backgrounds") if whole else reader.read()
    if hasattr(found, "subtracted"):
        if found.subtracted is None:
            raise FrameFormatError("subtracted background", "none", "one", source=str(path))
        found = found.subtracted.field
    covered = found.bounds.bbox
    begin = origin or (covered.y.start, covered.x.start)
    box = Box.factory[begin[0] : begin[0] + shape[0], begin[1] : begin[1] + shape[1]]
    if not covered.contains(box):
        raise FrameFormatError("background", str(covered), f"{box} and more, the image", source=str(path))
    drawn: NDArray[Any] = found.render(box, dtype=np.float64).array
    return drawn


def address_again(path: Path, *, added: bool) -> None:
    """State in a file that was written anew where its parts are.

    ``added``: the background is in the image again, and the tree says that none was subtracted.
    """
    with fits.open(path, disable_image_compression=True, memmap=False) as hdus:
        places = {(hdu.name, hdu.ver): (hdu.fileinfo(), hdu.header) for hdu in hdus}
        header = hdus[0].header.copy()
        for keyword, name in (("INDX", _INDEX), ("JSON", _TREE)):
            place = places[name, 1][0]
            header[f"{keyword}ADDR"] = place["hdrLoc"]
            header[f"{keyword}SIZE"] = place["datLoc"] - place["hdrLoc"] + place["datSpan"]
        index = fits.BinTableHDU(hdus[_INDEX].data.copy(), hdus[_INDEX].header)
    for row in index.data:
        place, own = places[str(row["EXTNAME"]).upper() or "PRIMARY", int(row["EXTVER"])]
        row["HDRADDR"], row["DATADDR"], row["DATSIZE"] = place["hdrLoc"], place["datLoc"], place["datSpan"]
        row["XTENSION"], row["ZIMAGE"] = own.get("XTENSION", "IMAGE"), own.get("ZIMAGE", False)
    with open(path, "r+b") as stream:
        _put(stream, 0, fits.PrimaryHDU(header=header))
        _put(stream, header["INDXADDR"], index)
        if added:
            stream.seek(header["JSONADDR"])
            table = _none_subtracted(stream.read(header["JSONSIZE"]))
            _put(stream, header["JSONADDR"], fits.BinTableHDU.fromstring(table))


def _put(stream: Any, address: int, hdu: Any) -> None:
    """Write an HDU over one of the same size."""
    made = io.BytesIO()
    hdu.writeto(made)
    with fits.open(io.BytesIO(made.getvalue())) as hdus:  # astropy puts an empty HDU before a table
        start, middle = (hdus[-1].fileinfo()[key] for key in ("hdrLoc", "datLoc"))
    whole = made.getvalue()
    # As it is on the disk: the checksum of a table in memory is that of other bytes.
    stored = type(hdu).fromstring(whole[start:])
    stored.add_datasum(when="data unit checksum")
    stored.add_checksum(when="HDU checksum", override_datasum=True)
    stream.seek(address)
    stream.write(stored.header.tostring().encode() + whole[middle:])


def _none_subtracted(table: bytes) -> bytes:
    """The table of the tree with blanks for the name of the background that was subtracted."""
    return re.sub(rb',"subtracted":"[^"]*"', lambda found: b" " * len(found[0]), table)


def _tree(hdus: fits.HDUList) -> Mapping[str, Any]:
    made: Mapping[str, Any] = json.loads(np.asarray(hdus[_TREE].data[0][_TREE]).tobytes())
    return made
