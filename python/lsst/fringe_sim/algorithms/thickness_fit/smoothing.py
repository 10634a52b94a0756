"""Average over neighbouring pixels without washing out their fringes.

Smoothing the flats before the fit takes contrast from steep fringes and bends what it averages. The likelihood
does neither: with a surface that follows the fringes, each pixel has a score (how much thicker it wants to be) and
an information (how strongly), both smooth on the scale of the surface. The kernel-weighted sums of the two give
the best common correction of a neighbourhood and its variance,

    δ = Σ G s / Σ G I        var δ = Σ G² I / (Σ G I)²

(local likelihood: Tibshirani & Hastie 1987, J. Am. Stat. Assoc. 82, 559). Masked pixels have no information and
take no part.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .amplitudes import Amplitudes
from .cells import core, load_row, run_threaded
from .newton import score
from .pixels import CellSurface, PixelFit, calm_surface, subtract_row
from .templates import FringeTemplates

__all__ = ["evaluate_pixels", "smooth_likelihood"]

_MATH = {"reassoc", "contract", "arcp", "nsz"}
_BAND_ROWS = 16
_SMOOTHED_ROWS = 256
_LONGEST_CORRECTION_UM = 0.05
"""A cell is not moved farther than this: the linear step would not hold."""
_REACH = 4.0
"""Standard deviations at which the kernel ends."""


def smooth_likelihood(
    data: Amplitudes,
    templates: FringeTemplates,
    pixels: PixelFit,
    surface: CellSurface,
    edges: tuple[NDArray[np.int64], NDArray[np.int64]],
    rough: NDArray[np.bool_],
    sigma_px: float,
    threads: int = 2,
) -> PixelFit:
    """Correct a surface by the kernel-weighted likelihood of its pixels.

    Parameters
    ----------
    data : `Amplitudes`
        The flats.
    templates : `FringeTemplates`
        The model, normalised to the sensor.
    pixels : `PixelFit`
        Each pixel by itself; kept as it is where ``rough``.
    surface : `CellSurface`
        Surface of the cells: what is to be corrected.
    edges : `tuple` [`numpy.ndarray`, `numpy.ndarray`]
        Edges of the cells in y and x [px].
    rough : `numpy.ndarray`, bool, shape ``(ny, nx)``
        Pixels near steps, over which nothing is averaged.
    sigma_px : `float`
        Standard deviation of the kernel [px].
    threads : `int`, optional
        Number of threads; has no influence on the result.

    Returns
    -------
    pixels : `PixelFit`
        Smoothed thickness, its uncertainty, and the chi-square of each pixel against it.
    """
    used = pixels.n_wavelengths
    taken = ~rough & (used > 0)
    surface = calm_surface(_follow_pixels(data, templates, surface, edges, taken, threads), threads)
    base = surface.at(*(np.arange(size) for size in used.shape))
    gain, information, _ = evaluate_pixels(data, templates, base, threads)
    gain *= taken * np.float32(1.0 / templates.step_um)
    information *= taken * np.float32(templates.step_um**-2)
    spread = _smooth(information, sigma_px, threads)
    seen = taken & (spread > 0.0)
    correction = np.divide(_smooth(gain, sigma_px, threads), spread, out=np.zeros_like(spread), where=seen)
    if data.noise_correlation_px > 0.0:
        shared = data.noise_correlation_px**2 / (data.noise_correlation_px**2 + sigma_px**2)
        variance = np.divide(np.float32(shared), spread, out=np.zeros_like(spread), where=seen)
    else:
        # The square of a Gaussian kernel is a narrower one, of integral 1 / (4 pi sigma²).
        square = _smooth(information, sigma_px / np.sqrt(2.0), threads) / (4.0 * np.pi * sigma_px**2)
        variance = np.divide(square, spread**2, out=np.zeros_like(spread), where=seen)
    value = np.where(seen, base + correction, pixels.value).astype(np.float32)
    freedom = np.maximum(used, 1).astype(np.float32)  # the thickness is that of many pixels
    chi2 = evaluate_pixels(data, templates, value, threads)[2] / freedom
    return replace(
        pixels,
        value=value,
        sigma=np.where(seen, np.sqrt(variance), pixels.sigma).astype(np.float32),
        chi2=np.where(seen, chi2, pixels.chi2).astype(np.float32),
    )


def _follow_pixels(
    data: Amplitudes,
    templates: FringeTemplates,
    surface: CellSurface,
    edges: tuple[NDArray[np.int64], NDArray[np.int64]],
    taken: NDArray[np.bool_],
    threads: int,
) -> CellSurface:
    """Surface whose cells are corrected by the likelihood of their pixels, not of their mean amplitudes.

    The mean over a steep cell is biased a little, in step with its fringes; the sum of the scores is not.
    """
    parts = evaluate_pixels(data, templates, surface.at(*(np.arange(size) for size in taken.shape)), threads)
    gain, information = (
        np.add.reduceat(np.add.reduceat(part * taken, edges[0][:-1], axis=0), edges[1][:-1], axis=1)
        for part in parts[:2]
    )
    move = np.divide(gain, information, out=np.zeros_like(gain), where=information > 0.0) * templates.step_um
    move = np.where(np.abs(move) < _LONGEST_CORRECTION_UM, move, 0.0)
    thickness = (surface.thickness_um + move).astype(np.float32)
    if min(thickness.shape) < 2:
        return replace(surface, thickness_um=thickness)
    slope_y, slope_x = np.gradient(thickness, surface.y_centre, surface.x_centre)
    return replace(
        surface,
        thickness_um=thickness,
        slope_y=np.asarray(slope_y, np.float32),
        slope_x=np.asarray(slope_x, np.float32),
    )


def _smooth(image: NDArray[np.float32], sigma_px: float, threads: int) -> NDArray[np.float32]:
    """Gaussian sums with zeros beyond the edges, in bands."""
    reach = int(np.ceil(_REACH * sigma_px))
    out = np.empty_like(image)

    def work(band: int) -> None:
        low, high = band * _SMOOTHED_ROWS, min((band + 1) * _SMOOTHED_ROWS, len(image))
        first = max(low - reach, 0)
        part = gaussian_filter(
            image[first : high + reach], sigma_px, mode="constant", truncate=_REACH, output=np.float32
        )
        out[low:high] = part[low - first : high - first]

    run_threaded(work, -(-len(image) // _SMOOTHED_ROWS), threads)
    return out


def evaluate_pixels(
    data: Amplitudes, templates: FringeTemplates, thickness_um: NDArray[np.float32], threads: int = 2
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Score, information and chi-square of every pixel at a given thickness.

    Parameters
    ----------
    data : `Amplitudes`
        The flats.
    templates : `FringeTemplates`
        The model.
    thickness_um : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Thickness [µm]; pixels without a number give zeros.
    threads : `int`, optional
        Number of threads; has no influence on the result.

    Returns
    -------
    score, information, chi2 : `numpy.ndarray`, float32, shape ``(ny, nx)``
        In steps of the template grid: ``sum w g r``, ``sum w g²``, ``sum w r²``.
    """
    ny = data.shape[1]
    out = np.zeros((3, *thickness_um.shape), np.float32)
    table = templates.table()
    scale = data.scale.astype(np.float32)
    cell_of_row = data.cell_of_row()

    def work(band: int) -> None:
        low, high = band * _BAND_ROWS, min((band + 1) * _BAND_ROWS, ny)
        image, variance, bad = data.rows(low, high)
        _evaluate_band(
            image, core(variance), core(bad), scale, table, templates.start_um, templates.step_um,
            thickness_um[low:high], low, data.offset, cell_of_row, data.x_edges, out[:, low:high],
        )  # fmt: skip

    run_threaded(work, -(-ny // _BAND_ROWS), threads)
    return out[0], out[1], out[2]


@numba.njit(cache=True, nogil=True, fastmath=_MATH)
def _evaluate_band(  # type: ignore[no-untyped-def]
    image, variance, bad, scale, table, start, step, thickness, first_row, offset, cell_of_row, x_edges, out
):
    bands, rows, columns = image.shape
    amplitude, spread = np.zeros((bands, columns), np.float32), np.zeros((bands, columns), np.float32)
    y, w = np.zeros((1, table.shape[1]), np.float32), np.zeros((1, table.shape[1]), np.float32)
    for r in range(rows):
        for band in range(bands):
            vb = band if variance.shape[0] > 1 else 0
            bb = band if bad.shape[0] > 1 else 0
            vr = r if variance.shape[1] > 1 else 0
            br = r if bad.shape[1] > 1 else 0
            load_row(
                image[band, r], variance[vb, vr], bad[bb, br], scale[band], amplitude[band], spread[band]
            )
            if offset.shape[0] > 0:
                subtract_row(amplitude[band], offset[band, cell_of_row[first_row + r]], x_edges)
        for x in range(columns):
            place = (thickness[r, x] - start) / step
            if not 0.0 <= place <= table.shape[0] - 1.0:
                continue
            for band in range(bands):
                y[0, band] = amplitude[band, x]
                w[0, band] = np.float32(1.0) / spread[band, x] if spread[band, x] > 0.0 else np.float32(0.0)
            out[0, r, x], out[1, r, x], out[2, r, x] = score(table, place, y, w, 0)
