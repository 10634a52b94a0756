"""What a frame holds beside fringes and objects: a smooth surface and steps between amplifiers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from ...errors import OutOfRangeError

__all__ = ["AmplifierGrid", "BackgroundTerms"]

FloatArray = NDArray[np.float64]

SPACING_PX = 256.0
"""Distance between the knots of the surface [px]: what is smaller than it is left to the fringes."""

_DEGREE = 3
_ROWS = 256
"""Rows that are converted to float64 at a time."""


@dataclass(frozen=True)
class AmplifierGrid:
    """Amplifiers of equal size, each of which may have a level of its own.

    Attributes
    ----------
    rows, columns : `int`
        Amplifiers on top of and beside each other.
    """

    rows: int = 1
    columns: int = 1

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise OutOfRangeError("amplifiers", (self.rows, self.columns), "1 or more each")


ONE_AMPLIFIER = AmplifierGrid()


class BackgroundTerms:
    """Linear terms of a background, each a function of the row times a function of the column.

    The surface is a tensor product of cubic B-splines; the level of an amplifier is 1 on it and 0 elsewhere.
    Sums over the pixels of the image are therefore products of small matrices, however large the image is.

    Parameters
    ----------
    shape : `tuple` [`int`, `int`]
        Rows and columns of the image.
    spacing_px : `float`, optional
        Distance between the knots of the surface [px]; a side that is shorter gets one cubic.
    amplifiers : `AmplifierGrid`, optional
        Amplifiers with levels of their own.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        spacing_px: float = SPACING_PX,
        amplifiers: AmplifierGrid | None = None,
    ) -> None:
        if not spacing_px > 0.0:
            raise OutOfRangeError("spacing of the background [px]", spacing_px, "positive")
        grid = amplifiers or ONE_AMPLIFIER
        self.shape = shape
        self._parts = [(_splines(shape[0], spacing_px), _splines(shape[1], spacing_px))]
        if grid.rows * grid.columns > 1:
            self._parts.append((_steps(shape[0], grid.rows), _steps(shape[1], grid.columns)))
        self._sizes = [rows.shape[1] * columns.shape[1] for rows, columns in self._parts]

    def __len__(self) -> int:
        """Number of terms."""
        return sum(self._sizes)

    def normal_matrix(self, weight: NDArray[Any]) -> FloatArray:
        """Sums of products of two terms with a weight per pixel, shape ``(P, P)``."""
        blocks = [
            [self._cross(weight, one, two) if i <= j else None for j, two in enumerate(self._parts)]
            for i, one in enumerate(self._parts)
        ]
        full = [
            [block if block is not None else blocks[j][i].T for j, block in enumerate(line)]  # type: ignore[union-attr]
            for i, line in enumerate(blocks)
        ]
        return np.block(full)

    def moments(self, image: NDArray[Any]) -> FloatArray:
        """Sum of an image times every term, shape ``(P,)``."""
        sums = [np.zeros((rows.shape[1], columns.shape[1])) for rows, columns in self._parts]
        for band in _bands(self.shape):
            values = image[band].astype(np.float64)
            for total, (rows, columns) in zip(sums, self._parts, strict=True):
                total += rows[band].T @ (values @ columns)
        return np.concatenate([total.ravel() for total in sums])

    def surface(self, coefficient: FloatArray) -> NDArray[np.float32]:
        """The background with these coefficients, shape ``shape``."""
        made = np.zeros(self.shape, dtype=np.float32)
        parts = np.split(coefficient, np.cumsum(self._sizes)[:-1])
        for (rows, columns), values in zip(self._parts, parts, strict=True):
            grid = values.reshape(rows.shape[1], columns.shape[1])
            made += (rows @ (grid @ columns.T)).astype(np.float32)
        return made

    def unity(self) -> FloatArray:
        """Coefficients of the constant 1: the splines of a side sum to it."""
        return np.concatenate([np.ones(self._sizes[0]), np.zeros(len(self) - self._sizes[0])])

    def _cross(
        self, weight: NDArray[Any], one: tuple[FloatArray, FloatArray], two: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        row_pairs, row_one, row_two = _overlapping(one[0], two[0])
        column_pairs, column_one, column_two = _overlapping(one[1], two[1])
        sums = np.zeros((row_pairs.shape[1], column_pairs.shape[1]))
        for band in _bands(self.shape):
            sums += row_pairs[band].T @ (weight[band].astype(np.float64) @ column_pairs)
        matrix = np.zeros((one[0].shape[1], one[1].shape[1], two[0].shape[1], two[1].shape[1]))
        matrix[row_one[:, None], column_one, row_two[:, None], column_two] = sums
        return matrix.reshape(one[0].shape[1] * one[1].shape[1], -1)


def _bands(shape: tuple[int, int]) -> Iterator[slice]:
    for start in range(0, shape[0], _ROWS):
        yield slice(start, start + _ROWS)


def _splines(side: int, spacing_px: float) -> FloatArray:
    """Cubic B-splines at the centres of the pixels, shape ``(side, spans + 3)``."""
    spans = max(1, round(side / spacing_px))
    step = side / spans
    knots = step * np.arange(-_DEGREE, spans + _DEGREE + 1)
    return np.asarray(BSpline.design_matrix(np.arange(side) + 0.5, knots, _DEGREE).toarray())


def _steps(side: int, parts: int) -> FloatArray:
    """1 on each of equal parts of a side, shape ``(side, parts)``."""
    part = np.arange(side) * parts // side
    return (part[:, None] == np.arange(parts)).astype(float)


def _overlapping(one: FloatArray, two: FloatArray) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """Products of a function of each kind that are not 0 everywhere, and of which functions they are."""
    first, second = np.nonzero(np.abs(one).T @ np.abs(two))
    return one[:, first] * two[:, second], first, second
