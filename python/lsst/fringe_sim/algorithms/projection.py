"""Coefficients of a frame in a basis of patterns, with their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..errors import InputError
from .frame_stack import TILE_BYTES


@dataclass(frozen=True, eq=False)
class Projection:
    """Coefficients of a frame in a basis.

    Attributes
    ----------
    coefficient : `numpy.ndarray`, shape ``(K,)``
        Least-squares coefficients.
    covariance : `numpy.ndarray`, shape ``(K, K)``
        Their covariance.
    background : `float`
        Constant level fitted beside them.
    chi2_per_pixel : `float`
        Mean squared residual in units of the variance.
    """

    coefficient: FloatArray
    covariance: FloatArray
    background: float
    chi2_per_pixel: float


def project(
    frame: ArrayLike, basis: ArrayLike, variance: ArrayLike | float, mask: ArrayLike | None = None
) -> Projection:
    """Fit a frame by a constant and the patterns of a basis.

    Parameters
    ----------
    frame : array_like, shape ``(ny, nx)``
        Image.
    basis : array_like, shape ``(K, ny, nx)``
        Patterns.
    variance : array_like or `float`
        Variance of the frame; broadcasts to it.
    mask : array_like, shape ``(ny, nx)``, optional
        Non-zero where a pixel is not to be used.

    Raises
    ------
    InputError
        Shapes that do not belong together, too few good pixels, or patterns that are not independent.
    """
    image, patterns = np.asarray(frame), np.asarray(basis)
    if patterns.ndim != 3 or patterns.shape[1:] != image.shape:
        raise InputError("shape of the basis", patterns.shape, f"(patterns, {image.shape})")
    noise = np.broadcast_to(np.asarray(variance, dtype=float), image.shape)
    flags = None if mask is None else np.asarray(mask)
    if flags is not None and flags.shape != image.shape:
        raise InputError("shape of the mask", flags.shape, f"{image.shape}")
    size = len(patterns) + 1
    normal, moment, square, used = np.zeros((size, size)), np.zeros(size), 0.0, 0
    rows = max(1, TILE_BYTES // (16 * size * image.shape[1]))
    for start in range(0, image.shape[0], rows):
        part = slice(start, start + rows)
        good = np.isfinite(image[part]) & (noise[part] > 0.0) & np.isfinite(patterns[:, part]).all(axis=0)
        if flags is not None:
            good &= flags[part] == 0
        weight = 1.0 / np.sqrt(noise[part][good])
        design = np.vstack([np.ones(weight.size), patterns[:, part][:, good]]) * weight
        data = image[part][good] * weight
        normal += design @ design.T
        moment += design @ data
        square += float(data @ data)
        used += weight.size
    if used <= size:
        raise InputError("good pixels", used, f"more than {size}")
    try:
        factor = scipy.linalg.cho_factor(normal)
    except np.linalg.LinAlgError:
        raise InputError("basis", "dependent patterns", "patterns that are independent") from None
    solution = scipy.linalg.cho_solve(factor, moment)
    covariance = scipy.linalg.cho_solve(factor, np.eye(size))
    return Projection(
        solution[1:],
        covariance[1:, 1:],
        float(solution[0]),
        max(square - float(solution @ moment), 0.0) / used,
    )
