"""Refinement of a thickness by Gauss-Newton steps on a fine table of templates."""

from __future__ import annotations

import numba
import numpy as np

__all__ = ["gauss_newton", "score"]

_MATH = {"reassoc", "contract", "arcp", "nsz"}


@numba.njit(cache=True, nogil=True, fastmath=_MATH)
def score(table, place, value, weight):  # type: ignore[no-untyped-def]
    """Score, information and chi-square at one place of the table, in units of its step.

    Parameters
    ----------
    table : float32, shape ``(n_thickness, padded wavelengths)``
        Template amplitudes.
    place : `float`
        Thickness in steps of the table; between 0 and ``n_thickness - 1``.
    value, weight : float32, shape ``(padded wavelengths,)``
        Amplitudes and inverse variances; weight 0 where there is none.

    Returns
    -------
    score, information, chi2 : `float`
        ``sum w g r``, ``sum w g²`` and ``sum w r²`` with the residual ``r`` and the slope ``g``.
    """
    below = min(int(place), table.shape[0] - 2)
    share = np.float32(place - below)
    low, high = table[below], table[below + 1]
    gain, information, chi2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for band in range(value.shape[0]):
        slope = high[band] - low[band]
        miss = value[band] - (low[band] + share * slope)
        leverage = weight[band] * slope
        gain += leverage * miss
        information += leverage * slope
        chi2 += weight[band] * miss * miss
    return gain, information, chi2


@numba.njit(cache=True, nogil=True, fastmath=_MATH)
def gauss_newton(table, place, value, weight, steps, longest):  # type: ignore[no-untyped-def]
    """Least chi-square near a place of the table.

    Parameters
    ----------
    table, value, weight
        As for `score`.
    place : `float`
        Where to begin.
    steps : `int`
        Largest number of steps; a step below a tenth of the standard deviation ends the search.
    longest : `float`
        Longest single step, in steps of the table.

    Returns
    -------
    place, information, chi2 : `float`
        Where it ended, information there, and chi-square after the last (quadratic) step.
    """
    top = table.shape[0] - 1.0
    information, chi2 = np.float32(0.0), np.float32(0.0)
    for _ in range(steps):
        gain, information, chi2 = score(table, place, value, weight)
        if information <= 0.0:
            break
        step = gain / information
        if abs(step) > longest:
            place = min(max(place + (longest if step > 0.0 else -longest), 0.0), top)
            continue
        moved = min(max(place + step, 0.0), top)
        if moved == place + step:
            chi2 -= gain * step
        place = moved
        if step * step * information < np.float32(0.01):
            break
    return place, information, chi2
