"""Noise of the cells, measured in the data themselves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, FloatArray
from ..flat_prep_options import GAUSSIAN_MAD
from .cells import CellData

LEAST_TRIPLES = 60
"""Fewest second differences from which a noise level is taken; with fewer, the stated variance is believed."""

STATED_UNCERTAINTY = 0.2  # Relative uncertainty of a stated noise level that cannot be checked

CLIP_SIGMA = 5.0

MOST_TAKEN = 0.9  # Part of the variance of the noise that a thickness may take up and still be told from it
LEAST_OTHERS = 2  # Wavelengths besides one that tell errors of a thickness map from noise


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """How the noise of the cells compares with what was stated."""

    factor: FloatArray  # (W,): measured over stated standard deviation of the independent noise
    response_scatter: float  # rms of the response of the cells that all wavelengths have in common
    measured: bool  # whether the data allowed a measurement; otherwise the stated noise stands
    neighbour_correlation: float  # correlation of the noise of neighbouring cells; 0 for independent pixels

    def with_taken(self, part: FloatArray | float) -> NoiseEstimate:
        """The same of data whose fit has taken up a part of the variance of the noise."""
        return replace(self, factor=self.factor / np.sqrt(1.0 - np.clip(part, 0.0, MOST_TAKEN)))


def noise_ratio(cells: CellData, left: Iterable[FloatArray], noise: Iterable[FloatArray]) -> FloatArray:
    """What second differences see of noise that a fit has left, over what they see of all of it.

    ``left``, ``noise`` (W, ny, nx): draws of whitened noise after and before the fit. Returns (W,): ratio of
    variances; 1 for wavelengths without data.
    """
    good = _all_of_nine(cells.weight > 0)

    def variance(draws: Iterable[FloatArray]) -> FloatArray:
        return np.asarray(sum((_second_difference(one) ** 2 * good).sum(axis=(1, 2)) for one in draws))

    whole = variance(noise)
    return np.divide(variance(left), whole, out=np.ones_like(whole), where=whole > 0.0)


def estimate_noise(cells: CellData, residual: FloatArray) -> NoiseEstimate:
    """Compare second differences of the residual with the stated noise.

    Second differences along both axes remove whatever is smooth on the scale of three cells. Their variance at one
    wavelength is that of the noise; their covariance between wavelengths is the scatter of the response of the
    cells, which no wavelength sees alone.

    ``residual`` (W, ny, nx).
    """
    waves = cells.shape[0]
    assumed = NoiseEstimate(np.ones(waves), cells.response_scatter, False, 0.0)
    if min(cells.shape[1:]) < 3:
        return assumed
    good = _all_of_nine(cells.weight > 0)
    common = good.all(axis=0)
    if min(int(plane.sum()) for plane in good) < LEAST_TRIPLES:
        return assumed
    difference = _second_difference(residual)
    stated = np.zeros(waves)
    measured = np.zeros(waves)
    clean = common.copy()
    for plane in range(waves):
        own = difference[plane][good[plane]]
        spread = GAUSSIAN_MAD * float(np.median(np.abs(own)))
        inlier = np.abs(difference[plane]) < CLIP_SIGMA * spread
        clean &= inlier
        use = good[plane] & inlier
        measured[plane] = float((difference[plane][use] ** 2).mean())
        stated[plane] = float(_mean_of_nine(1.0 / np.maximum(cells.weight[plane], 1e-300))[use].mean())
    scatter = (
        _common_variance(difference[:, clean], measured) if waves > 1 and clean.sum() > LEAST_TRIPLES else 0.0
    )
    independent = np.maximum(measured - scatter, 0.05 * measured)
    return NoiseEstimate(
        np.sqrt(independent / stated), float(np.sqrt(scatter)), True, _neighbour_correlation(difference, good)
    )


def scatter_of_pixels(image: NDArray[np.floating], good: BoolArray) -> float:
    """Standard deviation of what neighbouring pixels do not share, from the median of their second differences.

    ``image``, ``good`` (ny, nx). Infinite where too few pixels tell.
    """
    if min(image.shape) < 3:
        return float("inf")
    use = _all_of_nine(good[np.newaxis])
    if use.sum() < LEAST_TRIPLES:
        return float("inf")
    known = np.where(good, image, 0.0).astype(float)
    return GAUSSIAN_MAD * float(np.median(np.abs(_second_difference(known[np.newaxis])[use])))


def _common_variance(difference: FloatArray, measured: FloatArray) -> float:
    """Mean covariance of different wavelengths, 0 unless it is significant."""
    waves, count = difference.shape
    scaled = difference / np.sqrt(measured)[:, np.newaxis]
    total = scaled.sum(axis=0)
    pairs = 0.5 * (total**2 - (scaled**2).sum(axis=0))
    number = 0.5 * waves * (waves - 1)
    mean = float(pairs.mean()) / number
    # Second differences overlap: about one in three is independent.
    error = float(pairs.std()) / number / np.sqrt(count / 3.0)
    return mean * float(measured.mean()) if mean > 5.0 * error and mean > 1e-3 else 0.0


def _neighbour_correlation(difference: FloatArray, good: BoolArray) -> float:
    """Correlation of neighbours beyond the -2/3 that second differences of independent noise have."""
    both = good[:, :, 1:] & good[:, :, :-1]
    product = float((difference[:, :, 1:] * difference[:, :, :-1])[both].mean()) if both.any() else 0.0
    square = float((difference[good] ** 2).mean())
    return product / square + 2.0 / 3.0 if square > 0.0 else 0.0


def _second_difference(image: FloatArray) -> FloatArray:
    """Second difference along both axes with unit noise gain, ``(W, ny-2, nx-2)``."""
    rows = image[:, :-2] - 2.0 * image[:, 1:-1] + image[:, 2:]
    both: FloatArray = (rows[:, :, :-2] - 2.0 * rows[:, :, 1:-1] + rows[:, :, 2:]) / 6.0
    return both


def _all_of_nine(good: BoolArray) -> BoolArray:
    rows = good[:, :-2] & good[:, 1:-1] & good[:, 2:]
    both: BoolArray = rows[:, :, :-2] & rows[:, :, 1:-1] & rows[:, :, 2:]
    return both


def _mean_of_nine(image: FloatArray) -> FloatArray:
    """Noise variance of a second difference of cells with the given variances."""
    rows = image[:-2] + 4.0 * image[1:-1] + image[2:]
    both: FloatArray = (rows[:, :-2] + 4.0 * rows[:, 1:-1] + rows[:, 2:]) / 36.0
    return both


def map_variance_share(slope: FloatArray, residual: FloatArray, variance_um2: float) -> float:
    """Part of the stated variance of a thickness map that its errors have, at most all of it.

    An error of the map shows along the derivative with respect to thickness, noise in all directions alike.

    ``slope``, ``residual`` (W, ny, nx): whitened derivative with respect to thickness [1/µm], and whitened
    residual at the map; both 0 without data. ``variance_um2``: stated variance [µm²]. Returns the most likely part,
    0 to 1; 1 where there are too few wavelengths to tell.
    """
    curvature = (slope**2).sum(axis=0)
    others = (slope != 0.0).sum(axis=0) - 1
    used = (curvature > 0.0) & (others >= LEAST_OTHERS)
    if not used.any():
        return 1.0
    along = (slope * residual).sum(axis=0)[used] ** 2 / curvature[used]
    beside = (residual**2).sum(axis=0)[used] - along
    # Cells that something else has spoiled count for no more than the worst tenth of a percent.
    noise = float(np.minimum(beside, np.percentile(beside, 99.9)).sum() / others[used].sum())
    stated = variance_um2 * curvature[used]
    along = np.minimum(along, CLIP_SIGMA**2 * (noise + stated))
    shares = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 81)])
    cost = [float((np.log(noise + part * stated) + along / (noise + part * stated)).sum()) for part in shares]
    return float(shares[int(np.argmin(cost))])
