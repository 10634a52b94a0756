"""Levels of the OH bands and of the background in one frame, whatever the thickness is."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from ..array_types import FloatArray

Predictor = Callable[[FloatArray], FloatArray]

BAND_SIGMA = 1.0
"""Fringes of a band in a frame over those of the dark sky are 1, give or take this, and not negative: bands change by
half and more (Noll et al. 2015, doi 10.5194/acp-15-3647-2015), and a sensor may show less contrast than its model."""

_POWERS = tuple((y, x) for y, x in itertools.product(range(3), range(3)) if y + x <= 2)


def levels_of(products: FloatArray, side: FloatArray, bands: int) -> tuple[FloatArray, FloatArray, float]:
    """Strength of bands and terms of the background, their covariance, and the log of its inverse's determinant.

    A band that would be negative is not there, and has no freedom.
    """
    prior = np.where(np.arange(side.size) < bands, BAND_SIGMA**-2.0, 0.0)
    there = np.ones(side.size, dtype=bool)
    matrix = products + np.diag(prior)
    log_det = float(np.linalg.slogdet(matrix)[1])
    while True:
        kept = np.flatnonzero(there)
        inverse = np.zeros_like(matrix)
        inverse[np.ix_(kept, kept)] = np.linalg.inv(matrix[np.ix_(kept, kept)])
        level = inverse @ (side + prior)
        negative = there & (level < 0.0) & (prior > 0.0)
        if not negative.any():
            return level, inverse, log_det
        there &= ~negative


def background_terms(shape: tuple[int, ...]) -> FloatArray:
    """Polynomials of second degree over an image, ``(6, ny, nx)``."""
    y, x = (np.linspace(-1.0, 1.0, side) for side in shape)
    return np.stack([np.outer(y**row, x**column) for row, column in _POWERS])


def thinned(predict: Predictor, layer_um: FloatArray, thin: int) -> Predictor:
    """Predictions of every ``thin``-th pixel, whose places in the field are those of the whole image."""
    if thin == 1:
        return predict

    def of_some(thickness_um: FloatArray) -> FloatArray:
        whole = np.repeat(np.repeat(thickness_um, thin, axis=0), thin, axis=1)
        return predict(whole[: layer_um.shape[0], : layer_um.shape[1]])[:, ::thin, ::thin]

    return of_some
