"""How strong the fringes of a frame are: the three numbers that are all called "amplitude"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

__all__ = ["FringeAmplitudes", "fringe_amplitudes"]

_PERCENTILES = (1.0, 99.0)

_BLOCK = 16_384  # Values that are summed at a time


@dataclass(frozen=True)
class FringeAmplitudes:
    """The three numbers that are all called "amplitude", as fractions of the mean.

    Attributes
    ----------
    rms, half_peak_to_peak, half_range_1_99 : `float`
        Standard deviation, half of maximum minus minimum, half of the 99th minus the 1st percentile.
    mean : `float`
        What they are fractions of, in the unit of the frame.
    """

    rms: float
    half_peak_to_peak: float
    half_range_1_99: float
    mean: float


def fringe_amplitudes(image: ArrayLike, mask: ArrayLike | None = None) -> FringeAmplitudes:
    """Amplitudes of a frame relative to its mean.

    Parameters
    ----------
    image : array_like
        Sky in any positive unit.
    mask : array_like, optional
        Non-zero where a pixel is not to be used.

    Raises
    ------
    InputError
        No pixel is left, or their mean is not positive.
    """
    values = np.asarray(image)
    if values.dtype not in (np.float32, np.float64):
        values = values.astype(np.float64)
    good = np.isfinite(values)
    if mask is not None:
        good &= np.asarray(mask) == 0
    # Choosing costs more than all that follows.
    chosen = values.flatten() if good.all() else values[good]
    mean = float(chosen.mean(dtype=np.float64)) if chosen.size else 0.0
    if not mean > 0.0:
        raise InputError("image", mean if chosen.size else "no good pixels", "a positive mean")
    rms = float(np.sqrt(_squares(chosen, mean) / chosen.size))
    places = [percent / 100.0 * (chosen.size - 1) for percent in _PERCENTILES]
    ranks = sorted({rank for place in places for rank in _between(place, chosen.size)})
    chosen.partition([0, *ranks, chosen.size - 1])
    low, high = (_at(chosen, place) for place in places)
    return FringeAmplitudes(
        rms / mean, 0.5 * (float(chosen[-1]) - float(chosen[0])) / mean, 0.5 * (high - low) / mean, mean
    )


def _between(place: float, size: int) -> tuple[int, int]:
    """Ranks on both sides of a place among sorted values."""
    lower = int(place)
    return lower, min(lower + 1, size - 1)


def _at(partitioned: NDArray[Any], place: float) -> float:
    """Value at a place between two ranks, as of `numpy.percentile`."""
    lower, upper = (float(partitioned[rank]) for rank in _between(place, partitioned.size))
    return lower + (place - int(place)) * (upper - lower)


def _squares(values: NDArray[Any], mean: float) -> float:
    """Sum of squared departures, in blocks that stay in the cache."""
    total = 0.0
    for start in range(0, values.size, _BLOCK):
        departure = np.subtract(values[start : start + _BLOCK], mean, dtype=np.float64)
        total += float(departure @ departure)
    return total
