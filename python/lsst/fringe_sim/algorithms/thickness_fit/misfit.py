"""Model error in the likelihood of cells.

What a cell leaves over has the variance of its noise times a factor. The factors of a sensor are drawn from an
inverse chi-square distribution whose scale and tail are those of all its cells; summed over them, each cell has
Student's distribution (Lange, Little & Taylor 1989, J. Am. Stat. Assoc. 84, 881). A cell on a false minimum or across
a step has a large factor, and little say. These factors divided out, what is left over adds up as noise does, unless
cells err alike: how far they do is seen in the means of batches of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from ...array_types import FloatArray
from ...compiled import subkernel
from .templates import FlatTemplates

_TAILS = np.geomspace(2.0, 1024.0, 10)
"""Degrees of freedom that are tried; the likelihood changes little from one to the next."""
_ROUNDS = 25  # Steps of the scale towards the most probable one
_FEWEST_BATCHES = 16  # Batches whose means tell their variance to a tenth, at a dozen wavelengths


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


@subkernel(expand=True)
def improbability(chi2, freedom, scale, tail):  # type: ignore[no-untyped-def]
    """Twice the negative logarithm of Student's distribution of a cell, but for a constant."""
    return (tail + freedom) * np.log1p(max(chi2, 0.0) / (tail * scale))


@subkernel
def degrees_of_freedom(weight, item):  # type: ignore[no-untyped-def]
    """Degrees of freedom of a cell whose thickness is fitted."""
    number = 0
    for band in range(weight.shape[1]):
        number += 1 if weight[item, band] > 0.0 else 0
    return max(number - 1, 1)


def judge_cells(
    value: NDArray[np.float32],
    weight: NDArray[np.float32],
    templates: FlatTemplates,
    thickness_um: NDArray[np.floating],
    order_um: float,
) -> tuple[Misfit, FloatArray]:
    """How far cells are off beyond their noise, and how far they err alike: see `shared_variances`.

    ``value``, ``weight``: one row for each cell of ``thickness_um``, padded.
    """
    wavelengths = templates.n_wavelengths
    expected = templates.amplitude_at(thickness_um).T
    rest = np.sqrt(weight[:, :wavelengths]) * (value[:, :wavelengths] - expected)
    chi2 = (rest**2).sum(axis=1)
    misfit = Misfit.of(chi2, max(wavelengths - 1.0, 1.0))
    rest *= np.sqrt(misfit.trust(chi2))[:, None]
    return misfit, shared_variances(rest, thickness_um, order_um)


def shared_variances(rest: FloatArray, thickness_um: NDArray[np.floating], order_um: float) -> FloatArray:
    """Variance of sums over 1, 2, 4, ... cells, relative to that of cells which err each by itself; never falls.

    Cells beside each other may err alike, and those of the same phase of the fringes.

    ``rest``: what cells leave over, in standard deviations, ``(n_cells, n_wavelengths)``; ``thickness_um``: their
    thickness [µm], neighbours one after the other, ``(n_cells,)``; ``order_um``: thickness of a fringe [µm].
    """
    sizes = [1]
    while _FEWEST_BATCHES * 2 * sizes[-1] <= len(rest):
        sizes.append(2 * sizes[-1])
    most = np.ones(len(sizes))
    for order in (np.arange(len(rest)), np.argsort(thickness_um % order_um)):
        for at, size in enumerate(sizes[1:], 1):
            count = len(rest) // size
            means = rest[order[: count * size]].reshape(count, size, -1).mean(axis=1)
            most[at] = max(most[at], size * float(np.mean(means**2)))
    return np.maximum.accumulate(most)
