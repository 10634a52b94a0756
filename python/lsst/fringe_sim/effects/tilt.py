"""Parallel light that does not arrive along the normal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from ..errors import InputError
from ..optics.illumination import Beam
from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["Tilt"]


class Tilt(PlainNullEffect):
    """The sensor is tilted against the parallel beam."""

    name = "tilt"
    title = "tilted sensor"
    acts_on = "illumination"
    laboratory_only = True
    reference = "Born & Wolf, Principles of Optics, section 1.6"
    parameters = (Parameter("angle", "deg", 0.0, (0.0, 40.0), 3.0, "angle of incidence"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Tilt the beam."""
        if system.beam.theta.size > 1:
            raise InputError("effect tilt", "a beam of many angles", "set-ups with parallel light")
        angle = float(system.beam.theta[0]) + math.radians(values["angle"])
        return replace(system, beam=Beam.collimated(angle))
