"""Errors of the monochromator that differ from exposure to exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect

__all__ = ["WavelengthJitter"]

NODES_NM = tuple(range(800, 1051, 10))
"""Nominal wavelengths at which the error is free [nm]: those of flats, 10 nm from one another."""


class WavelengthJitter(PlainNullEffect):
    """Every exposure has a wavelength error of its own: a grating does not come back to where it was.

    Between two nodes the error runs in a straight line, so that flats 10 nm from one another are independent, and
    finer series have a smooth error of the scale.
    """

    name = "wavelength_jitter"
    title = "wavelength errors of single exposures"
    acts_on = "illumination"
    laboratory_only = True
    moves_wavelengths = True
    exchangeable = True
    reference = "repeatability of grating drives, 0.1-0.3 nm; MONOCH-WAVELENG against MONOWL in TS8 headers"
    parameters = tuple(
        Parameter(
            f"at_{node}", "nm", 0.0, (-5.0, 5.0), 0.2, f"true minus nominal wavelength at {node} nm",
            wavelength_nm=float(node),
        )
        for node in NODES_NM
    )  # fmt: skip

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Move every exposure by the error at its nominal wavelength."""
        own = tuple((parameter.wavelength_nm, values[parameter.name]) for parameter in self.parameters)
        return replace(system, wavelength_errors_nm=(*system.wavelength_errors_nm, own))
