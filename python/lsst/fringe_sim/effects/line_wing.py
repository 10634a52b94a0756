"""Wings of the monochromator line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect
from .line_profiles import LorentzianProfile, MixedProfile, line_width

__all__ = ["LineWing"]


class LineWing(PlainNullEffect):
    """A part of the light lies in a Lorentzian of the same width: its wings make hardly any fringes.

    The Lorentzian has the full width at half maximum of the line, and ends at ten times that from its middle.
    """

    name = "line_wing"
    title = "Lorentzian wings of the line"
    acts_on = "illumination"
    laboratory_only = True
    reference = (
        "Woods, Wrigley, Rottman & Haring 1994, doi 10.1364/AO.33.004273 (scattered light of gratings)"
    )
    parameters = (
        Parameter(
            "fraction",
            "",
            0.0,
            (0.0, 1.0),
            0.05,
            "part of the light in the Lorentzian",
            natural_bounds=(1.0,),
        ),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Mix the Lorentzian in."""
        wing = LorentzianProfile(line_width(system.profile, self.name))
        return replace(system, profile=MixedProfile(system.profile, wing, values["fraction"]))
