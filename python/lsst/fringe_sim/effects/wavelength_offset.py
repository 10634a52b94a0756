"""Error of the wavelength zero of the monochromator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["WavelengthOffset"]


class WavelengthOffset(PlainNullEffect):
    """All exposures lie a constant distance from their nominal wavelength."""

    name = "wavelength_offset"
    title = "wavelength zero"
    acts_on = "illumination"
    laboratory_only = True
    moves_wavelengths = True
    reference = "effect of a grating angle offset; MONOCH-WAVELENG against MONOWL in TS8 headers"
    parameters = (Parameter("offset", "nm", 0.0, (-10.0, 10.0), 0.5, "true minus nominal wavelength"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Shift every exposure."""
        return replace(system, wavelength_offset_nm=system.wavelength_offset_nm + values["offset"])
