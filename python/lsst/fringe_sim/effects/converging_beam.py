"""Light that converges instead of arriving parallel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from ..optics.illumination import Beam
from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect
from .beam_angles import widened

__all__ = ["ConvergingBeam"]


class ConvergingBeam(PlainNullEffect):
    """A uniform cone of light in place of every ray of the set-up, be it that of a lens or of an extended source."""

    name = "converging_beam"
    title = "converging beam or extended source"
    acts_on = "illumination"
    laboratory_only = True
    reference = "Groom 2017; Guo, Walter, Lage & Lupton 2022, section 2.2 (4 inch sphere at 1 m: 2.9 deg)"
    parameters = (
        Parameter("numerical_aperture", "", 0.0, (0.0, 0.7), 0.05, "sine of the largest angle of incidence"),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Widen the beam by a cone."""
        aperture = values["numerical_aperture"]
        # Phase between axis and rim in 265 um of silicon is 240 rad times the aperture squared: a node per 2 rad.
        nodes = 6 + math.ceil(120.0 * aperture**2)
        cone = Beam.cone(0.5 / aperture, nodes=nodes)
        if system.beam.theta.any():
            cone = widened(system.beam, cone, system.beam.theta.size + nodes)
        return replace(system, beam=cone)
