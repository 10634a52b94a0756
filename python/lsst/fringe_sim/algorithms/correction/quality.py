"""What a correction did to a frame: structure before and after, and whether the template may be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, uniform_filter
from scipy.stats import norm as normal
from scipy.stats import t as student

from ...errors import InputError
from .background import BackgroundTerms
from .objects import fit_frame
from .scales import ScaleFit, fit_scales

__all__ = ["FrameProof", "excess_structure", "prove", "uniform_background_indicator"]

FloatArray = NDArray[np.float64]

LEAST_PROBABILITY = 1e-3
"""Probability of a good template's statistic below which it is refused: one of a thousand good frames."""

BLOCKS = 8
"""Blocks a side, between which the scatter of every part of the statistic is taken."""

LEAST_SHARE = 0.5
"""Part of an aperture that must be good."""

UBI_RADIUS_PX, UBI_BOX_PX, UBI_REACH = 2.0, 10, 3
"""Radius of the apertures, side of the boxes of the local noise, radii around an aperture without masked pixels."""


@dataclass(frozen=True)
class FrameProof:
    """Numbers of one frame; structures are fractions of the noise of the aperture in which they are largest.

    Attributes
    ----------
    fringe_rms : `float`
        Standard deviation of what was subtracted, in the unit of the frame.
    structure_before, structure_after : `float`
        Structure beyond the noise, of the apertures up to the largest; background and objects are left out.
    fringes_left : `float`
        Fringes that the errors of the scales leave, in the largest aperture.
    ubi_before, ubi_after : `float`
        Uniform background indicator.
    probability : `float`
        Of a statistic as bad as that of this frame if the template is good.
    worst : `str`
        Which part of the statistic is the worst one.
    """

    fringe_rms: float
    structure_before: float
    structure_after: float
    fringes_left: float
    ubi_before: float
    ubi_after: float
    probability: float
    worst: str

    @property
    def passed(self) -> bool:
        """Whether the template adds no structure, and what it leaves does not resemble it."""
        return self.probability >= LEAST_PROBABILITY


def prove(
    image: NDArray[Any],
    weight: NDArray[np.float32],
    fit: ScaleFit,
    patterns: Sequence[NDArray[np.float32]],
    background: BackgroundTerms,
    aperture_px: int,
    variances: Sequence[NDArray[Any]] = (),
) -> FrameProof:
    """Compare a frame before and after its correction.

    Parameters
    ----------
    image : `numpy.ndarray`, shape ``(ny, nx)``
        The frame before it.
    weight : `numpy.ndarray`, shape ``(ny, nx)``
        Inverse variance of all good pixels, with those of objects.
    fit : `ScaleFit`
        Fit of the templates, of which the weight leaves out objects.
    patterns : sequence of `numpy.ndarray`
        The templates.
    background : `BackgroundTerms`
        Terms beside them.
    aperture_px : `int`
        Side of the largest aperture [px]; 20 arcsec are 100 px of the LSST Camera.
    variances : sequence of `numpy.ndarray`, optional
        Variance of the noise of each template, which may rise the noise of the frame by as much.

    Notes
    -----
    The statistic is the largest of several. For bands of scales of 1, 2, 4, … pixels: by how much the part of the
    fringes in the band raises the squares of the frame when it is subtracted, less what the noise of the templates
    lets expect. For every template: its product with what is left on the black squares of a chequerboard by scales
    from the white ones, and the other way round. The former have the errors of white noise, the latter those of the
    scatter between blocks; the probability of the largest is corrected for their number (Šidák 1967, JASA 62, 626).
    """
    # Objects without regard to the template: what it prints into the frame is not left out.
    plain = fit_frame(image, weight, [], background, rounds=1)
    untouched = np.where(plain.objects, 0, plain.fit.weight)
    used = fit.weight
    alone = fit_scales(image, used, [], background, clip_sigma=math.inf)
    before = _residual(image, used, alone, [], background)
    after = _residual(image, used, fit, patterns, background)
    apertures = [2**power for power in range(int(math.log2(max(aperture_px, 1))) + 1)]
    largest = max(aperture_px, 1)
    fringes = sum(scale * pattern for scale, pattern in zip(fit.scale, patterns, strict=True))
    allowed = sum((scale**2 * each for scale, each in zip(fit.scale, variances, strict=False)), np.zeros(()))
    looks = _rises(
        plain.residual,
        np.asarray(fringes, dtype=float),
        untouched,
        largest,
        np.asarray(allowed),
        fit.chi2_per_pixel,
    )
    looks |= _products(image, used, patterns, background)
    probability, worst = _corrected(looks)
    return FrameProof(
        fringe_rms=float((before - after)[used > 0].std()),
        structure_before=max(excess_structure(before, used, side) for side in [*apertures[1:], largest]),
        structure_after=max(excess_structure(after, used, side) for side in [*apertures[1:], largest]),
        fringes_left=_from_scales(fit, patterns, used, largest),
        ubi_before=uniform_background_indicator(before, used > 0),
        ubi_after=uniform_background_indicator(after, used > 0),
        probability=probability,
        worst=worst,
    )


