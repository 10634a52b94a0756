"""Refractive index of the support behind the adhesive."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["SupportIndex"]


class SupportIndex(PlainNullEffect):
    """The support reflects more or less than the tabulated material."""

    name = "support_index"
    title = "index of the support"
    acts_on = "stack"
    reference = "Guo, Walter, Lage & Lupton 2022, Table 1 assumes silicon; ceramics have an index of 1.7-2.2"
    # The support is an etalon of its own: its fringes return after half a wavelength in its optical thickness.
    parameters = (
        Parameter(
            "offset", "", 0.0, (-2.4, 1.0), 0.3, "index minus that of the set-up", repeats_after=0.00285
        ),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Shift the index of the support."""
        medium = system.stack.layers[system.stack.position("support")].medium
        changed = medium.modified(index_offset=medium.index_offset + values["offset"])
        return system.with_layer("support", medium=changed)
