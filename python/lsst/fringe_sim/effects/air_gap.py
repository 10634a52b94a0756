"""A gap behind the adhesive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..optics import Layer, get_medium
from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["AirGap"]


class AirGap(PlainNullEffect):
    """The adhesive has come off the support: a thin gap, empty in the cryostat, lies between them."""

    name = "air_gap"
    title = "gap between adhesive and support"
    acts_on = "stack"
    reference = (
        "Born & Wolf, Principles of Optics, section 1.6 (layered media): an adhesive that has come off"
    )
    parameters = (
        Parameter("thickness", "nm", 0.0, (0.0, 2000.0), 30.0, "thickness of the gap", repeats_after=470.0),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Insert the gap."""
        gap = Layer("air_gap", get_medium("vacuum"), 1e-3 * values["thickness"])
        return replace(system, stack=system.stack.with_inserted(gap, before="support"))
