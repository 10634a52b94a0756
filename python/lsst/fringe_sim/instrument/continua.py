"""Light of the sky without lines: airglow, zodiacal light, moonlight.

Radiances are in photons s⁻¹ m⁻² arcsec⁻² nm⁻¹. References: Noll et al. 2012 (airglow), Leinert et al. 1998 (zodiacal
light), Krisciunas & Schaefer 1991 (moonlight).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator

from ..array_types import FloatArray
from ..errors import OutOfRangeError, named_units
from ..resources import read_table
from .oh_levels import SECOND_RADIATION_CM_K

ARCSEC2_PER_SR = (180.0 * 3600.0 / math.pi) ** 2

_PHOTON_ENERGY_NM_J = 1.98644586e-16  # Energy of a photon times its wavelength [J nm]


_V_BAND_NM = 551.0


_SOLAR_TEMPERATURE_K = 5900.0
"""Colour temperature of the Sun between 500 and 1000 nm, where its flux falls by a factor 0.39 (ASTM E-490)."""


@named_units
@dataclass(frozen=True, eq=False)
class ContinuumTerm:
    """Light without lines.

    Attributes
    ----------
    name : `str`
        What it is.
    wavelength_nm, photon_radiance : `numpy.ndarray`, shape ``(K,)``
        Nodes [nm] and radiance [ph s⁻¹ m⁻² arcsec⁻² nm⁻¹] between which it is linear.
    origin : {"airglow", "celestial", "local"}
        ``airglow`` grows towards the horizon and passes the air, ``celestial`` only passes it, ``local`` is light
        scattered in the air, given as it arrives.
    """

    name: str
    wavelength_nm: FloatArray
    photon_radiance: FloatArray
    origin: Literal["airglow", "celestial", "local"]

    @named_units
    def radiance(self, wavelength_nm: ArrayLike) -> FloatArray:
        """Photon radiance per nm.

        Raises
        ------
        OutOfRangeError
            A wavelength outside the nodes.
        """
        wavelength = np.asarray(wavelength_nm, dtype=float)
        low, high = float(self.wavelength_nm[0]), float(self.wavelength_nm[-1])
        if np.any(~((wavelength >= low) & (wavelength <= high))):
            wrong = float(np.ravel(wavelength)[~np.ravel((wavelength >= low) & (wavelength <= high))][0])
            raise OutOfRangeError(
                "wavelength [nm]", wrong, f"{low} to {high}", source=f"continuum {self.name}"
            )
        return np.interp(wavelength, self.wavelength_nm, self.photon_radiance)


def airglow_continuum(solar_flux_sfu: float = 129.0) -> ContinuumTerm:
    """Residual continuum of the airglow (Noll et al. 2012), for a solar radio flux [sfu].

    Its level beyond 900 nm is very uncertain, as its authors say.
    """
    if not 50.0 <= solar_flux_sfu <= 400.0:
        raise OutOfRangeError("solar radio flux [sfu]", solar_flux_sfu, "50 to 400")
    table = read_table("sky", "sky_airglow_continuum_eso_sm01.ecsv")
    level = 0.2068 + 0.006139 * solar_flux_sfu
    return ContinuumTerm(
        "airglow continuum",
        np.asarray(table["wavelength"], dtype=float),
        1e-3 * level * np.asarray(table["photon_radiance"], dtype=float),
        "airglow",
    )


@named_units
def zodiacal_light(helioecliptic_longitude_deg: float, ecliptic_latitude_deg: float) -> ContinuumTerm:
    """Zodiacal light of Leinert et al. 1998, Table 17, with the reddening given there.

    Parameters
    ----------
    helioecliptic_longitude_deg, ecliptic_latitude_deg : `float`
        Ecliptic longitude minus that of the Sun, and latitude [deg].

    Raises
    ------
    OutOfRangeError
        A place too close to the Sun for the table.
    """
    table = read_table("sky", "sky_zodiacal_leinert1998.ecsv")
    longitude, latitude = (np.unique(np.asarray(table[name], dtype=float)) for name in ("dlon", "beta"))
    brightness = np.full((longitude.size, latitude.size), np.nan)
    rows = np.searchsorted(longitude, table["dlon"]), np.searchsorted(latitude, table["beta"])
    brightness[rows] = np.asarray(table["brightness"], dtype=float)
    place = (abs((helioecliptic_longitude_deg + 180.0) % 360.0 - 180.0), abs(ecliptic_latitude_deg))
    if not place[1] <= 90.0:
        raise OutOfRangeError("ecliptic latitude [deg]", ecliptic_latitude_deg, "-90 to 90")
    value = float(np.asarray(RegularGridInterpolator((longitude, latitude), brightness)(place)).item())
    if math.isnan(value):
        raise OutOfRangeError("helioecliptic position [deg]", place, "15 deg or more from the Sun")
    cosine = math.cos(math.radians(place[0])) * math.cos(math.radians(place[1]))
    elongation = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    reddening = 0.8 - 0.2 * min(max((elongation - 30.0) / 60.0, 0.0), 1.0)
    wave = np.arange(500.0, 1201.0, 5.0)
    energy = 1e-8 * 1e-3 * value * _solar_shape(wave, 500.0) * (1.0 + reddening * np.log10(wave / 500.0))
    return ContinuumTerm(
        "zodiacal light", wave, energy * wave / _PHOTON_ENERGY_NM_J / ARCSEC2_PER_SR, "celestial"
    )


@named_units
def moonlight(
    phase_angle_deg: float, separation_deg: float, moon_zenith_deg: float, target_zenith_deg: float = 0.0
) -> ContinuumTerm:
    """Moonlight scattered in the air (Krisciunas & Schaefer 1991), carried from V to the near infrared.

    Parameters
    ----------
    phase_angle_deg : `float`
        Phase angle of the Moon [deg]; 0 when full.
    separation_deg : `float`
        Angle between Moon and target [deg], at least 5.
    moon_zenith_deg, target_zenith_deg : `float`
        Zenith distances [deg].

    Returns
    -------
    term : `ContinuumTerm`
        A ``local`` term; zero when the Moon is below the horizon.

    Notes
    -----
    The Rayleigh part of the V-band model is taken to fall as the fourth power of the wavelength, its aerosol part as
    the power 1.3; the sunlight is reddened by the reflectance of the Moon, which rises as the power 0.7 of the
    wavelength between 550 and 1000 nm (Kieffer & Stone 2005). Good to some ten per cent.
    """
    for field, value, low, high in (
        ("phase angle [deg]", phase_angle_deg, 0.0, 180.0),
        ("separation [deg]", separation_deg, 5.0, 180.0),
        ("moon zenith distance [deg]", moon_zenith_deg, 0.0, 180.0),
        ("target zenith distance [deg]", target_zenith_deg, 0.0, 85.0),
    ):
        if not low <= value <= high:
            raise OutOfRangeError(field, value, f"{low:g} to {high:g}")
    wave = np.arange(500.0, 1201.0, 5.0)
    if moon_zenith_deg >= 90.0:
        return ContinuumTerm("moonlight", wave, np.zeros_like(wave), "local")
    extinction = 0.172
    moon = 10.0 ** (-0.4 * (3.84 + 0.026 * phase_angle_deg + 4e-9 * phase_angle_deg**4))
    to_moon, to_target = (
        (1.0 - 0.96 * math.sin(math.radians(angle)) ** 2) ** -0.5
        for angle in (moon_zenith_deg, target_zenith_deg)
    )
    path = 10.0 ** (-0.4 * extinction * to_moon) * (1.0 - 10.0 ** (-0.4 * extinction * to_target))
    rayleigh = 10.0**5.36 * (1.06 + math.cos(math.radians(separation_deg)) ** 2)
    aerosol = 10.0 ** (6.15 - separation_deg / 40.0)
    relative = wave / _V_BAND_NM
    scattered = rayleigh * relative**-4.0 + aerosol * relative**-1.3
    nanolambert = moon * path * scattered * relative**0.7 * _solar_shape(wave, _V_BAND_NM) * relative
    return ContinuumTerm("moonlight", wave, nanolambert * _photons_per_nanolambert(), "local")


def _photons_per_nanolambert() -> float:
    """V-band photons s⁻¹ m⁻² arcsec⁻² nm⁻¹ of one nanolambert, through its magnitude per arcsec² (K&S, Eq. 1)."""
    magnitude = (20.7233 - math.log(1.0 / 34.08)) / 0.92104
    vega_photons = 3.63e-11 * _V_BAND_NM / _PHOTON_ENERGY_NM_J  # W m⁻² nm⁻¹ at V = 0
    return float(10.0 ** (-0.4 * magnitude) * vega_photons)


def _solar_shape(wavelength_nm: FloatArray, reference_nm: float) -> FloatArray:
    """Energy flux per wavelength of the Sun relative to that at a reference wavelength."""

    def planck(wave: FloatArray | float) -> FloatArray | float:
        return np.power(wave, -5.0) / np.expm1(1e7 * SECOND_RADIATION_CM_K / (wave * _SOLAR_TEMPERATURE_K))

    return np.asarray(planck(wavelength_nm) / planck(reference_nm))
