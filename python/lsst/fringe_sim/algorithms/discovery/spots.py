"""Round spots in which all exposures lack or exceed the same part of the light: no effect of the catalogue is one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.special import ndtr

from ...array_types import FloatArray
from .channels import Channel

RADII = (3.0, 4.5, 7.0, 10.0, 15.0)
"""Standard deviations of the spots that are looked for [cells]; larger ones are patterns of large scale."""

LEAST_SEEN = 0.25  # Part of a spot that must lie on cells with data

MOST_SPOTS = 6

WORTH_FITTING = 12.0  # Fall of χ² that a further spot must promise

DEPTHS = math.log(1e3)
"""Range of the logarithm of the depth that a spot may have: equal chances from 0.01 to 10 per cent."""


@dataclass(frozen=True, eq=False)
class SpotScores:
    """Derivative and curvature of the likelihood with respect to the response of every cell.

    Beside the thickness of the cell, and beside the level that all have in common.
    """

    score: FloatArray
    information: FloatArray

    @classmethod
    def beside_level(cls, score: FloatArray, information: FloatArray, correlation: float) -> SpotScores:
        """From those of every cell beside its thickness ``(ny, nx)``."""
        inflation = 1.0 + 4.0 * max(correlation, 0.0)
        beside = score - float(score.sum() / information.sum()) * information
        return cls(beside / inflation, information / inflation)

    def channel(self) -> Channel:
        """Test of the strongest spot anywhere on the sensor.

        What is in one place is diluted among the patterns of the whole sensor. The chance that noise has a maximum as
        high is the mean Euler characteristic of a smooth Gaussian field [1]_, added up over the sizes.

        .. [1] Worsley et al. 1996, Human Brain Mapping 4, 58
        """
        largest = max((found[0] for found in self.maxima()), default=0.0)
        chance = sum(
            _chance_of_maximum(math.sqrt(largest), self.shape, math.sqrt(2.0) * radius)
            for radius in self.radii
        )
        return Channel("spots", largest, 1.0, min(chance, 1.0))

    def evidence(self) -> float:
        """What a few spots would bring if they were in the model: log evidence over that of a fit without them.

        They are added one by one where they bring most, fitted together, and place, size and depth of each integrated
        by the Laplace approximation: equal chances for every place, for the logarithm of the size and for that of the
        depth.
        """
        spots: FloatArray = np.zeros((0, 4))
        best = 0.0
        for _ in range(MOST_SPOTS):
            chi2, first = max(self.beside(spots).maxima(), default=(0.0, (0.0, 0.0, 0.0, 0.0)))
            if chi2 < WORTH_FITTING:
                break
            spots = self.fitted(np.vstack([spots, first]))
            evidence = self.log_evidence(spots)
            if evidence < best:
                break
            best = evidence
        return best

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        rows, columns = self.score.shape
        return rows, columns

    @property
    def radii(self) -> tuple[float, ...]:
        """Those of the spots that fit on the sensor [cells]."""
        return tuple(radius for radius in RADII if 4.0 * radius <= min(self.shape))

    def maxima(self) -> Iterator[tuple[float, tuple[float, float, float, float]]]:
        """Fall of χ² of the best spot of every size, and the spot: row, column, log of the radius, depth."""
        for radius in self.radii:
            amount, variance = self._filtered(radius)
            fall = np.divide(amount**2, variance, out=np.zeros(self.shape), where=variance > 0.0)
            y, x = np.unravel_index(int(np.argmax(fall)), self.shape)
            depth = amount[y, x] / max(variance[y, x], 1e-300)
            yield float(fall[y, x]), (float(y), float(x), math.log(radius), float(depth))

    def beside(self, spots: FloatArray) -> SpotScores:
        """The same with spots in the model."""
        return replace(self, score=self.score - self.information * self._pattern(spots))

    def fitted(self, spots: FloatArray) -> FloatArray:
        """The spots where they explain most together."""
        low = np.tile([0.0, 0.0, math.log(RADII[0] / 1.5), -np.inf], len(spots))
        high = np.tile([*np.subtract(self.shape, 1.0), math.log(1.5 * RADII[-1]), np.inf], len(spots))
        found = least_squares(
            lambda flat: self._misfit(flat.reshape(-1, 4)).ravel(),
            np.clip(spots.ravel(), low + 1e-6, high - 1e-6),
            bounds=(low, high),
            x_scale=np.tile([3.0, 3.0, 0.3, 1e-3], len(spots)),
            max_nfev=30,
        )
        return np.asarray(found.x.reshape(-1, 4))

    def log_evidence(self, spots: FloatArray) -> float:
        """Log evidence of spots at their best."""
        misfit = self._misfit(spots)
        fall = float((self._misfit(spots[:0]) ** 2).sum() - (misfit**2).sum())
        steps = np.tile([0.05, 0.05, 0.01, 0.0], len(spots)) + np.where(
            np.arange(spots.size) % 4 == 3, 1e-5, 0.0
        )
        slopes = []
        for number, step in enumerate(steps):
            moved = spots.ravel().copy()
            moved[number] += step
            slopes.append((self._misfit(moved.reshape(-1, 4)) - misfit).ravel() / step)
        jacobian = np.stack(slopes)
        curvature = np.linalg.slogdet(jacobian @ jacobian.T + 1e-12 * np.eye(len(steps)))[1]
        choices = self.shape[0] * self.shape[1] * math.log(RADII[-1] / RADII[0]) * 2.0 * DEPTHS
        volume = float(np.log(choices * np.abs(spots[:, 3])).sum())
        return (
            0.5 * fall + 2.0 * len(spots) * math.log(2.0 * math.pi) - 0.5 * float(curvature) - volume
            + math.lgamma(len(spots) + 1.0)
        )  # fmt: skip

    def _misfit(self, spots: FloatArray) -> FloatArray:
        """Response of the cells beside spots, over its noise."""
        root = np.sqrt(self.information)
        response = np.divide(self.score, root, out=np.zeros(self.shape), where=root > 0.0)
        return response - root * self._pattern(spots)

    def _pattern(self, spots: FloatArray) -> FloatArray:
        """Sum of spots beside the common level."""
        total = np.zeros(self.shape)
        for y, x, log_radius, depth in spots:
            radius = math.exp(log_radius)
            down = np.exp(-0.5 * ((np.arange(self.shape[0]) - y) / radius) ** 2)
            along = np.exp(-0.5 * ((np.arange(self.shape[1]) - x) / radius) ** 2)
            total += depth * np.outer(down, along)
        return np.asarray(total - float((total * self.information).sum() / self.information.sum()))

    def _filtered(self, radius: float) -> tuple[FloatArray, FloatArray]:
        """Score and curvature of spots at every place; those of hardly any data have none."""
        area = 2.0 * math.pi * radius**2
        amount = gaussian_filter(self.score, radius, mode="constant") * area
        wide = gaussian_filter(self.information, radius, mode="constant") * area
        # The square of a Gaussian is one of half the variance.
        narrow = gaussian_filter(self.information, radius / math.sqrt(2.0), mode="constant")
        enough = narrow > LEAST_SEEN * float(self.information.mean())
        variance = 0.5 * area * narrow - wide**2 / float(self.information.sum())
        return amount, np.where(enough, np.maximum(variance, 0.0), 0.0)


def _chance_of_maximum(height: float, shape: tuple[int, ...], length: float) -> float:
    """Mean Euler characteristic of where the absolute value of a Gaussian field of unit variance is above a height.

    The correlation of the field falls with distance ``d`` as ``exp(-d² / (2 length²))``.
    """
    density = math.exp(-0.5 * height**2)
    inside = shape[0] * shape[1] / length**2 * height / (2.0 * math.pi) ** 1.5 * density
    along_edges = (shape[0] + shape[1]) / length / (2.0 * math.pi) * density
    return 2.0 * (inside + along_edges + float(ndtr(-height)))
