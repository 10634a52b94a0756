"""Thickness of the oxide between detection layer and gates."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["GateOxide"]


class GateOxide(PlainNullEffect):
    """The oxide under the gates is thicker or thinner than the stack states."""

    name = "gate_oxide"
    title = "oxide under the gates"
    acts_on = "stack"
    reference = "Lage 2019, doi 10.48550/arXiv.1911.09577 (layers of 0.1-1.0 um, measured on single sensors)"
    parameters = (Parameter("offset", "um", 0.0, (-0.09, 0.3), 0.02, "thickness minus that of the stack"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Change the thickness of the oxide."""
        layer = system.stack.layers[system.stack.position("gate_oxide")]
        return system.with_layer("gate_oxide", thickness_um=layer.thickness_um + values["offset"])
