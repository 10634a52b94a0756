"""Thickness of the insulation behind the gates."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["Insulation"]


class Insulation(PlainNullEffect):
    """The insulation between gates and adhesive is thicker or thinner than the stack states."""

    name = "insulation"
    title = "insulation behind the gates"
    acts_on = "stack"
    reference = "Lage 2019, doi 10.48550/arXiv.1911.09577 (layers of 0.1-1.0 um, measured on single sensors)"
    parameters = (Parameter("offset", "um", 0.0, (-0.3, 0.5), 0.05, "thickness minus that of the stack"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Change the thickness of the insulation."""
        layer = system.stack.layers[system.stack.position("insulation")]
        return system.with_layer("insulation", thickness_um=layer.thickness_um + values["offset"])
