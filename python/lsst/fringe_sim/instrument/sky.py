"""The night sky: OH lines from molecular constants, continua, and what of them reaches the sensor.

Radiances are in photons s⁻¹ m⁻² arcsec⁻² (per nm for continua), at the zenith and above the lower atmosphere unless
a term says otherwise. Reference: Noll et al. 2025 (PALACE, lines and populations).
"""

from __future__ import annotations

import functools
import heapq
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..array_types import BoolArray, FloatArray
from ..errors import InputError, OutOfRangeError, UnknownNameError, named_units
from ..notebook import OneLine
from ..resources import read_table
from .continua import ARCSEC2_PER_SR, ContinuumTerm, airglow_continuum, moonlight, zodiacal_light
from .oh_levels import RotationalLevels, boltzmann

if TYPE_CHECKING:  # filters take time to import, and effects do without
    from .bandpass import Bandpass
    from .flat_spectrum import FlatSpectrum

__all__ = [
    "ContinuumTerm",
    "EmissionLines",
    "SkySpectrum",
    "SpectralComponent",
    "airglow_continuum",
    "blend_components",
    "moonlight",
    "van_rhijn_factor",
    "zodiacal_light",
]

AIRGLOW_HEIGHT_KM = 90.0
EARTH_RADIUS_KM = 6371.0

OH_NM = (880.0, 1110.0)  # Wavelengths between which the list of OH lines is complete [nm]

MOST_WITHOUT_LINES = 1e-3
"""Part of the light of a white source that a bandpass may let through outside `OH_NM`; of the y band it is 2e-5."""

LINES_NM = (300.0, 3000.0)  # Where the air glows in lines; the same lines in Å or µm lie outside

