"""The gate for FITS files from outside: a header that would hang their reader is refused before it is asked."""

from __future__ import annotations

import bz2
import gzip
import lzma
import math
import os
import re
import zipfile
from contextlib import suppress
from typing import IO

from .errors import FrameFormatError

_EXPANSION, _SMALL = 100, 1 << 30
"""A file may stand for so many bytes, and beyond them for so many times what it takes on the disk. No frame of
a detector is compressed more than tenfold."""


_CARD, _CHUNK = 80, 1 << 22


_BLOCK, _LONGEST_HEADER, _MOST_BYTES = 2880, 1 << 20, 1 << 40


_HEADER_END = re.compile(rb"END {77}(?: {80})*$")


_SIZE_KEYWORD = re.compile(rb"BITPIX|NAXIS\d*|[PG]COUNT|GROUPS")


_PLAIN_NUMBER = re.compile(rb"\w+ *= +([-+]?\d{1,18}) *(?:/.*)?", re.DOTALL)


_COUNTS = (b"NAXIS", b"TFIELDS", b"PCOUNT", b"GCOUNT")


_PIXEL_BYTES = 4


_COMPRESSED_AXIS = re.compile(rb"ZNAXIS(\d[\d ])= +(\d{1,30}) ")


_ENDLESS = re.compile(
    rb"(?:NAXIS  |TFIELDS) = *[-+]?0*[1-9]\d{3}|(?:NAXIS[1-9 ][\d ]{2}|TFIELDS |[PG]COUNT  )= *-"
)


def _zipped(stream: IO[bytes]) -> IO[bytes]:
    archive = zipfile.ZipFile(stream)
    return archive.open(archive.namelist()[0])


_COMPRESSED = {b"\x1f\x8b": gzip.open, b"BZ": bz2.open, b"\xfd7": lzma.open, b"PK": _zipped}


_LZW = b"\x1f\x9d"


def check_axes(stream: IO[bytes], source: str) -> None:
    """Refuse a FITS file over which astropy would be busy for hours, or for ever, or need more memory than there is.

    It asks a header for each of the axes and columns that it claims; the format has at most 999. And behind data of a
    negative size it looks for the next header further in front, again and again. A file of a few megabytes,
    compressed or with holes, may stand for any number of bytes.

    ``stream``: the file, compressed or not. It is read, and stands at its beginning afterwards; ``source``: its
    name. Raises `FrameFormatError`: there is such a header, or the file stands for far more than it is. Raises
    `OSError, EOFError`: the file cannot be read, or cannot be decompressed.
    """
    most = _most_bytes(stream, source)
    stream.seek(0)
    beginning = stream.read(2)
    if beginning == _LZW:
        raise FrameFormatError(
            "compression", "that of compress (.Z)", "gzip, bzip2, xz or zip", source=source
        )
    opener = _COMPRESSED.get(beginning)
    stream.seek(0)
    content: IO[bytes] = opener(stream) if opener else stream  # type: ignore[operator]
    rest = _after_plain_units(content, most, source)
    # Cards begin at multiples of their length, and so do pieces of the file.
    while piece := content.read(_CHUNK):
        _refuse_expansion(content.tell(), most, source)
        piece = rest + piece
        _refuse_endless(piece, source)
        _refuse_compressed(piece, most, source)
        rest = piece[len(piece) // _CARD * _CARD - _CARD :] if len(piece) >= _CARD else piece
    stream.seek(0)


def _after_plain_units(content: IO[bytes], most: int, source: str) -> bytes:
    """Pass over headers and data of a file as long as they are what the standard asks for.

    Returns the first header whose data may be anywhere, where astropy may look for the next one in what seems
    to be data: from there on all has to be looked at. Nothing at the end of the file.
    """
    while True:
        header = b""
        while not _HEADER_END.search(header[-_BLOCK:]):
            block = content.read(_BLOCK)
            header += block
            if len(block) < _BLOCK or len(header) > _LONGEST_HEADER:
                _refuse_endless(header, source)
                _refuse_compressed(header, most, source)
                return header
        _refuse_endless(header, source)
        _refuse_compressed(header, most, source)
        size = _data_size(header)
        if size is None:
            return header
        _refuse_expansion(content.tell() + size, most, source)
        content.seek(size, os.SEEK_CUR)


def _data_size(header: bytes) -> int | None:
    """Bytes between a header and the next one; nothing where that is open to interpretation."""
    if not header.startswith((b"SIMPLE  =                    T", b"XTENSION= ")):
        return None
    values: dict[bytes, int] = {}
    for place in range(0, len(header), _CARD):
        card = header[place : place + _CARD]
        keyword = card[:8].strip().upper()
        if not _SIZE_KEYWORD.fullmatch(keyword):
            continue
        number = _PLAIN_NUMBER.fullmatch(card)
        if number is None or keyword in values:
            return None
        values[keyword] = int(number[1])
    axes = [values.get(b"NAXIS%d" % (axis + 1), -1) for axis in range(values.get(b"NAXIS", -1))]
    if b"BITPIX" not in values or b"NAXIS" not in values or min(axes, default=0) < 0:
        return None
    bits = abs(values[b"BITPIX"]) * values.get(b"GCOUNT", 1)
    size = bits // 8 * (values.get(b"PCOUNT", 0) + (math.prod(axes) if axes else 0))
    return size + -size % _BLOCK if 0 <= size < _MOST_BYTES else None


def _refuse_compressed(header: bytes, most: int, source: str) -> None:
    """Refuse tile-compressed images that claim to be far larger than the file; astropy makes room for them first."""
    pixels = 0
    for match in _COMPRESSED_AXIS.finditer(header):
        if match.start() % _CARD == 0:
            pixels = (pixels if match[1].strip() not in (b"", b"1") else 1) * int(match[2])
            _refuse_expansion(pixels * _PIXEL_BYTES, most, source)


def _refuse_endless(piece: bytes, source: str) -> None:
    for keyword in _COUNTS:
        place = piece.find(keyword)
        while place >= 0:
            if place % _CARD == 0 and _ENDLESS.match(piece, place):
                claimed = " ".join(piece[place : place + 30].decode("ascii", "replace").split())
                allowed = "at most 999 axes or columns, and no negative size"
                raise FrameFormatError("header", claimed, allowed, source=source)
            place = piece.find(keyword, place + len(keyword))


def _most_bytes(stream: IO[bytes], source: str) -> int:
    """Bytes for which a file may stand by what it takes on the disk; one with holes is refused at once."""
    size = stored = stream.seek(0, os.SEEK_END)
    with suppress(OSError):  # it may be in memory
        # Some file systems do not tell their blocks.
        stored = 512 * os.fstat(stream.fileno()).st_blocks or size
    most = max(_SMALL, _EXPANSION * stored)
    _refuse_expansion(size, most, source)
    return most


def _refuse_expansion(size: int, most: int, source: str) -> None:
    if size > most:
        allowed = f"up to {most}, by what the file takes on the disk"
        raise FrameFormatError("bytes in the file", f"{size} or more", allowed, source=source)
