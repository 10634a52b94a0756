"""Pixels and columns that are not like their neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from ..array_types import BoolArray, Float32Array, FloatArray
from .flat_prep_options import GAUSSIAN_MAD, FlatPrepOptions

Image = Float32Array
Mask = NDArray[np.int32]

_BAND_ROWS = 256  # Rows that are looked at at a time
WIDEST_GROUP = 10  # Most columns side by side that are looked for as one defect
BESIDE = 2  # Columns on either side to which a group is compared
NEARBY = 40  # Columns on either side, at least, that tell how much the fringes rise and fall

USUAL_PERCENT = 80.0
EXCEPTIONAL = 6.0
"""A defect rises by this times what so many per cent of the groups nearby rise by at most: eight standard deviations
of a random pattern, six times the amplitude of a sine."""


def isolated_defects(image: Image, variance: Image, good: BoolArray, options: FlatPrepOptions) -> BoolArray:
    """Pixels far above or below all but one of their eight neighbours: hot pixels, pairs of them, cosmic rays.

    How far is far: `FlatPrepOptions.defect_sigma` of the noise, `FlatPrepOptions.defect_fraction` of the signal,
    and the spread of the neighbours themselves. The last keeps the crests of narrow fringes, whose neighbours
    across the fringe lie lower still.
    """
    defect = np.zeros(image.shape, dtype=np.bool_)
    ny = len(image)
    for start in range(1, ny - 1, _BAND_ROWS):
        rows = slice(start, min(start + _BAND_ROWS, ny - 1))
        y, x = _candidates(image, variance, good, options.defect_sigma, rows)
        far = _is_far_from_cross(image, variance, good, options.defect_sigma, y, x)
        y, x = y[far], x[far]
        isolated = _is_isolated(image, variance, good, options, y, x)
        defect[y[isolated], x[isolated]] = True
    return defect


def _candidates(
    image: Image, variance: Image, good: BoolArray, sigma: float, rows: slice
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Good pixels beyond one of the two neighbours along x and along y, which is cheap to see and necessary.

    The outermost ring has too few neighbours.
    """
    value = image[rows, 1:-1]
    left, right = image[rows, :-2], image[rows, 2:]
    above, below = image[rows.start + 1 : rows.stop + 1, 1:-1], image[rows.start - 1 : rows.stop - 1, 1:-1]
    high = value - np.maximum(np.minimum(left, right), np.minimum(above, below))
    low = np.minimum(np.maximum(left, right), np.maximum(above, below)) - value
    beyond = np.maximum(high, low)
    y, x = np.nonzero((beyond**2 > 0.25 * sigma**2 * variance[rows, 1:-1]) & good[rows, 1:-1])
    return y + rows.start, x + 1


def _is_far_from_cross(
    image: Image, variance: Image, good: BoolArray, sigma: float, y: NDArray[np.intp], x: NDArray[np.intp]
) -> BoolArray:
    """Whether pixels are far enough from all but one of the good neighbours along x and y, which is necessary too."""
    beside = (y, x - 1), (y, x + 1), (y - 1, x), (y + 1, x)
    value = image[y, x].astype(np.float64)
    most, least = ([np.where(good[at], image[at], none) for at in beside] for none in (-np.inf, np.inf))
    # Of two pairs, the second highest of all is the lower of the highest ones, or the higher of the lowest ones.
    highest, lowest = (
        [np.maximum(each[k], each[k + 1]) for k in (0, 2)]
        + [np.minimum(each[k], each[k + 1]) for k in (0, 2)]
        for each in (most, least)
    )
    high2 = np.maximum(np.minimum(*highest[:2]), np.maximum(*highest[2:]))
    low2 = np.minimum(np.minimum(*lowest[:2]), np.maximum(*lowest[2:]))
    beyond = np.maximum(value - high2, low2 - value)
    # The noise of the neighbours is that of the pixel, less at most the root of how far it is from them.
    return beyond * (beyond + sigma**2) > sigma**2 * variance[y, x]


def _is_isolated(
    image: Image,
    variance: Image,
    good: BoolArray,
    options: FlatPrepOptions,
    y: NDArray[np.intp],
    x: NDArray[np.intp],
) -> BoolArray:
    dy, dx = np.delete(np.indices((3, 3)).reshape(2, -1) - 1, 4, axis=1)
    around = y[:, None] + dy, x[:, None] + dx
    near, known = image[around].astype(np.float64), good[around]
    low, low2 = np.partition(np.where(known, near, np.inf), 1)[:, :2].T
    high2, high = np.partition(np.where(known, near, -np.inf), -2)[:, -2:].T
    value = image[y, x].astype(np.float64)
    above, below = high2 < value, low2 > value
    reference = np.where(above, high2, low2)
    with np.errstate(invalid="ignore"):  # of pixels with fewer than two neighbours to judge by
        spread = np.where(above, high2 - low, high - low2)
        # The noise that the pixel would have if it were like its neighbours.
        noise = np.sqrt(variance[y, x] - np.maximum(value, 0.0) + np.maximum(reference, 0.0))
        excess = np.abs(value - reference)
        limit = np.maximum(options.defect_sigma * noise, options.defect_fraction * np.abs(reference))
        return (known.sum(axis=1) > 1) & (above | below) & (excess > np.maximum(limit, spread))


