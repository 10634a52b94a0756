"""Absorbing coating behind the gates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..optics.media import get_medium
from ..optics.stack import Layer
from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["BlackCoating"]


class BlackCoating(PlainNullEffect):
    """A layer of black resist lies between the gates and the adhesive, as on ITL sensors."""

    name = "black_coating"
    title = "black coating behind the gates"
    acts_on = "stack"
    reference = "Guo, Walter, Lage & Lupton 2022, section 2.3 (Litho-Black on ITL sensors)"
    parameters = (Parameter("thickness", "um", 0.0, (0.0, 3.0), 0.3, "thickness added to that of the stack"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Insert the coating, or thicken the one that is there."""
        if "black_coating" in system.stack.names:
            layer = system.stack.layers[system.stack.position("black_coating")]
            return system.with_layer("black_coating", thickness_um=layer.thickness_um + values["thickness"])
        coating = Layer("black_coating", get_medium("litho_black"), values["thickness"])
        return replace(system, stack=system.stack.with_inserted(coating, before="adhesive"))
