"""Width of the monochromator line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..errors import InputError
from ..optics.illumination import GaussianProfile, TriangularProfile
from ..optics.system import OpticalSystem
from .base import Effect, Parameter

__all__ = ["Bandwidth"]


class Bandwidth(Effect):
    """Another full width at half maximum than the set-up states."""

    name = "bandwidth"
    title = "bandpass width"
    acts_on = "illumination"
    laboratory_only = True
    reference = "Guo, Walter, Lage & Lupton 2022, section 2.2"
    parameters = (Parameter("fwhm", "nm", float("nan"), (0.05, 20.0), 0.5, "full width at half maximum"),)

    def null_values(self, system: OpticalSystem) -> dict[str, float]:
        """Width that the set-up states."""
        return {"fwhm": _width(system)}

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Replace the width of the line."""
        _width(system)
        return replace(system, profile=replace(system.profile, fwhm_nm=values["fwhm"]))  # type: ignore[type-var]


def _width(system: OpticalSystem) -> float:
    if not isinstance(system.profile, GaussianProfile | TriangularProfile):
        raise InputError(
            "effect bandwidth", type(system.profile).__name__, "set-ups with a monochromator line"
        )
    return system.profile.fwhm_nm