CONTINUUM_STEP_NM = 0.1
"""Spacing of continuum nodes [nm]: the fringe of 365 µm of silicon (HSC and its support) has 0.35 nm."""


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class EmissionLines(OneLine):
    """Airglow lines.

    Attributes
    ----------
    wavelength_nm : `numpy.ndarray`, shape ``(N,)``
        Wavelength in vacuum [nm], ascending, 300 to 3000.
    photon_radiance : `numpy.ndarray`, shape ``(N,)``
        Zenith radiance above the lower atmosphere [ph s⁻¹ m⁻² arcsec⁻²].
    transmission : `numpy.ndarray`, shape ``(N,)``
        Molecular transmission of the air at the wavelength of the line, zenith.
    band : `numpy.ndarray` of `str`, shape ``(N,)``
        Vibrational band, e.g. ``8-4``.
    levels : `RotationalLevels`, optional
        The upper levels with their cold and hot populations, if they are known.
    """

    wavelength_nm: FloatArray
    photon_radiance: FloatArray
    transmission: FloatArray
    band: NDArray[np.str_]
    levels: RotationalLevels | None = None

    def __post_init__(self) -> None:
        shapes = {
            np.shape(array)
            for array in (
                self.wavelength_nm,
                self.photon_radiance,
                self.transmission,
                self.band,
                self.band if self.levels is None else self.levels.line_level,
            )
        }
        if len(shapes) != 1 or len(next(iter(shapes))) != 1:
            raise InputError("shapes of the line list", shapes, "one common shape (lines,)")
        for name in ("wavelength_nm", "photon_radiance", "transmission"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise InputError(f"{name} of the line list", "not finite", "finite numbers")
        if not np.all(self.photon_radiance >= 0.0):
            raise InputError("photon radiance", float(np.min(self.photon_radiance)), "not negative")
        if not np.all(np.diff(self.wavelength_nm) >= 0.0):
            raise InputError("wavelengths of the lines", "unordered", "ascending")
        low, high = LINES_NM
        outside = (self.wavelength_nm < low) | (self.wavelength_nm > high)
        if outside.any():
            worst = float(np.asarray(self.wavelength_nm)[outside][0])
            raise OutOfRangeError("wavelength of a line [nm]", worst, f"{low:g} to {high:g}")
        absorbed = (self.transmission < 0.0) | (self.transmission > 1.0)
        if absorbed.any():
            worst = float(np.asarray(self.transmission)[absorbed][0])
            raise OutOfRangeError("transmission of the air", worst, "0 to 1")

    @classmethod
    @named_units
    def oh(
        cls, rotational_temperature_k: float | None = None, vibrational_temperature_k: float | None = None
    ) -> EmissionLines:
        """OH lines between 880 and 1110 nm, recomputed from Einstein coefficients and populations.

        Parameters
        ----------
        rotational_temperature_k : `float`, optional
            Rotational temperature [K] of every vibrational level; by default the PALACE populations, which have
            191 K in the low levels and a hot population in the high ones.
        vibrational_temperature_k : `float`, optional
            Vibrational temperature [K] between the lowest rotational levels; by default the PALACE populations,
            which correspond to 10 970 K.

        Raises
        ------
        OutOfRangeError
            A temperature that is not positive.

        Notes
        -----
        A rotational temperature redistributes each vibrational level and keeps its population; a vibrational
        temperature redistributes the levels and keeps the photon radiance of the whole list.
        """
        table = read_table("sky", "oh_lines_palace_yband.ecsv")
        levels = RotationalLevels.of_reference()
        if rotational_temperature_k is not None:
            levels = levels.thermal(rotational_temperature_k)
        rate = np.asarray(table["A"], dtype=float) * np.asarray(table["g_up"], dtype=float)
        radiance = rate * levels.line_population * _photons_per_rayleigh()
        if vibrational_temperature_k is not None:
            total = radiance.sum()
            radiance *= _vibrational_factor(np.asarray(table["v_up"]), vibrational_temperature_k)
            radiance *= total / radiance.sum()
        order = np.argsort(np.asarray(table["wavelength"]), kind="stable")
        return cls(
            np.asarray(table["wavelength"], dtype=float)[order],
            radiance[order],
            np.asarray(table["transmission"], dtype=float)[order],
            np.asarray(table["band"], dtype=str)[order],
            levels.of_lines(order),
        )

    @functools.cached_property
    def bands(self) -> tuple[str, ...]:
        """Names of the bands, in the order of their first line."""
        return tuple(dict.fromkeys(str(name) for name in self.band))

    def scaled(self, band_scale: Mapping[str, float]) -> EmissionLines:
        """Lines whose bands are multiplied by factors, by name (``{"8-4": 1.3}``).

        Raises
        ------
        UnknownNameError
            A band that is not in the list.
        OutOfRangeError
            A factor that is negative or not finite.
        """
        factor = np.ones(len(self.wavelength_nm))
        for name, scale in band_scale.items():
            if name not in self.bands:
                raise UnknownNameError("OH band", name, self.bands)
            if not 0.0 <= scale < math.inf:
                raise OutOfRangeError(f"scale of OH band {name}", scale, "finite and not negative")
            factor[self.band == name] = scale
        return replace(self, photon_radiance=self.photon_radiance * factor)

    def of_band(self, name: str) -> EmissionLines:
        """Lines of one band."""
        if name not in self.bands:
            raise UnknownNameError("OH band", name, self.bands)
        chosen = self.band == name
        return EmissionLines(
            self.wavelength_nm[chosen],
            self.photon_radiance[chosen],
            self.transmission[chosen],
            self.band[chosen],
            None if self.levels is None else self.levels.of_lines(chosen),
        )

    def with_rotation(self, change: Callable[[RotationalLevels], RotationalLevels]) -> EmissionLines:
        """Lines of other rotational populations, which ``change`` makes of those of their levels.

        Raises
        ------
        InputError
            The levels of the lines are not known.
        """
        if self.levels is None:
            raise InputError("rotational levels of the lines", None, "known, as those of `EmissionLines.oh`")
        changed = change(self.levels)
        # A level can be empty only where a Boltzmann factor is below the smallest number; it stays so.
        before = np.maximum(self.levels.line_population, math.ulp(0.0))
        factor = changed.line_population / before
        return replace(self, photon_radiance=self.photon_radiance * factor, levels=changed)


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class SpectralComponent(OneLine):
    """Light of one origin as it reaches the sensor; only its level changes during a night.

    Attributes
    ----------
    name : `str`
        OH band or continuum.
    wavelength_nm : `numpy.ndarray`, shape ``(K,)``
        Wavelengths [nm].
    photons : `numpy.ndarray`, shape ``(K,)``
        Photons behind air and optics [s⁻¹ m⁻² arcsec⁻²].
    """

    name: str
    wavelength_nm: FloatArray
    photons: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class SkySpectrum(OneLine):
    """Lines and continua of one moment.

    Attributes
    ----------
    lines : `EmissionLines`
        Line emission.
    continua : `tuple` [`ContinuumTerm`, ...]
        Everything else, term by term.
    airmass : `float`
        Airmass of the pointing.
    flat : `~lsst.fringe_sim.instrument.flat_spectrum.FlatSpectrum` or `None`
        Light of the flat field by which the frames are divided, which prints its own fringes into them. By default
        frames with the beam of every pixel are divided by one of white light, and others by none.
    """

    lines: EmissionLines
    continua: tuple[ContinuumTerm, ...] = ()
    airmass: float = 1.0
    flat: FlatSpectrum | None = None

    @classmethod
    @named_units
    def dark(
        cls,
        lines: EmissionLines | None = None,
        airmass: float = 1.0,
        *,
        solar_flux_sfu: float = 129.0,
        helioecliptic_longitude_deg: float = 120.0,
        ecliptic_latitude_deg: float = 60.0,
    ) -> SkySpectrum:
        """Moonless sky: OH lines, airglow continuum and zodiacal light."""
        return cls(
            EmissionLines.oh() if lines is None else lines,
            (
                airglow_continuum(solar_flux_sfu),
                zodiacal_light(helioecliptic_longitude_deg, ecliptic_latitude_deg),
            ),
            airmass,
        )

    def with_band_scale(self, band_scale: Mapping[str, float]) -> SkySpectrum:
        """Spectrum whose OH bands are multiplied by factors."""
        return replace(self, lines=self.lines.scaled(band_scale))

    @named_units
    def components(
        self, bandpass: Bandpass, continuum_step_nm: float = CONTINUUM_STEP_NM
    ) -> list[SpectralComponent]:
        """What reaches the sensor, band by band and term by term.

        Parameters
        ----------
        bandpass : `Bandpass`
            Optics and air.
        continuum_step_nm : `float`, optional
            Spacing of the midpoints that stand for a continuum [nm].

        Returns
        -------
        components : `list` [`SpectralComponent`]
            OH bands first, then continua; those without any light are left out.

        Raises
        ------
        OutOfRangeError
            The bandpass lets light through where the list of `EmissionLines.oh` has no lines.
        """
        if self.lines.levels is not None:
            _refuse_outside_of_oh(bandpass)
        found = [self._band(name, bandpass) for name in self.lines.bands]
        found += [self._continuum(term, bandpass, continuum_step_nm) for term in self.continua]
        return [component for component in found if component.photons.sum() > 0.0]

    def _band(self, name: str, bandpass: Bandpass) -> SpectralComponent:
        lines = self.lines.of_band(name)
        air = bandpass.air.scattering(lines.wavelength_nm, self.airmass) * lines.transmission**self.airmass
        photons = lines.photon_radiance * van_rhijn_factor(self.airmass) * air
        return SpectralComponent(
            name, lines.wavelength_nm, photons * bandpass.transmission(lines.wavelength_nm)
        )

    def _continuum(self, term: ContinuumTerm, bandpass: Bandpass, step_nm: float) -> SpectralComponent:
        low, high = bandpass.support()
        count = math.ceil((high - low) / step_nm)
        wave = low + (np.arange(count) + 0.5) * (high - low) / count
        photons = term.radiance(wave) * bandpass.transmission(wave) * (high - low) / count
        if term.origin != "local":
            photons = photons * bandpass.air.total(wave, self.airmass)
        if term.origin == "airglow":
            photons = photons * van_rhijn_factor(self.airmass)
        return SpectralComponent(term.name, wave, photons)


def _refuse_outside_of_oh(bandpass: Bandpass) -> None:
    low, high = OH_NM
    outside = (bandpass.wavelength_nm < low) | (bandpass.wavelength_nm > high)
    light = np.gradient(bandpass.wavelength_nm) * bandpass.optics
    if light[outside].sum() > MOST_WITHOUT_LINES * light.sum():
        allowed = f"{low:g} to {high:g}, where the OH lines are known"
        raise OutOfRangeError("bandpass [nm]", bandpass.support(), allowed, source=bandpass.name)


def van_rhijn_factor(airmass: float) -> float:
    """Path through an emitting shell relative to the zenith.

    Parameters
    ----------
    airmass : `float`
        Secant of the zenith distance.

    References
    ----------
    van Rhijn 1921; ``1 / sqrt(1 - (R sin z / (R + h))²)``.
    """
    if not airmass >= 1.0:
        raise OutOfRangeError("airmass", airmass, "1 or more")
    sine_squared = 1.0 - airmass**-2
    return float(
        (1.0 - (EARTH_RADIUS_KM / (EARTH_RADIUS_KM + AIRGLOW_HEIGHT_KM)) ** 2 * sine_squared) ** -0.5
    )


def _photons_per_rayleigh() -> float:
    """Photons s⁻¹ m⁻² arcsec⁻² of one rayleigh."""
    return 1e10 / (4.0 * math.pi) / ARCSEC2_PER_SR


def _vibrational_factor(upper: NDArray[np.int64], temperature_k: float) -> FloatArray:
    """Wanted over reference population of the lowest rotational level, per line."""
    table = read_table("sky", "oh_levels_palace.ecsv")
    level = np.asarray(table["v_up"], dtype=np.int64)
    wanted = boltzmann(np.asarray(table["E_v0"], dtype=float), temperature_k)
    # Scaled to the middle of the range so that neither factor overflows.
    ratio = np.log(wanted) - np.asarray(table["ln_pop_N1"], dtype=float)
    factor = dict(zip(level.tolist(), np.exp(ratio - ratio[level == 6]), strict=True))
    return np.array([factor[int(each)] for each in upper])


@named_units
def blend_components(components: Sequence[SpectralComponent], rms_shift_nm: float) -> list[SpectralComponent]:
    """Fewer nodes with the same photons and the same mean wavelength in every component.

    Neighbours of one component are merged, cheapest first (Ward), until the photon-weighted rms distance of all
    nodes from those that stand for them reaches ``rms_shift_nm``. The fringe of a layer with period P in wavelength
    then changes by less than ``(2 pi rms_shift / P)² / 2`` of its amplitude. Faint components are thinned most.

    Parameters
    ----------
    components : sequence of `SpectralComponent`
        Nodes of each component in ascending order.
    rms_shift_nm : `float`
        Rms distance allowed [nm]; 0 merges only coincident nodes.

    Returns
    -------
    blended : `list` [`SpectralComponent`]
        In the same order.
    """
    if not 0.0 <= rms_shift_nm < math.inf:
        raise OutOfRangeError("rms shift [nm]", rms_shift_nm, "finite and not negative")
    kept = [component.photons > 0.0 for component in components]
    sizes = [int(keep.sum()) for keep in kept]
    wave = np.concatenate([item.wavelength_nm[keep] for item, keep in zip(components, kept, strict=True)])
    photons = np.concatenate([item.photons[keep] for item, keep in zip(components, kept, strict=True)])
    owner = np.repeat(np.arange(len(components)), sizes)
    alive, wave, photons = _merge_neighbours(wave, photons, owner, rms_shift_nm**2 * float(photons.sum()))
    return [
        SpectralComponent(item.name, wave[alive & (owner == number)], photons[alive & (owner == number)])
        for number, item in enumerate(components)
    ]


def _merge_neighbours(
    wavelength: FloatArray, weight: FloatArray, owner: NDArray[np.int64], budget: float
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Agglomerate neighbours of one owner until the added variance would exceed the budget.

    Returns which nodes survive, and the wavelengths and weights in which the survivors hold what they absorbed.
    """
    wave, mass = wavelength.tolist(), weight.tolist()
    count = len(wave)
    left = [n - 1 if n > 0 and owner[n - 1] == owner[n] else -1 for n in range(count)]
    right = [n + 1 if n + 1 < count and owner[n + 1] == owner[n] else -1 for n in range(count)]
    age, alive = [0] * count, [True] * count
    heap: list[tuple[float, int, int, int, int]] = []

    def offer(a: int, b: int) -> None:
        price = mass[a] * mass[b] / (mass[a] + mass[b]) * (wave[a] - wave[b]) ** 2
        heapq.heappush(heap, (price, a, b, age[a], age[b]))

    for node in range(count):
        if right[node] >= 0:
            offer(node, right[node])
    while heap:
        price, a, b, age_a, age_b = heapq.heappop(heap)
        if not (alive[a] and alive[b]) or (age[a], age[b]) != (age_a, age_b):
            continue  # priced before one of the two changed
        if price > budget:
            break
        budget -= price
        total = mass[a] + mass[b]
        wave[a], mass[a], alive[b] = (mass[a] * wave[a] + mass[b] * wave[b]) / total, total, False
        age[a] += 1
        right[a] = right[b]
        if right[b] >= 0:
            left[right[b]] = a
            offer(a, right[b])
        if left[a] >= 0:
            offer(left[a], a)
    return np.array(alive), np.array(wave), np.array(mass)
