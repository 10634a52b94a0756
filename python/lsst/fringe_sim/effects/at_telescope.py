"""Effects of the way from the laboratory, where thickness is measured, to the telescope, where the sky is seen."""

from __future__ import annotations

import math
from dataclasses import replace

from ..optics.system import OpticalSystem
from .base import Parameter, PlainNullEffect, Values

PHASE_NM, PER_K = 960.0, 10.0
"""Wavelength at which the phase of the adhesive is stated [nm], and the change of temperature that it is for [K]."""

ADHESIVE_PHASE_SIGMA = 0.3
"""Uncertainty of that phase [rad per 10 K]. Epoxies change by about 10⁻⁴ per kelvin in length and as much, of the
other sign, in index; either alone turns a fringe of 14 µm by 0.2 to 0.4 rad, and the sum's sign is not known."""


def adhesive_change(system: OpticalSystem, phase_per_10k: float) -> float:
    """Relative change of the optical thickness of the adhesive between the laboratory and this temperature."""
    if system.laboratory_temperature_k is None:
        return 0.0
    layer = system.stack.layers[system.stack.position("adhesive")]
    index = float(layer.medium.index(PHASE_NM, system.temperature_k).real)
    round_trip = 4.0 * math.pi * index * layer.thickness_um / (1e-3 * PHASE_NM)
    colder = (system.laboratory_temperature_k - system.temperature_k) / PER_K
    return phase_per_10k * colder / round_trip


class SensorTemperature(PlainNullEffect):
    """The silicon is warmer or colder than the set-up of the telescope states."""

    name = "sensor_temperature"
    title = "sensor temperature at the telescope"
    acts_on = "stack"
    sky_only = True
    reference = "Franta et al. 2017, doi 10.1016/j.apsusc.2017.02.021 (silicon from 100 to 300 K)"
    parameters = (Parameter("offset", "K", 0.0, (-15.0, 15.0), 3.0, "temperature minus that of the set-up"),)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Warm the sensor, at a telescope."""
        if system.laboratory_temperature_k is None:
            return system
        return replace(system, temperature_k=system.temperature_k + values["offset"])


class EpoxyTemperature(PlainNullEffect):
    """The adhesive becomes shorter and denser between the temperatures of laboratory and sky.

    The thickness of a map and the index of the set-up are those of the laboratory. Their product changes by a common
    factor, of which only the size is known.
    """

    name = "epoxy_temperature"
    title = "adhesive at another temperature than in the laboratory"
    acts_on = "stack"
    sky_only = True
    reference = "expansion and change of index of epoxies, each about 1e-4 per kelvin; the vendor states none"
    parameters = (
        Parameter(
            "phase_per_10k", "rad", 0.0, (-2.0, 2.0), ADHESIVE_PHASE_SIGMA,
            "turn of the fringe for 10 K of cooling, at 960 nm in the adhesive of the stack",
        ),
    )  # fmt: skip

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Change the index, which turns the fringe as a change of the length does."""
        factor = 1.0 + adhesive_change(system, values["phase_per_10k"])
        if factor == 1.0:
            return system
        medium = system.stack.layers[system.stack.position("adhesive")].medium
        return system.with_layer("adhesive", medium=medium.modified(index_scale=medium.index_scale * factor))
