"""Gaussian smoothing that knows of masks and of noise."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from ..array_types import BoolArray, Float32Array, FloatArray
from ..compiled import run_threaded
from ..errors import InputError, OutOfRangeError

Image = Float32Array

SMOOTHING_REACH = 4.0  # Half width of the smoothing kernel in standard deviations

MINIMUM_WEIGHT = 0.02
"""Least part of the smoothing kernel that must lie on good pixels for a value in a pixel that is not good."""

_BAND_ROWS = 256  # Rows that one thread smooths at a time


def smooth_masked(image: Image, variance: Image, good: BoolArray, sigma_px: float) -> tuple[Image, Image]:
    """Gaussian average over good pixels only, and its variance.

    With kernel ``G`` and weight ``w`` (1 on good pixels, else 0): ``Σ G w I / Σ G w``, variance
    ``Σ G² w V / (Σ G w)²``. Pixels that are not good, or not finite, count nowhere; they receive the average of
    their good neighbours.

    ``image``, ``variance``: values with independent noise, and their variance.
    ``good``: pixels to use.
    ``sigma_px``: standard deviation of the kernel [px], cut off at four of them; 0 leaves good pixels as they
    are.
    Returns NaN in pixels that are not good and have less than 2 % of the kernel on good ones. Neighbouring
    values are correlated: the noise of the result has a Gaussian correlation of standard deviation
    ``sqrt(2) sigma_px``.
    `InputError`: the arrays have different shapes, or are not two-dimensional.
    `OutOfRangeError`: ``sigma_px`` is negative.
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
    reach = len(kernel) // 2
    value, noise = np.empty(image.shape, np.float32), np.empty(image.shape, np.float32)

    def smooth(band: int) -> None:
        """Rows of one band, from those that reach into it."""
        start = band * _BAND_ROWS
        stop = min(start + _BAND_ROWS, len(image))
        first = max(start - reach, 0)
        rows, inner = slice(first, stop + reach), slice(start - first, stop - first)
        near = usable[rows]

        def spread(values: NDArray[np.floating], factors: FloatArray) -> Float32Array:
            masked = np.where(near, values, np.float32(0.0)).astype(np.float32, copy=False)
            columns = correlate1d(masked, factors, axis=0, mode="constant")[inner]
            return correlate1d(columns, factors, axis=1, mode="constant")

        weight = spread(np.ones(near.shape, np.float32), kernel)
        enough = (weight >= MINIMUM_WEIGHT) | near[inner]
        weight[~enough] = np.nan
        value[start:stop] = spread(image[rows], kernel) / weight
        noise[start:stop] = spread(variance[rows], kernel**2) / weight**2

    run_threaded(smooth, -(-len(image) // _BAND_ROWS))
    return value, noise


def _gaussian_kernel(sigma_px: float) -> FloatArray:
    reach = max(1, math.ceil(SMOOTHING_REACH * sigma_px))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return kernel / kernel.sum()
