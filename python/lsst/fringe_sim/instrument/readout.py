"""From photons to numbers: photon and read noise (GalSim), and units of surface brightness."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, OutOfRangeError, named_units
from .bandpass import Bandpass

if TYPE_CHECKING:
    import galsim

__all__ = [
    "add_photon_noise",
    "add_readout",
    "electrons_to_magnitude",
    "electrons_to_microjansky",
    "magnitude_to_microjansky",
    "microjansky_to_magnitude",
    "zero_point",
]

FloatArray = NDArray[np.float64]

AB_MICROJANSKY_ZERO_POINT = 23.9
"""AB magnitude of 1 µJy."""

_PLANCK_J_S = 6.62607015e-34


def add_photon_noise(electrons: ArrayLike, rng: np.random.Generator) -> NDArray[np.float64]:
    """Poisson noise of the photoelectrons.

    Parameters
    ----------
    electrons : array_like, shape ``(ny, nx)``
        Expected electrons per pixel, none negative.
    rng : `numpy.random.Generator`
        Source of randomness; seeds GalSim's own generator.

    Returns
    -------
    noisy : `numpy.ndarray`, float64, shape ``(ny, nx)``
        Whole numbers of electrons.

    Raises
    ------
    InputError
        An image that is not two-dimensional, or has pixels that are negative or not finite.
    """
    image = _expected(electrons)
    import galsim

    galsim.Image(image, copy=False).addNoise(galsim.PoissonNoise(_deviate(rng)))
    return image


def add_readout(
    electrons: ArrayLike, rng: np.random.Generator, read_noise_e: float, gain: float
) -> NDArray[np.float64]:
    """Counts of an exposure: Poisson noise of the photoelectrons and Gaussian read noise.

    Parameters
    ----------
    electrons : array_like, shape ``(ny, nx)``
        Expected electrons per pixel, none negative.
    rng : `numpy.random.Generator`
        Source of randomness; seeds GalSim's own generator.
    read_noise_e : `float`
        Read noise [e⁻ rms].
    gain : `float`
        Electrons per count [e⁻/ADU].

    Returns
    -------
    adu : `numpy.ndarray`, float64, shape ``(ny, nx)``
        Counts, not yet rounded.

    Raises
    ------
    InputError
        An image that is not two-dimensional, or has pixels that are negative or not finite.
    OutOfRangeError
        A negative read noise, or a gain that is not positive.
    """
    if not 0.0 <= read_noise_e < math.inf:
        raise OutOfRangeError("read noise [e]", read_noise_e, "finite and not negative")
    if not 0.0 < gain < math.inf:
        raise OutOfRangeError("gain [e/ADU]", gain, "positive")
    adu = _expected(electrons) / gain
    import galsim

    noise = galsim.CCDNoise(_deviate(rng), sky_level=0.0, gain=gain, read_noise=read_noise_e)
    galsim.Image(adu, copy=False).addNoise(noise)
    return adu


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
def electrons_to_magnitude(
    electrons: ArrayLike, zero_point_mag: float, exposure_s: float, pixel_scale_arcsec: float
) -> FloatArray:
    """Surface brightness [AB mag arcsec⁻²] of electrons per pixel; NaN where there are none."""
    rate = np.asarray(electrons, dtype=float) / (exposure_s * pixel_scale_arcsec**2)
    magnitude = np.full(rate.shape, np.nan)
    positive = rate > 0.0
    magnitude[positive] = zero_point_mag - 2.5 * np.log10(rate[positive])
    return magnitude


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


def _expected(electrons: ArrayLike) -> NDArray[np.float64]:
    image = np.array(electrons, dtype=np.float64, ndmin=2)
    if image.ndim != 2:
        raise InputError("shape of the image", image.shape, "two axes (y, x)")
    if not np.all(image >= 0.0) or not np.all(np.isfinite(image)):
        raise InputError("expected electrons", float(np.min(image)), "finite and not negative in every pixel")
    return image


def _deviate(rng: np.random.Generator) -> galsim.BaseDeviate:
    # GalSim takes 0 as "choose a seed"
    import galsim

    return galsim.BaseDeviate(int(rng.integers(1, 2**31 - 1)))
