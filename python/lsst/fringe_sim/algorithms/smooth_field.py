"""A smooth field over an image as splines, whose coefficients have a mean, tilts and a spread that is not known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from ..array_types import FloatArray

NEGLIGIBLE_WEIGHT = 1e-4
"""Spreads of less weight are left out of an average; they change it by less than this of a standard deviation."""


@dataclass(frozen=True, eq=False)
class Splines:
    """Tensor product of cubic B-splines over an image; without spans a constant."""

    rows: FloatArray  # (ny, k)
    columns: FloatArray  # (nx, l)
    spans: int

    @classmethod
    def of(cls, shape: tuple[int, ...], spans: int) -> Splines:
        """Splines with so many spans along each side."""
        rows, columns = (_basis(side, spans) for side in shape)
        return cls(rows, columns, spans)

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return self.rows.shape[1] * self.columns.shape[1]

    def surface(self, coefficient: FloatArray) -> FloatArray:
        """Value at every pixel."""
        inner = coefficient.reshape(self.rows.shape[1], self.columns.shape[1])
        return np.asarray(self.rows @ inner @ self.columns.T)

    def sums(self, image: FloatArray) -> FloatArray:
        """Sum of an image times each spline, ``(count,)``."""
        return np.asarray(self.rows.T @ image @ self.columns).ravel()

    def products(self, image: FloatArray) -> FloatArray:
        """Sum of an image times each pair of splines, ``(count, count)``."""
        k, m = self.rows.shape[1], self.columns.shape[1]
        along = (self.columns[:, :, None] * self.columns[:, None, :]).reshape(-1, m * m)
        across = (self.rows[:, :, None] * self.rows[:, None, :]).reshape(-1, k * k)
        pairs = (across.T @ (image @ along)).reshape(k, k, m, m)
        return np.asarray(pairs.transpose(0, 2, 1, 3)).reshape(k * m, k * m)

    def variance(self, covariance: FloatArray) -> FloatArray:
        """Variance of the surface of every pixel."""
        k, m = self.rows.shape[1], self.columns.shape[1]
        pairs = covariance.reshape(k, m, k, m).transpose(0, 2, 1, 3).reshape(k * k, m * m)
        along = (self.columns[:, :, None] * self.columns[:, None, :]).reshape(-1, m * m)
        across = (self.rows[:, :, None] * self.rows[:, None, :]).reshape(-1, k * k)
        return np.asarray(across @ pairs @ along.T)


def _basis(side: int, spans: int) -> FloatArray:
    if spans == 0:
        return np.ones((side, 1))
    knots = np.concatenate([[0.0] * 3, np.linspace(0.0, 1.0, spans + 1), [1.0] * 3])
    place = (np.arange(side) + 0.5) / side
    return np.asarray(BSpline.design_matrix(place, knots, 3).toarray())


def nearest_coefficients(splines: Splines, surface: FloatArray) -> FloatArray:
    """Coefficients of the surface nearest to another."""
    rows, columns = np.linalg.pinv(splines.rows), np.linalg.pinv(splines.columns)
    return np.asarray(rows @ surface @ columns.T).ravel()


def prior_covariance(splines: Splines, spread_um: float, reach_um: float) -> FloatArray:
    """Covariance of the coefficients: mean and tilts, as far as the map may be off, and a spread about them.

    The spread has parts that all of a row share, that all of a column share, and of each coefficient, equally large.
    """
    if splines.count == 1:
        return np.full((1, 1), reach_um**2)
    sides = (splines.rows.shape[1], splines.columns.shape[1])
    rows, columns = (np.eye(side) + 1.0 for side in sides)
    across, along = (np.linspace(-1.0, 1.0, side) for side in sides)
    plane = np.stack([np.ones(splines.count), np.repeat(across, sides[1]), np.tile(along, sides[0])])
    return np.asarray(spread_um**2 * np.kron(rows, columns) + reach_um**2 * (plane.T @ plane))


@dataclass(frozen=True, eq=False)
class Spread:
    """How large the spread of the coefficients may be, from the quadratic form of half the χ² about a point."""

    splines: Splines
    information: FloatArray
    linear: FloatArray  # half the χ² is a constant less ``linear @ c``, and ``0.5 c @ information @ c``
    spreads_um: FloatArray
    reach_um: float
    log_each: FloatArray  # log of the evidence of each spread, over the likelihood at the point

    @classmethod
    def of(
        cls,
        splines: Splines,
        information: FloatArray,
        gradient: FloatArray,
        coefficient: FloatArray,
        spreads_um: FloatArray,
        reach_um: float,
    ) -> Spread:
        """From the information on the coefficients and minus the gradient of half the χ² at a point."""
        linear = gradient + information @ coefficient
        at_zero = -float(gradient @ coefficient) - 0.5 * float(coefficient @ information @ coefficient)
        tried = spreads_um if splines.count > 1 else spreads_um[:1]
        logs = []
        for spread in tried:
            root = np.linalg.cholesky(prior_covariance(splines, float(spread), reach_um))
            factor = cho_factor(np.eye(splines.count) + root.T @ information @ root, lower=True)
            side = root.T @ linear
            gain = 0.5 * float(side @ cho_solve(factor, side))
            logs.append(at_zero + gain - float(np.log(np.diag(factor[0])).sum()))
        return cls(splines, information, linear, tried, reach_um, np.array(logs))

    @property
    def likeliest(self) -> float:
        """Spread of the largest evidence [µm]."""
        return float(self.spreads_um[self.log_each.argmax()])

    @property
    def log_evidence(self) -> float:
        """Averaged over the spreads, each factor between them counting alike."""
        return float(logsumexp(self.log_each)) - math.log(self.log_each.size)

    def posterior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of the coefficients, whatever the spread is."""
        weights = np.exp(self.log_each - logsumexp(self.log_each))
        parts = []
        for weight, spread in zip(weights, self.spreads_um, strict=True):
            if weight > NEGLIGIBLE_WEIGHT:
                inverse = np.linalg.inv(prior_covariance(self.splines, float(spread), self.reach_um))
                covariance = np.asarray(np.linalg.inv(self.information + inverse), dtype=float)
                parts.append((weight, covariance @ self.linear, covariance))
        total = sum(weight for weight, *_ in parts)
        mean = np.asarray(sum(weight * middle for weight, middle, _ in parts) / total)
        spread_of = [w * (c + np.outer(m - mean, m - mean)) for w, m, c in parts]
        return mean, np.asarray(np.sum(spread_of, axis=0) / total)
