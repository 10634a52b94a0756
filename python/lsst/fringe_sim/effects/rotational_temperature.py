"""Temperature of the layer of air that glows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..instrument.sky import SECOND_RADIATION_CM_K, SkySpectrum
from .base import Parameter, PlainNullEffect

__all__ = ["RotationalTemperature"]

REFERENCE_K = 190.0
"""Rotational temperature of the low levels in the line list; the departure from it counts."""


class RotationalTemperature(PlainNullEffect):
    """Rotational levels are populated as in warmer or colder air; every band keeps its photons."""

    name = "rotational_temperature"
    title = "rotational temperature of OH"
    acts_on = "spectrum"
    reference = "Noll et al. 2025, Geosci. Model Dev. 18, 4353 (PALACE: 190-200 K, +-20 K through a night)"
    parameters = (
        Parameter("offset", "K", 0.0, (-80.0, 200.0), 15.0, "departure from the 190 K of the line list"),
    )

    def change_sky(self, sky: SkySpectrum, values: Mapping[str, float]) -> SkySpectrum:
        """Multiply populations by the ratio of two Boltzmann factors."""
        colder = SECOND_RADIATION_CM_K * (1.0 / REFERENCE_K - 1.0 / (REFERENCE_K + values["offset"]))
        return replace(sky, lines=sky.lines.with_rotation(lambda energy: np.exp(colder * energy)))
