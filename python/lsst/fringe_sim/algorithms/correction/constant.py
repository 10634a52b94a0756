"""Parts of a frame without any noise, as of a dead amplifier: they are no data."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray

BLOCK_PX = 16
"""Side of the blocks that are looked at: half of the smallest amplifier of a sensor that is cut down to 64 px."""

LEAST_PROBABILITY = 1e-3
"""Probability that any block of a frame is constant by chance, below which a constant block has no noise."""


def without_constant_blocks(image: NDArray[np.generic], good: BoolArray) -> BoolArray:
    """Good pixels that have noise.

    ``image``: the frame, ``(ny, nx)``; ``good``: pixels that may be used, ``(ny, nx)``. Rounded pixels may be equal
    to their neighbours by chance. How often is told by the blocks that are not constant; a frame without any such
    block has no noise that could be missed.
    """
    ny, nx = (size // BLOCK_PX for size in image.shape)
    whole = image[: ny * BLOCK_PX, : nx * BLOCK_PX].reshape(ny, BLOCK_PX, nx, BLOCK_PX)
    first = whole[:, 0, :, 0]
    constant = (whole == first[:, None, :, None]).all(axis=(1, 3))
    if not constant.any() or constant.all():
        return good
    lively = whole.swapaxes(1, 2)[~constant]
    equal = float(np.mean(lively[:, :, 1:] == lively[:, :, :-1]))
    by_chance = (BLOCK_PX**2 - 1) * math.log(equal) if equal > 0.0 else -math.inf
    if by_chance + math.log(constant.size) > math.log(LEAST_PROBABILITY):
        return good
    # The edges of a dead part lie within the blocks around.
    dead = np.zeros(image.shape, dtype=bool)
    for row, column in np.argwhere(constant):
        around = tuple(slice(max(at - 1, 0) * BLOCK_PX, (at + 2) * BLOCK_PX) for at in (row, column))
        dead[around] |= image[around] == first[row, column]
    return good & ~dead
