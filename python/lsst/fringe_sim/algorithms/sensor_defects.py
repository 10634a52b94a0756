"""Pixels and columns that are not like their neighbours."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from .flat_prep_options import GAUSSIAN_MAD, FlatPrepOptions

__all__ = ["bad_columns", "column_means", "isolated_defects"]

Image = NDArray[np.float32]
Mask = NDArray[np.int32]


def isolated_defects(
    image: Image, variance: Image, good: NDArray[np.bool_], options: FlatPrepOptions
) -> NDArray[np.bool_]:
    """Pixels far above or below all but one of their eight neighbours: hot pixels, pairs of them, cosmic rays.

    How far is far: `FlatPrepOptions.defect_sigma` of the noise, `FlatPrepOptions.defect_fraction` of the signal,
    and the spread of the neighbours themselves. The last keeps the crests of narrow fringes, whose neighbours
    across the fringe lie lower still.
    """
    defect = np.zeros(image.shape, dtype=np.bool_)
    _find_isolated(image, variance, good, options.defect_sigma, options.defect_fraction, defect)
    return defect


@numba.njit(cache=True, parallel=True)
def _find_isolated(
    image: Image,
    variance: Image,
    good: NDArray[np.bool_],
    sigma: float,
    fraction: float,
    defect: NDArray[np.bool_],
) -> None:  # pragma: no cover - compiled
    ny, nx = image.shape
    for line in numba.prange(ny - 2):
        # The parallel index is unsigned; the outermost ring has too few neighbours.
        y = int(np.int64(line)) + 1
        for x in range(1, nx - 1):
            # A cheap necessary condition first: beyond one of the two neighbours along x and along y.
            value = image[y, x]
            left, right = image[y, x - 1], image[y, x + 1]
            above, below = image[y + 1, x], image[y - 1, x]
            high = value - max(min(left, right), min(above, below))
            low = min(max(left, right), max(above, below)) - value
            beyond = max(high, low)
            if beyond * beyond > 0.25 * sigma * sigma * variance[y, x] and good[y, x]:
                defect[y, x] = _is_isolated(image, variance, good, sigma, fraction, y, x)


@numba.njit(cache=True)
def _is_isolated(
    image: Image,
    variance: Image,
    good: NDArray[np.bool_],
    sigma: float,
    fraction: float,
    y: int,
    x: int,
) -> bool:  # pragma: no cover - compiled
    value = image[y, x]
    high = high2 = -np.inf
    low = low2 = np.inf
    for yy in range(y - 1, y + 2):
        for xx in range(x - 1, x + 2):
            if (yy == y and xx == x) or not good[yy, xx]:
                continue
            near = image[yy, xx]
            if near > high:
                high, high2 = near, high
            elif near > high2:
                high2 = near
            if near < low:
                low, low2 = near, low
            elif near < low2:
                low2 = near
    if not low2 < np.inf:
        return False  # fewer than two neighbours to judge by
    if high2 < value:
        excess, reference, spread = value - high2, high2, high2 - low
    elif low2 > value:
        excess, reference, spread = low2 - value, low2, high - low2
    else:
        return False
    # The noise that the pixel would have if it were like its neighbours.
    noise = math.sqrt(variance[y, x] - max(value, 0.0) + max(reference, 0.0))
    return excess > max(sigma * noise, fraction * abs(reference), spread)


def column_means(image: Image, mask: Mask) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Mean of the good pixels of each column, and whether there are enough of them to go by."""
    good = mask == 0
    count = good.sum(axis=0)
    total = np.where(good, image, np.float32(0.0)).sum(axis=0, dtype=np.float64)
    return total / np.maximum(count, 1), count >= max(4, image.shape[0] // 10)


def bad_columns(
    mean: NDArray[np.float64], known: NDArray[np.bool_], options: FlatPrepOptions
) -> NDArray[np.intp]:
    """Greedy search: the worst column is replaced by what its neighbours predict, until none stands out."""
    index = np.flatnonzero(known)
    profile = mean[index].copy()
    if len(profile) < 12:
        return np.zeros(0, dtype=np.intp)
    found: list[int] = []
    residual = profile - _predicted(profile)[0]
    limit = max(
        options.column_sigma * GAUSSIAN_MAD * float(np.median(np.abs(residual))),
        options.column_fraction * float(np.median(profile)),
    )
    for _ in range(len(profile) // 4):
        prediction, spread = _predicted(profile)
        residual = profile - prediction
        # As with single pixels, a defect stands out from the spread of its neighbours; a fringe does not.
        excess = np.where(np.abs(residual) > spread, np.abs(residual), 0.0)
        excess[:2] = excess[-2:] = 0.0  # no neighbours on one side
        worst = int(np.argmax(excess))
        if not excess[worst] > limit:
            break
        found.append(int(index[worst]))
        profile[worst] = prediction[worst]
    return np.unique(np.array(found, dtype=np.intp))


def _predicted(profile: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cubic prediction of every value from two on either side, and the range of these four."""
    p = np.pad(profile, 2, mode="edge")
    beside = np.stack([p[:-4], p[1:-3], p[3:-1], p[4:]])
    return (4.0 * (beside[1] + beside[2]) - (beside[0] + beside[3])) / 6.0, np.ptp(beside, axis=0)
