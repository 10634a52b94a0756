"""Quick comparison of models with data: on a part of the cells, with what is free at each wavelength taken out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...array_types import FloatArray

SAMPLED_CELLS, FEW_CELLS = 400, 150
"""Cells on which a start is followed, and on which many starts are compared; the best are fitted to all cells."""


def sampled_part(cells: int, wanted: int = SAMPLED_CELLS) -> tuple[slice, slice, slice]:
    """Every so many rows and columns of planes, for about as many cells as wanted."""
    stride = max(1, math.isqrt(cells // wanted))
    return slice(None), slice(None, None, stride), slice(None, None, stride)


def fringe_order_um(wavelength_nm: FloatArray, index: float) -> float:
    """Thickness from one fringe to the next at the middle wavelength, for a refractive index [µm]."""
    return 1e-3 * float(np.median(wavelength_nm)) / (2.0 * index)


def local_minima(values: FloatArray) -> NDArray[np.intp]:
    """Places of values than which neither neighbour is lower."""
    return np.flatnonzero(np.r_[True, values[1:] <= values[:-1]] & np.r_[values[:-1] <= values[1:], True])


def chi2_with_free_levels(model: FloatArray, value: FloatArray, weight: FloatArray) -> float:
    """χ² with the best level at each wavelength; all ``(W, ny, nx)``."""
    square = (weight * model**2).sum(axis=(1, 2))
    product = (weight * model * value).sum(axis=(1, 2))
    level = np.divide(product, square, out=np.ones(len(square)), where=square > 0.0)
    return float((weight * (value - level[:, None, None] * model) ** 2).sum())


def chi2_with_free_fringes(
    models: FloatArray, value: FloatArray, weight: FloatArray, strongest: float = math.inf
) -> FloatArray:
    """χ² of several models, with the best level and the best contrast, not a negative one, at each wavelength.

    ``models`` (W, S, ny, nx). ``value``, ``weight`` (W, ny, nx). ``strongest``: largest contrast, relative to the
    models'. Returns (S,).
    """
    waves = len(value)
    weights = weight.reshape(waves, -1, 1)
    total = np.maximum(weights.sum(axis=1), 1e-300)
    data = value.reshape(waves, -1, 1)
    rest = data - (weights * data).sum(axis=1, keepdims=True) / total[:, None]
    flat = models.reshape(waves, models.shape[1], -1)
    # Fringes are small: sums of squares are taken about a common middle.
    flat = flat - ((flat[:, :1] @ weights) / total[:, None])
    cross, mean = (flat @ (weights * rest))[..., 0], (flat @ weights)[..., 0] / total
    square = np.einsum("wsn,wsn,wn->ws", flat, flat, weights[..., 0]) - mean**2 * total
    best = np.divide(np.maximum(cross, 0.0), square, out=np.zeros_like(cross), where=square > 0.0)
    contrast = np.minimum(best, strongest)
    return np.asarray((weights * rest**2).sum() - (contrast * (2.0 * cross - contrast * square)).sum(axis=0))
