"""Flats that are taken under the same conditions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..effects import Effect
from ..errors import InputError, OutOfRangeError, named_units
from ..model import FringeModel
from ..optics import Beam
from ..optics.illumination import GaussianProfile, TriangularProfile
from ..optics.system import OpticalSystem

LEVEL_E = 20_000.0  # Usual level of a flat [electrons per pixel]


@named_units
@dataclass(frozen=True)
class FlatSeries:
    """Flats that are taken under the same conditions."""

    wavelength_nm: tuple[float, ...]  # nominal wavelengths [nm]
    level_e: float = LEVEL_E  # mean level [electrons]
    # bandwidth_fwhm_nm, temperature_k, f_number: nominal width of the line [nm], temperature [K] and focal
    # ratio; as in the set-up where not given
    bandwidth_fwhm_nm: float | None = None
    temperature_k: float | None = None
    f_number: float | None = None
    # time in which each flat gathers charge [s]; empty, the default, if not known
    dark_time_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.wavelength_nm or not all(0.0 < w < math.inf for w in self.wavelength_nm):
            raise InputError("wavelengths of a series [nm]", self.wavelength_nm, "one or more, positive")
        if not 0.0 < self.level_e < math.inf:
            raise OutOfRangeError("level of a series [e]", self.level_e, "positive")
        if self.dark_time_s and len(self.dark_time_s) != len(self.wavelength_nm):
            raise InputError(
                "dark times of a series [s]", self.dark_time_s, "one for each wavelength, or none"
            )

    def at_level(self, level_e: float) -> FlatSeries:
        """The same light for as long as another level takes [electrons]."""
        return replace(self, level_e=level_e, dark_time_s=self._longer(level_e / self.level_e))

    @named_units
    def at_bandwidth(self, fwhm_nm: float, setup_fwhm_nm: float) -> FlatSeries:
        """The same level behind a slit of another width than the set-up's [nm]: exposures get longer."""
        return replace(self, bandwidth_fwhm_nm=fwhm_nm, dark_time_s=self._longer(setup_fwhm_nm / fwhm_nm))

    @named_units
    def at_wavelengths(self, wavelength_nm: tuple[float, ...]) -> FlatSeries:
        """Flats at other wavelengths [nm]; as long as those of the nearest."""
        if not self.dark_time_s:
            return replace(self, wavelength_nm=wavelength_nm)
        order = np.argsort(self.wavelength_nm)
        waves, known = np.array(self.wavelength_nm)[order], np.array(self.dark_time_s)[order]
        times = tuple(np.interp(wavelength_nm, waves, known).tolist())
        return replace(self, wavelength_nm=wavelength_nm, dark_time_s=times)

    def _longer(self, factor: float) -> tuple[float, ...]:
        return tuple(factor * time for time in self.dark_time_s)

    def conditions(self, model: FringeModel) -> FringeModel:
        """Model under the nominal conditions of the series.

        Effects whose null is stated by the set-up (width of the line, temperature) keep their ratio to it.
        """
        system = model.base_system
        if self.bandwidth_fwhm_nm is not None:
            if not isinstance(system.profile, GaussianProfile | TriangularProfile):
                raise InputError(
                    "bandwidth of a series [nm]", self.bandwidth_fwhm_nm, "none: the light has no line"
                )
            system = replace(system, profile=replace(system.profile, fwhm_nm=self.bandwidth_fwhm_nm))
        if self.temperature_k is not None:
            system = replace(system, temperature_k=self.temperature_k)
        if self.f_number is not None:
            nodes = 6 + math.ceil(120.0 * (0.5 / self.f_number) ** 2)
            system = replace(system, beam=Beam.cone(self.f_number, nodes=nodes))
        moved = tuple(
            replace(item, values=_in_proportion(item.effect, item.values, model, system))
            for item in model.effects
        )
        return replace(model, base_system=system, effects=moved)


def _in_proportion(
    effect: Effect, values: Mapping[str, float], model: FringeModel, system: OpticalSystem
) -> dict[str, float]:
    there = effect.null_values(system)
    here = effect.null_values(model.base_system)
    return {
        name: value if there[name] == here[name] else value * there[name] / here[name]
        for name, value in values.items()
    }
