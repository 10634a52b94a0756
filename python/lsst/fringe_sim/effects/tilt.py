"""Parallel light that does not arrive along the normal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from ..optics.illumination import Beam
from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect
from .beam_angles import widened

__all__ = ["Tilt"]


class Tilt(PlainNullEffect):
    """The sensor is tilted against the beam."""

    name = "tilt"
    title = "tilted sensor"
    acts_on = "illumination"
    laboratory_only = True
    reference = "Born & Wolf, Principles of Optics, section 1.6"
    parameters = (Parameter("angle", "deg", 0.0, (0.0, 40.0), 3.0, "angle of incidence"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Tilt the beam."""
        angle = math.radians(values["angle"])
        beam = system.beam
        if beam.theta.size == 1:
            return replace(system, beam=Beam.collimated(float(beam.theta[0]) + angle))
        # The tilt spreads sin^2 of the rim by this much; the phase in 265 um of silicon takes a node per 2 rad.
        spread = 2.0 * math.sin(float(beam.theta.max())) * math.sin(angle)
        return replace(
            system,
            beam=widened(beam, Beam.collimated(angle), beam.theta.size + 6 + math.ceil(120.0 * spread)),
        )
