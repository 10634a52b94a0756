"""Photon and read noise of large exposures."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import Float32Array
from ..compiled import run_threaded
from ..errors import InputError, OutOfRangeError

_BAND_ROWS = 64
"""Rows with a random stream of their own: their number, not that of the threads, decides the numbers."""


def add_exposure_noise(
    electrons: ArrayLike, rng: np.random.Generator, read_noise_e: float = 0.0
) -> Float32Array:
    """Poisson noise of the photoelectrons and Gaussian read noise [e⁻], exact up to 2²⁴ electrons.

    From ``rng`` one stream is spawned for every 64 rows.
    """
    image = np.asarray(electrons)
    if image.ndim != 2:
        raise InputError("shape of the image", image.shape, "two axes (y, x)")
    if not 0.0 <= read_noise_e < math.inf:
        raise OutOfRangeError("read noise [e]", read_noise_e, "finite and not negative")
    lowest = float(image.min())
    if not lowest >= 0.0 or not math.isfinite(float(image.max())):
        raise InputError("expected electrons", lowest, "finite and not negative in every pixel")
    noisy = np.empty(image.shape, dtype=np.float32)
    streams = rng.spawn(-(-len(image) // _BAND_ROWS))

    def expose(number: int) -> None:
        band, stream = slice(number * _BAND_ROWS, (number + 1) * _BAND_ROWS), streams[number]
        noisy[band] = stream.poisson(image[band])
        if read_noise_e > 0.0:
            read = stream.standard_normal(noisy[band].shape, dtype=np.float32)
            noisy[band] += np.float32(read_noise_e) * read

    # Random numbers are drawn outside of Python's lock.
    run_threaded(expose, len(streams))
    return noisy
