"""Scales of fringe templates in a frame, with the background fitted beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from ...errors import OutOfRangeError, UndeterminedError
from .background import BackgroundTerms

__all__ = ["ScaleFit", "fit_scales", "steady_weight"]

FloatArray = NDArray[np.float64]

RIDGE = 1e-9
"""Part of its mean that is added to the diagonal of the background's normal matrix: rounding of sums in float64 is
1e-13 of it, and terms without pixels become 0."""

LEAST_INDEPENDENT = 1e-6
"""Least eigenvalue of the correlation matrix of templates, below which float32 patterns are one pattern."""

LEAST_BLOCKS = 25
"""Blocks with pixels below which the errors of the scales, which come from their scatter, mean nothing: with 25 an
error is itself known to 14 %."""

MOST_BLOCKS_A_SIDE, SMALLEST_BLOCK_PX = 16, 4
"""Blocks are as large as correlated noise reaches, and enough of them to know a scatter to 5 %: 16 a side
where the image is large enough, 4 pixels a side where it is not."""

ROUNDS, UNCHANGED = 6, 2e-4
"""Most rounds of clipping, and the part of the pixels below which it ends: Gaussian noise has 6e-5 beyond
four standard deviations."""

LARGEST_NOISE = 1e15
"""Noise of a pixel, and one over it, whose square and its products with pixels are numbers in single precision."""

SAMPLE = 200_000
"""Pixels that tell a scatter to 0.2 %."""

CELL_PX = 64
"""Side of the cells in which the variance is averaged: no pixel is weighed by its own noise."""


@dataclass(frozen=True, eq=False)
class ScaleFit:
    """Scales of templates, and what was fitted beside them.

    Attributes
    ----------
    scale : `numpy.ndarray`, shape ``(K,)``
        Scales, in the unit of the image over that of the templates.
    covariance : `numpy.ndarray`, shape ``(K, K)``
        Their covariance, from the scatter between blocks of pixels: it holds for noise that is correlated within a
        block, and for a variance that is not known.
    coefficient : `numpy.ndarray`, shape ``(P,)``
        Coefficients of the background.
    weight : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Inverse variance of the pixels that were used; 0 for others and for clipped ones.
    chi2_per_pixel : `float`
        Mean squared residual over the variance.
    """

    scale: FloatArray
    covariance: FloatArray
    coefficient: FloatArray
    weight: NDArray[np.float32]
    chi2_per_pixel: float

    @property
    def pixels(self) -> int:
        """Pixels that were used."""
        return int(np.count_nonzero(self.weight))


@dataclass(frozen=True, eq=False)
class _Solution:
    scale: FloatArray
    coefficient: FloatArray
    schur: FloatArray
    """Normal matrix of the scales with the background eliminated."""
    leakage: FloatArray
    """Background that each template resembles, shape ``(P, K)``."""


def fit_scales(
    image: NDArray[Any],
    weight: NDArray[Any],
    patterns: Sequence[NDArray[np.float32]],
    background: BackgroundTerms,
    *,
    clip_sigma: float = 4.0,
) -> ScaleFit:
    """Weighted least squares of all templates and the background at once.

    Parameters
    ----------
    image : `numpy.ndarray`, shape ``(ny, nx)``
        The frame.
    weight : `numpy.ndarray`, shape ``(ny, nx)``
        Inverse variance, see `steady_weight`; 0 where a pixel is not to be used.
    patterns : sequence of `numpy.ndarray`, K of shape ``(ny, nx)``
        Templates; numbers wherever the weight is not 0.
    background : `BackgroundTerms`
        Terms whose coefficients nobody wants to know; a constant in a template is one of them.
    clip_sigma : `float`, optional
        Pixels that lie off by more standard deviations are left out, until none leaves.

    Raises
    ------
    UndeterminedError
        Too few pixels, or templates that the background or other templates can stand for.

    Notes
    -----
    The covariance is ``S⁻¹ (Σ_b g_b g_bᵀ) S⁻¹`` with the normal matrix ``S`` of the templates less what the
    background takes of them, and the score ``g_b`` of a block of pixels (Liang & Zeger 1986, Biometrika 73,
    13).
    """
    level = np.float32(np.median(image[weight > 0])) if (weight > 0).any() else np.float32(0.0)
    centred = np.where(weight > 0, image - level, 0).astype(np.float32)
    used = weight.astype(np.float32)
    blocks = _Blocks.of(background.shape)
    for _ in range(ROUNDS):
        _refuse_few(used, blocks, len(background) + len(patterns))
        solution = _solve(centred, used, patterns, background)
        residual = centred - background.surface(solution.coefficient)
        for scale, pattern in zip(solution.scale, patterns, strict=True):
            residual -= np.float32(scale) * np.where(used > 0, pattern, 0)
        pull = residual[used > 0] * np.sqrt(used[used > 0])
        # A variance that is wrong by a factor clips as one that is right.
        spread = 1.4826 * float(np.median(np.abs(pull[:: max(1, pull.size // SAMPLE)])))
        off = np.abs(residual) * np.sqrt(used) > clip_sigma * spread
        if np.count_nonzero(off) <= UNCHANGED * pull.size or spread <= rounding_of(level) * math.sqrt(
            used.max()
        ):
            break
        used = np.where(off, 0, used).astype(np.float32)
    free = pull.size - len(background) - len(patterns)
    covariance = _covariance(residual, used, patterns, background, solution, blocks) * pull.size / free
    coefficient = solution.coefficient + float(level) * background.unity()
    chi2 = float(np.sum(np.square(pull, dtype=np.float64)) / free)
    return ScaleFit(solution.scale, covariance, coefficient, used, chi2)


def steady_weight(
    good: NDArray[np.bool_], variance: NDArray[Any] | None, image: NDArray[Any]
) -> NDArray[np.float32]:
    """Inverse variance of the background: 0 in pixels that are not good, steady over cells elsewhere.

    A variance that follows the counts of its pixel would give low counts more weight than high ones.

    Parameters
    ----------
    good : `numpy.ndarray` of `bool`, shape ``(ny, nx)``
        Pixels that may be used.
    variance : `numpy.ndarray` or `None`
        Variance of the pixels; if not known, one for all, from differences of neighbours.
    image : `numpy.ndarray`
        The frame.

    Raises
    ------
    OutOfRangeError
        A noise below 1e-15 or above 1e15.
    """
    if variance is None:
        both = good[:, 1:] & good[:, :-1]
        difference = image[:, 1:][both].astype(np.float64) - image[:, :-1][both]
        spread = 1.4826 * float(np.median(np.abs(difference))) / math.sqrt(2.0) if difference.size else 0.0
        _refuse_unit(spread)
        return np.where(good, 1.0 / spread**2 if spread > 0.0 else 1.0, 0.0).astype(np.float32)
    known = good & np.isfinite(variance) & (variance > 0)
    _refuse_unit(math.sqrt(float(np.median(variance[known]))) if known.any() else 0.0)
    weight = np.zeros(good.shape, dtype=np.float32)
    for y in range(0, good.shape[0], CELL_PX):
        for x in range(0, good.shape[1], CELL_PX):
            cell = np.s_[y : y + CELL_PX, x : x + CELL_PX]
            values = variance[cell][known[cell]]
            if values.size:
                weight[cell] = np.where(known[cell], 1.0 / np.median(values), 0.0)
    return weight


def _refuse_unit(noise: float) -> None:
    """Refuse numbers whose squares single precision does not hold."""
    if noise > 0.0 and not 1.0 / LARGEST_NOISE < noise < LARGEST_NOISE:
        allowed = f"{1.0 / LARGEST_NOISE:.0e} to {LARGEST_NOISE:.0e}, in another unit"
        raise OutOfRangeError("noise of a pixel", noise, allowed)


def rounding_of(level: ArrayLike) -> float:
    """Errors of float32 in numbers of this size, several of them added up."""
    return 8.0 * float(np.finfo(np.float32).eps) * float(np.max(np.abs(level)))


@dataclass(frozen=True)
class _Blocks:
    """Equal blocks of pixels: large enough for correlated noise, and enough of them for a scatter."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]

    @classmethod
    def of(cls, shape: tuple[int, int]) -> _Blocks:
        return cls(*(np.arange(0, side, _block_side(side)) for side in shape))

    def sums(self, image: NDArray[Any]) -> FloatArray:
        """Sum over each block."""
        by_row = np.add.reduceat(image, self.rows, axis=0, dtype=np.float64)
        return np.add.reduceat(by_row, self.columns, axis=1)


