"""Temperature of the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..optics.system import OpticalSystem
from .base import Effect, Parameter

__all__ = ["Temperature"]


class Temperature(Effect):
    """The silicon is warmer or colder than the set-up states."""

    name = "temperature"
    title = "sensor temperature"
    acts_on = "stack"
    laboratory_only = True
    reference = "Green 2008, doi 10.1016/j.solmat.2008.06.009"
    parameters = (Parameter("kelvin", "K", float("nan"), (120.0, 320.0), 5.0, "temperature of the silicon"),)

    def null_values(self, system: OpticalSystem) -> dict[str, float]:
        """Temperature that the set-up states."""
        return {"kelvin": system.temperature_k}

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Replace the temperature."""
        return replace(system, temperature_k=values["kelvin"])
