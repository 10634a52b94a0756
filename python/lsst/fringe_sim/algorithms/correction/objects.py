"""Objects in a frame, found where background and fringes are subtracted, so that no fringe is taken for one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label, uniform_filter

from ...array_types import BoolArray, Float32Array, FloatArray
from ...compiled import run_threaded
from .background import BackgroundTerms
from .scales import ScaleFit, coefficient_of, rounding_of, scale_fit, settle
from .sums import FrameSums, Solution

__all__ = ["FrameFit", "find_objects", "fit_frame", "masked_sums", "square_sums"]

SCALES_PX = (0.0, 1.5, 5.0)
"""Widths of the kernels with which objects are looked for [px]: single pixels, stars, halos and galaxies."""

THRESHOLDS = (5.0, 4.0, 4.0)
"""Standard deviations above which they are; 4096² pixels of noise have about one above 5."""

LEAST_GROWTH_PX, GROWTH = 3.0, 0.5
"""An object is masked as far as 3 px and half the square root of its area around what is above the threshold."""

UNCHANGED = 1e-3  # Part of the pixels of which no fit takes notice, below which objects count as the same

SAMPLE, LEAST_SAMPLE = 200_000, 1000
"""Pixels that tell a scatter to 0.2 %, and those below which all are asked."""

BINNED_PX = (2, 2, 4)  # Side of the squares of pixels in which objects of each width are sought

NEIGHBOURHOOD_PX, CELLS_A_NEIGHBOURHOOD = 256, 8
"""Side of the square around a place whose scatter an object has to exceed, the distance of the knots of the
background, as which longer waves count; and the cells a side whose sums tell it."""

_ROWS = 128  # Rows that are worked on at a time, which the memory of a processor holds

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
    background: Float32Array
    residual: Float32Array
    sums: FrameSums
    solution: Solution


def fit_frame(
    image: NDArray[Any],
    weight: Float32Array,
    patterns: Sequence[Float32Array],
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


def find_objects(residual: Float32Array, good: BoolArray, rounding: float = 0.0) -> BoolArray:
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
            above = _single(residual, left, threshold * noise, binned)
        else:
            above = _above(residual, left, width, threshold, binned, noise)
        _grow_into(objects, above, binned)
    return objects


def _single(residual: Float32Array, good: BoolArray, limit: float, binned: int) -> BoolArray:
    """Squares of pixels of which one lies off by more than a limit."""
    above = np.empty([-(-size // binned) for size in good.shape], dtype=bool)

    def one(rows: slice, squares: slice) -> None:
        single = np.abs(residual[rows]) > np.float32(limit)
        above[squares] = square_sums(single & good[rows], binned) > 0

    _for_bands(one, len(good), binned)
    return above


def _above(
    residual: Float32Array, good: BoolArray, width: float, threshold: float, binned: int, noise: float
) -> BoolArray:
    """Squares of pixels in which the smoothed residual stands above its own scatter."""
    shape = [-(-size // binned) for size in good.shape]
    smooth, share = (np.empty(shape, dtype=np.float32) for _ in range(2))
    kernel = {"sigma": width / binned, "radius": round(3.0 * width / binned)}

    def one(rows: slice, squares: slice) -> None:
        # With so many rows around that the kernel sees all it would.
        first = max(squares.start - kernel["radius"], 0)
        last = squares.stop + kernel["radius"]
        wide, inner = slice(first * binned, last * binned), slice(squares.start - first, squares.stop - first)
        total = square_sums(np.where(good[wide], residual[wide], np.float32(0.0)), binned)
        number = square_sums(good[wide], binned)
        share[squares] = gaussian_filter(number, **kernel)[inner] / np.float32(binned**2)
        smooth[squares] = gaussian_filter(total, **kernel)[inner]
        smooth[squares] /= np.maximum(share[squares], 0.25) * np.float32(binned**2)

    _for_bands(one, len(good), binned)
    seen = share > 0.25
    # White noise is the least there is: few independent places do not tell less.
    effective = math.sqrt(width**2 + (binned**2 - 1) / 12.0)
    least = noise / (2.0 * math.sqrt(math.pi) * effective)
    scatter = np.maximum(
        max(_scatter(smooth, seen), least) / np.sqrt(np.maximum(share, 0.25)),
        _scatter_around(smooth, seen, NEIGHBOURHOOD_PX // binned),
    )
    return np.asarray(seen & (smooth > threshold * scatter))


def _scatter_around(values: Float32Array, good: BoolArray, side: int) -> Float32Array:
    """Root mean square of the values below 0 in the neighbourhood of each: objects only add light, waves do not."""
    cell = max(1, side // CELLS_A_NEIGHBOURHOOD)
    below = good & (values < 0.0)
    number = square_sums(below, cell)
    total = square_sums(np.where(below, np.square(values), np.float32(0.0)), cell)
    number, total = (
        uniform_filter(each, CELLS_A_NEIGHBOURHOOD + 1, mode="constant") for each in (number, total)
    )
    scatter = np.sqrt(np.divide(total, number, out=np.zeros_like(total), where=number > 0.0))
    wide = scatter.repeat(cell, axis=0).repeat(cell, axis=1)
    return np.asarray(wide[: values.shape[0], : values.shape[1]])


def masked_sums(values: NDArray[Any], good: BoolArray, side: int) -> Float32Array:
    """Sums over the good pixels of squares, as `square_sums`, in threads."""
    made = np.empty([-(-size // side) for size in good.shape], dtype=np.float32)

    def one(rows: slice, squares: slice) -> None:
        made[squares] = square_sums(np.where(good[rows], values[rows], np.float32(0.0)), side)

    _for_bands(one, len(good), side)
    return made


def _for_bands(work: Callable[[slice, slice], object], rows: int, side: int) -> None:
    """Call ``work`` with some rows at a time, and the rows of squares that they are, in threads."""
    squares = max(1, _ROWS // side)
    step = squares * side

    def one(band: int) -> None:
        last = min((band + 1) * step, rows)
        work(slice(band * step, last), slice(band * squares, -(-last // side)))

    run_threaded(one, -(-rows // step))


def square_sums(image: NDArray[Any], side: int) -> Float32Array:
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
