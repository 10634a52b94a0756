"""Checks shared by the products, each ending in one typed error."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FrameFormatError, InputError, OutOfRangeError, is_masked, to_number, without_unit
from .mask import ALL_BITS

_ROWS = 256  # Rows of an image that are looked at at a time


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """View of ``array`` that cannot be written through; the caller's own array keeps its flags."""
    view = array.view()
    view.flags.writeable = False
    return view


def as_float_array(
    field: str, values: ArrayLike, ndim: int, dtype: type[np.floating] = np.float32, unit: str = ""
) -> NDArray[Any]:
    """Read-only real array of ``ndim`` axes; one that has the type already, in any byte order, is shared."""
    try:
        array = np.asarray(without_unit(field, values, unit))
    except InputError:
        raise
    except (ValueError, TypeError):  # of sequences of quantities, too
        raise FrameFormatError(field, "ragged nested sequences", f"a real array of {ndim} axes") from None
    if array.dtype.kind not in "fiu":
        raise FrameFormatError(field, f"dtype {array.dtype}", "real numbers")
    if is_masked(values):
        raise FrameFormatError(field, "masked in part", "numbers; what is masked belongs into the mask")
    if array.ndim != ndim or array.size == 0:
        raise FrameFormatError(field, f"shape {array.shape}", f"{ndim} axes, none of them empty")
    if array.dtype.newbyteorder("=") != np.dtype(dtype):
        with np.errstate(over="ignore"):
            array = array.astype(dtype)
    return read_only(array)


def as_mask(
    field: str, values: ArrayLike, shape: tuple[int, ...], dtype: type[np.signedinteger] = np.int32
) -> NDArray[Any]:
    """Read-only mask of the given shape; one that has the type already, in any byte order, is shared."""
    array = np.asarray(without_unit(field, values))
    if array.dtype.kind not in "iub":
        raise FrameFormatError(field, f"dtype {array.dtype}", "integers, one bit for each mask plane")
    check_shape(field, array, shape)
    used = int(np.bitwise_or.reduce(array, axis=None))
    if used & ~ALL_BITS:
        raise FrameFormatError(field, f"bits {used & ~ALL_BITS:#x}", "the bits of MASK_PLANES")
    if array.dtype.newbyteorder("=") != np.dtype(dtype):
        array = array.astype(dtype)
    return read_only(array)


def check_shape(field: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Refuse an array of another shape."""
    if array.shape != shape:
        raise FrameFormatError(field, f"shape {array.shape}", f"shape {shape}, that of the image")


def check_good_pixels(
    field: str, values: NDArray[Any], mask: NDArray[Any] | None = None, *, nonnegative: bool = False
) -> None:
    """Refuse a pixel that the mask calls good and that holds no usable number.

    One leading plane (or some rows of an image) is looked at at a time, so a memory-mapped cube is never in memory
    as a whole.
    """
    rows = (slice(low, low + _ROWS) for low in range(0, len(values), _ROWS))
    planes: Iterable[int | slice] = range(len(values)) if values.ndim == 3 else rows
    bad = 0
    for plane in planes:
        part = values[plane]
        # Nearly always all is well, which the smallest and the largest number say; one that is none spoils both.
        if (part.min() >= 0 if nonnegative else part.min() > -np.inf) and part.max() < np.inf:
            continue
        wrong = ~(np.isfinite(part) & (part >= 0)) if nonnegative else ~np.isfinite(part)
        if mask is not None:
            wrong &= mask[plane] == 0
        bad += int(np.count_nonzero(wrong))
    if bad:
        kind = "negative or not finite" if nonnegative else "not finite"
        where = "are good in MASK" if mask is not None else "are part of the frame"
        raise FrameFormatError(field, f"{bad} pixels that are {kind} and {where}", "finite good pixels")


def check_number(
    field: str,
    value: object,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    open_low: bool = False,
    allow_inf: bool = False,
    unit: str = "",
) -> float:
    """Return ``value``, or a quantity in ``unit``, as a float inside ``[low, high]`` (or ``(low, high]``)."""
    value = without_unit(field, value, unit)
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(field, value, "a number")
    number = to_number(field, value)
    inside = (number > low if open_low else number >= low) and number <= high
    if not inside or (math.isinf(number) and not allow_inf):
        bracket = "(" if open_low else "["
        raise OutOfRangeError(field, number, f"a number in {bracket}{low:g}, {high:g}]")
    return number


def check_whole_number(field: str, value: object, *, low: int, high: int) -> int:
    """Return ``value`` as an integer inside ``[low, high]``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise InputError(field, value, "a whole number")
    if not low <= value <= high:
        raise OutOfRangeError(field, int(value), f"a whole number in [{low}, {high}]")
    return int(value)


def check_name(field: str, value: object, *, empty: bool = True) -> str:
    """Return ``value`` as a printable ASCII name without blanks at its ends."""
    if not isinstance(value, str) or not value.isascii() or not value.isprintable() or value != value.strip():
        raise InputError(field, value, "printable ASCII text without blanks at its ends")
    if not value and not empty:
        raise InputError(field, value, "a name")
    if len(value) > 60:
        raise InputError(field, value, "at most 60 characters")
    return value


def check_mapping(field: str, value: object) -> Mapping[str, Any]:
    """Return ``value`` if it is a mapping."""
    if not isinstance(value, Mapping):
        raise InputError(field, type(value).__name__, "a mapping of header keywords to values")
    return value
