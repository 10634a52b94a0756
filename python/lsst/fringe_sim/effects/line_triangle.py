"""Triangular shape of the monochromator line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..optics.illumination import TriangularProfile
from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect
from .line_profiles import MixedProfile, line_width

__all__ = ["LineTriangle"]


class LineTriangle(PlainNullEffect):
    """The line is more like a triangle of the same width, the image of one slit on an equal one, than a Gaussian."""

    name = "line_triangle"
    title = "triangular slit function"
    acts_on = "illumination"
    laboratory_only = True
    reference = "James & Sternberg 1969, The Design of Optical Spectrometers: equal entrance and exit slits"
    parameters = (
        Parameter(
            "fraction", "", 0.0, (0.0, 1.0), 0.5, "part of the light in the triangle", natural_bounds=(1.0,)
        ),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Mix the triangle in."""
        triangle = TriangularProfile(line_width(system.profile, self.name))
        return replace(system, profile=MixedProfile(system.profile, triangle, values["fraction"]))
