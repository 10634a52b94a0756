"""Comparison of models with data where level and contrast are free at each wavelength."""

from __future__ import annotations

import math

import numpy as np

from ...array_types import FloatArray


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
