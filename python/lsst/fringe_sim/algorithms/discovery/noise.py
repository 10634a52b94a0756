"""Noise of the cells, from what neighbouring cells do not share beside response and thickness of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, FloatArray
from ..flat_prep_options import GAUSSIAN_MAD
from ..inference import Point

FEWEST = 60
"""Second differences from which a noise level is taken; with fewer the stated one is believed, as before."""

STATED_UNCERTAINTY = 0.2  # Relative uncertainty of a stated noise level that cannot be checked


def is_measured(seen: BoolArray) -> bool:
    """Whether cells with data, ``(ny, nx)``, are enough to measure their noise."""
    return min(seen.shape) >= 3 and int(_nine(seen[np.newaxis]).sum()) >= FEWEST


def measured_noise(point: Point, shape: tuple[int, int, int]) -> tuple[FloatArray, float]:
    """Measured over stated standard deviation of the noise ``(W,)``, and the scatter of the response of the cells.

    The projected residual of a cell has the variance that its projector says; second differences of neighbours remove
    what is smooth. What exceeds that along the response, beside a thickness that may be off by its error, is scatter
    of the response.
    """
    seen = np.asarray((point.problem.data.weight > 0.0).all(axis=0)).reshape(shape[1:])
    if not is_measured(seen):
        return np.ones(shape[0]), point.problem.response_sigma
    good = _nine(seen[np.newaxis])[0]
    # A thickness that is known has followed the noise by a part of its error.
    left = point.projected(point.first_residual).reshape(shape)
    share = _mean_of_nine(point.noise_share.reshape(shape))
    factor = np.sqrt((_second(left)[:, good] ** 2).mean(axis=1) / share[:, good].mean(axis=1))
    factor = _shrunk(factor, int(good.sum()))
    common = point.beside_thickness(point.response)
    length = np.sqrt((common * point.response).sum(axis=0)).clip(1e-12)
    along = ((common * point.first_residual).sum(axis=0) / length).reshape(1, *shape[1:])
    excess = (_second(along)[0, good] ** 2).mean() - float(np.mean(factor**2))
    scatter2 = excess / _mean_of_nine((length**2).reshape(1, *shape[1:]))[0, good].mean()
    return factor, float(np.sqrt(max(scatter2, 0.0)))


def neighbour_scatter(field: FloatArray, seen: BoolArray, stated: float) -> float:
    """Standard deviation of what neighbours of a field ``(ny, nx)`` do not share; the stated one if there are few."""
    if not is_measured(seen):
        return stated
    return float(np.sqrt((_second(field[np.newaxis])[0, _nine(seen[np.newaxis])[0]] ** 2).mean()))


def scatter_of_pixels(image: NDArray[np.floating], good: BoolArray) -> float:
    """Standard deviation of what neighbouring pixels do not share, from the median of their second differences.

    ``image``, ``good`` (ny, nx). Infinite where too few pixels tell.
    """
    if min(image.shape) < 3:
        return float("inf")
    use = _nine(good[np.newaxis])
    if use.sum() < FEWEST:
        return float("inf")
    known = np.where(good, image, 0.0).astype(float)
    return GAUSSIAN_MAD * float(np.median(np.abs(_second(known[np.newaxis])[use])))


OVERLAP = 3.78
"""Sum of the squared correlations of second differences of independent noise: how many of them are worth one."""


def _shrunk(factor: FloatArray, number: int) -> FloatArray:
    """Factors drawn to their mean by as much of their scatter as their own errors explain."""
    error2 = OVERLAP / (2.0 * number)
    middle = float(factor.mean())
    scatter2 = float(factor.var()) / middle**2
    return middle + (factor - middle) * float(np.sqrt(max(1.0 - error2 / max(scatter2, 1e-300), 0.0)))


def _second(image: FloatArray) -> FloatArray:
    """Second difference along both axes with unit noise gain, ``(W, ny-2, nx-2)``."""
    rows = image[:, :-2] - 2.0 * image[:, 1:-1] + image[:, 2:]
    return np.asarray((rows[:, :, :-2] - 2.0 * rows[:, :, 1:-1] + rows[:, :, 2:]) / 6.0)


def _mean_of_nine(image: FloatArray) -> FloatArray:
    """Variance of that for cells of such variances."""
    rows = image[:, :-2] + 4.0 * image[:, 1:-1] + image[:, 2:]
    return np.asarray((rows[:, :, :-2] + 4.0 * rows[:, :, 1:-1] + rows[:, :, 2:]) / 36.0)


def _nine(good: BoolArray) -> BoolArray:
    rows = good[:, :-2] & good[:, 1:-1] & good[:, 2:]
    return np.asarray(rows[:, :, :-2] & rows[:, :, 1:-1] & rows[:, :, 2:])
