"""Roughness of the interface between the adhesive and the support."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["InterfaceRoughness"]


class InterfaceRoughness(PlainNullEffect):
    """The back surface is rough: the reflected wave loses coherence."""

    name = "roughness"
    title = "interface roughness"
    acts_on = "stack"
    reference = "Beckmann & Spizzichino 1963; Davies 1954, doi 10.1049/pi-3.1954.0067"
    parameters = (Parameter("sigma", "nm", 0.0, (0.0, 300.0), 50.0, "rms height of the support surface"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Add the roughness in quadrature to the upper face of the support."""
        layer = system.stack.layers[system.stack.position("support")]
        sigma = (layer.roughness_nm**2 + values["sigma"] ** 2) ** 0.5
        return system.with_layer("support", roughness_nm=sigma)
