"""Model error in the likelihood of cells.

What a cell leaves over has the variance of its noise times a factor. The factors of a sensor are drawn from an
inverse chi-square distribution whose scale and tail are those of all its cells; summed over them, each cell has
Student's distribution (Lange, Little & Taylor 1989, J. Am. Stat. Assoc. 84, 881). A cell on a false minimum or across
a step has a large factor, and little say. These factors divided out, what is left over adds up as noise does, unless
cells err alike: how far they do is seen in the means of batches of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

__all__ = ["Misfit", "shared_variances"]

FloatArray = NDArray[np.float64]

_TAILS = np.geomspace(2.0, 1024.0, 10)
"""Degrees of freedom that are tried; the likelihood changes little from one to the next."""
_ROUNDS = 25
"""Steps of the scale towards the most probable one."""
_FEWEST_BATCHES = 16
"""Batches whose means tell their variance to a tenth, at a dozen wavelengths."""


@dataclass(frozen=True)
class Misfit:
    """Distribution of the factors on the variance: their scale, and the degrees of freedom of their tail."""

    scale: float
    tail: float
    freedom: float

    @classmethod
    def of(cls, chi2: FloatArray, freedom: float) -> Misfit:
        """The most probable one, given the chi-square of each cell; noise is never less than what is stated."""
        if chi2.size == 0:
            return cls(1.0, float(_TAILS[-1]), freedom)
        scale = np.full(_TAILS.size, max(float(np.median(chi2)) / freedom, 1.0))
        for _ in range(_ROUNDS):
            share = (_TAILS + freedom) / (_TAILS * scale + chi2[:, None])
            scale = np.maximum(scale * (share * chi2[:, None]).mean(axis=0) / freedom, 1.0)
        tried = [cls(float(s), float(tail), freedom) for s, tail in zip(scale, _TAILS, strict=True)]
        return min(tried, key=lambda each: each.cost(chi2))

    def trust(self, chi2: FloatArray) -> FloatArray:
        """Expected inverse of the factor of each cell."""
        return (self.tail + self.freedom) / (self.tail * self.scale + chi2)

    def cost(self, chi2: FloatArray) -> float:
        """Twice the negative logarithm of the probability of all cells, but for a constant of the flats."""
        tail, freedom = self.tail, self.freedom
        norm = gammaln(0.5 * tail) - gammaln(0.5 * (tail + freedom)) + 0.5 * freedom * np.log(0.5 * tail)
        each = freedom * np.log(self.scale) + (tail + freedom) * np.log1p(chi2 / (tail * self.scale))
        return float(each.sum() + 2.0 * norm * chi2.size)


def shared_variances(rest: FloatArray, orders: Iterable[NDArray[np.intp]]) -> FloatArray:
    """Variance of sums over 1, 2, 4, ... cells, relative to that of cells which err each by itself; never falls.

    Parameters
    ----------
    rest : `numpy.ndarray`, shape ``(n_cells, n_wavelengths)``
        What cells leave over, in standard deviations.
    orders : iterable of `numpy.ndarray` of `int`
        Rows of cells in which neighbours may err alike.
    """
    sizes = [1]
    while _FEWEST_BATCHES * 2 * sizes[-1] <= len(rest):
        sizes.append(2 * sizes[-1])
    most = np.ones(len(sizes))
    for order in orders:
        for at, size in enumerate(sizes[1:], 1):
            count = len(rest) // size
            means = rest[order[: count * size]].reshape(count, size, -1).mean(axis=1)
            most[at] = max(most[at], size * float(np.mean(means**2)))
    return np.maximum.accumulate(most)
