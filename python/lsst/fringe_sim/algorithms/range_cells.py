"""Cells of sky frames, and the polynomials that a map from a range is fitted with (`map_from_range`)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike, NDArray

from ..array_types import BoolArray, FloatArray
from ..blocks import block_sums

DEGREE, BACKGROUND_DEGREE = 8, 1
"""Degrees of the polynomials of the map and, along either side, of a background beside the fringes."""

PLANE_ORDERS = 0.125  # What a layer may depart from a plane over a window [orders]: 45 degrees of phase
LARGEST_TABLE = 2  # Orders beyond the range that the sky is asked for
TABLE_STEPS = 48  # Thicknesses in an order at which the sky is tabulated
PARTS = 16  # Parts along a side, in each of which the fringes must be seen


class Polynomial(NamedTuple):
    """Polynomials over a sensor, from -1 to 1 along each side."""

    rows: FloatArray
    columns: FloatArray

    @classmethod
    def of(cls, shape: tuple[int, ...]) -> Polynomial:
        """Of the pixels or cells of a sensor."""
        rows, columns = (
            np.asarray(legvander((np.arange(side) + 0.5) * 2.0 / side - 1.0, DEGREE), dtype=np.float64)
            for side in shape
        )
        return cls(rows, columns)

    def value(self, coefficient: FloatArray) -> FloatArray:
        """Map with these coefficients."""
        square = np.zeros((DEGREE + 1, DEGREE + 1))
        square[down_degrees(), across_degrees()] = coefficient
        return np.asarray(self.rows @ square @ self.columns.T)

    def sigma(self, covariance: FloatArray) -> FloatArray:
        """Uncertainty of the map."""
        found = np.empty((len(self.rows), len(self.columns)))
        across = self.columns[:, across_degrees()]
        for number, row in enumerate(self.rows):
            terms = row[down_degrees()] * across
            found[number] = np.sqrt(np.maximum(np.einsum("pi,ij,pj->p", terms, covariance, terms), 0.0))
        return found


def down_degrees() -> NDArray[np.int64]:
    """Degree along the columns of each term."""
    return np.array([i for i in range(DEGREE + 1) for _ in range(DEGREE + 1 - i)])


def across_degrees() -> NDArray[np.int64]:
    """Degree along the rows of each term."""
    return np.array([j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)])


class Seed(NamedTuple):
    """A plane in a window."""

    gain: float
    centre: tuple[float, float]
    thickness_um: float
    slope: tuple[float, float]


@dataclass(frozen=True, eq=False)
class FittedMap:
    """A map that was fitted."""

    coefficient: FloatArray
    covariance: FloatArray
    thickness_um: FloatArray
    residual2: FloatArray  # squared pulls of all cells
    followed: BoolArray
    level: FloatArray  # strength of the fringes, and the background

    @property
    def cost(self) -> float:
        """Sum of the squared pulls."""
        return float(self.residual2.sum())

    @property
    def misfit(self) -> float:
        """Mean of the squared pulls of the cells that are followed."""
        return float(np.mean(self.residual2[self.followed]))


@dataclass(frozen=True, eq=False)
class RangeCells:
    """Cells of the image, and what is expected of them."""

    shape: tuple[int, int]
    value: FloatArray
    weight: FloatArray
    place: FloatArray  # (cells, 2), from -1 to 1
    terms: FloatArray  # (cells, T) of the map
    background: FloatArray
    prior: FloatArray  # inverse variances of the coefficients
    middle: FloatArray
    range_um: tuple[float, float]
    order_um: float
    grid: FloatArray
    light: FloatArray
    slope: FloatArray
    radius: float  # of a window

    @classmethod
    def of(
        cls,
        image: FloatArray,
        weight: FloatArray,
        cell: int,
        range_um: tuple[float, float],
        predict: Callable[[FloatArray], ArrayLike],
        order_um: float,
    ) -> RangeCells:
        """Cells of one image, and the sky at the thicknesses of a range."""
        low, high = range_um
        weights = block_sums(weight, cell)
        value = block_sums(np.where(weight > 0.0, image, 0.0) * weight, cell) / np.maximum(weights, 1e-300)
        across = Polynomial.of(weights.shape)
        terms = np.einsum("yi,xj->yxij", across.rows, across.columns)[..., down_degrees(), across_degrees()]
        some = BACKGROUND_DEGREE + 1
        beside = np.einsum("yi,xj->yxij", across.rows[:, :some], across.columns[:, :some])
        degree = down_degrees() + across_degrees()
        # A layer that goes through its range, of which finer structure has less.
        spread = (high - low) / (1.0 + degree) ** 2
        margin = LARGEST_TABLE * order_um
        grid = np.arange(max(low - margin, 0.5 * low), high + margin, order_um / TABLE_STEPS)
        light = np.asarray(predict(grid), dtype=float)
        light = light / light.mean() - 1.0
        return cls(
            shape=(weights.shape[0], weights.shape[1]),
            value=value.ravel(),
            weight=weights.ravel(),
            place=np.stack(np.broadcast_arrays(across.rows[:, 1][:, None], across.columns[:, 1]), -1).reshape(
                -1, 2
            ),
            terms=terms.reshape(-1, degree.size),
            background=beside.reshape(weights.size, -1),
            prior=np.asarray(1.0 / spread**2, dtype=np.float64),
            middle=np.where(degree == 0, 0.5 * (low + high), 0.0),
            range_um=range_um,
            order_um=order_um,
            grid=grid,
            light=light,
            slope=np.gradient(light, grid),
            radius=1.2 * math.sqrt(PLANE_ORDERS * order_um / (high - low)),
        )

    def fringes(self, thickness_um: FloatArray) -> FloatArray:
        """Fringes of the dark sky, over the sky."""
        return np.asarray(np.interp(thickness_um, self.grid, self.light))

    def slopes(self, thickness_um: FloatArray) -> FloatArray:
        """Their derivative [1/µm]."""
        return np.asarray(np.interp(thickness_um, self.grid, self.slope))

    def differ(self, one: FittedMap, other: FittedMap) -> bool:
        """Whether two maps are a quarter of an order or more apart."""
        apart = (one.thickness_um - other.thickness_um)[other.followed]
        return bool(np.sqrt(np.mean(np.square(apart))) > 0.25 * self.order_um)

    def parts(self, along: int = PARTS) -> NDArray[np.int64]:
        """Part of the sensor of each cell."""
        row, column = (0.5 * (self.place + 1.0) * along).astype(int).T
        return np.asarray(row * along + column)
