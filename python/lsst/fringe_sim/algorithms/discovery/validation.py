"""Which part of the data is held out, and how far from the model data are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from ...array_types import FloatArray
from .verdict import CONFIDENCE

BLOCKS_ACROSS = 8
FEWEST_ROWS = 12
"""Blocks along a side of the sensor that are held out or not, and the rows of cells from which on there are any."""

FEWEST_WAVELENGTHS = 8  # Wavelengths from which on every fourth is left out at once


def size_beyond(parts: Sequence[tuple[float, float, float]], pattern: FloatArray) -> dict[str, float]:
    """Size of what is left beyond noise, as `Verdict.size` states it.

    Noise of single exposures and noise that all of them share, the scatter of the response of the cells, are compared
    with what is left of each: what all exposures share is lost in χ² where the response scatters. The limit takes
    the sum for a multiple of one chi-square (Satterthwaite 1946, doi 10.2307/3002019). Noise that happens to be small
    gives no limit below that of mean noise: power-constrained limits of Cowan et al. 2011.

    ``parts``: variance of a value by noise, χ² and degrees of freedom, of each kind of noise. ``pattern`` (W, N): the
    model over its level, of cells with data.
    """
    variance, chi2, freedom = np.array(parts).T
    noise, left = float(variance.sum()), float((variance * chi2 / freedom).sum())
    degrees = noise**2 / float((variance**2 / freedom).sum())
    counts = math.sqrt(max(left - noise, 0.0))
    most = math.sqrt(max(max(left, noise) * degrees / float(chdtri(degrees, CONFIDENCE)) - noise, 0.0))
    fringes = math.sqrt(float(pattern.var(axis=1).mean())) if pattern.size else 0.0
    return {
        "of_counts": counts,
        "of_fringes": counts / fringes if fringes > 0.0 else math.nan,
        "of_fringes_at_most": most / fringes if fringes > 0.0 else math.nan,
    }
