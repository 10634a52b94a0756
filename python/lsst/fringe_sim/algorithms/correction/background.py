"""What a frame holds beside fringes and objects: a smooth surface and steps between amplifiers."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from ...array_types import Float32Array, FloatArray
from ...compiled import run_threaded
from ...errors import OutOfRangeError

__all__ = ["AmplifierGrid", "BackgroundTerms"]

IntArray = NDArray[np.int64]

SPACING_PX = 256.0
"""Distance between the knots of the surface [px]: what is smaller than it is left to the fringes."""

CUBIC = 4  # Coefficients of a cubic
PRODUCT = 7  # Coefficients of the product of two cubics

MOST_BLOCKS_A_SIDE, SMALLEST_BLOCK_PX = 16, 4
"""Blocks are as large as correlated noise reaches, and enough of them to know a scatter to 5 %: 16 a side
where the image is large enough, 4 pixels a side where it is not."""

_ROWS = 32  # Rows of a surface that are made at a time: few enough that a processor's own memory holds them


@dataclass(frozen=True)
class AmplifierGrid:
    """Amplifiers of equal size, each of which may have a level of its own.

    Attributes
    ----------
    rows, columns : `int`
        Amplifiers on top of and beside each other.
    learned : `bool`
        Whether a frame tells how much the levels differ (`LevelSpread`); otherwise they are free.
    """

    rows: int = 1
    columns: int = 1
    learned: bool = False

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise OutOfRangeError("amplifiers", (self.rows, self.columns), "1 or more each")


ONE_AMPLIFIER = AmplifierGrid()

AMPLIFIERS_UNKNOWN = AmplifierGrid(2, 8, learned=True)
"""Where nobody says which amplifiers there are: those of the LSST Camera, whose lines are also those of the two of
DECam, the four of HSC, and the four quadrants of others."""


class BackgroundTerms:
    """Linear terms of a background, each a function of the row times a function of the column.

    The surface is a tensor product of cubic B-splines; the level of an amplifier is 1 on it and 0 elsewhere. The
    image is cut into cells, in each of which every term is a cubic of row and column. Sums over pixels are
    therefore a few numbers per cell, from which all others follow.

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
        self, shape: tuple[int, int], spacing_px: float = SPACING_PX, amplifiers: AmplifierGrid | None = None
    ) -> None:
        if not spacing_px > 0.0:
            raise OutOfRangeError("spacing of the background [px]", spacing_px, "positive")
        grid = amplifiers or ONE_AMPLIFIER
        self.shape = shape
        self.rows = Side.of(shape[0], spacing_px, grid.rows, halved=grid.learned)
        self.columns = Side.of(shape[1], spacing_px, grid.columns, halved=grid.learned)
        self._grid = (self.rows.splines.shape[1], self.columns.splines.shape[1])
        self._levels = (grid.rows, grid.columns) if grid.rows * grid.columns > 1 else (0, 0)
        self.learned = grid.learned and self._levels[0] > 0

    def __len__(self) -> int:
        """Number of terms."""
        return int(np.prod(self._grid)) + int(np.prod(self._levels))

    @property
    def levels(self) -> slice:
        """Which of the terms are levels of amplifiers."""
        return slice(int(np.prod(self._grid)), len(self))

    @property
    def amplifiers(self) -> tuple[int, int]:
        """Amplifiers with levels, on top of and beside each other."""
        return self._levels

    def local(self, *, quarters: bool = False) -> tuple[FloatArray, IntArray]:
        """What each cell has of the terms.

        Parameters
        ----------
        quarters : `bool`, optional
            Whether every quarter of an amplifier has a level, where they are learned.

        Returns
        -------
        coefficient : `numpy.ndarray`, shape ``(ny, nx, 16, T)``
            Coefficients of the T terms of a cell in products of the four `Side.basis` of its rows and columns.
        term : `numpy.ndarray` of `int`, shape ``(ny, nx, T)``
            Which terms they are.
        """
        rows, columns = self.rows, self.columns
        size = (len(rows), len(columns), CUBIC * CUBIC, -1)
        coefficient = np.einsum("ypa,xqb->yxpqab", rows.cubic, columns.cubic).reshape(size)
        span = rows.span[:, None] + np.arange(CUBIC), columns.span[:, None] + np.arange(CUBIC)
        term = (span[0][:, None, :, None] * self._grid[1] + span[1][:, None, :]).reshape(*size[:2], -1)
        if self._levels[0]:
            one = np.einsum("yp,xq->yxpq", rows.one, columns.one).reshape(*size[:3], 1)
            parts = (rows.half, columns.half) if quarters else (rows.part, columns.part)
            beside = self._levels[1] * (2 if quarters else 1)
            level = parts[0][:, None] * beside + parts[1] + self.levels.start
            coefficient = np.concatenate([coefficient, one], axis=3)
            term = np.concatenate([term, level[..., None]], axis=2)
        return coefficient, term

    def surface(self, coefficient: FloatArray) -> Float32Array:
        """The background with these coefficients, shape ``shape``."""
        made = np.empty(self.shape, dtype=np.float32)
        self.for_bands(coefficient, made.__setitem__)
        return made

    def for_bands(self, coefficient: FloatArray, work: Callable[[slice, Float32Array], object]) -> None:
        """Call ``work`` with some rows at a time and the background there, in threads."""
        splines = coefficient[: int(np.prod(self._grid))].reshape(self._grid)
        across = (splines @ self.columns.splines.T).astype(np.float32)
        down = self.rows.splines.astype(np.float32)
        levels = None
        if self._levels[0]:
            level = coefficient[int(np.prod(self._grid)) :].reshape(self._levels)
            levels = level[:, self.columns.pixel_part].astype(np.float32)

        def one(band: int) -> None:
            rows = slice(band * _ROWS, min((band + 1) * _ROWS, self.shape[0]))
            values = down[rows] @ across
            if levels is not None:
                values += levels[self.rows.pixel_part[rows]]
            work(rows, values)

        run_threaded(one, -(-self.shape[0] // _ROWS))

    def unity(self) -> FloatArray:
        """Coefficients of the constant 1: the splines of a side sum to it."""
        number = int(np.prod(self._grid))
        return np.concatenate([np.ones(number), np.zeros(len(self) - number)])


@dataclass(frozen=True, eq=False)
class Side:
    """One side of an image, cut where a span of the splines, an amplifier or a block ends."""

    splines: FloatArray  # cubic B-splines at the centres of the pixels, ``(side, spans + 3)``
    pixel_part: IntArray  # amplifier of each pixel, ``(side,)``
    edges: IntArray  # first pixels of the N pieces, and the length of the side, ``(N + 1,)``
    # orthonormal polynomials of rising degree over the pixels of each piece; 0 for those beyond its pixels,
    # ``(pixels, 7)``
    basis: list[FloatArray]
    product: FloatArray  # products of two of the first four polynomials, as sums of all, ``(N, 4, 4, 7)``
    cubic: FloatArray  # coefficients of the four splines of a piece, ``(N, 4, 4)``
    one: FloatArray  # coefficients of the constant 1, ``(N, 4)``
    # span, part, half, block: first spline, amplifier, half of an amplifier, and block of each piece, ``(N,)``
    span: IntArray
    part: IntArray
    half: IntArray
    block: IntArray

    def __len__(self) -> int:
        """Number of pieces."""
        return len(self.basis)

    @classmethod
    def of(cls, side: int, spacing_px: float, amplifiers: int, *, halved: bool = False) -> Side:
        """Cut a side."""
        spans = max(1, round(side / spacing_px))
        blocks = max(1, min(MOST_BLOCKS_A_SIDE, side // SMALLEST_BLOCK_PX))
        halves = amplifiers * (2 if halved else 1)
        span, part, half, block = (_parts(side, number) for number in (spans, amplifiers, halves, blocks))
        cuts = np.flatnonzero(np.diff(span) + np.diff(part) + np.diff(half) + np.diff(block)) + 1
        edges = np.concatenate([[0], cuts, [side]])
        splines = _splines(side, spans)
        pieces = [slice(start, stop) for start, stop in itertools.pairwise(edges)]
        basis = [_polynomials(piece.stop - piece.start) for piece in pieces]
        cubics = [each[:, :CUBIC] for each in basis]
        first = edges[:-1]
        return cls(
            splines=splines,
            pixel_part=part,
            edges=edges,
            basis=basis,
            product=np.stack(
                [np.einsum("np,nr,nk->prk", c, c, b) for c, b in zip(cubics, basis, strict=True)]
            ),
            cubic=np.stack(
                [
                    each.T @ splines[piece, span[piece.start] : span[piece.start] + CUBIC]
                    for each, piece in zip(cubics, pieces, strict=True)
                ]
            ),
            one=np.stack([each.sum(axis=0) for each in cubics]),
            span=span[first],
            part=part[first],
            half=half[first],
            block=block[first],
        )


def _parts(side: int, number: int) -> IntArray:
    """Which of equal parts of a side each pixel is in, by its centre."""
    return np.asarray((2 * np.arange(side) + 1) * number // (2 * side))


def _splines(side: int, spans: int) -> FloatArray:
    step = side / spans
    knots = step * np.arange(1 - CUBIC, spans + CUBIC)
    return np.asarray(BSpline.design_matrix(np.arange(side) + 0.5, knots, CUBIC - 1).toarray())


def _polynomials(pixels: int) -> FloatArray:
    place = (np.arange(pixels) + 0.5) * 2.0 / pixels - 1.0
    powers = np.polynomial.legendre.legvander(place, min(PRODUCT, pixels) - 1)
    made = np.zeros((pixels, PRODUCT))
    made[:, : powers.shape[1]] = np.linalg.qr(powers)[0]
    return made