def _block_side(side: int) -> int:
    return max(SMALLEST_BLOCK_PX, -(-side // MOST_BLOCKS_A_SIDE))


def _refuse_few(weight: NDArray[Any], blocks: _Blocks, parameters: int) -> None:
    pixels = int(np.count_nonzero(weight))
    filled = int(np.count_nonzero(blocks.sums(weight > 0)))
    if filled < LEAST_BLOCKS or pixels <= 4 * parameters:
        block = SMALLEST_BLOCK_PX
        allowed = (
            f"more than {4 * parameters} (for {parameters} terms) in {LEAST_BLOCKS} blocks of {block} x {block} or "
            f"more; there are {filled}"
        )
        raise UndeterminedError("pixels for the scales of the templates", pixels, allowed)


def _solve(
    image: NDArray[np.float32],
    weight: NDArray[np.float32],
    patterns: Sequence[NDArray[np.float32]],
    background: BackgroundTerms,
) -> _Solution:
    weighted = [np.where(weight > 0, weight * pattern, 0) for pattern in patterns]
    normal = background.normal_matrix(weight)
    normal[np.diag_indices_from(normal)] += RIDGE * np.trace(normal) / len(normal)
    factor = scipy.linalg.cho_factor(normal)
    mixed = np.zeros((len(background), len(patterns)))
    for number, each in enumerate(weighted):
        mixed[:, number] = background.moments(each)
    leakage = scipy.linalg.cho_solve(factor, mixed)
    gram = np.array([[_dot(one, two) for two in patterns] for one in weighted]).reshape(
        len(patterns), len(patterns)
    )
    schur = gram - mixed.T @ leakage
    schur = 0.5 * (schur + schur.T)
    _refuse_degenerate(schur, np.diag(gram))
    along = background.moments(weight * image)
    moment = np.array([_dot(each, image) for each in weighted]) - leakage.T @ along
    scale = np.linalg.solve(schur, moment)
    coefficient = scipy.linalg.cho_solve(factor, along - mixed @ scale)
    return _Solution(scale, coefficient, schur, leakage)


def _dot(one: NDArray[Any], two: NDArray[Any]) -> float:
    """Sum of products of pixels; a pixel without weight counts nowhere, whatever the template has there."""
    total = 0.0
    for start in range(0, len(one), 256):
        left = one[start : start + 256].astype(np.float64)
        right = np.where(left != 0.0, two[start : start + 256], 0.0)
        total += float(np.vdot(left, right))
    return total


def _refuse_degenerate(schur: FloatArray, power: FloatArray) -> None:
    """Templates of which the background, or each other, leave nothing."""
    if not power.size:
        return
    left = np.diag(schur) / np.where(power > 0.0, power, 1.0)
    if not (left > LEAST_INDEPENDENT).all():
        number = int(np.argmin(left))
        allowed = "a template that varies more quickly than the background"
        raise UndeterminedError(
            f"part of template {number} beside the background", float(left[number]), allowed
        )
    root = np.sqrt(np.diag(schur))
    least = float(np.linalg.eigvalsh(schur / np.outer(root, root))[0])
    if least < LEAST_INDEPENDENT:
        raise UndeterminedError("independence of the templates", least, f"above {LEAST_INDEPENDENT:g}")


def _covariance(
    residual: NDArray[np.float32],
    weight: NDArray[np.float32],
    patterns: Sequence[NDArray[np.float32]],
    background: BackgroundTerms,
    solution: _Solution,
    blocks: _Blocks,
) -> FloatArray:
    scores = []
    weighted = weight * residual
    for pattern, leakage in zip(patterns, solution.leakage.T, strict=True):
        beside = np.where(weight > 0, pattern, 0) - background.surface(leakage)
        scores.append(blocks.sums(weighted * beside).ravel())
    filled = np.count_nonzero(blocks.sums(weight > 0))
    score = np.array(scores).reshape(len(patterns), blocks.rows.size * blocks.columns.size)
    meat = score @ score.T * filled / (filled - 1)
    half = np.linalg.solve(solution.schur, meat)
    return np.asarray(np.linalg.solve(solution.schur, half.T))
