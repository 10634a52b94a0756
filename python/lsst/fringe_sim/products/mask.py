"""Mask planes: names, bits, and their place in a FITS header.

A mask is an int32 image in which each bit is one named plane; 0 is a good pixel. The bit numbers are those of
afw, so that a frame written here and read there means the same; the planes that only this package knows lie
above them. In a file the planes are named by ``HIERARCH MP_<plane>`` keywords and are matched by name: bits
are moved to their place here on reading.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FrameFormatError, UnknownNameError

MASK_PLANES: Mapping[str, int] = MappingProxyType(
    {
        "BAD": 0,
        "SAT": 1,
        "INTRP": 2,
        "CR": 3,
        "EDGE": 4,
        "DETECTED": 5,
        "DETECTED_NEGATIVE": 6,
        "SUSPECT": 7,
        "NO_DATA": 8,
        "SLIP": 9,
        "LOW_SIGNAL": 10,
    }
)
"""Bit of each plane. SLIP: the fringe order may be wrong. LOW_SIGNAL: too few wavelengths or photons."""

_PREFIX = "MP_"


def mask_bits(*names: str) -> int:
    """Bit pattern of the named planes.

    Parameters
    ----------
    *names : `str`
        Plane names, as in `MASK_PLANES`.

    Returns
    -------
    bits : `int`
        Sum of ``2**MASK_PLANES[name]`` over the different names.

    Raises
    ------
    UnknownNameError
        There is no such plane.
    """
    bits = 0
    for name in names:
        if name not in MASK_PLANES:
            raise UnknownNameError("mask plane", name, MASK_PLANES)
        bits |= 1 << MASK_PLANES[name]
    return bits


ALL_BITS = mask_bits(*MASK_PLANES)


def describe_mask(mask: ArrayLike) -> dict[str, int]:
    """Number of pixels in which each plane is set, for the planes that are set at all."""
    values = np.asarray(mask)
    counts = {name: int(np.count_nonzero(values & (1 << bit))) for name, bit in MASK_PLANES.items()}
    return {name: count for name, count in counts.items() if count}


def mask_plane_cards() -> list[tuple[str, int, str]]:
    """Header cards (keyword, bit, comment) that name every plane, as afw writes them."""
    return [(f"HIERARCH {_PREFIX}{name}", bit, "mask plane bit") for name, bit in MASK_PLANES.items()]


def planes_from_header(header: Mapping[str, object], *, source: str | None = None) -> dict[str, int]:
    """Read the ``MP_<plane>`` keywords of a mask HDU.

    Returns the bit number in the file of each plane; empty if the header names none.
    """
    planes: dict[str, int] = {}
    for keyword in header:
        if not str(keyword).startswith(_PREFIX):
            continue
        name, bit = str(keyword)[len(_PREFIX) :], header[keyword]
        if name not in MASK_PLANES:
            raise UnknownNameError("mask plane", name, MASK_PLANES, source=source)
        if not isinstance(bit, int) or isinstance(bit, bool) or not 0 <= bit <= 30:
            raise FrameFormatError(str(keyword), bit, "a bit number from 0 to 30", source=source)
        if bit in planes.values():
            raise FrameFormatError(str(keyword), bit, "one bit for each plane", source=source)
        planes[name] = bit
    return planes


def remap_mask(mask: NDArray[Any], planes: Mapping[str, int], *, source: str | None = None) -> NDArray[Any]:
    """Move bits from a file's numbering to that of `MASK_PLANES`.

    ``planes``: bit of each plane in that file (`planes_from_header`). Empty: the numbering is the one used
    here. Returns the mask itself if no set bit has to move, else an int32 one.
    """
    bits_in_file = dict(planes) or dict(MASK_PLANES)
    used = int(np.bitwise_or.reduce(mask, axis=None)) if mask.size else 0
    stray = used & ~_sum_of_bits(bits_in_file.values())
    if stray:
        raise FrameFormatError(
            "MASK", f"bits {stray:#x}", "bits named by an MP_<plane> keyword", source=source
        )
    moved = {name: bit for name, bit in bits_in_file.items() if bit != MASK_PLANES[name]}
    if not any(used & (1 << bit) for bit in moved.values()):
        return mask
    result = np.zeros(mask.shape, dtype=np.int32)
    for name, bit in bits_in_file.items():
        result |= (((mask >> bit) & 1) << MASK_PLANES[name]).astype(np.int32)
    return result


def _sum_of_bits(bits: Iterable[int]) -> int:
    total = 0
    for bit in bits:
        total |= 1 << bit
    return total
