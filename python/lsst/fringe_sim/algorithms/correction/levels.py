"""How much the levels of the amplifiers of a frame differ, as the frame itself tells."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar

from ...array_types import FloatArray

__all__ = ["FREE_LEVELS", "LevelSpread"]

LEAST_MODE = 1e-9
"""Part of what the best known level says, below which one is a constant, which the smooth background has."""

DECADES = (-4.0, 8.0)
"""Powers of ten of the variance of the levels, over that with which the frame knows one, that are tried."""


@dataclass(frozen=True)
class LevelSpread:
    """Levels as draws from a normal distribution about a common one.

    Where the spread is small the levels vanish, and take nothing of the fringes; where it is large they are free.

    Attributes
    ----------
    precision : `float`
        Variance of the noise over that of the levels: what is added to the normal matrix of weighted pixels.
    noise : `float`
        Variance of the noise over that which the weights state.
    """

    precision: float = 0.0
    noise: float = 1.0

    @classmethod
    def of(
        cls,
        normal: FloatArray,
        beside: FloatArray,
        gram: FloatArray,
        amplifiers: tuple[int, int],
        pixels: int,
    ) -> LevelSpread:
        """The spread of largest likelihood, with background and templates free.

        Parameters
        ----------
        normal : `numpy.ndarray`, shape ``(P, P)``
            Normal matrix of the smooth background and of the levels of all quarters of amplifiers.
        beside : `numpy.ndarray`, shape ``(P, K + 1)``
            Products of these terms with K templates and the frame.
        gram : `numpy.ndarray`, shape ``(K + 1, K + 1)``
            Products of templates and frame.
        amplifiers : `tuple` [`int`, `int`]
            Amplifiers on top of and beside each other.
        pixels : `int`
            Pixels in use.

        Notes
        -----
        The residual maximum likelihood of Patterson & Thompson (1971, Biometrika 58, 545). Noise is what the halves
        of amplifiers differ by, if that is more than the noise of the pixels lets expect: fringes that no template
        has yet differ within amplifiers as they do between them.
        """
        known, said, left = _quarters(normal, beside, gram, 4 * amplifiers[0] * amplifiers[1])
        noise = max(left, 0.0) / max(pixels - len(normal) - len(gram) + 1, 1)
        noise = max(noise, _within(known, said, amplifiers))
        whole = np.kron(np.eye(amplifiers[0]), np.ones((2, 1)))
        whole = np.kron(whole, np.kron(np.eye(amplifiers[1]), np.ones((2, 1))))
        values, vectors = np.linalg.eigh(whole.T @ known @ whole)
        keep = values > LEAST_MODE * max(float(values[-1]), 1e-300)
        if not keep.any():
            return cls()
        squares = (vectors.T @ (whole.T @ said))[keep] ** 2 / max(noise, 1e-300)
        best = _largest_likelihood(values[keep], squares, float(np.mean(values[keep])))
        return cls(1.0 / best, noise)

    @property
    def scatter(self) -> float:
        """What the deviation of a level is in the right side of the normal equations."""
        return math.sqrt(self.precision * self.noise)

    def add_to(self, normal: FloatArray, levels: slice) -> None:
        """Expect the levels to lie about a common one."""
        diagonal = np.arange(len(normal))[levels] if self.precision else np.zeros(0, dtype=int)
        normal[diagonal, diagonal] += self.precision


FREE_LEVELS = LevelSpread()


def _quarters(
    normal: FloatArray, beside: FloatArray, gram: FloatArray, number: int
) -> tuple[FloatArray, FloatArray, float]:
    """Normal matrix and right side of the last terms, beside all others, and the squares that these leave."""
    first, last = np.arange(len(normal) - number), np.arange(len(normal) - number, len(normal))
    templates = beside[first, :-1]
    other = np.block([[normal[np.ix_(first, first)], templates], [templates.T, gram[:-1, :-1]]])
    diagonal = np.diag(other)
    # Templates that are one are refused later, by their name.
    other[np.diag_indices_from(other)] = np.where(diagonal > 0.0, diagonal * (1.0 + LEAST_MODE), 1.0)
    mixed = np.concatenate([normal[np.ix_(first, last)], beside[last, :-1].T])
    along = np.append(beside[first, -1], gram[:-1, -1])
    solved = scipy.linalg.solve(other, np.column_stack([mixed, along]), assume_a="pos")
    known = normal[np.ix_(last, last)] - mixed.T @ solved[:, :-1]
    known = 0.5 * (known + known.T)
    said = beside[last, -1] - mixed.T @ solved[:, -1]
    left = (
        gram[-1, -1] - along @ solved[:, -1] - said @ np.linalg.pinv(known, LEAST_MODE, hermitian=True) @ said
    )
    return known, said, float(left)


def _within(known: FloatArray, said: FloatArray, amplifiers: tuple[int, int]) -> float:
    """Mean square of the differences of halves of amplifiers, over the variance that weights let expect."""
    inverse = np.linalg.pinv(known, LEAST_MODE, hermitian=True)
    level = inverse @ said
    rows, columns = (np.eye(number) for number in amplifiers)
    found = []
    for down, across in (((1.0, 1.0), (1.0, -1.0)), ((1.0, -1.0), (1.0, 1.0))):
        halves = np.kron(np.kron(rows, [down]), np.kron(columns, [across]))
        variance = np.einsum("ij,jk,ik->i", halves, inverse, halves)
        some = variance > 0.0
        found.append(float(np.mean((halves @ level)[some] ** 2 / variance[some])) if some.any() else 0.0)
    return max(found)


def _largest_likelihood(values: FloatArray, squares: FloatArray, unit: float) -> float:
    """Variance of the levels over that of the noise of a pixel of weight 1."""

    def cost(power: float) -> float:
        ratio = 10.0**power / unit
        grown = 1.0 + ratio * values
        return float(np.log(grown).sum() - (ratio * squares / grown).sum())

    tried = np.linspace(*DECADES, 49)
    best = tried[np.argmin([cost(power) for power in tried])]
    found = minimize_scalar(cost, bounds=(best - 0.25, best + 0.25), method="bounded")
    return float(10.0**found.x / unit)
