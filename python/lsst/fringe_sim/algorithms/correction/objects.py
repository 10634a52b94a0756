"""Objects in a frame, found where background and fringes are subtracted, so that no fringe is taken for one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from .background import BackgroundTerms
from .scales import ScaleFit, coefficient_of, rounding_of, scale_fit, settle
from .sums import FrameSums, Solution

__all__ = ["FrameFit", "find_objects", "fit_frame", "square_sums"]

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]

SCALES_PX = (0.0, 1.5, 5.0)
"""Widths of the kernels with which objects are looked for [px]: single pixels, stars, halos and galaxies."""

THRESHOLDS = (5.0, 4.0, 4.0)
"""Standard deviations above which they are; 4096² pixels of noise have about one above 5."""

LEAST_GROWTH_PX, GROWTH = 3.0, 0.5
"""An object is masked as far as 3 px and half the square root of its area around what is above the threshold."""

UNCHANGED = 1e-3
"""Part of the pixels of which no fit takes notice, below which objects count as the same."""

SAMPLE, LEAST_SAMPLE = 200_000, 1000
"""Pixels that tell a scatter to 0.2 %, and those below which all are asked."""

BINNED_PX = (2, 2, 4)
"""Side of the squares of pixels in which objects of each width are sought."""

ROUNDS = 4
"""Rounds of fit and detection; fringes and background are those of pixels without the objects found so far."""


@dataclass(frozen=True, eq=False)
class FrameFit:
    """A frame taken apart.

    Attributes
    ----------
    fit : `ScaleFit`
        Scales and background.
    objects : `numpy.ndarray` of `bool`, shape ``(ny, nx)``
        Pixels of objects.
    background : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Background.
    residual : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Frame less background and fringes, if any are seen; 0 where the frame has no number.
    sums : `FrameSums`
        Sums over the pixels that were used.
    solution : `Solution`
        Their least-squares solution.
    """

    fit: ScaleFit
    objects: BoolArray
    background: NDArray[np.float32]
    residual: NDArray[np.float32]
    sums: FrameSums
    solution: Solution


def fit_frame(
    image: NDArray[Any],
    weight: NDArray[np.float32],
    patterns: Sequence[NDArray[np.float32]],
    background: BackgroundTerms,
    *,
    rounds: int = ROUNDS,
) -> FrameFit:
    """Fit background and fringes, find the objects in what is left, and repeat without them.

    Parameters
    ----------
    image, weight, patterns, background
        See `fit_scales`.
    rounds : `int`, optional
        Most rounds; ends when the objects stay the same.

    Raises
    ------
    UndeterminedError
        Too few pixels are left, or the templates are not independent.
    """
    sums = FrameSums(image, weight, patterns, background)
    objects = np.zeros(weight.shape, dtype=bool)
    residual = None
    for _ in range(rounds):
        solution, residual = settle(sums, sums.usable & ~objects, residual)
        found = find_objects(residual, sums.usable, rounding_of(sums.level))
        changed = np.count_nonzero(found != objects)
        objects = found
        if changed <= UNCHANGED * objects.size:
            break
    assert residual is not None
    fit = scale_fit(sums, solution)
    if patterns and not fit.seen:
        # Their scales are noise, and the frame is one without them.
        solution = sums.solve(templates=False)
        residual = sums.residual(solution)
        fit = dataclasses.replace(fit, coefficient=coefficient_of(sums, solution))
    return FrameFit(fit, objects, background.surface(fit.coefficient), residual, sums, solution)


def find_objects(residual: NDArray[np.float32], good: BoolArray, rounding: float = 0.0) -> BoolArray:
    """Pixels of objects, with what surrounds them.

    Parameters
    ----------
    residual : `numpy.ndarray`, shape ``(ny, nx)``
        Frame less background and fringes; 0 where a pixel is not good.
    good : `numpy.ndarray` of `bool`
        Pixels that say something.
    rounding : `float`, optional
        Scatter that is rounding: a frame without noise has no objects that could be told from it.
    """
    objects = np.zeros(good.shape, dtype=bool)
    noise = _scatter(residual, good)
    if noise <= rounding:
        return objects
    for width, threshold, binned in zip(SCALES_PX, THRESHOLDS, BINNED_PX, strict=True):
        # What is found already does not reach into the wider kernels.
        left = good & ~objects
        if width == 0.0:
            single = np.abs(residual) > np.float32(threshold * noise)
            above = square_sums(single & left, binned) > 0
        else:
            above = _above(residual, left, width, threshold, binned, noise)
        _grow_into(objects, above, binned)
    return objects


def _above(
    residual: NDArray[np.float32], good: BoolArray, width: float, threshold: float, binned: int, noise: float
) -> BoolArray:
    """Squares of pixels in which the smoothed residual stands above its own scatter."""
    values = np.where(good, residual, np.float32(0.0))
    share = square_sums(good, binned)
    smooth = gaussian_filter(square_sums(values, binned), width / binned, truncate=3.0)
    share = gaussian_filter(share, width / binned, truncate=3.0) / np.float32(binned**2)
    seen = share > 0.25
    smooth /= np.maximum(share, 0.25) * np.float32(binned**2)
    # White noise is the least there is: few independent places do not tell less.
    effective = math.sqrt(width**2 + (binned**2 - 1) / 12.0)
    least = noise / (2.0 * math.sqrt(math.pi) * effective)
    scatter = max(_scatter(smooth, seen), least) / np.sqrt(np.maximum(share, 0.25))
    return np.asarray(seen & (smooth > threshold * scatter))


def square_sums(image: NDArray[Any], side: int) -> NDArray[np.float32]:
    """Sums over squares; those at the far edges have fewer pixels."""
    if side == 1:
        return np.asarray(image, dtype=np.float32)
    if image.dtype == bool and side < 256:
        image = image.view(np.uint8)
    ny, nx = (size - size % side for size in image.shape)
    kind = image.dtype if image.dtype.kind == "u" else np.dtype(np.float32)
    rows = image[:ny].reshape(-1, side, image.shape[1]).sum(axis=1, dtype=kind)
    if ny < image.shape[0]:
        rows = np.concatenate([rows, image[ny:].sum(axis=0, dtype=kind)[None]])
    total = rows[:, :nx:side].astype(np.float32)
    for offset in range(1, side):
        total += rows[:, offset:nx:side]
    if nx < image.shape[1]:
        total = np.concatenate([total, rows[:, nx:].sum(axis=1, dtype=np.float32)[:, None]], axis=1)
    return total


def _scatter(values: NDArray[Any], good: BoolArray) -> float:
    """Standard deviation from the quartile below the median: objects only add light."""
    step = (values.size // SAMPLE) | 1
    sample = values.ravel()[::step][good.ravel()[::step]]
    if sample.size < LEAST_SAMPLE:
        sample = values[good]
    low, middle = np.percentile(sample, [25.0, 50.0]) if sample.size else (0.0, 0.0)
    return float(middle - low) / 0.6745


def _grow_into(objects: BoolArray, above: BoolArray, binned: int) -> None:
    """Add squares of pixels near those that are above a threshold, further around large objects."""
    number, count = label(above, structure=np.ones((3, 3)))
    area = np.bincount(number.ravel(), minlength=count + 1) * binned**2
    reach = LEAST_GROWTH_PX + GROWTH * np.sqrt(area)
    rim = above.copy()
    rim[1:-1, 1:-1] &= ~(above[:-2, 1:-1] & above[2:, 1:-1] & above[1:-1, :-2] & above[1:-1, 2:])
    y, x = np.nonzero(rim)
    # Squares reach from their corners: half their side further than from their centres.
    near = _near(above.shape, y, x, (reach[number[y, x]] + (binned - 1) / 2.0) / binned)
    near |= above
    wide = near.repeat(binned, axis=1)[:, : objects.shape[1]]
    for offset in range(binned):
        rows = objects[offset::binned]
        rows |= wide[: len(rows)]


def _near(
    shape: tuple[int, ...], y: NDArray[np.int64], x: NDArray[np.int64], radius: FloatArray
) -> BoolArray:
    """Pixels within a radius of places, from the beginnings and ends of the rows of their circles."""
    ny, nx = shape
    edges = np.zeros((ny, nx + 1), dtype=np.int32)
    order = np.argsort(-radius)
    y, x, radius = y[order], x[order], radius[order]
    for offset in range(-int(radius[0]) if radius.size else 0, int(radius[0]) + 1 if radius.size else 0):
        some = int(np.searchsorted(-radius, -abs(offset), side="right"))
        row = y[:some] + offset
        there = (row >= 0) & (row < ny)
        half = np.sqrt(radius[:some][there] ** 2 - offset**2).astype(np.int64)
        first, last = np.maximum(x[:some][there] - half, 0), np.minimum(x[:some][there] + half + 1, nx)
        np.add.at(edges, (row[there], first), 1)
        np.add.at(edges, (row[there], last), -1)
    # Where more circles have begun than ended.
    return np.asarray(np.cumsum(edges, axis=1, out=edges)[:, :-1] > 0)
