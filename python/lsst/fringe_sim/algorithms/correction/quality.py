"""What a correction did to a frame: structure before and after, and whether the template may be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtr

from ...array_types import BoolArray, Float32Array, FloatArray
from ...compiled import processors, run_threaded
from ...errors import InputError
from .objects import FrameFit, find_objects, square_sums
from .part_left import part_left
from .scales import CLIP_SIGMA, rounding_of
from .sums import FrameSums

__all__ = ["FrameProof", "excess_structure", "prove", "uniform_background_indicator"]

LEAST_PROBABILITY = 1e-3
"""Probability of a good template's statistic below which it is refused: one of a thousand good frames."""

JUDGED_TOGETHER = 2  # Blocks a side over which products are added before their scatter is taken
LEAST_SHARE = 0.5  # Part of an aperture that must be good
LEAST_OVERLAPPING = 4  # Half the side of the smallest apertures that overlap [px]

UBI_RADIUS_PX, UBI_BOX_PX, UBI_STEP_PX = 2.0, 10, 4
"""Radius of the apertures, side of the boxes of the local noise, distance of the apertures from each other, which
hardly overlap."""

NOISE_ROWS = 512
"""Rows whose differences of neighbours tell the noise of a pixel to 0.1 % where a row has a thousand pixels."""

ROWS = 128  # Rows that are worked on at a time, which the memory of a processor holds
NOISE_SAMPLE = 200_000  # Pixels that tell a scatter to 0.2 %


@dataclass(frozen=True)
class FrameProof:
    """Numbers of one frame; structures are fractions of the noise of the aperture in which they are largest.

    Attributes
    ----------
    evidence : `float`
        Logarithm of the evidence of the templates (`log_evidence`); below 0 no fringes are seen, and nothing was
        subtracted.
    fringe_rms : `float`
        Standard deviation of what was subtracted, in the unit of the frame.
    structure_before, structure_after : `float`
        Structure beyond the noise, of the apertures up to the largest; background and objects are left out.
    fringes_left, fringes_left_sigma : `float`
        The fringes that are left, in the aperture in which fringes are most of the noise, and the error of
        this number; NaN where none are seen.
    part_left, part_left_sigma : `float`
        The same as a part of the fringes that were subtracted (`part_left`).
    ubi_before, ubi_after : `float`
        Uniform background indicator.
    probability : `float`
        Of a statistic as bad as that of this frame if the template is good.
    worst : `str`
        Which part of the statistic is the worst one.
    """

    evidence: float
    fringe_rms: float
    structure_before: float
    structure_after: float
    fringes_left: float
    fringes_left_sigma: float
    part_left: float
    part_left_sigma: float
    ubi_before: float
    ubi_after: float
    probability: float
    worst: str

    @property
    def seen(self) -> bool:
        """Whether the frame has the fringes of the templates."""
        return self.evidence > 0.0

    @property
    def passed(self) -> bool:
        """Whether the template adds no structure, and what it leaves does not resemble it."""
        return self.probability >= LEAST_PROBABILITY


def prove(
    frame: FrameFit, weight: Float32Array, aperture_px: int, variances: Sequence[NDArray[Any]] = ()
) -> FrameProof:
    """Compare a frame before and after its correction.

    Parameters
    ----------
    frame : `FrameFit`
        The frame, taken apart by the templates.
    weight : `numpy.ndarray`, shape ``(ny, nx)``
        Inverse variance of all good pixels, with those of objects.
    aperture_px : `int`
        Side of the largest aperture [px]; 20 arcsec are 100 px of the LSST Camera.
    variances : sequence of `numpy.ndarray`, optional
        Variance of the noise of each template, which may rise the noise of the frame by as much.

    Notes
    -----
    The statistic is the largest of several. For bands of scales of 1, 2, 4, … pixels (differences of means over
    squares of so many pixels and over squares of twice as many): by how much the part of the fringes in the band
    raises the squares of the frame when it is subtracted, less what the noise of the templates lets expect. For
    every template: its product with what is left on the black squares of a chequerboard by scales from the white
    ones, and the other way round. The former have the errors of white noise, the latter those of the scatter between
    blocks; the probability of the largest is corrected for their number (Šidák 1967, JASA 62, 626).
    """
    sums, fit = frame.sums, frame.fit
    used, largest = sums.used, max(aperture_px, 1)
    if not fit.seen:
        return _untouched(frame, largest)
    before = sums.residual(sums.solve(templates=False))
    fringes = _scaled_sum(fit.scale, sums.patterns)
    allowed = [scale**2 * each for scale, each in zip(fit.scale, variances, strict=False)]
    mean = float(fit.scale @ sums.mean_patterns())
    apertures, noise = _Apertures(used, largest), _pixel_variance(frame.residual, used)

    def looks() -> dict[str, float]:
        # Objects without regard to the template: what it prints into the frame is not left out.
        untouched = _plain_weight(before, weight, sums)
        return _rises(before, fringes, untouched, largest, allowed, fit.chi2_per_pixel) | _products(sums)

    found, whole, structure, ubi, left = _together(
        looks,
        lambda: math.sqrt(apertures.power(fringes - np.float32(mean)) / noise) if noise > 0.0 else math.nan,
        lambda: [apertures.structure(each, noise) for each in (before, frame.residual)],
        lambda: [uniform_background_indicator(each, used) for each in (before, frame.residual)],
        lambda: part_left(frame.residual, fringes, used, fit, frame.solution.schur, allowed),
    )
    probability, worst = _corrected(found)
    return FrameProof(
        evidence=fit.evidence,
        fringe_rms=_rms(fringes, used),
        structure_before=structure[0],
        structure_after=structure[1],
        fringes_left=whole * left.value,
        fringes_left_sigma=whole * left.sigma,
        part_left=left.value,
        part_left_sigma=left.sigma,
        ubi_before=ubi[0],
        ubi_after=ubi[1],
        probability=probability,
        worst=worst,
    )


