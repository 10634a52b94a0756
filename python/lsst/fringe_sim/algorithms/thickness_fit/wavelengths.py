"""How far wavelengths are off their labels: their common error, to which nothing but the labels testifies.

A layer that is thicker by some part shows the same fringes at wavelengths that are longer by about that part, so the
flats tell only how far the wavelengths are off relative to each other. How wide they scatter about their labels, and
whether a single one is far off, is found from the offsets themselves: they are drawn from Student's distribution,
whose width is probable up to what is stated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...array_types import FloatArray

_LEAST_SHIFT_NM = 0.02  # Least standard deviation of the wavelengths: that of a calibrated monochromator
_TAIL = 6.0  # Degrees of freedom of Student's distribution: now and then a wavelength is far off
_WIDTHS, _PLACES, _ZOOMS = 25, 101, 3
"""Steps of the sums over width and common error; a width is known to about a fifth, three steps of it."""


@dataclass(frozen=True)
class CommonError:
    """What all wavelengths are off by, given how far they are off relative to each other."""

    # mean_nm, sigma_nm: what is to be added to all offsets, and its standard uncertainty [nm]
    mean_nm: float
    sigma_nm: float
    cost: float  # twice the negative logarithm of the probability of the relative offsets


def common_error(shift_nm: FloatArray, along: FloatArray, accuracy_nm: float) -> CommonError:
    """Common error of the wavelengths, summed over it and over the width of their distribution.

    ``shift_nm``: offsets that fit the flats [nm], ``(n_wavelengths,)``; ``along``: what may be added to them
    without any effect on the flats, ``(n_wavelengths,)``; ``accuracy_nm``: stated standard deviation of the
    wavelengths about their labels [nm].
    """
    widths = np.geomspace(*_range_of_widths(accuracy_nm), _WIDTHS)
    roots = -shift_nm / along
    beyond = float(np.ptp(roots)) + 4.0 * _LEAST_SHIFT_NM
    low, high = float(roots.min()) - beyond, float(roots.max()) + beyond
    for _ in range(_ZOOMS):
        common = np.linspace(low, high, _PLACES)
        moved = shift_nm + common[:, None] * along
        cost = _cost(moved[None], widths[:, None], accuracy_nm)
        least = float(cost.min())
        share = np.exp(-0.5 * (cost - least)).sum(axis=0)
        total, step = float(share.sum()), float(common[1] - common[0])
        share /= total
        mean = float(share @ common)
        sigma = float(np.sqrt(share @ (common - mean) ** 2))
        reach = max(8.0 * sigma, 2.0 * step)
        low, high = mean - reach, mean + reach
    return CommonError(mean, sigma, least - 2.0 * float(np.log(total * step)))


def spread_of_wavelengths(shift_nm: FloatArray, accuracy_nm: float = np.inf) -> float:
    """Most probable standard deviation of most wavelengths about their labels [nm]."""
    accuracy_nm = min(accuracy_nm, max(float(np.abs(shift_nm).max()), _LEAST_SHIFT_NM))
    widths = np.geomspace(*_range_of_widths(accuracy_nm), 2 * _WIDTHS)
    return float(widths[np.argmin(_cost(shift_nm, widths, accuracy_nm))])


def shift_precision(shift_nm: FloatArray, accuracy_nm: float) -> FloatArray:
    """Precision of a normal prior of each wavelength with the slope of the true one where the offsets stand."""
    if not np.any(shift_nm):
        return np.full(shift_nm.shape, accuracy_nm**-2.0)
    width = spread_of_wavelengths(shift_nm, accuracy_nm)
    return np.asarray((_TAIL + 1.0) / (_TAIL * width**2 + shift_nm**2))


def _cost(shift_nm: FloatArray, width_nm: FloatArray, accuracy_nm: float) -> FloatArray:
    """Twice the negative logarithm of the probability of offsets and of the width of their distribution."""
    width = width_nm[..., None]
    tail = (_TAIL + 1.0) * np.log1p(shift_nm**2 / (_TAIL * width**2)) + 2.0 * np.log(width)
    return np.asarray(tail.sum(axis=-1) + (width_nm / accuracy_nm) ** 2)


def _range_of_widths(accuracy_nm: float) -> tuple[float, float]:
    """Least and largest standard deviation that is possible where some accuracy is stated [nm]."""
    return min(_LEAST_SHIFT_NM, accuracy_nm), 3.0 * accuracy_nm
