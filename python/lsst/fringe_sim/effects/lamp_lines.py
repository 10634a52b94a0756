"""Lines of the lamp inside the bandpass of the monochromator."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..optics.illumination import LampSpectrum
from ..optics.system import OpticalSystem
from ..resources import read_table
from .base import FloatArray, Parameter, PlainNullEffect

__all__ = ["LampLines", "xenon_lines"]

_LINE_FWHM_NM = 2.0
_REFERENCE_NM = 992.6
_STEP_NM = 0.1
_RANGE_NM = (200.0, 1200.0)


class LampLines(PlainNullEffect):
    """The xenon arc has lines on its continuum: where one lies in the bandpass, it shifts and narrows the light.

    Every line is a Lorentzian of 2 nm FWHM on an even continuum; their strengths have the measured ratios.
    """

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


def xenon_lines() -> tuple[FloatArray, FloatArray]:
    """Wavelengths in vacuum [nm] and relative intensities of strong lines of neutral xenon."""
    table = read_table("laboratory", "xenon_lines.ecsv")
    return np.array(table["wavelength"]), np.array(table["intensity"])


@functools.cache
def _lines() -> tuple[FloatArray, FloatArray]:
    """Lorentzian lines relative to the peak of that at 992.6 nm, on a fine grid."""
    low, high = _RANGE_NM
    places, intensities = xenon_lines()
    wavelength = np.linspace(low, high, round((high - low) / _STEP_NM) + 1)
    shape = np.zeros(wavelength.size)
    reference = intensities[np.argmin(np.abs(places - _REFERENCE_NM))]
    for centre, intensity in zip(places, intensities, strict=True):
        shape += intensity / reference / (1.0 + (2.0 * (wavelength - centre) / _LINE_FWHM_NM) ** 2)
    return wavelength, shape
