"""Cells that something spoiled in one exposure: cosmic rays, mostly."""

from __future__ import annotations

import functools
import math

import numpy as np
from scipy.ndimage import binary_dilation, median_filter

from ...array_types import BoolArray, FloatArray
from ..flat_prep_options import GAUSSIAN_MAD

OUTLIER_SIGMA = 6.0  # Robust standard deviations beyond which a cell is spoiled
GROWTH_SIGMA = 3.0  # The same for what adjoins a spoiled cell
MOST_OF_A_PLANE = 0.02  # Part of a plane beyond which outliers are a pattern of their own, and stay

MOST_PLANES = 0.3
"""Part of the exposures beyond which what is wrong with a cell is not an accident of one of them."""

NEIGHBOURHOOD = 7  # Side of the area whose median is taken off [cells]; a track covers less than half of it

TILE = 24  # Side of the tiles in which the spread is taken [cells]: misfit of the model may be larger in some places


def spoiled_cells(residual: FloatArray, used: BoolArray) -> BoolArray:
    """Cells that stand out from their surroundings in one exposure, and not in most.

    What all exposures have in common (the response of the cells) is taken off. The spread is that of the residual
    itself, in tiles: where the model does not fit, only what is far worse than its misfit stands out.

    ``residual`` (W, ny, nx). ``used`` (W, ny, nx). Returns (W, ny, nx).
    """
    waves = len(residual)
    if waves < 3:
        return np.zeros(used.shape, dtype=bool)
    known = np.where(used, residual, np.nan)
    seen = used.any(axis=0)
    common = np.zeros(seen.shape)
    common[seen] = np.nanmedian(known[:, seen], axis=0)
    own = np.where(used, residual - common, 0.0)
    # What is wrong with all of a neighbourhood is no track: the light, or a wrong effect.
    own = np.where(used, own - np.stack([median_filter(plane, NEIGHBOURHOOD) for plane in own]), 0.0)
    departure = np.stack([_in_own_spread(plane, good) for plane, good in zip(own, used, strict=True)])
    departure /= _tail_over_spread(waves)
    spoiled = np.abs(departure) > OUTLIER_SIGMA
    spoiled &= spoiled.sum(axis=0) <= max(1.0, MOST_PLANES * waves)
    around = np.ones((3, 3), dtype=bool)
    for plane, beyond in zip(spoiled, np.abs(departure) > GROWTH_SIGMA, strict=True):
        plane |= binary_dilation(plane, around, iterations=2, mask=beyond)
    pattern = spoiled.sum(axis=(1, 2)) > MOST_OF_A_PLANE * used.sum(axis=(1, 2))
    spoiled[pattern] = False
    return spoiled


@functools.cache
def _tail_over_spread(waves: int) -> float:
    """Standard deviation that the tail of noise has behind its median over exposures, over its robust spread.

    One exposure in three is the median itself: the spread of so few says little of the tail. For a value to be far
    above the median, all below the median have to be low, so that the tail is that of ``x`` minus their mean.
    """
    noise = np.random.default_rng(0).standard_normal((waves, 40_000))
    spread = GAUSSIAN_MAD * float(np.median(np.abs(noise - np.median(noise, axis=0))))
    return math.sqrt(1.0 + 1.0 / (waves // 2 + 1)) / spread


def _in_own_spread(plane: FloatArray, good: BoolArray) -> FloatArray:
    """Values over the robust spread of their tile, or of the plane where that is larger."""
    if not good.any():
        return plane
    whole = float(np.median(np.abs(plane[good])))
    spread = np.full(plane.shape, whole)
    for top in range(0, plane.shape[0], TILE):
        for left in range(0, plane.shape[1], TILE):
            tile = slice(top, top + TILE), slice(left, left + TILE)
            inside = np.abs(plane[tile][good[tile]])
            if inside.size >= TILE:
                spread[tile] = max(whole, float(np.median(inside)))
    return np.asarray(plane / np.maximum(GAUSSIAN_MAD * spread, 1e-300))
