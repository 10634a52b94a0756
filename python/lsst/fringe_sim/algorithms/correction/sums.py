"""Sums over the pixels of a frame from which fits of background and templates, and their errors, follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ...array_types import BoolArray, Float32Array, FloatArray
from ...compiled import run_threaded
from ...errors import UndeterminedError
from .background import CUBIC, BackgroundTerms
from .levels import FREE_LEVELS, LevelSpread

TERMS = CUBIC * CUBIC  # Products of cubics in a cell

RIDGE = 1e-9
"""Part of its mean that is added to the diagonal of the background's normal matrix: rounding of sums in float64 is
1e-13 of it, and terms without pixels become 0."""

LEAST_INDEPENDENT = 1e-6
"""Least eigenvalue of the correlation matrix of templates, below which float32 patterns are one pattern."""

FEW = 0.05
"""Part of the pixels of a cell up to which changes are added; beyond it the sums are made anew, which is quicker."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Least-squares solution."""

    scale: FloatArray  # scales of the templates, ``(K,)``
    coefficient: FloatArray  # coefficients of the background, ``(P,)``
    schur: FloatArray  # normal matrix of the scales with the background eliminated, ``(K, K)``
    leakage: FloatArray  # background that each template resembles, ``(P, K)``


class FrameSums:
    """Weighted sums of products of templates, image and background terms, cell by cell, over the pixels in use.

    One pass over the pixels makes them. When few pixels come or go, only those are added or taken away; parts of the
    frame, errors and what is left of a fit need no pixels at all.

    ``image``: the frame, ``(ny, nx)``; ``weight``: inverse variance; 0 where a pixel is never used, float32,
    ``(ny, nx)``; ``patterns``: templates; numbers wherever the weight is not 0, ``(K, ny, nx)``.
    """

    def __init__(
        self,
        image: NDArray[Any],
        weight: Float32Array,
        patterns: Sequence[Float32Array],
        background: BackgroundTerms,
    ) -> None:
        self.weight, self.patterns, self.background = weight, list(patterns), background
        self.usable = weight > 0
        self.level = _middle(image, self.usable)
        self.image = np.subtract(image, np.float32(self.level), dtype=np.float32)
        self.image[~self.usable] = 0.0
        self.used = np.zeros(weight.shape, dtype=bool)
        self.pixels = np.zeros((len(background.rows), len(background.columns)), dtype=np.int64)
        size = TERMS + len(self.patterns) + 1
        self.matrix = np.zeros((*self.pixels.shape, size, size))
        self._local, self._term = background.local()
        self.spread = FREE_LEVELS
        """How much the levels of amplifiers differ, by the last solution from all cells."""

    def use(self, used: BoolArray) -> None:
        """Take these pixels into the sums, and all others out of them."""
        run_threaded(lambda row: self._use_row(row, used), len(self.background.rows))
        self.used = used

    def solve(self, cells: BoolArray | None = None, *, templates: bool = True) -> Solution:
        """Least-squares solution from all cells or some, with the templates or without.

        Raises `UndeterminedError`: templates that the background or other templates can stand for.
        """
        matrix = self.matrix if cells is None else self.matrix * cells[..., None, None]
        number = len(self.patterns) if templates else 0
        chosen = [*range(number), len(self.patterns)]
        normal = _assembled(self._local, self._term, matrix[..., :TERMS, :TERMS], len(self.background))
        normal[np.diag_indices_from(normal)] += RIDGE * np.trace(normal) / len(normal)
        beside = np.zeros((len(self.background), len(chosen)))
        moments = self._local.swapaxes(2, 3) @ matrix[..., :TERMS, TERMS:][..., chosen]
        np.add.at(beside, self._term, moments)
        gram = matrix[..., TERMS:, TERMS:].sum(axis=(0, 1))[np.ix_(chosen, chosen)]
        if self.background.learned and cells is None:
            self.spread = self._spread(chosen, gram)
        self.spread.add_to(normal, self.background.levels)
        factor = scipy.linalg.cho_factor(normal)
        mixed, along = beside[:, :number], beside[:, number]
        leakage = scipy.linalg.cho_solve(factor, mixed)
        schur = gram[:number, :number] - mixed.T @ leakage
        schur = 0.5 * (schur + schur.T)
        _refuse_degenerate(schur, np.diag(gram)[:number])
        scale = np.linalg.solve(schur, gram[:number, number] - leakage.T @ along)
        coefficient = scipy.linalg.cho_solve(factor, along - mixed @ scale)
        return Solution(scale, coefficient, schur, leakage)

    def products(self, solution: Solution, means: FloatArray) -> FloatArray:
        """Sum in each cell of what a solution leaves times each template less its mean, shape ``(K, ny, nx)``."""
        left = self._left(solution)
        number = len(self.patterns)
        made = np.zeros((number, *self.pixels.shape))
        for k in range(number):
            beside = -means[k] * self._on_cells(self.background.unity())
            other = np.concatenate([beside, np.zeros((*self.pixels.shape, number + 1))], axis=2)
            other[..., TERMS + k] = 1.0
            made[k] = np.einsum("yxm,yxmn,yxn->yx", left, self.matrix, other)
        return made

    def by_cell(self, solution: Solution) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        """Normal matrix of background and templates in each cell, what a solution leaves times each term, the terms.

        Shapes ``(ny, nx, T, T)``, ``(ny, nx, T)``, ``(ny, nx, T)``; the templates are the terms after the background.
        """
        number, terms = len(self.patterns), self._term.shape[2]
        design = np.zeros((*self.pixels.shape, TERMS + number, terms + number))
        design[..., :TERMS, :terms] = self._local
        design[..., TERMS:, terms:] = np.eye(number)
        turned = design.swapaxes(2, 3)
        rows = self.matrix[..., :-1, :]
        score = (turned @ (rows @ self._left(solution)[..., None]))[..., 0]
        places = np.broadcast_to(len(self.background) + np.arange(number), (*self.pixels.shape, number))
        return turned @ rows[..., :-1] @ design, score, np.concatenate([self._term, places], axis=2)

    def totals(self, solution: Solution) -> list[FloatArray]:
        """Sums in each cell of 1, of what a solution leaves, and of each template beside the background."""
        one = np.concatenate(
            [self._on_cells(self.background.unity()), np.zeros((*self.pixels.shape, len(self.patterns) + 1))],
            axis=2,
        )
        others = [one, self._left(solution)]
        for k, leakage in enumerate(solution.leakage.T):
            beside = np.zeros_like(one)
            beside[..., :TERMS] = -self._on_cells(leakage)
            beside[..., TERMS + k] = 1.0
            others.append(beside)
        return [np.einsum("yxm,yxmn,yxn->yx", one, self.matrix, other) for other in others]

    def chi2(self, solution: Solution) -> float:
        """Sum of the squared pulls of the pixels in use."""
        left = self._left(solution)
        return max(float(np.einsum("yxm,yxmn,yxn->", left, self.matrix, left)), 0.0)

    def mean_patterns(self) -> FloatArray:
        """Weighted mean of each template over the pixels in use."""
        one = self._on_cells(self.background.unity())
        total = np.einsum("yxm,yxmn->n", one, self.matrix[..., :TERMS, :])
        weight = np.einsum("yxm,yxmn,yxn->", one, self.matrix[..., :TERMS, :TERMS], one)
        return np.asarray(total[TERMS:-1] / weight)

    def by_block(self, values: NDArray[Any]) -> NDArray[Any]:
        """Sums over the cells of each block."""
        rows, columns = self.background.rows.block, self.background.columns.block
        made = np.zeros((rows[-1] + 1, columns[-1] + 1), dtype=values.dtype)
        np.add.at(made, (rows[:, None], columns), values)
        return made

    def residual(self, solution: Solution) -> Float32Array:
        """Frame less background and templates; 0 where a pixel is never used."""
        left = np.empty(self.image.shape, dtype=np.float32)

        def take(rows: slice, surface: Float32Array) -> None:
            part = np.subtract(self.image[rows], surface, out=left[rows])
            for scale, pattern in zip(solution.scale, self.patterns, strict=False):
                part -= np.multiply(pattern[rows], np.float32(scale), out=surface)
            part *= self.usable[rows]

        self.background.for_bands(solution.coefficient, take)
        return left

    def _left(self, solution: Solution) -> FloatArray:
        """What a solution leaves, in terms of what the sums are of."""
        scale = np.zeros(len(self.patterns))
        scale[: solution.scale.size] = solution.scale
        rest = np.broadcast_to(np.append(-scale, 1.0), (*self.pixels.shape, scale.size + 1))
        return np.concatenate([-self._on_cells(solution.coefficient), rest], axis=2)

    def _spread(self, chosen: list[int], gram: FloatArray) -> LevelSpread:
        """How much the levels of amplifiers differ, beside the background and the chosen templates."""
        rows, columns = self.background.amplifiers
        start = self.background.levels.start
        local, term = self.background.local(quarters=True)
        normal = _assembled(local, term, self.matrix[..., :TERMS, :TERMS], start + 4 * rows * columns)
        moments = local.swapaxes(2, 3) @ self.matrix[..., :TERMS, TERMS:][..., chosen]
        beside = np.zeros((len(normal), len(chosen)))
        np.add.at(beside, term, moments)
        return LevelSpread.of(normal, beside, gram, (rows, columns), int(self.pixels.sum()))

    def _on_cells(self, coefficient: FloatArray) -> FloatArray:
        return np.asarray((self._local @ coefficient[self._term][..., None])[..., 0])

    def _use_row(self, row: int, used: BoolArray) -> None:
        edges = self.background.rows.edges, self.background.columns.edges
        for column in range(len(self.background.columns)):
            cell = (slice(*edges[0][row : row + 2]), slice(*edges[1][column : column + 2]))
            new = used[cell]
            changed = new != self.used[cell]
            number = int(np.count_nonzero(changed))
            if number == 0:
                continue
            if number > FEW * new.size:
                self.matrix[row, column] = self._whole(row, column, cell, new)
            else:
                self.matrix[row, column] += self._few(row, column, cell, changed)
            self.pixels[row, column] = np.count_nonzero(new)

    def _whole(self, row: int, column: int, cell: tuple[slice, slice], used: BoolArray) -> FloatArray:
        """Sums over the pixels of a cell."""
        rows, columns = self.background.rows.basis[row], self.background.columns.basis[column]
        weight = np.where(used, self.weight[cell], 0.0).astype(np.float64)
        each = np.empty((len(self.patterns) + 1, *weight.shape))
        for number, image in enumerate([*self.patterns, self.image]):
            np.copyto(each[number], image[cell])
            if number < len(self.patterns):
                each[number][~used] = 0.0
        weighted = weight * each
        mixed = rows[:, :CUBIC].T @ weighted @ columns[:, :CUBIC]
        flat = weighted.reshape(len(each), -1)
        return self._joined(
            row, column, rows.T @ weight @ columns, mixed, flat @ each.reshape(len(each), -1).T
        )

    def _few(self, row: int, column: int, cell: tuple[slice, slice], changed: BoolArray) -> FloatArray:
        """Sums over pixels that come, less those over pixels that go."""
        y, x = np.nonzero(changed)
        weight = self.weight[cell][y, x] * np.where(self.used[cell][y, x], -1.0, 1.0)
        rows = self.background.rows.basis[row][y]
        columns = self.background.columns.basis[column][x]
        each = np.stack([image[cell][y, x] for image in [*self.patterns, self.image]]).astype(np.float64)
        weighted = each * weight
        mixed = (rows[:, :CUBIC].T * weighted[:, None, :]) @ columns[:, :CUBIC]
        return self._joined(row, column, (rows.T * weight) @ columns, mixed, weighted @ each.T)

    def _joined(
        self, row: int, column: int, surface: FloatArray, mixed: FloatArray, gram: FloatArray
    ) -> FloatArray:
        down, across = self.background.rows.product[row], self.background.columns.product[column]
        made = np.empty(self.matrix.shape[2:])
        pairs = np.tensordot(np.tensordot(down, surface, axes=1), across, axes=([2], [2]))
        made[:TERMS, :TERMS] = pairs.transpose(0, 2, 1, 3).reshape(TERMS, TERMS)
        made[TERMS:, :TERMS] = mixed.reshape(-1, TERMS)
        made[:TERMS, TERMS:] = made[TERMS:, :TERMS].T
        made[TERMS:, TERMS:] = gram
        return made


