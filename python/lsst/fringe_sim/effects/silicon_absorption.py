"""Scale of the extinction coefficient of silicon."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["SiliconAbsorption"]


class SiliconAbsorption(PlainNullEffect):
    """The detection layer absorbs more or less than the tabulated silicon."""

    name = "silicon_absorption"
    title = "silicon extinction"
    acts_on = "stack"
    reference = (
        "Green 2008 against Schinke et al. 2015, doi 10.1063/1.4923419: tables differ by 10-20 % in the red"
    )
    parameters = (Parameter("scale", "", 1.0, (0.5, 2.0), 0.1, "factor on the extinction coefficient"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Scale the extinction coefficient of the detection layer."""
        medium = system.stack.layers[system.stack.position(system.detection)].medium
        changed = medium.modified(extinction_scale=medium.extinction_scale * values["scale"])
        return system.with_layer(system.detection, medium=changed)
