"""Square blocks of pixels: their sums, and their means. What fills no block at the far edges is left out."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .array_types import FloatArray


def in_blocks(images: NDArray[Any], side: int) -> NDArray[Any]:
    """View of the last two axes as blocks of so many pixels along a side, ``(…, rows, side, columns, side)``."""
    rows, columns = (size // side for size in images.shape[-2:])
    cut = images[..., : rows * side, : columns * side]
    return cut.reshape(*images.shape[:-2], rows, side, columns, side)


def block_sums(images: NDArray[Any], side: int) -> NDArray[Any]:
    """Sums over blocks."""
    return images if side == 1 else np.asarray(in_blocks(images, side).sum(axis=(-3, -1)))


def block_means(images: NDArray[Any], side: int) -> NDArray[Any]:
    """Means over blocks; NaN where any pixel of a block is NaN."""
    return images if side == 1 else np.asarray(in_blocks(images, side).mean(axis=(-3, -1)))


def means_of_known(values: FloatArray, side: int) -> FloatArray:
    """Mean over the pixels of each block of one image that are numbers; NaN where none is."""
    if side == 1:
        return values
    ny, nx = (size // side * side for size in values.shape)
    values = values[:ny, :nx]
    known = np.isfinite(values)

    def summed(plane: NDArray[Any]) -> NDArray[Any]:  # a few long sums take less time than many short ones
        rows = functools.reduce(np.add, (plane[k::side] for k in range(side)))
        columns: NDArray[Any] = functools.reduce(np.add, (rows[:, k::side] for k in range(side)))
        return columns

    total, count = summed(np.where(known, values, 0.0)), summed(known.astype(np.int32))
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
