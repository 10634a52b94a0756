"""Gaussian smoothing that knows of masks and of noise."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, OutOfRangeError

__all__ = ["smooth_masked"]

Image = NDArray[np.float32]

SMOOTHING_REACH = 4.0
"""Half width of the smoothing kernel in standard deviations."""

MINIMUM_WEIGHT = 0.02
"""Least part of the smoothing kernel that must lie on good pixels for a value in a pixel that is not good."""


def smooth_masked(
    image: Image, variance: Image, good: NDArray[np.bool_], sigma_px: float
) -> tuple[Image, Image]:
    """Gaussian average over good pixels only, and its variance.

    With kernel ``G`` and weight ``w`` (1 on good pixels, else 0): ``Σ G w I / Σ G w``, variance
    ``Σ G² w V / (Σ G w)²``. Pixels that are not good, or not finite, count nowhere; they receive the average of
    their good neighbours.

    Parameters
    ----------
    image, variance : `numpy.ndarray` [y, x]
        Values with independent noise, and their variance.
    good : `numpy.ndarray` [y, x], bool
        Pixels to use.
    sigma_px : `float`
        Standard deviation of the kernel [px], cut off at four of them; 0 leaves good pixels as they are.

    Returns
    -------
    smoothed, variance : `numpy.ndarray` [y, x], float32
        NaN in pixels that are not good and have less than 2 % of the kernel on good ones. Neighbouring values are
        correlated: the noise of the result has a Gaussian correlation of standard deviation ``sqrt(2) sigma_px``.

    Raises
    ------
    InputError
        The arrays have different shapes, or are not two-dimensional.
    OutOfRangeError
        ``sigma_px`` is negative.
    """
    if image.ndim != 2 or not image.shape == variance.shape == good.shape:
        shapes = (image.shape, variance.shape, good.shape)
        raise InputError("shapes of image, variance and mask", shapes, "one two-dimensional shape")
    if not sigma_px >= 0.0:
        raise OutOfRangeError("smoothing sigma [px]", sigma_px, "zero or a positive number")
    usable = good & np.isfinite(image) & np.isfinite(variance)
    if sigma_px == 0.0:
        nothing = np.float32(np.nan)
        return (
            np.where(usable, image, nothing).astype(np.float32),
            np.where(usable, variance, nothing).astype(np.float32),
        )
    kernel = _gaussian_kernel(sigma_px)
    value, noise = np.empty(image.shape, np.float32), np.empty(image.shape, np.float32)
    zero = np.float32(0.0)
    _smooth(
        np.where(usable, image, zero).astype(np.float32, copy=False),
        np.where(usable, variance, zero).astype(np.float32, copy=False),
        usable.astype(np.float32),
        kernel,
        value,
        noise,
    )
    return value, noise


def _gaussian_kernel(sigma_px: float) -> Image:
    reach = max(1, math.ceil(SMOOTHING_REACH * sigma_px))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return (kernel / kernel.sum()).astype(np.float32)


@numba.njit(cache=True)
def _accumulate(total: Image, values: Image, factor: float) -> None:  # pragma: no cover - compiled
    for x in range(total.size):
        total[x] += factor * values[x]


@numba.njit(cache=True, parallel=True)
def _smooth(
    image: Image, variance: Image, weight: Image, kernel: Image, value: Image, noise: Image
) -> None:  # pragma: no cover - compiled
    ny, nx = image.shape
    reach = kernel.size // 2
    for line in numba.prange(ny):
        y = int(np.int64(line))  # the parallel index is unsigned
        # Along the columns first, into one row with room for the kernel at both ends; then along that row.
        column = np.zeros((3, nx + 2 * reach), np.float32)
        inner = column[:, reach : reach + nx]
        for t in range(max(-reach, -y), min(reach, ny - 1 - y) + 1):
            k = kernel[t + reach]
            _accumulate(inner[0], image[y + t], k)
            _accumulate(inner[1], weight[y + t], k)
            _accumulate(inner[2], variance[y + t], k * k)
        row = np.zeros((3, nx), np.float32)
        for t in range(kernel.size):
            k = kernel[t]
            _accumulate(row[0], column[0, t : t + nx], k)
            _accumulate(row[1], column[1, t : t + nx], k)
            _accumulate(row[2], column[2, t : t + nx], k * k)
        for x in range(nx):
            w = row[1, x]
            if w >= MINIMUM_WEIGHT or weight[y, x] > 0.0:
                value[y, x] = row[0, x] / w
                noise[y, x] = row[2, x] / (w * w)
            else:
                value[y, x] = np.nan
                noise[y, x] = np.nan
