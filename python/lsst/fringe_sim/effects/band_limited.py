"""Filters of images that their samples define: cosine series, mirrored at the edges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.fft import dct, idct

from .base import FloatArray
from .image_geometry import ImageGeometry

__all__ = ["filtered"]


def filtered(
    image: FloatArray, geometry: ImageGeometry, axis: int, response: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Multiply the cosine series of an image along one axis by a function of its frequency.

    Parameters
    ----------
    image : `numpy.ndarray`, shape ``(..., ny, nx)``
        The image.
    geometry : `ImageGeometry`
        Where its samples lie.
    axis : `int`
        -2 or -1.
    response : callable
        Factor at angular frequencies [rad/px].

    Returns
    -------
    image : `numpy.ndarray`, shape ``(..., ny, nx)``
    """
    size = image.shape[axis]
    factor = response(np.arange(size) * np.pi / size / geometry.cell_px[axis])
    shape = (size, 1) if axis == -2 else (size,)
    result: FloatArray = idct(dct(image, type=2, axis=axis) * factor.reshape(shape), type=2, axis=axis)
    return result
