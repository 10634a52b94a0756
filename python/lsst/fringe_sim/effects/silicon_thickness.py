"""Thickness of the detection layer."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["SiliconThickness"]


class SiliconThickness(PlainNullEffect):
    """The detection layer is thicker or thinner than the stack states."""

    name = "silicon_thickness"
    title = "silicon thickness"
    acts_on = "stack"
    reference = "Guo, Walter, Lage & Lupton 2022, Table 1 (100 um, constant)"
    parameters = (
        Parameter(
            "offset", "um", 0.0, (-20.0, 20.0), 1.0, "thickness minus that of the stack", repeats_after=0.13
        ),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Change the thickness of the detection layer."""
        layer = system.stack.layers[system.stack.position(system.detection)]
        return system.with_layer(system.detection, thickness_um=layer.thickness_um + values["offset"])