def _assembled(local: FloatArray, term: NDArray[np.int64], matrix: FloatArray, size: int) -> FloatArray:
    """Normal matrix of all terms from the sums over each cell."""
    blocks = local.swapaxes(2, 3) @ matrix @ local
    flat = (term[..., :, None] * size + term[..., None, :]).ravel()
    sums = np.bincount(flat, weights=blocks.ravel(), minlength=size * size)
    return np.asarray(sums, dtype=np.float64).reshape(size, size)


def _middle(image: NDArray[Any], usable: BoolArray) -> float:
    """Median of every so many rows: the level to which all others are relative."""
    step = max(1, image.shape[0] // 64)
    values = image[::step][usable[::step]]
    if not values.size:
        values = image[usable]
    return float(np.float32(np.median(values))) if values.size else 0.0


def four_digits(value: float) -> float:
    """A measured number as a message states it."""
    return float(f"{value:.4g}")


def _refuse_degenerate(schur: FloatArray, power: FloatArray) -> None:
    """Templates of which the background, or each other, leave nothing."""
    if not power.size:
        return
    left = np.diag(schur) / np.where(power > 0.0, power, 1.0)
    if not (left > LEAST_INDEPENDENT).all():
        number = int(np.argmin(left))
        allowed = "a template that varies more quickly than the background"
        raise UndeterminedError(
            f"part of template {number} beside the background", four_digits(left[number]), allowed
        )
    root = np.sqrt(np.diag(schur))
    least = float(np.linalg.eigvalsh(schur / np.outer(root, root))[0])
    if least < LEAST_INDEPENDENT:
        raise UndeterminedError(
            "independence of the templates", four_digits(least), f"above {LEAST_INDEPENDENT:g}"
        )
