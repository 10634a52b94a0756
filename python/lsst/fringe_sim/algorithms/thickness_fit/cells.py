"""Averages over small cells of a sensor, safe against bad columns, bad rows and hot pixels.

The fringe order is solved on cells, not on pixels: a cell has less noise and there are fewer of them. One bad
column that nobody masked would spoil every cell it crosses, so each cell throws out the rows and columns that
do not follow their neighbours before it is averaged.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...array_types import Float32Array, FloatArray
from ...compiled import kernel, run_threaded, subkernel
from ...errors import InputError
from .amplitudes import Amplitudes
from .bands import load_band
from .medians import middle_of
from .templates import LANES

_SPIKE_SIGMA = 6.0  # A row or column of a cell this many standard deviations off its neighbours is thrown out
_FINEST_PERIOD_PX = 24.0  # Shortest fringe whose curvature is not mistaken for a spike [px]
_LEAST_CONTRAST = 0.4  # Smallest share of the contrast that a steep cell is taken to keep
_LEAST_FILLED = 0.2  # Smallest fraction of good pixels with which a cell counts at a wavelength


@dataclass(frozen=True, eq=False)
class Cells:
    """Mean amplitude of every cell."""

    # value, weight: mean amplitude and its inverse variance; weight 0 where there is none, float32,
    # ``(ncy, ncx, padded wavelengths)``
    value: Float32Array
    weight: Float32Array
    # rise_y, rise_x: slope of the amplitude inside the cell along rows and columns [1/px], from its two halves,
    # float32
    rise_y: Float32Array
    rise_x: Float32Array
    # y_edges, x_edges: first row (column) of each cell, and the end of the last
    y_edges: NDArray[np.int64]
    x_edges: NDArray[np.int64]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return (self.value.shape[0], self.value.shape[1])

    @property
    def n_wavelengths(self) -> NDArray[np.int64]:
        """Number of wavelengths of each cell, shape ``(ncy, ncx)``."""
        return np.count_nonzero(self.weight > 0, axis=-1)

    @property
    def y_centre(self) -> FloatArray:
        """Row of the centre of each row of cells [px]."""
        return np.asarray(0.5 * (self.y_edges[:-1] + self.y_edges[1:] - 1.0), dtype=float)

    @property
    def x_centre(self) -> FloatArray:
        """Column of the centre of each column of cells [px]."""
        return np.asarray(0.5 * (self.x_edges[:-1] + self.x_edges[1:] - 1.0), dtype=float)


def cell_edges(length: int, size: int, breaks: Sequence[int] = ()) -> NDArray[np.int64]:
    """Edges of cells of about ``size`` pixels, none of which crosses a break.

    ``length``: number of pixels; ``size``: wanted size of a cell; none is larger; ``breaks``: pixels at which a new
    zone of the sensor begins. Raises `InputError`: a break outside the sensor.
    """
    for value in breaks:
        if not 0 <= value <= length:
            raise InputError("zone boundary [px]", value, f"0 to {length}")
    borders = sorted({0, length, *(int(value) for value in breaks)})
    edges = [0]
    for low, high in itertools.pairwise(borders):
        count = -(-(high - low) // size)
        edges.extend(int(e) for e in np.rint(np.linspace(low, high, count + 1)).astype(int)[1:])
    return np.array(edges, dtype=np.int64)


def effective_number(rows: float, columns: float, correlation_px: float) -> float:
    """Number of independent pixels in a block whose noise is white noise smoothed by a Gaussian kernel.

    The correlation of two pixels a distance ``r`` apart is ``exp(-r² / 4 s²)``; the variance of the mean is
    the mean of the correlation over all pairs, which factors into rows and columns.

    ``rows, columns``: size of the block [px]; ``correlation_px``: standard deviation ``s`` of the kernel [px]; 0
    for independent pixels.
    """
    return (
        rows * columns / (_pair_sum(round(rows), correlation_px) * _pair_sum(round(columns), correlation_px))
    )


def _pair_sum(count: int, correlation_px: float) -> float:
    """Variance of the mean of a line of pixels, times their number."""
    if correlation_px == 0.0 or count <= 1:
        return 1.0
    lag = np.arange(1, count)
    rho = np.exp(-(lag**2) / (4.0 * correlation_px**2))
    return float(1.0 + 2.0 * np.sum((1.0 - lag / count) * rho))


def cell_independence(size: int, correlation_px: float) -> float:
    """Independent cells per cell of a large area: cells share noise where the kernel is wider than they are."""
    if correlation_px == 0.0:
        return 1.0
    block = max(16, int(12.0 * correlation_px / size))
    whole = effective_number(block * size, block * size, correlation_px)
    return min(whole / (block**2 * effective_number(size, size, correlation_px)), 1.0)


def average_cells(
    data: Amplitudes,
    y_edges: NDArray[np.int64],
    x_edges: NDArray[np.int64],
    *,
    largest_amplitude: ArrayLike,
    threads: int = 2,
) -> Cells:
    """Average a cube over cells.

    ``y_edges, x_edges``: from `cell_edges`; ``largest_amplitude``: largest fringe amplitude that the model can
    show: how much curvature is still a fringe, ``(n_wavelengths,)``.
    """
    wavelengths = data.shape[0]
    shape = (len(y_edges) - 1, len(x_edges) - 1)
    padded = -(-wavelengths // LANES) * LANES
    value, weight, rise_y, rise_x = (np.zeros((*shape, padded), np.float32) for _ in range(4))
    wave = 2.0 * np.pi / _FINEST_PERIOD_PX
    curvature = (0.5 * wave**2 * np.asarray(largest_amplitude, dtype=float)).astype(np.float32)
    size = (float(np.diff(y_edges).max()), float(np.diff(x_edges).max()))
    inflation = size[0] * size[1] / effective_number(*size, data.noise_correlation_px)

    def work(strip: int) -> None:
        low, high = int(y_edges[strip]), int(y_edges[strip + 1])
        for band in range(wavelengths):  # the strip of one is still in cache when its cells are averaged
            amplitude, inverse = load_band(data, low, high, slice(band, band + 1))
            _average_strip(
                amplitude[0], inverse[0], band, curvature[band], x_edges,
                inflation, data.noise_correlation_px > 0.0, value[strip], weight[strip],
                rise_y[strip], rise_x[strip],
            )  # fmt: skip

    run_threaded(work, shape[0], threads)
    return Cells(value, weight, rise_y, rise_x, y_edges, x_edges)


def compensate_slopes(
    cells: Cells, slope_y: Float32Array, slope_x: Float32Array, order_um: float
) -> tuple[Cells, Float32Array, Float32Array]:
    """Undo the loss of contrast that averaging over a steep cell brings.

    A fringe whose phase turns by ``2 pi t`` across a cell keeps ``sin(pi t) / (pi t)`` of its amplitude, in each
    direction; a slope that is taken from the two halves of a cell is too small by this and by the same loss over
    half a cell.

    ``slope_y, slope_x``: slopes of the thickness as found from the halves [µm/px], float32, ``(ncy, ncx)``. Returns
    ``cells``: the cells with amplitudes divided by the loss, and weights to match; ``slope_y, slope_x``: corrected
    slopes.
    """
    turn_y = slope_y * np.diff(cells.y_edges)[:, None] / order_um
    turn_x = slope_x * np.diff(cells.x_edges)[None, :] / order_um
    true_y, true_x = turn_y, turn_x
    kept = np.ones_like(turn_y)
    for _ in range(4):
        kept = np.maximum(np.sinc(true_y) * np.sinc(true_x), _LEAST_CONTRAST)
        # Across a cell the difference of the halves keeps sinc(t/2) of the mean slope's sinc(t).
        true_y = turn_y / np.maximum(
            np.sinc(true_x) * np.sinc(0.5 * np.clip(true_y, -1, 1)) ** 2, _LEAST_CONTRAST
        )
        true_x = turn_x / np.maximum(
            np.sinc(true_y) * np.sinc(0.5 * np.clip(true_x, -1, 1)) ** 2, _LEAST_CONTRAST
        )
    kept = np.where(np.isfinite(kept), kept, 1.0).astype(np.float32)[..., None]
    return (
        replace(cells, value=cells.value / kept, weight=cells.weight * kept**2),
        (slope_y * np.where(turn_y == 0, 1, true_y / np.where(turn_y == 0, 1, turn_y))).astype(np.float32),
        (slope_x * np.where(turn_x == 0, 1, true_x / np.where(turn_x == 0, 1, turn_x))).astype(np.float32),
    )


def sample_pixels(data: Amplitudes, most: int = 200_000) -> Cells:
    """Cells of one pixel each, on a regular grid over the sensor.

    ``most``: bound on the number of pixels taken.
    """
    wavelengths, ny, nx = data.shape
    stride = max(1, int(np.ceil(np.sqrt(ny * nx / most))))
    rows, columns = np.arange(0, ny, stride), np.arange(0, nx, stride)
    padded = -(-wavelengths // LANES) * LANES
    value, weight, none = (np.zeros((len(rows), len(columns), padded), np.float32) for _ in range(3))
    scale = data.scale.astype(np.float32)[:, None]
    for number, row in enumerate(rows):
        image, variance, bad = (part[:, 0, ::stride] for part in data.rows(int(row), int(row) + 1))
        good = (bad == 0) & np.isfinite(image) & np.isfinite(variance) & (variance > 0)
        value[number, :, :wavelengths] = np.where(good, image * scale - 1, 0).T
        weight[number, :, :wavelengths] = np.where(good, 1 / np.where(good, variance * scale**2, 1), 0).T
    return Cells(value, weight, none, none, np.append(rows, ny), np.append(columns, nx))


@kernel(relaxed=True)
def _average_strip(  # type: ignore[no-untyped-def]
    value, inverse, band, curvature, x_edges, inflation, correlated, out, out_weight, rise_y, rise_x
):
    """One row of cells at one wavelength."""
    rows = value.shape[0]
    cells = x_edges.shape[0] - 1
    columns = x_edges[cells]
    widest = np.int64(0)
    for c in range(cells):
        widest = max(widest, x_edges[c + 1] - x_edges[c])
    sums = np.zeros((3, columns), np.float32)
    column_sum, column_var, column_count = sums[0], sums[1], sums[2]
    keep = np.empty((2, max(rows, widest)), np.bool_)  # of rows, and of columns
    line, line_count = np.empty(max(rows, widest), np.float32), np.empty(max(rows, widest), np.float32)
    for r in range(rows):
        for x in range(columns):
            seen = inverse[r, x] > np.float32(0.0)
            column_sum[x] += value[r, x]
            column_var[x] += np.float32(1.0) / inverse[r, x] if seen else np.float32(0.0)
            column_count[x] += np.float32(1.0) if seen else np.float32(0.0)
    for c in range(cells):
        low, high = x_edges[c], x_edges[c + 1]
        width = high - low
        total, count, var = 0.0, 0.0, 0.0
        for x in range(low, high):
            total += column_sum[x]
            count += column_count[x]
            var += column_var[x]
        if count < _LEAST_FILLED * rows * width:
            continue
        noise = np.sqrt(var / count)
        for r in range(rows):  # the cell is still in cache
            row_sum = np.float32(0.0)
            for x in range(low, high):
                row_sum += value[r, x]
            line[r] = row_sum
        if count == rows * width:
            across, along = column_sum[low:high], line[:rows]
            tolerance_x = _tolerance(noise, rows, correlated, curvature)
            tolerance_y = _tolerance(noise, width, correlated, curvature)
            if _bend(across) <= rows * tolerance_x and _bend(along) <= width * tolerance_y:
                rise_x[c, band] = _half_slope(across) / rows
                rise_y[c, band] = _half_slope(along) / width
                out[c, band] = total / count
                out_weight[c, band] = count * count / (var * inflation)
                continue
        for r in range(rows):
            row_count = np.float32(0.0)
            for x in range(low, high):
                row_count += np.float32(1.0) if inverse[r, x] > 0.0 else np.float32(0.0)
            line_count[r] = row_count
        rejected = np.int64(0)
        for axis in range(2):  # each function is called at one place, so that its code is there once
            if axis == 1:
                for x in range(width):
                    line[x], line_count[x] = column_sum[low + x], column_count[low + x]
            size = rows if axis == 0 else width
            rejected += _reject(line, line_count, size, noise, correlated, curvature, keep[axis])
            rise = rise_y if axis == 0 else rise_x
            rise[c, band] = _slope(line, line_count, size, keep[axis])
        if rejected > 0:
            total, count, var = 0.0, 0.0, 0.0
            for r in range(rows):
                if keep[0, r]:
                    for x in range(width):
                        if keep[1, x] and inverse[r, low + x] > 0.0:
                            total += value[r, low + x]
                            var += 1.0 / inverse[r, low + x]
                            count += 1.0
            if count < _LEAST_FILLED * rows * width:
                continue
        out[c, band] = total / count
        out_weight[c, band] = count * count / (var * inflation)


@subkernel(expand=True)
def _tolerance(noise, count, correlated, curvature):  # type: ignore[no-untyped-def]
    """Second difference of line means up to which no line of a filled cell is rejected.

    Inside, a line that is tolerated bends by less than ``2 (6 sigma sqrt(3/2) + curvature)``; the two ends are
    tested on the same second difference, with ``6 sigma sqrt(6) + 2 curvature``: the same number.
    """
    sigma = noise if correlated else noise / np.sqrt(count)
    return np.float32(_SPIKE_SIGMA * sigma * np.sqrt(6.0) + 2.0 * curvature)


@subkernel(expand=True)
def _bend(line):  # type: ignore[no-untyped-def]
    """Largest second difference."""
    most = np.float32(0.0)
    for k in range(1, line.shape[0] - 1):
        most = max(most, abs(line[k - 1] - np.float32(2.0) * line[k] + line[k + 1]))
    return most


@subkernel(expand=True)
def _half_slope(line):  # type: ignore[no-untyped-def]
    """Mean of the upper half less mean of the lower half, over the distance of the two."""
    size = line.shape[0]
    half = size // 2
    if half == 0:
        return np.float32(0.0)
    low, high = np.float32(0.0), np.float32(0.0)
    for k in range(half):
        low += line[k]
        high += line[size - 1 - k]
    return (high - low) / np.float32(half * (size - half))


@subkernel
def _reject(total, count, size, noise, correlated, curvature, keep):  # type: ignore[no-untyped-def]
    """Mark lines whose mean does not lie between its neighbours; returns how many.

    A line is compared with the mean of the nearest lines still kept on both sides, at an end with the line
    through the nearest two. The worst goes first; of several about as bad, the one farthest from the median,
    so that a pair of bad columns does not take its good neighbours with it.
    """
    for k in range(size):
        keep[k] = count[k] > 0.0
    rejected = 0
    while rejected < size // 2:
        worst, least_ratio = -1, 1.0
        for k in range(size):
            if keep[k]:
                ratio = _miss_ratio(total, count, size, noise, correlated, curvature, keep, k)
                if ratio > least_ratio:
                    worst, least_ratio = k, ratio
        if worst < 0:
            break
        middle = _median(total, count, size, keep)
        farthest = abs(total[worst] / count[worst] - middle)
        for k in range(size):
            if keep[k] and k != worst:
                distance = abs(total[k] / count[k] - middle)
                if distance > farthest:
                    ratio = _miss_ratio(total, count, size, noise, correlated, curvature, keep, k)
                    if ratio > 0.6 * least_ratio and ratio > 1.0:
                        worst, farthest = k, distance
        keep[worst] = False
        rejected += 1
    return rejected


@subkernel
def _miss_ratio(total, count, size, noise, correlated, curvature, keep, k):  # type: ignore[no-untyped-def]
    """How far a line is from where its neighbours put it, in units of what is tolerated."""
    before = k - 1
    while before >= 0 and not keep[before]:
        before -= 1
    after = k + 1
    while after < size and not keep[after]:
        after += 1
    if before < 0:
        before = after
        after += 1
        while after < size and not keep[after]:
            after += 1
    elif after >= size:
        after = before
        before -= 1
        while before >= 0 and not keep[before]:
            before -= 1
    if before < 0 or after >= size:
        return 0.0
    share = (k - before) / (after - before)
    predicted = (1.0 - share) * total[before] / count[before] + share * total[after] / count[after]
    variance = 1.0 / count[k] + (1.0 - share) ** 2 / count[before] + share**2 / count[after]
    sigma = noise * np.sqrt(variance if not correlated else 1.0 + (1.0 - share) ** 2 + share**2)
    bend = curvature * abs((k - before) * (after - k))
    return abs(total[k] / count[k] - predicted) / (_SPIKE_SIGMA * sigma + bend)


@subkernel
def _slope(total, count, size, keep):  # type: ignore[no-untyped-def]
    """Slope of the line means: upper half less lower half, over the distance of the two halves [1/px]."""
    middle = 0.5 * (size - 1.0)
    low, low_n, low_at, high, high_n, high_at = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(size):
        if keep[k] and count[k] > 0.0:
            if k < middle:
                low += total[k]
                low_n += count[k]
                low_at += count[k] * k
            elif k > middle:
                high += total[k]
                high_n += count[k]
                high_at += count[k] * k
    if low_n == 0.0 or high_n == 0.0:
        return 0.0
    return (high / high_n - low / low_n) / (high_at / high_n - low_at / low_n)


@subkernel
def _median(total, count, size, keep):  # type: ignore[no-untyped-def]
    means = np.empty(size, np.float64)  # as everywhere that a median is taken
    number = np.int64(0)
    for k in range(size):
        if keep[k]:
            means[number] = total[k] / count[k]
            number += 1
    return middle_of(means, number)
