"""Whether a frame holds the fringes of the templates at all."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import logsumexp

from ...array_types import FloatArray

__all__ = ["log_evidence"]


def log_evidence(scale: FloatArray, covariance: FloatArray, blocks: int) -> float:
    """Logarithm of how much more probable the frame is with the templates than without; above 0 they are seen.

    Parameters
    ----------
    scale : `numpy.ndarray`, shape ``(K,)``
        Scales of the templates.
    covariance : `numpy.ndarray`, shape ``(K, K)``
        Their covariance, from the scatter between blocks.
    blocks : `int`
        Number of blocks.

    Notes
    -----
    Against the frame without fringes stand K + 1 equally probable ones: each template alone, and all of them.
    The prior of scales has the width that one block would give them (Zellner's g-prior with unit information;
    equation 6 of Liang et al. 2008, JASA 103, 410, doi 10.1198/016214507000001337), so that a scale has to be further
    from 0 the more ways there are to find one by chance, and the more pixels tell it.
    """
    sigma = np.sqrt(np.diag(covariance))
    if not scale.size:
        return -math.inf
    if not (sigma > 0.0).all():
        return math.inf if scale.any() else -math.inf
    information = np.linalg.pinv(covariance / np.outer(sigma, sigma), hermitian=True)
    pull = scale / sigma
    along = information @ pull
    looks = [_log_bayes_factor(float(pull @ along), scale.size, blocks)]
    if scale.size > 1:
        # The best fit of one template, the scales of all others being 0.
        squares = along**2 / np.diag(information)
        looks += [_log_bayes_factor(float(square), 1, blocks) for square in squares]
    return float(logsumexp(looks) - math.log(len(looks)))


def _log_bayes_factor(t2: float, terms: int, blocks: int) -> float:
    """Of as many terms, of which Hotelling's statistic is known, against none."""
    free = blocks - 1 - terms
    unexplained = free / (free + t2)
    more, all_blocks = math.log1p(blocks), blocks - 1
    return 0.5 * (free * more - all_blocks * math.log1p(blocks * unexplained))
