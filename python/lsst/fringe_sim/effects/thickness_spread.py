"""Variation of the layer's thickness inside a pixel."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["ThicknessSpread"]


class ThicknessSpread(PlainNullEffect):
    """A pixel sees the mean over a Gaussian distribution of thicknesses: every harmonic loses by its own square."""

    name = "thickness_spread"
    title = "thickness variation inside a pixel"
    acts_on = "stack"
    reference = "Davies 1954, doi 10.1049/pi-3.1954.0067: average over the phase of a rough layer"
    parameters = (
        Parameter("sigma", "nm", 0.0, (0.0, 300.0), 30.0, "rms variation of the layer that varies"),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Add the variation in quadrature to that of the varying layer."""
        layer = system.stack.layers[system.stack.position(system.varying)]
        spread = (layer.thickness_spread_um**2 + (1e-3 * values["sigma"]) ** 2) ** 0.5
        return system.with_layer(system.varying, thickness_spread_um=spread)
