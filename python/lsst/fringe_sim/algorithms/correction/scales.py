"""Scales of fringe templates in a frame, with the background fitted beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...array_types import BoolArray, Float32Array, FloatArray
from ...errors import InputError, OutOfRangeError, UndeterminedError
from .background import SMALLEST_BLOCK_PX, BackgroundTerms
from .detection import log_evidence
from .scatter import scale_covariance
from .sums import FrameSums, Solution, four_digits

__all__ = [
    "ScaleFit",
    "coefficient_of",
    "fit_scales",
    "refuse_negative_sky",
    "refuse_part_without_sky",
    "scale_fit",
    "settle",
    "sky_is_subtracted",
    "steady_weight",
]

LEAST_BLOCKS = 25
"""Blocks with pixels below which the errors of the scales, which come from their scatter, mean nothing: with 25 an
error is itself known to 14 %."""

ROUNDS, UNCHANGED = 6, 2e-4
"""Most rounds of clipping, and the part of the pixels below which it ends: Gaussian noise has 6e-5 beyond
four standard deviations."""

CLIP_SIGMA = 4.0  # Standard deviations beyond which a pixel is left out

ROUGH_SIGMA = 5.0
"""Standard deviations from the median of its cell beyond which a pixel is left out of the first fit, which
stars would spoil."""

LARGEST_NOISE = 1e15
"""Noise of a pixel, and one over it, whose square and its products with pixels are numbers in single precision."""

SAMPLE = 200_000  # Pixels that tell a scatter to 0.2 %

CELL_PX, CELL_STEP = 64, 4
"""Side of the cells in which the variance is averaged, so that no pixel is weighed by its own noise, and the
distance of the pixels that tell it."""

_ROWS = 256  # Rows that are worked on at a time


@dataclass(frozen=True, eq=False)
class ScaleFit:
    """Scales of templates, and what was fitted beside them.

    Attributes
    ----------
    scale : `numpy.ndarray`, shape ``(K,)``
        Scales, in the unit of the image over that of the templates.
    covariance : `numpy.ndarray`, shape ``(K, K)``
        Their covariance, from the scatter between blocks of pixels (`scale_covariance`): it holds for noise that is
        correlated, and for a variance that is not known.
    coefficient : `numpy.ndarray`, shape ``(P,)``
        Coefficients of the background.
    weight : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Inverse variance of the pixels that were used; 0 for others and for clipped ones.
    chi2_per_pixel : `float`
        Mean squared residual over the variance.
    evidence : `float`
        Logarithm of the evidence of the templates (`log_evidence`).
    """

    scale: FloatArray
    covariance: FloatArray
    coefficient: FloatArray
    weight: Float32Array
    chi2_per_pixel: float
    evidence: float

    @property
    def seen(self) -> bool:
        """Whether the frame is more probable with the fringes of the templates than without."""
        return self.evidence > 0.0

    @property
    def pixels(self) -> int:
        """Pixels that were used."""
        return int(np.count_nonzero(self.weight))


def fit_scales(
    image: NDArray[Any],
    weight: NDArray[Any],
    patterns: Sequence[Float32Array],
    background: BackgroundTerms,
    *,
    clip_sigma: float = CLIP_SIGMA,
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
    """
    sums = FrameSums(image, weight.astype(np.float32), patterns, background)
    solution, _ = settle(sums, sums.usable, clip_sigma=clip_sigma)
    return scale_fit(sums, solution)


def settle(
    sums: FrameSums,
    allowed: BoolArray,
    residual: Float32Array | None = None,
    *,
    clip_sigma: float = CLIP_SIGMA,
) -> tuple[Solution, Float32Array]:
    """Fit, leave out pixels that lie off, and repeat until they stay the same.

    Parameters
    ----------
    sums : `FrameSums`
        Sums over the frame, which are left with the pixels of the last fit.
    allowed : `numpy.ndarray` of `bool`, shape ``(ny, nx)``
        Pixels that may be used.
    residual : `numpy.ndarray`, optional
        What an earlier fit left, which tells the pixels to begin with.
    clip_sigma : `float`, optional
        Pixels that lie off by more standard deviations are left out.

    Returns
    -------
    solution : `Solution`
    residual : `numpy.ndarray`, float32, shape ``(ny, nx)``
        What it leaves in all pixels with a weight.
    """
    used = allowed
    if math.isfinite(clip_sigma):
        used = (
            _roughly_good(sums, allowed) if residual is None else _kept(sums, allowed, residual, clip_sigma)
        )
    rounding = rounding_of(sums.level) * math.sqrt(float(sums.weight.max(initial=0.0)))
    for left in reversed(range(ROUNDS)):
        sums.use(used)
        _refuse_few(sums)
        solution = sums.solve()
        residual = sums.residual(solution)
        if left == 0 or not math.isfinite(clip_sigma) or _spread(sums, residual) <= rounding:
            break
        kept = _kept(sums, allowed, residual, clip_sigma)
        if np.count_nonzero(kept != used) <= UNCHANGED * sums.pixels.sum():
            break
        used = kept
    assert residual is not None
    return solution, residual


