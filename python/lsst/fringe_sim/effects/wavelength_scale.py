"""Error of the wavelength scale of the monochromator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["WavelengthScale"]


class WavelengthScale(PlainNullEffect):
    """The wavelength error grows linearly from 935 nm, the middle of 880 to 990 nm, where it is zero."""

    name = "wavelength_scale"
    title = "wavelength scale"
    acts_on = "illumination"
    laboratory_only = True
    moves_wavelengths = True
    reference = "linear part of a grating calibration error"
    parameters = (
        Parameter("stretch", "nm/nm", 0.0, (-0.1, 0.1), 0.005, "relative error of wavelength differences"),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Stretch the scale about its pivot."""
        return replace(system, wavelength_stretch=system.wavelength_stretch + values["stretch"])
