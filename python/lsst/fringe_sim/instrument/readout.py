"""From electrons to units of surface brightness."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..errors import named_units
from .bandpass import Bandpass

__all__ = ["electrons_to_microjansky", "magnitude_to_microjansky", "microjansky_to_magnitude", "zero_point"]

AB_MICROJANSKY_ZERO_POINT = 23.9  # AB magnitude of 1 µJy
_PLANCK_J_S = 6.62607015e-34


def zero_point(bandpass: Bandpass, collecting_area_m2: float, airmass: float | None = None) -> float:
    """AB magnitude of a source that gives one electron per second.

    Parameters
    ----------
    bandpass : `Bandpass`
        Optics, with the quantum efficiency that its tables state.
    collecting_area_m2 : `float`
        Collecting area [m²].
    airmass : `float`, optional
        Airmass of the air in the throughput; without air if not given.

    Notes
    -----
    The brightness of the sky is by convention that which arrives at the telescope: without air. What disturbs the
    photometry of stars and galaxies, as fringes do, is compared with their brightness above the air.
    """
    wave = bandpass.wavelength_nm
    throughput = bandpass.transmission(wave) * bandpass.quantum_efficiency(wave)
    if airmass is not None:
        throughput = throughput * bandpass.air.total(wave, airmass)
    # 3631 Jy in photons s⁻¹ m⁻² per relative interval of wavelength
    photons = 3631e-26 / _PLANCK_J_S
    electrons = collecting_area_m2 * photons * float(np.trapezoid(throughput / wave, wave))
    return 2.5 * math.log10(electrons)


@named_units
def electrons_to_microjansky(
    electrons: ArrayLike, zero_point_mag: float, exposure_s: float, pixel_scale_arcsec: float
) -> FloatArray:
    """Surface brightness [µJy arcsec⁻²] of electrons per pixel; linear, so differences may be given."""
    rate = np.asarray(electrons, dtype=float) / (exposure_s * pixel_scale_arcsec**2)
    return rate * 10.0 ** (0.4 * (AB_MICROJANSKY_ZERO_POINT - zero_point_mag))


def magnitude_to_microjansky(magnitude: ArrayLike) -> FloatArray:
    """Flux [µJy] of AB magnitudes."""
    return 10.0 ** (0.4 * (AB_MICROJANSKY_ZERO_POINT - np.asarray(magnitude, dtype=float)))


def microjansky_to_magnitude(microjansky: ArrayLike) -> FloatArray:
    """AB magnitudes of fluxes [µJy]; NaN where they are not positive."""
    flux = np.asarray(microjansky, dtype=float)
    magnitude = np.full(flux.shape, np.nan)
    magnitude[flux > 0.0] = AB_MICROJANSKY_ZERO_POINT - 2.5 * np.log10(flux[flux > 0.0])
    return magnitude