def scale_fit(sums: FrameSums, solution: Solution) -> ScaleFit:
    """Scales with their errors."""
    pixels = int(sums.pixels.sum())
    free = pixels - len(sums.background) - solution.scale.size
    blocks = np.count_nonzero(sums.by_block(sums.pixels))
    covariance = scale_covariance(sums, solution)
    return ScaleFit(
        scale=solution.scale,
        covariance=covariance,
        coefficient=coefficient_of(sums, solution),
        weight=np.where(sums.used, sums.weight, np.float32(0.0)),
        chi2_per_pixel=sums.chi2(solution) / free,
        evidence=log_evidence(solution.scale, covariance, int(blocks)),
    )


def coefficient_of(sums: FrameSums, solution: Solution) -> FloatArray:
    """Coefficients of the whole background: the sums are of frames less a level."""
    return np.asarray(solution.coefficient + sums.level * sums.background.unity())


def steady_weight(good: BoolArray, variance: NDArray[Any] | None, image: NDArray[Any]) -> Float32Array:
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
        step = max(1, image.size // (4 * SAMPLE))
        both = good[::step, 1:] & good[::step, :-1]
        difference = image[::step, 1:][both].astype(np.float64) - image[::step, :-1][both]
        spread = 1.4826 * float(np.median(np.abs(difference))) / math.sqrt(2.0) if difference.size else 0.0
        _refuse_unit(spread)
        return np.where(good, 1.0 / spread**2 if spread > 0.0 else 1.0, 0.0).astype(np.float32)
    known = good & np.isfinite(variance) & (variance > 0)
    some = np.where(known[::CELL_STEP, ::CELL_STEP], variance[::CELL_STEP, ::CELL_STEP], np.nan)
    middle = _cell_medians(some)
    finite = middle[np.isfinite(middle)]
    _refuse_unit(math.sqrt(float(np.median(finite))) if finite.size else 0.0)
    weight = np.zeros(good.shape, dtype=np.float32)
    for row, across in enumerate(middle):
        rows = slice(row * CELL_PX, (row + 1) * CELL_PX)
        steady = np.broadcast_to(np.repeat(across, CELL_PX)[: good.shape[1]], known[rows].shape)
        # In a cell of which hardly anything is known, each pixel counts as it is.
        steady = np.where(np.isfinite(steady), steady, variance[rows])
        np.divide(1.0, steady, out=weight[rows], where=known[rows], casting="same_kind")
    return weight


def refuse_negative_sky(image: NDArray[Any], weight: Float32Array) -> None:
    """Refuse a frame that has been negated: a sky that was subtracted lies within the noise of a pixel of 0.

    Raises
    ------
    OutOfRangeError
        It is lower.
    """
    step = max(1, image.size // SAMPLE)
    used = weight.ravel()[::step]
    known = used > 0
    if not known.any():
        return
    level = float(np.median(image.ravel()[::step][known]))
    noise = 1.0 / math.sqrt(float(np.median(used[known])))
    if level < -noise:
        allowed = f"positive, or subtracted: within the noise of a pixel ({noise:.3g}) of 0"
        raise OutOfRangeError("sky of the frame", four_digits(level), allowed)


def sky_is_subtracted(level: float, noise: float) -> bool:
    """Whether a level lies within the noise of a pixel of 0, so that nobody knows the sky."""
    return abs(level) < noise


def refuse_part_without_sky(subtracted: BoolArray) -> None:
    """Refuse frames of which some have their sky and others do not: their templates have no common unit.

    Raises
    ------
    InputError
        Some do, and others do not.
    """
    if subtracted.any() and not subtracted.all():
        number = int(np.count_nonzero(subtracted))
        raise InputError(
            "frames without their sky", number, "0, or all: --background puts back what was subtracted"
        )


def _cell_medians(some: NDArray[Any]) -> NDArray[Any]:
    """Median of each cell over what is no NaN of every so many pixels of every so many rows."""
    side = CELL_PX // CELL_STEP
    padded = np.pad(some, [(0, -size % side) for size in some.shape], constant_values=np.nan)
    cells = padded.reshape(padded.shape[0] // side, side, -1, side).swapaxes(1, 2)
    ordered = np.sort(cells.reshape(*cells.shape[:2], -1), axis=-1)
    place = np.maximum(np.isfinite(ordered).sum(axis=-1, keepdims=True) - 1, 0) // 2
    return np.asarray(np.take_along_axis(ordered, place, axis=-1)[..., 0])


def _refuse_unit(noise: float) -> None:
    """Refuse numbers whose squares single precision does not hold."""
    if noise > 0.0 and not 1.0 / LARGEST_NOISE < noise < LARGEST_NOISE:
        allowed = f"{1.0 / LARGEST_NOISE:.0e} to {LARGEST_NOISE:.0e}, in another unit"
        raise OutOfRangeError("noise of a pixel", four_digits(noise), allowed)


def rounding_of(level: ArrayLike) -> float:
    """Errors of float32 in numbers of this size, several of them added up."""
    return 8.0 * float(np.finfo(np.float32).eps) * float(np.max(np.abs(level)))


def _roughly_good(sums: FrameSums, allowed: BoolArray) -> BoolArray:
    """Pixels that are near the median of their cell."""
    few = allowed[::CELL_STEP, ::CELL_STEP]
    some = np.where(few, sums.image[::CELL_STEP, ::CELL_STEP], np.float32(np.nan))
    middle = _cell_medians(some)
    side = CELL_PX // CELL_STEP
    wide = middle.repeat(side, axis=0).repeat(side, axis=1)[: some.shape[0], : some.shape[1]]
    reach = ROUGH_SIGMA * 1.4826 * _cell_medians(np.abs(some - wide))
    good = allowed.copy()
    for row, across in enumerate(zip(middle, reach, strict=True)):
        rows = slice(row * CELL_PX, (row + 1) * CELL_PX)
        centre, most = (np.repeat(each, CELL_PX)[: allowed.shape[1]] for each in across)
        # A cell without a number has no limit.
        good[rows] &= ~(np.abs(sums.image[rows] - centre) > most)
    return good


def _kept(sums: FrameSums, allowed: BoolArray, residual: Float32Array, clip_sigma: float) -> BoolArray:
    """Pixels that do not lie off; a variance that is wrong by a factor clips as one that is right."""
    most = np.float32((clip_sigma * _spread(sums, residual)) ** 2)
    kept = np.empty(allowed.shape, dtype=bool)
    for start in range(0, len(kept), _ROWS):
        rows = slice(start, start + _ROWS)
        with np.errstate(over="ignore"):  # beyond all numbers is beyond the limit
            pull2 = np.square(residual[rows])
            pull2 *= sums.weight[rows]
        np.less_equal(pull2, most, out=kept[rows])
    kept &= allowed
    return kept


def _spread(sums: FrameSums, residual: Float32Array) -> float:
    """Scatter of the pulls of a sample of the pixels in use."""
    step = (residual.size // SAMPLE) | 1
    used = sums.used.ravel()[::step]
    pull = np.abs(residual.ravel()[::step][used]) * np.sqrt(sums.weight.ravel()[::step][used])
    return 1.4826 * float(np.median(pull)) if pull.size else 0.0


def _refuse_few(sums: FrameSums) -> None:
    parameters = len(sums.background) + len(sums.patterns)
    pixels = int(sums.pixels.sum())
    filled = int(np.count_nonzero(sums.by_block(sums.pixels)))
    if filled < LEAST_BLOCKS or pixels <= 4 * parameters:
        block = SMALLEST_BLOCK_PX
        allowed = (
            f"more than {4 * parameters} (for {parameters} terms) in {LEAST_BLOCKS} blocks of {block} x {block} or "
            f"more; there are {filled}"
        )
        raise UndeterminedError("pixels for the scales of the templates", pixels, allowed)
