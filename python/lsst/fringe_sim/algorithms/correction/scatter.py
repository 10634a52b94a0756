"""Covariance of the scores of a fit, from the scatter between blocks of pixels and what is alike in several blocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from .sums import FrameSums, Solution

__all__ = ["score_covariance"]

FloatArray = NDArray[np.float64]


def score_covariance(sums: FrameSums, solution: Solution) -> FloatArray:
    """Covariance of the sums of products of templates and noise, shape ``(K, K)``.

    Notes
    -----
    The sum over blocks of the products of their scores (Liang & Zeger 1986, Biometrika 73, 13) holds for noise that is
    correlated within a block. Halos of stars and the light of faint sources are correlated from block to block, which
    matters for templates that change as slowly (Conley 1999, J. Econometrics 92, 1). Score products of
    pairs of blocks would be too few to tell: the correlation of the means of the residual over blocks, as a
    function of their distance alone, is taken between the sums of the templates over blocks. A background that was
    fitted makes distant blocks opposite; what would narrow the errors is therefore left out.
    """
    number = solution.scale.size
    if not number:
        return np.zeros((0, 0))
    score = np.array([sums.by_block(each).ravel() for each in sums.products(solution)])
    pixels = int(sums.pixels.sum())
    filled = np.count_nonzero(sums.by_block(sums.pixels))
    free = pixels - len(sums.background) - number
    within = score @ score.T * (filled / (filled - 1) * pixels / free)
    weight, residual, *patterns = (sums.by_block(each) for each in sums.totals(solution))
    along = _correlated(residual, weight)
    between = np.array([[float((along * _lagged(a, b)).sum()) for b in patterns] for a in patterns])
    return np.asarray(within + _widening(0.5 * (between + between.T), within))


def _correlated(residual: FloatArray, weight: FloatArray) -> FloatArray:
    """Covariance of the means of two blocks, by the lag between them; 0 for a block and itself."""
    products, pairs = _lagged(residual, residual), _lagged(weight, weight)
    rows, columns = (np.fft.fftfreq(size, 1.0 / size) for size in products.shape)
    distance = np.rint(np.hypot(rows[:, np.newaxis], columns)).astype(int)
    flat = distance.ravel()
    total, number = np.bincount(flat, products.ravel()), np.bincount(flat, np.maximum(pairs, 0.0).ravel())
    mean = np.divide(total, number, out=np.zeros_like(total), where=number > 0.0)[distance]
    mean[0, 0] = 0.0
    return np.asarray(mean)


def _lagged(one: FloatArray, other: FloatArray) -> FloatArray:
    """Sum over all pairs of blocks of a product, by the lag between them."""
    size = 2 * one.shape[0], 2 * one.shape[1]
    return np.asarray(irfft2(rfft2(one, size).conj() * rfft2(other, size), size))


def _widening(between: FloatArray, within: FloatArray) -> FloatArray:
    """The part of a covariance that widens another one."""
    values, vectors = np.linalg.eigh(within)
    known = values > np.finfo(float).eps * len(values) * values[-1]
    root = vectors[:, known] * np.sqrt(values[known])
    inverse = vectors[:, known] / np.sqrt(values[known])
    more, turn = np.linalg.eigh(inverse.T @ between @ inverse)
    wider = root @ turn
    return np.asarray((wider * np.maximum(more, 0.0)) @ wider.T)
