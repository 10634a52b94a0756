"""Thickness of every pixel, starting from the solved cells.

Where the cells around a pixel lie on one surface, the pixel starts from the surface and needs two Gauss-Newton
steps. Near a step in the layer the pixel tries every surface that a cell in reach shows, and takes the one that
its own amplitudes prefer.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, uniform_filter

from ...array_types import BoolArray, Float32Array, FloatArray
from ...compiled import kernel, run_threaded, subkernel
from .amplitudes import Amplitudes
from .bands import BAND_ROWS, load_band
from .medians import middle_of
from .newton import gauss_newton, newton_block
from .templates import FlatTemplates

_STEPS = 5  # Most Gauss-Newton steps; two are usual
_LONGEST_STEP = 0.1  # Longest Gauss-Newton step, in fringe orders
SAME_SURFACE = 0.25
"""Cells whose thickness agrees within this many orders, slopes allowed for, lie on one surface."""
LONE_CELL_PENALTY = 12.0
"""Chi-square by which a surface shown by a single cell must be better than one that several show."""
_BLOCK = 32


class PixelFit(NamedTuple):
    """Result for every pixel; NaN (and 0 wavelengths) where there was nothing to fit."""

    # value, sigma: thickness and its standard uncertainty [µm], float32, ``(ny, nx)``
    value: Float32Array
    sigma: Float32Array
    chi2: Float32Array  # reduced chi-square, float32, ``(ny, nx)``
    n_wavelengths: NDArray[np.int32]  # number of wavelengths used, int32, ``(ny, nx)``

    def rows(self, part: slice) -> PixelFit:
        """Views of some rows."""
        return PixelFit(self.value[part], self.sigma[part], self.chi2[part], self.n_wavelengths[part])


class CellSurface(NamedTuple):
    """Thickness and slope of every cell, and where cells lie on one surface."""

    # thickness_um, slope_y, slope_x: thickness at the centre [µm] and its slopes [µm/px]; finite everywhere,
    # float32, ``(ncy, ncx)``
    thickness_um: Float32Array
    slope_y: Float32Array
    slope_x: Float32Array
    # y_centre, x_centre: centres of the cells [px]
    y_centre: FloatArray
    x_centre: FloatArray
    smooth: BoolArray  # whether a cell and its eight neighbours lie on one surface, bool, ``(ncy, ncx)``
    # whether a cell has data; the thickness of the others is borrowed, and no evidence for a surface, bool,
    # ``(ncy, ncx)``
    known: BoolArray
    # standard uncertainty of the thickness from the noise of the flats [µm]; infinite where it is not known,
    # float32, ``(ncy, ncx)``
    sigma_um: Float32Array

    @classmethod
    def from_cells(
        cls,
        thickness_um: Float32Array,
        slope_y: NDArray[np.floating],
        slope_x: NDArray[np.floating],
        y_centre: FloatArray,
        x_centre: FloatArray,
        order_um: float,
        known: BoolArray,
        sigma_um: Float32Array,
    ) -> Self:
        """Find out which cells lie on one surface."""
        rise = np.diff(y_centre)[:, None] * 0.5 * (slope_y[1:] + slope_y[:-1])
        run = np.diff(x_centre)[None, :] * 0.5 * (slope_x[:, 1:] + slope_x[:, :-1])
        broken = np.zeros(thickness_um.shape, bool)
        breaks = np.abs(np.diff(thickness_um, axis=0) - rise) > SAME_SURFACE * order_um
        broken[1:] |= breaks
        broken[:-1] |= breaks
        breaks = np.abs(np.diff(thickness_um, axis=1) - run) > SAME_SURFACE * order_um
        broken[:, 1:] |= breaks
        broken[:, :-1] |= breaks
        broken = binary_dilation(broken, np.ones((3, 3), bool))
        return cls(
            np.ascontiguousarray(thickness_um, np.float32),
            np.ascontiguousarray(slope_y, np.float32),
            np.ascontiguousarray(slope_x, np.float32),
            y_centre,
            x_centre,
            ~broken,
            known,
            sigma_um,
        )

    def at(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Float32Array:
        """Bilinear surface at some rows and columns of pixels, shape ``(len(rows), len(columns))`` [µm]."""
        below_y, share_y = (part[rows] for part in bracket(self.y_centre, int(rows.max()) + 1))
        below_x, share_x = (part[columns] for part in bracket(self.x_centre, int(columns.max()) + 1))
        above_y = np.minimum(below_y + 1, len(self.y_centre) - 1)
        above_x = np.minimum(below_x + 1, len(self.x_centre) - 1)
        cells = self.thickness_um
        lines = cells[below_y] + share_y[:, None] * (cells[above_y] - cells[below_y])
        return lines[:, below_x] + share_x * (lines[:, above_x] - lines[:, below_x])


def calm_surface(surface: CellSurface, threads: int = 2) -> CellSurface:
    """Replace every smooth cell by the median of what the 5 by 5 cells around it foretell.

    Only a place to begin: a cell that noise has put on a false minimum, a fraction of an order away, must not
    take its pixels there.
    """
    out = surface.thickness_um.copy()

    def work(row: int) -> None:
        _calm_row(surface, row, out[row])

    run_threaded(work, len(out), threads)
    calm = surface.smooth & (surface.sigma_um > 0.0)
    density = np.where(calm, 1.0 / np.where(calm, surface.sigma_um, 1.0), 0.0)
    number, total = (
        25.0 * uniform_filter(each.astype(float), 5, mode="constant") for each in (surface.smooth, density)
    )
    # The median of independent normal numbers about one value, each of an uncertainty of its own.
    sigma = np.sqrt(0.5 * np.pi * np.maximum(number, 0.0)) / np.maximum(total, 1e-30)
    return surface._replace(
        thickness_um=out, sigma_um=np.where(surface.smooth, sigma, surface.sigma_um).astype(np.float32)
    )


@kernel
def _calm_row(surface, row, out):  # type: ignore[no-untyped-def]
    thickness, slope_y, slope_x, y_centre, x_centre, smooth, _, _ = surface
    ny, nx = thickness.shape
    guess = np.empty(25, np.float64)
    for x in range(nx):
        if not smooth[row, x]:
            continue
        number = np.int64(0)
        for b in range(max(row - 2, 0), min(row + 3, ny)):
            for a in range(max(x - 2, 0), min(x + 3, nx)):
                if smooth[b, a]:
                    up = slope_y[b, a] * (y_centre[row] - y_centre[b])
                    guess[number] = thickness[b, a] + up + slope_x[b, a] * (x_centre[x] - x_centre[a])
                    number += 1
        out[x] = middle_of(guess, number)


def fit_pixels(
    data: Amplitudes, templates: FlatTemplates, surface: CellSurface, order_um: float, *, threads: int = 2
) -> PixelFit:
    """Refine every pixel."""
    _, ny, nx = data.shape
    value, sigma, chi2 = (np.empty((ny, nx), np.float32) for _ in range(3))
    found = PixelFit(value, sigma, chi2, np.zeros((ny, nx), np.int32))
    grid = templates.grid()
    along_y, along_x = bracket(surface.y_centre, ny), bracket(surface.x_centre, nx)

    def work(band: int) -> None:
        low, high = band * BAND_ROWS, min((band + 1) * BAND_ROWS, ny)
        amplitude, weight = load_band(data, low, high)
        part = found.rows(slice(low, high))
        _fit_band(amplitude, weight, grid, order_um, surface, low, along_y, along_x, part)

    run_threaded(work, -(-ny // BAND_ROWS), threads)
    return found


def bracket(centre: FloatArray, length: int) -> tuple[NDArray[np.int64], Float32Array]:
    """For each pixel the cell centre below it, and how far it is to the next (outside 0..1: beyond the ends)."""
    if len(centre) == 1:
        return np.zeros(length, np.int64), np.zeros(length, np.float32)
    pixel = np.arange(length)
    below = np.clip(np.searchsorted(centre, pixel, side="right") - 1, 0, len(centre) - 2)
    share = (pixel - centre[below]) / (centre[below + 1] - centre[below])
    return below.astype(np.int64), share.astype(np.float32)


@kernel(relaxed=True)
def _fit_band(amplitude, weight, grid, order, surface, first_row, along_y, along_x, found):  # type: ignore[no-untyped-def]
    table, start, step = grid
    value, sigma, chi2_out, used_out = found
    (below_y, share_y), (below_x, share_x) = along_y, along_x
    thickness, smooth = surface.thickness_um, surface.smooth
    bands = amplitude.shape[0]
    rows, columns = value.shape
    padded = table.shape[1]
    longest = _LONGEST_STEP * order / step
    # Amplitudes lie far apart in a cube; blocks of pixels bring those of one pixel together.
    y, w = np.zeros((_BLOCK, padded), np.float32), np.zeros((_BLOCK, padded), np.float32)
    begin, flat = np.empty(columns, np.float32), np.empty(columns, np.bool_)
    place, move = np.empty(_BLOCK, np.float64), np.empty(_BLOCK, np.float32)
    information, misfit = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    top = table.shape[0] - 1.0
    upright = np.empty(thickness.shape[1], np.float32)
    for r in range(rows):
        for band in range(bands):
            for x in range(columns):
                used_out[r, x] += np.int32(weight[band, r, x] > np.float32(0.0))
        below, share = below_y[first_row + r], share_y[first_row + r]
        own_y = _start_row(thickness, smooth, below, share, below_x, share_x, upright, begin, flat)
        for first in range(0, columns, _BLOCK):
            size = min(_BLOCK, columns - first)
            for band in range(bands):
                for b in range(size):
                    y[b, band] = amplitude[band, r, first + b]
                    w[b, band] = weight[band, r, first + b]
            for b in range(size):
                place[b] = min(max((begin[first + b] - start) / step, 0.0), top)
            newton_block(table, place, y, w, size, np.int64(_STEPS), longest, information, misfit, move)
            for b in range(size):
                x = first + b
                if not flat[x] and used_out[r, x] > 0:
                    own_x = below_x[x] if share_x[x] < 0.5 else min(below_x[x] + 1, thickness.shape[1] - 1)
                    place[b], information[b], misfit[b] = _try_surfaces(
                        grid, order, y, w, b, surface, first_row + r, x, own_y, own_x, longest
                    )
            for b in range(size):
                value[r, first + b] = start + step * place[b]
                sigma[r, first + b] = information[b]
                chi2_out[r, first + b] = misfit[b]
        _finish_row(value[r], sigma[r], chi2_out[r], used_out[r], np.float32(step))


@subkernel(relaxed=True)
def _start_row(thickness, smooth, below, share, below_x, share_x, upright, begin, flat):  # type: ignore[no-untyped-def]
    """Thickness of the surface along one row, and where it is smooth; returns the row of the nearest cells."""
    above = min(below + 1, thickness.shape[0] - 1)
    own = below if share < 0.5 else above
    for c in range(thickness.shape[1]):
        upright[c] = thickness[below, c] + share * (thickness[above, c] - thickness[below, c])
    last = thickness.shape[1] - 1
    for x in range(begin.shape[0]):
        left, right = below_x[x], min(below_x[x] + 1, last)
        begin[x] = upright[left] + share_x[x] * (upright[right] - upright[left])
        flat[x] = smooth[own, left if share_x[x] < 0.5 else right]
    return own


@subkernel(relaxed=True)
def _finish_row(value, sigma, chi2, used, step):  # type: ignore[no-untyped-def]
    """Information to standard uncertainty, chi-square to reduced chi-square; NaN where there was nothing to fit."""
    for x in range(sigma.shape[0]):
        information = sigma[x]
        safe = information if information > 0.0 else np.float32(1.0)
        sigma[x] = step / np.sqrt(safe) if information > 0.0 else np.float32(np.inf)
        chi2[x] = max(chi2[x], np.float32(0.0)) / np.float32(max(used[x] - 1, 1))
        if used[x] == 0:
            value[x] = np.float32(np.nan)
            sigma[x] = np.float32(np.nan)
            chi2[x] = np.float32(np.nan)


@subkernel
def _try_surfaces(grid, order, y, w, item, surface, row, column, own_y, own_x, longest):  # type: ignore[no-untyped-def]
    """Best of the surfaces that the cells around a pixel show.

    Cells without data show none; only a pixel in such a cell has nothing better to begin with.
    """
    table, start, step = grid
    thickness, slope_y, slope_x, y_centre, x_centre, _, known, _ = surface
    guess, votes = np.empty(9, np.float64), np.zeros(9, np.int64)
    number = 0
    for a in range(max(own_y - 1, 0), min(own_y + 2, thickness.shape[0])):
        for b in range(max(own_x - 1, 0), min(own_x + 2, thickness.shape[1])):
            if known[own_y, own_x] and not known[a, b]:
                continue
            at = (
                thickness[a, b] + slope_y[a, b] * (row - y_centre[a]) + slope_x[a, b] * (column - x_centre[b])
            )
            seen = False
            for k in range(number):
                if abs(guess[k] - at) < SAME_SURFACE * order:
                    votes[k] += 1
                    seen = True
                    break
            if not seen:
                guess[number], votes[number] = at, 1
                number += 1
    best, best_information, best_chi2, best_cost = 0.0, np.float32(0.0), np.float32(0.0), np.inf
    for k in range(number):
        place = min(max((guess[k] - start) / step, 0.0), table.shape[0] - 1.0)
        place, information, chi2 = gauss_newton(table, place, y, w, item, np.int64(2 * _STEPS), longest)
        cost = chi2 + (LONE_CELL_PENALTY if votes[k] == 1 else 0.0)
        if cost < best_cost:
            best, best_information, best_chi2, best_cost = place, information, chi2, cost
    return best, best_information, best_chi2
