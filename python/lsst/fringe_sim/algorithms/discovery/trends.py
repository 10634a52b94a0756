"""Errors that are said to be draws, one for each exposure, but follow a smooth curve in wavelength."""

from __future__ import annotations

import numpy as np
from scipy.special import fdtrc

from ...array_types import FloatArray
from .channels import Channel

ORDER = 3  # Order of the polynomial in wavelength that draws do not follow

FEWEST_DRAWS = 6

WIDTHS = np.geomspace(1e-3, 1e3, 121)
"""Widths of the distribution of the draws that are tried, in their typical size."""


def trend_channel(name: str, wavelength_nm: FloatArray, error: FloatArray, covariance: FloatArray) -> Channel:
    """Test that errors of single exposures are draws of one distribution, against a cubic in wavelength.

    What moves fringes smoothly with wavelength is in all exposures alike. It is no accident of each, though free
    errors of all exposures explain it. An error that all have in common is left to the draws.

    ``wavelength_nm`` (N,): where the errors are; `FEWEST_DRAWS` at least. ``error`` (N,). ``covariance`` (N,
    N): how well they are known, all else free. Returns the F test in units in which errors scatter alike; the width
    of the distribution is the likeliest beside the polynomial (REML).
    """
    place = wavelength_nm - wavelength_nm.mean()
    shapes = np.vander(place / max(float(np.abs(place).max()), 1e-300), ORDER + 1, increasing=True)
    size = max(float(np.sqrt((error**2).mean())), 1e-300)
    identity = np.eye(len(error))
    fits = [_whitened_fit(shapes, error, covariance + (width * size) ** 2 * identity) for width in WIDTHS]
    beside = max(fits, key=lambda each: each[0])
    _, flat, smooth = beside
    left = len(error) - ORDER - 1
    statistic = (flat - smooth) / ORDER / max(smooth / left, 1e-300)
    return Channel(name, ORDER * statistic, float(ORDER), float(fdtrc(ORDER, left, max(statistic, 0.0))))


def _whitened_fit(
    shapes: FloatArray, error: FloatArray, covariance: FloatArray
) -> tuple[float, float, float]:
    """Log of the restricted likelihood of the curve, and χ² of a constant and of the curve."""
    root = np.linalg.cholesky(covariance)
    white, wanted = np.linalg.solve(root, shapes), np.linalg.solve(root, error)
    smooth, flat = _left(white, wanted), _left(white[:, :1], wanted)
    freedom = 2.0 * np.log(np.diag(root)).sum() + np.linalg.slogdet(white.T @ white)[1]
    return -0.5 * (smooth + float(freedom)), flat, smooth


def _left(columns: FloatArray, wanted: FloatArray) -> float:
    coefficients = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return float(((wanted - columns @ coefficients) ** 2).sum())