def _scaled_sum(scale: FloatArray, patterns: Sequence[Float32Array]) -> Float32Array:
    total = np.empty_like(patterns[0])

    def one(band: int) -> None:
        part = total[band * ROWS : (band + 1) * ROWS]
        part[...] = 0.0
        for factor, pattern in zip(scale, patterns, strict=True):
            part += np.float32(factor) * pattern[band * ROWS : (band + 1) * ROWS]

    run_threaded(one, -(-len(total) // ROWS))
    return total


def _together(*works: Callable[[], Any]) -> list[Any]:
    """What each of several works returns, done in threads."""
    if processors() == 1:
        return [work() for work in works]
    # Each begins when a thread is free: they take very different times.
    with ThreadPoolExecutor(processors()) as pool:
        return list(pool.map(lambda work: work(), works))


def _untouched(frame: FrameFit, largest: int) -> FrameProof:
    """Of a frame from which nothing was subtracted: what is left of fringes that are not seen nobody knows."""
    used = frame.sums.used
    noise = _pixel_variance(frame.residual, used)
    structure = _Apertures(used, largest).structure(frame.residual, noise)
    ubi = uniform_background_indicator(frame.residual, used)
    unknown = dict.fromkeys(("fringes_left", "fringes_left_sigma", "part_left", "part_left_sigma"), math.nan)
    return FrameProof(
        frame.fit.evidence, 0.0, structure, structure, **unknown,
        ubi_before=ubi, ubi_after=ubi, probability=1.0, worst="",
    )  # fmt: skip


def _plain_weight(residual: Float32Array, weight: Float32Array, sums: FrameSums) -> Float32Array:
    """Weight without objects and outliers of a frame whose fringes nobody knows."""
    good = weight > 0
    objects = find_objects(residual, good, rounding_of(sums.level))
    with np.errstate(over="ignore"):  # beyond all numbers is beyond the limit
        pull2 = np.square(residual)
        pull2 *= weight
    step = (pull2.size // NOISE_SAMPLE) | 1
    some = pull2.ravel()[::step][sums.used.ravel()[::step]]
    limit = CLIP_SIGMA**2 * 1.4826**2 * float(np.median(some)) if some.size else math.inf
    return np.where(objects | (pull2 > limit), np.float32(0.0), weight)


class _Apertures:
    """Square apertures of 2, 4, 8, … px and the largest ones, over the good pixels of a frame."""

    def __init__(self, good: BoolArray, largest: int) -> None:
        self.good, self.largest = good, largest
        self.shares: list[Float32Array] = []
        share: NDArray[Any] = good
        while 2 << len(self.shares) <= largest:
            self.shares.append(_overlapping(share, 1 << len(self.shares)))
            share = square_sums(share, 2)
        self.last = _of_apertures(good, largest)

    def structure(self, values: Float32Array, noise: float) -> float:
        """Structure beyond the noise [variance of a pixel] in the apertures in which it is largest."""
        return math.sqrt(max(self.power(values) / noise - 1.0, 0.0)) if noise > 0.0 else math.nan

    def power(self, values: Float32Array) -> float:
        """Largest mean square of means over apertures, as the variance of a pixel of white noise that had it."""
        total: Float32Array = np.where(self.good, values, np.float32(0.0))
        found = [_power(self.last, _of_apertures(total, self.largest), self.largest)]
        for level, share in enumerate(self.shares):
            found.append(_power(share, _overlapping(total, 1 << level), 2 << level))
            total = square_sums(total, 2)
        return max(found)


def excess_structure(residual: NDArray[Any], weight: NDArray[Any], aperture_px: int) -> float:
    """Standard deviation of the means over square apertures beyond that of white noise, as a fraction of the latter.

    Parameters
    ----------
    residual : `numpy.ndarray`, shape ``(ny, nx)``
        Frame less its background.
    weight : `numpy.ndarray`
        0 where a pixel is not good.
    aperture_px : `int`
        Side of the apertures [px], which overlap by half where it is even.
    """
    good = weight > 0
    share = _of_apertures(good, aperture_px)
    total = _of_apertures(np.where(good, residual, np.float32(0.0)), aperture_px)
    noise = _pixel_variance(residual, good)
    # NaN if no aperture has enough pixels.
    return math.sqrt(max(_power(share, total, aperture_px) / noise - 1.0, 0.0)) if noise > 0.0 else math.nan


def _power(share: NDArray[Any], total: NDArray[Any], side: int) -> float:
    """Mean square of means over apertures relative to that of white noise of variance 1; NaN without apertures."""
    seen = share > LEAST_SHARE * side**2
    if not seen.any():
        return math.nan
    number = share[seen]
    squares = float(np.mean(np.square(total[seen] / number), dtype=np.float64))
    return squares / float(np.mean(1.0 / number, dtype=np.float64))


def uniform_background_indicator(residual: NDArray[Any], good: BoolArray) -> float:
    """Scatter of the flux in empty apertures over what the noise of pixels lets expect (Medford et al. 2021).

    0.98 for white noise, more where the noise is correlated over an aperture.

    Parameters
    ----------
    residual : `numpy.ndarray`, shape ``(ny, nx)``
        Frame less its background.
    good : `numpy.ndarray` of `bool`
        Pixels without objects and defects.

    Returns
    -------
    indicator : `float`
        NaN where no aperture is free of masked pixels.

    Notes
    -----
    ``(std(flux) + median(error) / area) / median(error)``, as the program fringez of the authors computes it
    (doi 10.1088/1538-3873/abf77a), with apertures of radius 2 px; here they stand on every fourth pixel of every
    fourth row that has six good ones on either side, and not on random ones.
    """
    step, disc = UBI_STEP_PX, _disc(UBI_RADIUS_PX)
    bad = square_sums(~good, step)
    # Around a pixel of a square lie this one, the one before and the two after.
    full = [slice(1 + offset, size - 2 + offset) for size in bad.shape[:1] for offset in (-1, 0, 1, 2)]
    wide = [slice(1 + offset, size - 2 + offset) for size in bad.shape[1:] for offset in (-1, 0, 1, 2)]
    free = sum(bad[rows, columns] for rows in full for columns in wide) == 0
    if not np.any(free):
        return math.nan
    places = np.argwhere(free)
    y, x = (places[:: len(places) // NOISE_SAMPLE | 1] * step + step + step // 2).T
    reach = len(disc) // 2
    flux = sum(
        part * residual[y + dy - reach, x + dx - reach]
        for dy, line in enumerate(disc)
        for dx, part in enumerate(line)
    )
    error = np.sqrt(_box_variance(residual, good)[y // UBI_BOX_PX, x // UBI_BOX_PX] * disc.sum())
    middle = float(np.median(error))
    return (float(np.std(flux)) + middle / float(disc.sum())) / middle if middle > 0.0 else math.nan


def _of_apertures(values: NDArray[Any], side: int) -> Float32Array:
    """Sums over apertures, which overlap by half where their side is even."""
    half = side // 2 if side % 2 == 0 else side
    # Squares that the edge has cut are no part of apertures.
    ny, nx = (size // half for size in values.shape)
    total = square_sums(values, half)[:ny, :nx]
    return total if half == side else _overlapping(total, half)


def _overlapping(total: NDArray[Any], half: int) -> Float32Array:
    """Apertures of two by two squares; where there are so many that it matters not, without overlap."""
    if half < LEAST_OVERLAPPING:
        return square_sums(total, 2)
    whole = np.asarray(total, dtype=np.float32)
    return np.asarray(whole[1:, 1:] + whole[1:, :-1] + whole[:-1, 1:] + whole[:-1, :-1])


def _pixel_variance(residual: NDArray[Any], good: BoolArray) -> float:
    step = max(1, len(good) // NOISE_ROWS)
    both = good[::step, 1:] & good[::step, :-1]
    if not both.any():
        raise InputError("pairs of good pixels", 0, "some")
    difference = (residual[::step, 1:] - residual[::step, :-1])[both]
    return 0.5 * float(np.mean(np.square(difference, dtype=np.float64)))


def _rises(
    before: Float32Array,
    fringes: Float32Array,
    weight: Float32Array,
    largest: int,
    allowed: Sequence[NDArray[Any]],
    chi2: float,
) -> dict[str, float]:
    """Probability, for each band of scales, that what is subtracted there adds so much to the squares by chance."""
    noise = sum(_dot(weight, each) for each in allowed)
    looks, moment, width = {}, weight * before, 1
    while width <= max(largest, 2) and min(fringes.shape) >= 2:
        ny, nx = (2 * (size // 2) for size in fringes.shape)
        fringes, weight, moment = (each[:ny, :nx] for each in (fringes, weight, moment))
        coarser = square_sums(fringes, 2) / np.float32(4.0)
        power = rise = 0.0
        for corner in (np.s_[::2, ::2], np.s_[::2, 1::2], np.s_[1::2, ::2], np.s_[1::2, 1::2]):
            band = fringes[corner] - coarser
            power += _dot(band, band * weight[corner])
            rise -= 2.0 * _dot(band, moment[corner])
        error = 2.0 * math.sqrt(chi2 * power)
        rise += power - noise
        looks[f"structure of {width} px"] = float(ndtr(-rise / error)) if error > 0.0 else 1.0
        fringes, weight, moment = coarser, square_sums(weight, 2), square_sums(moment, 2)
        width *= 2
    return looks


def _rms(values: Float32Array, good: BoolArray) -> float:
    """Standard deviation of the good pixels."""
    kept, number = np.where(good, values, np.float32(0.0)), max(float(np.count_nonzero(good)), 1.0)
    mean = float(kept.sum(axis=1).sum(dtype=np.float64)) / number
    return math.sqrt(max(_dot(kept, kept) / number - mean**2, 0.0))


def _dot(one: NDArray[Any], two: NDArray[Any]) -> float:
    """Sum of products of pixels: single precision within a row only."""
    return float(np.einsum("yx,yx->y", one, two).sum(dtype=np.float64))


def _products(sums: FrameSums) -> dict[str, float]:
    """Probability, for each template, of its product with what scales from other pixels leave."""
    blocks = sums.background.rows.block[:, None] + sums.background.columns.block
    white = blocks % 2 == 0
    means = sums.mean_patterns()
    total = np.zeros((len(sums.patterns), *white.shape))
    for used in (white, ~white):
        total += sums.products(sums.solve(used), means) * ~used
    return {
        f"template {number}": _chance(square_sums(sums.by_block(each), JUDGED_TOGETHER), sided=2)
        for number, each in enumerate(total)
    }


def _chance(blocks: NDArray[Any], sided: int) -> float:
    """Probability of a mean over blocks that is so large by chance."""
    values = np.asarray(blocks[blocks != 0.0], dtype=float)  # squares in single precision may all be 0
    if values.size < 3:
        return 1.0
    pull = float(values.mean() / (values.std(ddof=1) / math.sqrt(values.size)))
    return float(sided * stdtr(values.size - 1, -(abs(pull) if sided == 2 else pull)))


def _corrected(looks: dict[str, float]) -> tuple[float, str]:
    """Probability of the smallest of several, and which it is."""
    worst = min(looks, key=lambda name: looks[name])
    return float(-math.expm1(len(looks) * math.log1p(-min(looks[worst], 1.0 - 1e-12)))), worst


def _disc(radius: float) -> FloatArray:
    """Parts of pixels inside a circle about the central one, from 100 points in each."""
    reach = math.ceil(radius)
    points = (np.arange(10 * (2 * reach + 1)) + 0.5) / 10.0 - reach - 0.5
    inside = np.hypot(points[:, None], points) <= radius
    side = 2 * reach + 1
    return np.asarray(inside.reshape(side, 10, side, 10).mean(axis=(1, 3)))


def _box_variance(values: NDArray[Any], good: BoolArray) -> FloatArray:
    """Variance of the good pixels in boxes; that of all in boxes without many."""
    kept = np.where(good, values, 0.0)
    number, total, squares = (
        square_sums(each, UBI_BOX_PX).astype(np.float64) for each in (good, kept, np.square(kept))
    )
    number = np.maximum(number, 1.0)
    variance = np.asarray(squares / number - (total / number) ** 2)
    full = number > 0.5 * UBI_BOX_PX**2
    variance[~full] = np.median(variance[full]) if full.any() else kept[good].var()
    return variance
