"""Refractive index of the adhesive."""

from __future__ import annotations

from collections.abc import Mapping

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["EpoxyIndex"]


class EpoxyIndex(PlainNullEffect):
    """Another index level and a Cauchy dispersion of the adhesive."""

    name = "epoxy_index"
    title = "adhesive index and dispersion"
    acts_on = "stack"
    reference = (
        "spread of published epoxies: refractiveindex.info (NOA-61, SU-8, EpoCore); the vendor states none"
    )
    parameters = (
        Parameter("offset", "", 0.0, (-0.3, 0.3), 0.03, "index minus that of the set-up at 960 nm"),
        Parameter(
            "cauchy",
            "um2",
            0.0,
            (-0.05, 0.05),
            0.005,
            "coefficient of 1/wavelength² relative to 960 nm",
            refinement=1,
        ),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Change the medium of the adhesive."""
        medium = system.stack.layers[system.stack.position("adhesive")].medium
        changed = medium.modified(
            index_offset=medium.index_offset + values["offset"],
            dispersion_um2=medium.dispersion_um2 + values["cauchy"],
        )
        return system.with_layer("adhesive", medium=changed)
