"""Noise of the cells, measured in the data themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, FloatArray
from ..flat_prep_options import GAUSSIAN_MAD

LEAST_TRIPLES = 60
"""Fewest second differences from which a noise level is taken; with fewer, the stated variance is believed."""

STATED_UNCERTAINTY = 0.2  # Relative uncertainty of a stated noise level that cannot be checked


def scatter_of_pixels(image: NDArray[np.floating], good: BoolArray) -> float:
    """Standard deviation of what neighbouring pixels do not share, from the median of their second differences.

    ``image``, ``good`` (ny, nx). Infinite where too few pixels tell.
    """
    if min(image.shape) < 3:
        return float("inf")
    use = _all_of_nine(good[np.newaxis])
    if use.sum() < LEAST_TRIPLES:
        return float("inf")
    known = np.where(good, image, 0.0).astype(float)
    return GAUSSIAN_MAD * float(np.median(np.abs(_second_difference(known[np.newaxis])[use])))


def _second_difference(image: FloatArray) -> FloatArray:
    """Second difference along both axes with unit noise gain, ``(W, ny-2, nx-2)``."""
    rows = image[:, :-2] - 2.0 * image[:, 1:-1] + image[:, 2:]
    both: FloatArray = (rows[:, :, :-2] - 2.0 * rows[:, :, 1:-1] + rows[:, :, 2:]) / 6.0
    return both


def _all_of_nine(good: BoolArray) -> BoolArray:
    rows = good[:, :-2] & good[:, 1:-1] & good[:, 2:]
    both: BoolArray = rows[:, :, :-2] & rows[:, :, 1:-1] & rows[:, :, 2:]
    return both
