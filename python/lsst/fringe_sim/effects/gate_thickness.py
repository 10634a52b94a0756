"""Thickness of the polysilicon gates."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["GateThickness"]


class GateThickness(PlainNullEffect):
    """The gates are thicker or thinner than the stack states."""

    name = "gate_thickness"
    title = "polysilicon gates"
    acts_on = "stack"
    reference = "Lage 2019, doi 10.48550/arXiv.1911.09577 (0.3-0.34 um)"
    parameters = (Parameter("offset", "um", 0.0, (-0.2, 0.3), 0.02, "thickness minus that of the stack"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Change the thickness of the gates."""
        layer = system.stack.layers[system.stack.position("gates")]
        return system.with_layer("gates", thickness_um=layer.thickness_um + values["offset"])
