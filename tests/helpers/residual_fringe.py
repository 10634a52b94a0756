"""What templates leave of a frame without noise, beside the shot noise of its sky."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import uniform_filter


@dataclass(frozen=True)
class Residual:
    """Standard deviations over the sky: of the residual, of its means over an aperture, of their shot noise."""

    rms: float
    smoothed_rms: float
    shot_noise: float

    @property
    def ratio(self) -> float:
        """Residual over shot noise in the aperture; the DES criterion asks for less than 0.1."""
        return self.smoothed_rms / self.shot_noise


def residual_fringe(
    residual: ArrayLike, sky_electrons: float, aperture_px: int, read_noise_e: float = 0.0
) -> Residual:
    """Compare a residual without noise [e⁻] with the shot noise in a square aperture."""
    values = np.asarray(residual, dtype=float)
    share = uniform_filter(np.ones(values.shape), aperture_px, mode="constant")
    smooth = uniform_filter(values - values.mean(), aperture_px, mode="constant")
    full = share > 0.9
    noise = math.sqrt(sky_electrons + read_noise_e**2) / aperture_px
    averaged = smooth[full] / share[full]
    return Residual(values.std() / sky_electrons, averaged.std() / sky_electrons, noise / sky_electrons)
