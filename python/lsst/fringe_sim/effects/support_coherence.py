"""Coherence of the light that returns from the far side of the support."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["SupportCoherence"]


class SupportCoherence(PlainNullEffect):
    """The support varies in thickness inside a pixel; a fraction of a wavelength makes it incoherent."""

    name = "support_coherence"
    title = "partially incoherent support"
    acts_on = "stack"
    reference = "Harbecke 1986, doi 10.1007/BF00616616 (coherent and incoherent multilayers)"
    parameters = (
        Parameter("spread", "um", 0.0, (0.0, 2.0), 0.05, "rms thickness variation of the support in a pixel"),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Add the variation in quadrature to that of the support."""
        layer = system.stack.layers[system.stack.position("support")]
        spread = (layer.thickness_spread_um**2 + values["spread"] ** 2) ** 0.5
        return system.with_layer("support", thickness_spread_um=spread)
