"""How large the cells of a sensor may be, from the steepness of its fringes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...array_types import Float32Array
from .amplitudes import Amplitudes

LARGEST_CELL_PX = 8  # Cells beyond this would wash out the steep fringes of real sensors (9 nm per pixel)
MOST_CELLS = 600_000  # Bound on the memory of the order evidence: about 84 orders of 4 bytes for each cell
_FEWEST_CELLS = 64
"""Cells that are more than what is learned beside the thickness: a dozen numbers of each wavelength."""
_STEEPEST_STRUCTURE = 1.0
"""Largest ``1 - cos`` of the phase across a cell, in the steepest tenth of the sensor: a quarter of a fringe."""
_LARGEST_LOSS = 1.0
"""Largest loss of amplitude by the average over a cell, there, in standard deviations of that average.

Slopes inside the cells make up for most of it; beyond this, cells of some phases take the wrong order all the same.
"""
_NINTH_DECILE = 1.28  # Of a normal distribution, in standard deviations
_CLEAREST = 4  # Wavelengths from which the size of the cells is chosen
_SAMPLE = 1000  # Squares from which their median is taken
_CUT_NOISE = 0.902  # Mean of the squares of normal deviates that are cut at eight times their median


def choose_cell_size(data: Amplitudes) -> int:
    """Largest cell over which the steepest tenth of the sensor still shows its fringes, to within the noise.

    The structure function ``<(a(x + s) - a(x))²> / 2 var(a)`` of a fringe is ``1 - cos`` of its phase over the
    distance ``s``; it is taken in blocks, at the wavelengths with the clearest fringes, with the noise subtracted.

    Returns 1, 2, 4 or 8 px, or what keeps the number of cells below `MOST_CELLS`.
    """
    _, ny, nx = data.shape
    least = int(np.ceil(np.sqrt(ny * nx / MOST_CELLS)))
    rows = np.unique(np.linspace(0, max(ny - 2 * LARGEST_CELL_PX, 0), 16).astype(int))
    height = min(2 * LARGEST_CELL_PX, ny)
    lines = [_strip(data, slice(None), int(row), height, every=4) for row in rows]
    image, variance = (np.concatenate(parts, axis=1) for parts in zip(*lines, strict=True))
    seen = np.flatnonzero(np.isfinite(image).any(axis=(1, 2)))
    if seen.size == 0:
        return max(LARGEST_CELL_PX, least)
    noise = np.array([np.nanmean(variance[k]) for k in seen])
    excess = np.array([np.nanvar(image[k]) for k in seen]) - noise
    best = np.argsort(-excess / noise)[:_CLEAREST]
    best = best[excess[best] > 0.0]
    if best.size == 0:
        return max(LARGEST_CELL_PX, least)
    noise, signal, seen = noise[best], excess[best], seen[best]
    strips = [_strip(data, slice(None), int(row), height)[0][seen] for row in rows]
    for size in (8, 4, 2):
        if size <= least:
            break
        if size >= max(ny, nx) or ny * nx < _FEWEST_CELLS * size**2:
            continue
        structure = _structure(strips, size, noise, signal)
        # The mean over a ramp of phase f is sin(f/2) / (f/2) of its middle: about 1 - (1 - cos f) / 12.
        lost = structure / 12.0 * size * np.sqrt(signal[0] / noise[0])
        if structure < _STEEPEST_STRUCTURE and lost < _LARGEST_LOSS:
            return max(size, least)
    return max(least, 1)


def _strip(
    data: Amplitudes, bands: slice, row: int, height: int, every: int = 1
) -> tuple[Float32Array, Float32Array]:
    """Amplitude and variance of some rows (or every so many of them), NaN where not to be used."""
    image, variance, bad = (part[bands, ::every] for part in data.rows(row, row + height))
    scale = data.scale.astype(np.float32)[bands, None, None]
    good = (bad == 0) & np.isfinite(image) & (variance > 0) & np.isfinite(variance)
    return (
        np.where(good, image * scale - np.float32(1), np.float32(np.nan)),
        np.where(good, variance * scale**2, np.float32(np.nan)),
    )


def _structure(
    strips: list[Float32Array], lag: int, noise: NDArray[np.floating], signal: NDArray[np.floating]
) -> float:
    """Ninth decile over blocks of the structure function at one distance."""
    values = []
    share = signal / noise**2 / np.sum((signal / noise) ** 2)
    for image in strips:
        width = max(image.shape[2] // 16, 4 * lag)
        for left in range(0, image.shape[2], width):
            block = image[:, :, left : left + width]
            for step in (block[:, lag:] - block[:, :-lag], block[:, :, lag:] - block[:, :, :-lag]):
                square = (step**2).reshape(len(step), -1)
                count = np.isfinite(square).sum(axis=1)
                if square.size and count.min() >= 16:
                    # Spikes are cut: neither a fringe nor noise has squares so far above the median.
                    square = np.minimum(square, 8.0 * _medians(square)[:, None])
                    excess = np.nanmean(square, axis=1) - 2.0 * _CUT_NOISE * noise
                    # Where noise rules, the ninth decile would be that of the noise of these means.
                    scatter = _NINTH_DECILE * np.sqrt(np.sum((share * 2.0 * noise) ** 2 * 2.0 / count))
                    values.append(0.5 * (np.sum(share * excess) - scatter))
    return float(np.percentile(values, 90)) if values else np.inf


def _medians(values: Float32Array) -> Float32Array:
    """Median of about a thousand numbers of each row; what is not a number is sorted last, and does not count."""
    some = np.sort(values[:, :: 1 + values.shape[1] // _SAMPLE], axis=1)
    middle = some[np.arange(len(some)), np.isfinite(some).sum(axis=1) // 2]
    return np.where(np.isfinite(middle), middle, np.float32(np.inf))
