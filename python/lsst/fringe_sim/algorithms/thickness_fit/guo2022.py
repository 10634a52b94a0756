"""The fit of Guo et al. (2022), section 3.3: a walk from pixel to pixel, one fringe order at a time.

Step 1 takes one pixel and searches the whole thickness range for the least reduced chi-square. Steps 2 and 3
walk up the rest of that column, then along each following column in turn, down and up, and look for the least
reduced chi-square within one fringe order (300 nm) around the value of the pixel before. Step 4 walks the
other way from the first pixel. A pixel that slips takes every later pixel with it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled import kernel, run_threaded, subkernel
from ...errors import InputError, OutOfRangeError
from .amplitudes import Amplitudes
from .pixels import PixelFit
from .templates import FlatTemplates


def walk_fit(
    data: Amplitudes,
    templates: FlatTemplates,
    *,
    start_pixel: tuple[int, int],
    range_um: tuple[float, float],
    window_um: float = 0.3,
    threads: int = 2,
) -> PixelFit:
    """Fit every pixel by the walk of the paper.

    ``templates``: model on a uniform grid; its step is the resolution of the result; ``start_pixel``: row and
    column of the first pixel. If it is masked, the next good one along the walk takes its place; ``range_um``:
    range of the first search [µm]; ``window_um``: full width of the later searches [µm]: one fringe order. Raises
    `InputError`: the start pixel lies outside the sensor, or no pixel is good. Raises `OutOfRangeError`: the search
    range reaches beyond the templates.
    """
    _, ny, nx = data.shape
    row, column = start_pixel
    if not (0 <= row < ny and 0 <= column < nx):
        raise InputError(
            "start pixel (row, column)", start_pixel, f"rows 0 to {ny - 1}, columns 0 to {nx - 1}"
        )
    low = round((range_um[0] - templates.start_um) / templates.step_um)
    high = round((range_um[1] - templates.start_um) / templates.step_um)
    if not 0 <= low < high < len(templates.response):
        allowed = f"inside {templates.start_um:g} to {templates.stop_um:g}"
        raise OutOfRangeError("search range [um]", range_um, allowed)
    flats = (*data.rows(0, ny), data.scale.astype(np.float32))
    table = np.ascontiguousarray(templates.amplitude().T.astype(np.float32))
    forward, backward = _paths(ny, nx, row, column)
    seed = _seed(flats, table, forward, backward, low, high)
    if seed < 0:
        raise InputError("pixels", "all masked", "at least one good pixel")
    half = max(round(0.5 * window_um / templates.step_um), 1)
    value, sigma, chi2 = (np.full((ny, nx), np.nan, np.float32) for _ in range(3))
    found = PixelFit(value, sigma, chi2, np.zeros((ny, nx), np.int32))

    def work(path: int) -> None:
        way = (forward, backward)[path]
        _walk(flats, table, way, seed, half, templates.start_um, templates.step_um, found)

    run_threaded(work, 2, threads)
    return found


def _paths(ny: int, nx: int, row: int, column: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Forward and backward path as ``(first row, first column, direction of rows, of columns, steps)``."""
    forward = np.array([row, column, 1, 1, (ny - row) + ny * (nx - 1 - column)])
    backward = np.array([row - 1, column, -1, -1, row + ny * column])
    if row == 0:  # nothing is left below the first pixel: the backward walk begins in the next column
        backward = np.array([0, column - 1, 1, -1, ny * column])
    return forward, backward


@subkernel(relaxed=True)
def _load(flats, y, x, value, weight):  # type: ignore[no-untyped-def]
    """Amplitudes and weights of one pixel; returns the number of wavelengths that can be used."""
    image, variance, bad, scale = flats
    used = 0
    for band in range(image.shape[0]):
        amplitude = image[band, y, x] * scale[band] - np.float32(1.0)
        spread = variance[band, y, x] * scale[band] * scale[band]
        if bad[band, y, x] == 0 and np.isfinite(amplitude) and spread > 0.0 and np.isfinite(spread):
            value[band] = amplitude
            weight[band] = np.float32(1.0) / spread
            used += 1
        else:
            value[band] = np.float32(0.0)
            weight[band] = np.float32(0.0)
    return used


@subkernel(relaxed=True)
def _search(table, value, weight, low, high, chi2):  # type: ignore[no-untyped-def]
    """Row of least chi-square in ``low..high`` (both included); the first of equals."""
    count = high - low + 1
    for k in range(count):
        chi2[k] = np.float32(0.0)
    for band in range(table.shape[0]):
        y, w = value[band], weight[band]
        if w > 0.0:
            line = table[band, low : high + 1]
            for k in range(count):
                miss = y - line[k]
                chi2[k] += w * miss * miss
    best = 0
    least = chi2[0]
    for k in range(1, count):
        if chi2[k] < least:
            least = chi2[k]
            best = k
    return low + best, least


@subkernel
def _next_pixel(y, x, dy, dx, ny):  # type: ignore[no-untyped-def]
    """One step of the serpentine: along the column, then into the next column in the same row."""
    if 0 <= y + dy < ny:
        return y + dy, x, dy
    return y, x + dx, -dy


@kernel
def _seed(flats, table, forward, backward, low, high):  # type: ignore[no-untyped-def]
    """Row of the template that fits the first good pixel best, anywhere in the range; -1 if none is good."""
    bands, ny = flats[0].shape[0], flats[0].shape[1]
    value, weight = np.empty(bands, np.float32), np.empty(bands, np.float32)
    chi2 = np.empty(high - low + 1, np.float32)
    for path in (forward, backward):
        y, x, dy, dx = path[0], path[1], path[2], path[3]
        for _ in range(path[4]):
            if _load(flats, y, x, value, weight) > 0:
                return _search(table, value, weight, low, high, chi2)[0]
            y, x, dy = _next_pixel(y, x, dy, dx, ny)
    return -1


@kernel(relaxed=True)
def _walk(flats, table, path, seed, half, start, step, found):  # type: ignore[no-untyped-def]
    thickness, sigma, reduced, used = found
    bands, ny = flats[0].shape[0], flats[0].shape[1]
    rows = table.shape[1]
    value, weight = np.empty(bands, np.float32), np.empty(bands, np.float32)
    chi2 = np.empty(2 * half + 1, np.float32)
    y, x, dy, dx = path[0], path[1], path[2], path[3]
    reference = seed
    for _ in range(path[4]):
        count = _load(flats, y, x, value, weight)
        if count > 0:
            low, high = max(reference - half, 0), min(reference + half, rows - 1)
            reference, least = _search(table, value, weight, low, high, chi2)
            left, right = max(reference - 1, 0), min(reference + 1, rows - 1)
            information = 0.0
            for band in range(bands):
                slope = (table[band, right] - table[band, left]) / ((right - left) * step)
                information += weight[band] * slope * slope
            thickness[y, x] = start + step * reference
            sigma[y, x] = 1.0 / np.sqrt(information) if information > 0.0 else np.inf
            reduced[y, x] = least / max(count - 1, 1)
            used[y, x] = count
        y, x, dy = _next_pixel(y, x, dy, dx, ny)