def column_means(image: Image, mask: Mask) -> tuple[FloatArray, BoolArray]:
    """Mean of the good pixels of each column, and whether there are enough of them to go by."""
    good = mask == 0
    count = good.sum(axis=0)
    total = np.where(good, image, np.float32(0.0)).sum(axis=0, dtype=np.float64)
    return total / np.maximum(count, 1), count >= max(4, image.shape[0] // 10)


def bad_columns(mean: FloatArray, known: BoolArray, options: FlatPrepOptions) -> NDArray[np.intp]:
    """Greedy search: the worst columns are replaced by what their neighbours predict, until none stands out."""
    index = np.flatnonzero(known)
    profile = mean[index].copy()
    if len(profile) < 12:
        return np.zeros(0, dtype=np.intp)
    residual = profile - _predicted(profile)[0]
    limit = max(
        options.column_sigma * GAUSSIAN_MAD * float(np.median(np.abs(residual))),
        options.column_fraction * float(np.median(profile)),
    )
    found: list[int] = []
    # Where an amplifier is left out, the fringes go on elsewhere.
    for run in np.split(np.arange(len(index)), np.flatnonzero(np.diff(index) > 1 + WIDEST_GROUP) + 1):
        part = profile[run]
        found.extend(index[run[_adjacent_bad_columns(part, limit)]].tolist())
        profile[run] = part
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


def _adjacent_bad_columns(profile: FloatArray, limit: float) -> NDArray[np.intp]:
    """Columns, alone or side by side, that rise from those beside them as little else does nearby.

    How much any so many columns rise from their neighbours is known from those nearby: fringes, however strong, do it
    everywhere. What is found is replaced in ``profile`` by what lies on either side, and no longer hides others.
    """
    widths = range(1, min(WIDEST_GROUP, len(profile) // 6) + 1)
    found: list[int] = []
    before = -1
    while widths and before < len(found) <= len(profile) // 4:
        before = len(found)
        least = [np.maximum(_usual_rise(_rise(profile, width)[0], width), limit) for width in widths]
        while (group := _worst_group(profile, widths, least)) is not None:
            first, last = group
            found.extend(range(first, last))
            left, right = profile[first - BESIDE : first].mean(), profile[last : last + BESIDE].mean()
            profile[first:last] = np.linspace(left, right, last - first + 2)[1:-1]
    return np.array(found, dtype=np.intp)


def _worst_group(profile: FloatArray, widths: range, least: list[FloatArray]) -> tuple[int, int] | None:
    """First column of the group that stands out most, and the one behind it."""
    worst, group = 1.0, None
    for width, low in zip(widths, least, strict=True):
        rise, step = _rise(profile, width)
        # At a step of the gain between amplifiers the two sides differ by more.
        score = np.where(np.abs(rise) > np.abs(step), np.abs(rise) / low, 0.0)
        at = int(np.argmax(score))
        if score[at] > worst:
            worst, group = float(score[at]), (at + BESIDE, at + BESIDE + width)
    return group


def _rise(profile: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Mean of every ``width`` columns over that of the `BESIDE` ones on either side, and by how much these differ."""
    total = np.concatenate([[0.0], np.cumsum(profile)])
    first = np.arange(BESIDE, len(profile) - width - BESIDE + 1)
    inner = (total[first + width] - total[first]) / width
    left = (total[first] - total[first - BESIDE]) / BESIDE
    right = (total[first + width + BESIDE] - total[first + width]) / BESIDE
    return inner - 0.5 * (left + right), right - left


def _usual_rise(rise: FloatArray, width: int) -> FloatArray:
    """What a group must exceed by the fringes around it, of which a few defects are a small part."""
    size = min(2 * (NEARBY + 8 * width) + 1, len(rise))
    usual: FloatArray = percentile_filter(np.abs(rise), USUAL_PERCENT, size, mode="reflect")
    return EXCEPTIONAL * usual


def _predicted(profile: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cubic prediction of every value from two on either side, and the range of these four."""
    p = np.pad(profile, 2, mode="edge")
    beside = np.stack([p[:-4], p[1:-3], p[3:-1], p[4:]])
    return (4.0 * (beside[1] + beside[2]) - (beside[0] + beside[3])) / 6.0, np.ptp(beside, axis=0)
