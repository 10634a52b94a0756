"""Absorption in the adhesive."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["EpoxyAbsorption"]


class EpoxyAbsorption(PlainNullEffect):
    """The adhesive absorbs: contrast falls with thickness."""

    name = "epoxy_absorption"
    title = "adhesive absorption"
    acts_on = "stack"
    reference = "Guo, Walter, Lage & Lupton 2022 take k = 0; filled epoxies absorb in the near infrared"
    parameters = (Parameter("k", "", 0.0, (0.0, 0.05), 0.002, "extinction coefficient"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Add to the extinction coefficient of the adhesive."""
        medium = system.stack.layers[system.stack.position("adhesive")].medium
        changed = medium.modified(extinction_offset=medium.extinction_offset + values["k"])
        return system.with_layer("adhesive", medium=changed)