def excess_structure(residual: NDArray[Any], weight: NDArray[Any], aperture_px: int) -> float:
    """Standard deviation of the means over square apertures beyond that of white noise, as a fraction of the latter.

    Parameters
    ----------
    residual : `numpy.ndarray`, shape ``(ny, nx)``
        Frame less its background.
    weight : `numpy.ndarray`
        Inverse variance, which counts up to a factor; 0 where a pixel is not good.
    aperture_px : `int`
        Side of the apertures [px].
    """
    mean, share = _means(residual, weight > 0, aperture_px)
    seen = share > LEAST_SHARE
    if not seen.any():
        return math.nan
    good = weight > 0
    # The noise of a pixel is that of differences of neighbours, which no smooth structure enters.
    noise = _pixel_variance(residual, good) / (aperture_px**2 * share[seen])
    if not np.mean(noise) > 0.0:
        return math.nan
    excess = float(np.mean(mean[seen] ** 2) / np.mean(noise) - 1.0)
    return math.sqrt(max(excess, 0.0))


def uniform_background_indicator(residual: NDArray[Any], good: NDArray[np.bool_]) -> float:
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
    (doi 10.1088/1538-3873/abf77a), with apertures of radius 2 px; here they stand on every pixel that has six
    good ones on either side, and not on random ones.
    """
    values = np.where(good, residual, 0.0).astype(np.float64)
    disc = _disc(UBI_RADIUS_PX)
    reach = int(UBI_REACH * UBI_RADIUS_PX)
    free = uniform_filter(good.astype(np.float32), 2 * reach + 1, mode="constant") > 1.0 - 1e-4
    if not free.any():
        return math.nan
    flux = convolve(values, disc, mode="constant")[free]
    error = np.sqrt(convolve(_box_variance(values, good), disc, mode="nearest")[free])
    middle = float(np.median(error))
    return (float(flux.std()) + middle / float(disc.sum())) / middle if middle > 0.0 else math.nan


def _residual(
    image: NDArray[Any],
    weight: NDArray[Any],
    fit: ScaleFit,
    patterns: Sequence[NDArray[np.float32]],
    background: BackgroundTerms,
) -> FloatArray:
    """Frame less background and fringes; 0 where it has no weight."""
    left = np.where(weight > 0, image - background.surface(fit.coefficient), 0.0)
    for scale, pattern in zip(fit.scale, patterns, strict=True):
        left -= np.where(weight > 0, scale * pattern, 0.0)
    return left


def _means(residual: NDArray[Any], good: NDArray[np.bool_], side: int) -> tuple[FloatArray, FloatArray]:
    """Mean over the good pixels of apertures, and their share of each."""
    share = uniform_filter(good.astype(np.float64), side, mode="constant")
    total = uniform_filter(np.where(good, residual, 0.0), side, mode="constant")
    return total / np.maximum(share, 1e-9), share


def _pixel_variance(residual: NDArray[Any], good: NDArray[np.bool_]) -> float:
    both = good[:, 1:] & good[:, :-1]
    if not both.any():
        raise InputError("pairs of good pixels", 0, "some")
    return 0.5 * float(np.mean(np.square(residual[:, 1:] - residual[:, :-1])[both]))


def _rises(
    before: NDArray[Any],
    fringes: FloatArray,
    weight: NDArray[Any],
    largest: int,
    allowed: FloatArray,
    chi2: float,
) -> dict[str, float]:
    """Probability, for each band of scales, that what is subtracted there adds so much to the squares by chance."""
    looks = {}
    finer, width = fringes, 1
    while width <= max(largest, 2):
        coarser = uniform_filter(fringes, 2 * width + 1)
        band = finer - coarser
        rise = float(np.sum(weight * (band**2 - 2.0 * band * before - allowed)))
        error = 2.0 * math.sqrt(chi2 * float(np.sum(weight * band**2)))
        looks[f"structure of {width} px"] = float(normal.sf(rise / error)) if error > 0.0 else 1.0
        finer, width = coarser, 2 * width
    return looks


def _products(
    image: NDArray[Any],
    weight: NDArray[Any],
    patterns: Sequence[NDArray[np.float32]],
    background: BackgroundTerms,
) -> dict[str, float]:
    """Probability, for each template, of its product with what scales from other pixels leave."""
    squares = np.add.outer(*(np.arange(side) * 2 * BLOCKS // side for side in weight.shape)) % 2 == 0
    sums: list[FloatArray] = [np.zeros((BLOCKS, BLOCKS)) for _ in patterns]
    for used, judged in ((squares, ~squares), (~squares, squares)):
        fit = fit_scales(image, np.where(used, weight, 0), patterns, background, clip_sigma=math.inf)
        left = _residual(image, np.where(judged, weight, 0), fit, patterns, background)
        for number, pattern in enumerate(patterns):
            beside = np.where(weight > 0, pattern, 0.0)
            beside = np.where(weight > 0, beside - beside[weight > 0].mean(), 0.0)
            sums[number] += _block_sums(left * beside * weight)
    return {f"template {number}": _chance(each, sided=2) for number, each in enumerate(sums)}


def _block_sums(values: FloatArray) -> FloatArray:
    edges = [np.arange(BLOCKS) * side // BLOCKS for side in values.shape]
    return np.asarray(np.add.reduceat(np.add.reduceat(values, edges[0], axis=0), edges[1], axis=1))


def _chance(blocks: FloatArray, sided: int) -> float:
    """Probability of a mean over blocks that is so large by chance."""
    values = blocks[blocks != 0.0]
    if values.size < 3:
        return 1.0
    pull = float(values.mean() / (values.std(ddof=1) / math.sqrt(values.size)))
    return float(sided * student.sf(abs(pull) if sided == 2 else pull, values.size - 1))


def _corrected(looks: dict[str, float]) -> tuple[float, str]:
    """Probability of the smallest of several, and which it is."""
    worst = min(looks, key=lambda name: looks[name])
    return float(-math.expm1(len(looks) * math.log1p(-min(looks[worst], 1.0 - 1e-12)))), worst


def _from_scales(
    fit: ScaleFit, patterns: Sequence[NDArray[np.float32]], weight: NDArray[Any], side: int
) -> float:
    """What the errors of the scales leave in an aperture, as a fraction of its noise."""
    good = weight > 0
    smooth = np.stack([_means(each - each[good].mean(), good, side)[0][good] for each in patterns])
    power = float(np.trace(fit.covariance @ (smooth @ smooth.T))) / smooth.shape[1]
    noise = fit.chi2_per_pixel / float(np.mean(weight[good])) / side**2
    return math.sqrt(power / noise) if noise > 0.0 else math.nan


def _disc(radius: float) -> FloatArray:
    """Parts of pixels inside a circle about the central one, from 100 points in each."""
    reach = math.ceil(radius)
    points = (np.arange(10 * (2 * reach + 1)) + 0.5) / 10.0 - reach - 0.5
    inside = np.hypot(points[:, None], points) <= radius
    side = 2 * reach + 1
    return np.asarray(inside.reshape(side, 10, side, 10).mean(axis=(1, 3)))


def _box_variance(values: FloatArray, good: NDArray[np.bool_]) -> FloatArray:
    """Variance of the good pixels in boxes, on every pixel of a box; that of all in boxes without any."""
    padding = [(0, -side % UBI_BOX_PX) for side in values.shape]
    shape = [(side + extra) // UBI_BOX_PX for side, (_, extra) in zip(values.shape, padding, strict=True)]
    sums = [
        np.pad(each, padding).reshape(shape[0], UBI_BOX_PX, shape[1], UBI_BOX_PX).sum(axis=(1, 3))
        for each in (good.astype(np.float64), values, values**2)
    ]
    number = np.maximum(sums[0], 1.0)
    variance = sums[2] / number - (sums[1] / number) ** 2
    full = sums[0] > 0.5 * UBI_BOX_PX**2
    variance[~full] = np.median(variance[full]) if full.any() else values[good].var()
    spread = variance.repeat(UBI_BOX_PX, axis=0).repeat(UBI_BOX_PX, axis=1)
    return np.asarray(spread[: values.shape[0], : values.shape[1]])
