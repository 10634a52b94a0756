"""Correlation function of images and of coadds that still contain fringes (section 5.4 and Figure 16).

The estimator is that of TreeCorr's ``KKCorrelation``, ``sum(w w' k k') / sum(w w')`` over all pairs of pixels in bins
of log separation. On a grid the pairs of one lag are one product of Fourier transforms, so that every pair is
counted, exactly, in the time of a few transforms.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike
from scipy.ndimage import affine_transform, spline_filter

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError

__all__ = [
    "CoaddCorrelation",
    "CorrelationFunction",
    "LogBins",
    "coadd_correlation",
    "coadd_model",
    "correlation_function",
    "random_cutout",
]


@dataclass(frozen=True)
class LogBins:
    """Bins of separation, uniform in its logarithm.

    Attributes
    ----------
    smallest_px, largest_px : `float`
        Limits of the separations [px].
    count : `int`
        Number of bins.
    """

    smallest_px: float = 1.0
    largest_px: float = 256.0
    count: int = 24

    def __post_init__(self) -> None:
        if not 0.0 < self.smallest_px < self.largest_px < math.inf:
            raise OutOfRangeError(
                "separations [px]", (self.smallest_px, self.largest_px), "two increasing, positive numbers"
            )
        if self.count < 1:
            raise OutOfRangeError("number of bins", self.count, "1 or more")

    @property
    def edges_px(self) -> FloatArray:
        """Limits of the bins [px], shape ``(count + 1,)``."""
        return np.geomspace(self.smallest_px, self.largest_px, self.count + 1)

    @property
    def size(self) -> float:
        """Width of a bin in the natural logarithm."""
        return math.log(self.largest_px / self.smallest_px) / self.count


@dataclass(frozen=True, eq=False)
class CorrelationFunction:
    """Correlation against separation.

    Attributes
    ----------
    separation_px : `numpy.ndarray`, shape ``(B,)``
        Mean separation of the pairs of a bin [px]; the middle of an empty bin.
    xi : `numpy.ndarray`, shape ``(B,)``
        Mean product; NaN in an empty bin.
    weight : `numpy.ndarray`, shape ``(B,)``
        Sum of the weights of the pairs; their number if all weights are 1.
    """

    separation_px: FloatArray
    xi: FloatArray
    weight: FloatArray


@dataclass(frozen=True, eq=False)
class CoaddCorrelation:
    """Correlation functions of coadds of more and more exposures.

    Attributes
    ----------
    counts : `tuple` [`int`, ...]
        Exposures in the coadds.
    coadd : `tuple` [`CorrelationFunction`, ...]
        Of the coadds with fringes and noise.
    null : `tuple` [`CorrelationFunction`, ...]
        Of coadds of as many exposures of noise alone.
    model : `tuple` [`numpy.ndarray`, ...]
        ``xi_1 / N + (1 - 1 / N) xi_floor`` for the same counts, without noise.
    single, floor : `CorrelationFunction`
        Mean correlation of one exposure's fringes, and of the fringes of two different exposures.
    """

    counts: tuple[int, ...]
    coadd: tuple[CorrelationFunction, ...]
    null: tuple[CorrelationFunction, ...]
    model: tuple[FloatArray, ...]
    single: CorrelationFunction
    floor: CorrelationFunction


def correlation_function(
    image: ArrayLike, weight: ArrayLike | None = None, bins: LogBins | None = None
) -> CorrelationFunction:
    """Correlation of an image with itself.

    Parameters
    ----------
    image : array_like, shape ``(ny, nx)``
        Values, e.g. fluxes less their mean. Nothing is subtracted here.
    weight : array_like, shape ``(ny, nx)``, optional
        Weights; 0 where a pixel is masked. Pixels that are not finite get weight 0.
    bins : `LogBins`, optional
        Separations.

    Returns
    -------
    correlation : `CorrelationFunction`
        Every pair counts once.

    Raises
    ------
    InputError
        An image without two axes, weights that do not fit or are negative, or no good pixel.
    """
    values, weights = _weighted(image, weight)
    return _autocorrelation(values, weights, _bins_for(values, bins))


def coadd_model(single: ArrayLike, floor: ArrayLike, count: int) -> FloatArray:
    """Correlation of a mean of N exposures, ``xi_1 / N + (1 - 1 / N) xi_floor``.

    Parameters
    ----------
    single : array_like
        Mean correlation of one exposure with itself.
    floor : array_like
        Mean correlation of two different exposures: that of the pattern that no dither and no rotation removes.
    count : `int`
        Exposures N.
    """
    if count < 1:
        raise OutOfRangeError("exposures in a coadd", count, "1 or more")
    return np.asarray(single, dtype=float) / count + (1.0 - 1.0 / count) * np.asarray(floor, dtype=float)


def random_cutout(coefficients: ArrayLike, size_px: int, rng: np.random.Generator) -> FloatArray:
    """Square cut from a pattern at a random place and under a random angle.

    Parameters
    ----------
    coefficients : array_like, shape ``(ny, nx)``
        Cubic spline coefficients of the pattern, from `scipy.ndimage.spline_filter`.
    size_px : `int`
        Side of the square [px]; its diagonal must fit into the pattern.
    rng : `numpy.random.Generator`
        Source of randomness.

    Raises
    ------
    OutOfRangeError
        The square does not fit under every angle.
    """
    pattern = np.asarray(coefficients)
    reach = 0.5 * math.sqrt(2.0) * (size_px - 1) + 1.0
    high = np.array(pattern.shape) - 1.0 - reach
    if size_px < 2 or np.any(high < reach):
        raise OutOfRangeError(
            "side of the region [px]", size_px, f"2 to {int((min(pattern.shape) - 3) / math.sqrt(2.0))}"
        )
    centre = rng.uniform(reach, high)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    offset = centre - turn @ np.full(2, 0.5 * (size_px - 1))
    cut = affine_transform(pattern, turn, offset, (size_px, size_px), order=3, prefilter=False)
    return np.asarray(cut, dtype=float)


def coadd_correlation(
    patterns: Sequence[ArrayLike],
    counts: Sequence[int],
    noise_rms: float,
    rng: np.random.Generator,
    *,
    region_px: int = 256,
    bins: LogBins | None = None,
) -> CoaddCorrelation:
    """Correlation that fringes leave in coadds of randomly placed and rotated exposures.

    Parameters
    ----------
    patterns : sequence of array_like
        Fringe patterns (of several sensors, of several hours, or what a correction leaves of them) as fractions of
        the sky or in electrons; each exposure takes one of them at random.
    counts : sequence of `int`
        Exposures in the coadds, ascending; a coadd continues the one before.
    noise_rms : `float`
        White noise of a pixel of one exposure, in the units of the patterns.
    rng : `numpy.random.Generator`
        Source of randomness.
    region_px : `int`, optional
        Side of the region that is coadded [px].
    bins : `LogBins`, optional
        Separations; up to half of the region by default.

    Returns
    -------
    result : `CoaddCorrelation`

    Raises
    ------
    InputError
        No pattern, a pattern with pixels that are not finite, or counts that do not ascend.
    OutOfRangeError
        A negative noise, or a region that does not fit under every angle.

    Notes
    -----
    The mean of every exposure and coadd is subtracted, as in the paper. ``single`` and ``floor`` are estimated from
    the same exposures: the mean of their own correlations, and what is left of the correlation of the noiseless mean
    of all of them.
    """
    wanted = tuple(int(count) for count in counts)
    if not wanted or wanted[0] < 1 or any(two <= one for one, two in itertools.pairwise(wanted)):
        raise InputError("exposures in the coadds", wanted, "whole numbers, ascending from 1 or more")
    if not 0.0 <= noise_rms < math.inf:
        raise OutOfRangeError("noise rms", noise_rms, "finite and not negative")
    splines = [_spline(pattern) for pattern in patterns]
    if not splines:
        raise InputError("fringe patterns", 0, "one or more")
    chosen = LogBins(1.0, 0.5 * region_px, 20) if bins is None else bins
    fringes, noise = np.zeros((region_px, region_px)), np.zeros((region_px, region_px))
    coadds, nulls = [], []
    own = np.zeros(chosen.count)
    for number in range(1, wanted[-1] + 1):
        cut = random_cutout(splines[rng.integers(len(splines))], region_px, rng)
        cut -= cut.mean()
        own += correlation_function(cut, bins=chosen).xi
        fringes += cut
        noise += noise_rms * rng.standard_normal(cut.shape)
        if number in wanted:
            coadds.append(correlation_function(_centred((fringes + noise) / number), bins=chosen))
            nulls.append(correlation_function(_centred(noise / number), bins=chosen))
    total = wanted[-1]
    last = correlation_function(_centred(fringes / total), bins=chosen)
    mean_own = own / total
    # xi_N = xi_1 / N + (1 - 1 / N) xi_floor holds exactly for the exposures of one coadd; solved for the floor.
    beyond = (last.xi - mean_own / total) * (total / (total - 1.0)) if total > 1 else np.zeros_like(own)
    single = CorrelationFunction(last.separation_px, mean_own, last.weight)
    floor = CorrelationFunction(last.separation_px, beyond, last.weight)
    models = tuple(coadd_model(mean_own, beyond, count) for count in wanted)
    return CoaddCorrelation(wanted, tuple(coadds), tuple(nulls), models, single, floor)


def _autocorrelation(values: FloatArray, weights: FloatArray, bins: LogBins) -> CorrelationFunction:
    """Sums of products and of weights over all lags of a bin; every pair is met twice, as +lag and -lag."""
    reach = [min(side - 1, math.floor(bins.largest_px)) for side in values.shape]
    # Zeros for as many pixels as the largest lag keep the ends apart.
    size = [
        scipy.fft.next_fast_len(side + lag, real=True) for side, lag in zip(values.shape, reach, strict=True)
    ]
    rows, columns = (np.arange(-lag, lag + 1) for lag in reach)

    def lagged(one: FloatArray) -> FloatArray:
        power = np.abs(scipy.fft.rfft2(one, size, workers=-1)) ** 2
        return scipy.fft.irfft2(power, size, workers=-1)[np.ix_(rows, columns)]

    if np.all(weights == 1.0):  # all pixels: the number of pairs at a lag is known
        pairs = np.outer(values.shape[0] - np.abs(rows), values.shape[1] - np.abs(columns)).astype(float)
    else:
        pairs = lagged(weights)
    squared = (rows**2)[:, None] + columns**2
    squared[reach[0], reach[1]] = 1  # a pixel is no neighbour of its own; its bin is set below
    # As TreeCorr: half the logarithm of the squared separation, bins closed below.
    bin_of = np.floor((0.5 * np.log(squared) - math.log(bins.smallest_px)) / bins.size).astype(int)
    bin_of[reach[0], reach[1]] = -1
    used = (bin_of >= 0) & (bin_of < bins.count)
    place, count = bin_of[used], pairs[used]
    product, weight, distance = (
        np.bincount(place, each, minlength=bins.count)
        for each in (lagged(values)[used], count, count * np.sqrt(squared[used]))
    )
    edges = bins.edges_px
    separation = np.sqrt(edges[1:] * edges[:-1])
    xi = np.full(bins.count, np.nan)
    # Transforms leave rounding where there are no pairs.
    filled = weight > 1e-9 * max(float(weight.max()), np.finfo(float).tiny)
    xi[filled] = product[filled] / weight[filled]
    separation[filled] = distance[filled] / weight[filled]
    return CorrelationFunction(separation, xi, np.where(filled, 0.5 * weight, 0.0))


def _weighted(image: ArrayLike, weight: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
    """Values times weights, and weights, both without NaN."""
    values = np.array(image, dtype=float)
    if values.ndim != 2:
        raise InputError("shape of the image", values.shape, "two axes (y, x)")
    weights = np.ones_like(values) if weight is None else np.array(weight, dtype=float)
    if weights.shape != values.shape:
        raise InputError("shape of the weights", weights.shape, f"{values.shape}")
    if not np.all(weights >= 0.0) or not np.all(np.isfinite(weights)):
        raise InputError("weights", "negative or not finite", "finite and not negative")
    bad = ~np.isfinite(values)
    weights[bad], values[bad] = 0.0, 0.0
    if not weights.any():
        raise InputError("good pixels", 0, "at least one")
    return values * weights, weights


def _bins_for(values: FloatArray, bins: LogBins | None) -> LogBins:
    return LogBins(1.0, max(2.0, 0.25 * min(values.shape)), 24) if bins is None else bins


def _centred(image: FloatArray) -> FloatArray:
    return image - image.mean()


def _spline(pattern: ArrayLike) -> FloatArray:
    values = np.asarray(pattern, dtype=float)
    if values.ndim != 2 or not np.all(np.isfinite(values)):
        raise InputError("fringe pattern", values.shape, "two axes, every pixel finite")
    return np.asarray(spline_filter(values, order=3))
