"""Thickness of the anti-reflection coating."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["ArCoating"]


class ArCoating(PlainNullEffect):
    """Both coating layers are thicker or thinner by a common factor."""

    name = "ar_coating"
    title = "anti-reflection coating"
    acts_on = "stack"
    reference = "Rasmussen, LSST Document-8590: thicknesses fitted to a quantum efficiency curve"
    parameters = (Parameter("scale", "", 1.0, (0.5, 1.5), 0.05, "factor on both thicknesses"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Scale the coating."""
        for name in ("ar_outer", "ar_inner"):
            layer = system.stack.layers[system.stack.position(name)]
            system = system.with_layer(name, thickness_um=layer.thickness_um * values["scale"])
        return system
