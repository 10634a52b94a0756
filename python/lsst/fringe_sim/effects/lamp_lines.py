"""Lines of the lamp inside the bandpass of the monochromator."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..optics.illumination import LampSpectrum
from ..optics.system import OpticalSystem
from .base import FloatArray, Parameter, PlainNullEffect

__all__ = ["XENON_LINES", "LampLines"]

XENON_LINES = (
    (823.390, 10000.0),
    (834.912, 2000.0),
    (841.150, 2000.0),
    (882.183, 5000.0),
    (895.471, 1000.0),
    (904.793, 400.0),
    (916.517, 500.0),
    (951.599, 200.0),
    (968.798, 150.0),
    (972.083, 100.0),
    (980.238, 2000.0),
    (992.592, 3000.0),
    (1084.131, 1000.0),
)
"""Wavelengths in vacuum [nm] and relative intensities of neutral xenon.

Sansonetti & Martin 2005, Handbook of Basic Atomic Spectroscopic Data, doi 10.1063/1.1800011; intensities are those of
a discharge, of which an arc under pressure keeps the order only.
"""

_LINE_FWHM_NM = 2.0
_STEP_NM = 0.1
_RANGE_NM = (200.0, 1200.0)


class LampLines(PlainNullEffect):
    """The xenon arc has lines on its continuum: where one lies in the bandpass, it shifts and narrows the light."""

    name = "lamp_lines"
    title = "lines of the xenon lamp"
    acts_on = "illumination"
    laboratory_only = True
    reference = (
        "Sansonetti & Martin 2005, doi 10.1063/1.1800011 (lines of neutral xenon, 2 nm wide in an arc)"
    )
    parameters = (
        Parameter("strength", "", 0.0, (0.0, 50.0), 1.0, "peak of the 992.6 nm line over the continuum"),
    )

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Put the lines on the spectrum of the lamp."""
        wavelength, lines = _lines()
        light = 1.0 + values["strength"] * lines
        if system.lamp is not None:
            known = system.lamp
            inside = (wavelength >= known.wavelength_nm[0]) & (wavelength <= known.wavelength_nm[-1])
            wavelength, light = wavelength[inside], light[inside] * known.at(wavelength[inside])
        return replace(system, lamp=LampSpectrum(wavelength, light))


@functools.cache
def _lines() -> tuple[FloatArray, FloatArray]:
    """Lorentzian lines relative to the peak of that at 992.6 nm, on a fine grid."""
    low, high = _RANGE_NM
    wavelength = np.linspace(low, high, round((high - low) / _STEP_NM) + 1)
    shape = np.zeros(wavelength.size)
    for centre, intensity in XENON_LINES:
        shape += intensity / 3000.0 / (1.0 + (2.0 * (wavelength - centre) / _LINE_FWHM_NM) ** 2)
    return wavelength, shape
