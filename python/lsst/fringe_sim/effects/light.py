"""Effects on the light that falls on the sensor: its line, its wavelength, its angles and what is scattered.

How the light varies over the sensor is in `illumination`.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np

from ..errors import InputError
from ..optics.illumination import Beam, GaussianProfile, LampSpectrum, TriangularProfile
from ..optics.system import OpticalSystem
from ..resources import read_table
from .base import Effect, FloatArray, Parameter, PlainNullEffect, ResponseContext, SearchHints, Values
from .line_profiles import LorentzianProfile, MixedProfile, line_width

JITTER_NODES_NM = tuple(range(800, 1051, 10))
"""Nominal wavelengths at which the error of single exposures is free [nm]: those of flats, 10 nm from one another."""

AZIMUTHS = 8
"""Directions of a tilt relative to a ray, over half a turn; the mean over them converges exponentially."""

_LINE_FWHM_NM = 2.0
_REFERENCE_NM = 992.6
_STEP_NM = 0.1
_RANGE_NM = (200.0, 1200.0)


class Bandwidth(Effect):
    """Another full width at half maximum than the set-up states."""

    name = "bandwidth"
    title = "bandpass width"
    acts_on = "illumination"
    laboratory_only = True
    reference = "Guo, Walter, Lage & Lupton 2022, section 2.2"
    parameters = (Parameter("fwhm", "nm", math.nan, (0.05, 20.0), 0.5, "full width at half maximum"),)

    def null_values(self, system: OpticalSystem) -> dict[str, float]:
        """Width that the set-up states."""
        return {"fwhm": _width(system)}

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Replace the width of the line."""
        _width(system)
        return replace(system, profile=replace(system.profile, fwhm_nm=values["fwhm"]))  # type: ignore[type-var]


def _width(system: OpticalSystem) -> float:
    if not isinstance(system.profile, GaussianProfile | TriangularProfile):
        raise InputError(
            "effect bandwidth", type(system.profile).__name__, "set-ups with a monochromator line"
        )
    return system.profile.fwhm_nm


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
    parameters = (Parameter("fraction", "", 0.0, (0.0, 1.0), 0.05, "part of the light in the Lorentzian"),)
    search = SearchHints(natural_bounds=(1.0,))

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Mix the Lorentzian in."""
        wing = LorentzianProfile(line_width(system.profile, self.name))
        return replace(system, profile=MixedProfile(system.profile, wing, values["fraction"]))


class LineTriangle(PlainNullEffect):
    """The line is more like a triangle of the same width, the image of one slit on an equal one, than a Gaussian."""

    name = "line_triangle"
    title = "triangular slit function"
    acts_on = "illumination"
    laboratory_only = True
    reference = "James & Sternberg 1969, The Design of Optical Spectrometers: equal entrance and exit slits"
    parameters = (Parameter("fraction", "", 0.0, (0.0, 1.0), 0.5, "part of the light in the triangle"),)
    search = SearchHints(natural_bounds=(1.0,))

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Mix the triangle in."""
        triangle = TriangularProfile(line_width(system.profile, self.name))
        return replace(system, profile=MixedProfile(system.profile, triangle, values["fraction"]))


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

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
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


class WavelengthOffset(PlainNullEffect):
    """All exposures lie a constant distance from their nominal wavelength."""

    name = "wavelength_offset"
    title = "wavelength zero"
    acts_on = "illumination"
    laboratory_only = True
    reference = "effect of a grating angle offset; MONOCH-WAVELENG against MONOWL in TS8 headers"
    parameters = (Parameter("offset", "nm", 0.0, (-10.0, 10.0), 0.5, "true minus nominal wavelength"),)
    search = SearchHints(moves_wavelengths=True)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Shift every exposure."""
        return replace(system, wavelength_offset_nm=system.wavelength_offset_nm + values["offset"])


class WavelengthScale(PlainNullEffect):
    """The wavelength error grows linearly from 935 nm, the middle of 880 to 990 nm, where it is zero."""

    name = "wavelength_scale"
    title = "wavelength scale"
    acts_on = "illumination"
    laboratory_only = True
    reference = "linear part of a grating calibration error"
    parameters = (
        Parameter("stretch", "nm/nm", 0.0, (-0.1, 0.1), 0.005, "relative error of wavelength differences"),
    )
    search = SearchHints(moves_wavelengths=True)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Stretch the scale about its pivot."""
        return replace(system, wavelength_stretch=system.wavelength_stretch + values["stretch"])


class WavelengthJitter(PlainNullEffect):
    """Every exposure has a wavelength error of its own: a grating does not come back to where it was.

    Between two nodes the error runs in a straight line, so that flats 10 nm from one another are independent, and
    finer series have a smooth error of the scale.
    """

    name = "wavelength_jitter"
    title = "wavelength errors of single exposures"
    acts_on = "illumination"
    laboratory_only = True
    reference = "repeatability of grating drives, 0.1-0.3 nm; MONOCH-WAVELENG against MONOWL in TS8 headers"
    parameters = tuple(
        Parameter(
            f"at_{node}", "nm", 0.0, (-5.0, 5.0), 0.2, f"true minus nominal wavelength at {node} nm",
            wavelength_nm=float(node),
        )
        for node in JITTER_NODES_NM
    )  # fmt: skip
    search = SearchHints(moves_wavelengths=True, exchangeable=True)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Move every exposure by the error at its nominal wavelength."""
        own = tuple((parameter.wavelength_nm, values[parameter.name]) for parameter in self.parameters)
        return replace(system, wavelength_errors_nm=(*system.wavelength_errors_nm, own))


class ConvergingBeam(PlainNullEffect):
    """A uniform cone of light in place of every ray of the set-up, be it that of a lens or of an extended source."""

    name = "converging_beam"
    title = "converging beam or extended source"
    acts_on = "illumination"
    laboratory_only = True
    reference = "Groom 2017; Guo, Walter, Lage & Lupton 2022, section 2.2 (4 inch sphere at 1 m: 2.9 deg)"
    parameters = (
        Parameter("numerical_aperture", "", 0.0, (0.0, 0.7), 0.05, "sine of the largest angle of incidence"),
    )

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Widen the beam by a cone."""
        aperture = values["numerical_aperture"]
        # Phase between axis and rim in 265 um of silicon is 240 rad times the aperture squared: a node per 2 rad,
        # and three for what remains: 1e-5 of the fringes without the cone or less, at every aperture up to 0.5.
        nodes = 3 + math.ceil(120.0 * aperture**2)
        cone = Beam.cone(0.5 / aperture, nodes=nodes)
        if system.beam.theta.any():
            cone = widened(system.beam, cone, system.beam.theta.size + nodes)
        return replace(system, beam=cone)


class Tilt(PlainNullEffect):
    """The sensor is tilted against the beam."""

    name = "tilt"
    title = "tilted sensor"
    acts_on = "illumination"
    laboratory_only = True
    reference = "Born & Wolf, Principles of Optics, section 1.6"
    parameters = (Parameter("angle", "deg", 0.0, (0.0, 40.0), 3.0, "angle of incidence"),)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Tilt the beam."""
        angle = math.radians(values["angle"])
        beam = system.beam
        if beam.theta.size == 1:
            return replace(system, beam=Beam.collimated(float(beam.theta[0]) + angle))
        # The tilt spreads sin^2 of the rim by this much; the phase in 265 um of silicon takes a node per 2 rad.
        spread = 2.0 * math.sin(float(beam.theta.max())) * math.sin(angle)
        return replace(
            system,
            beam=widened(beam, Beam.collimated(angle), beam.theta.size + 6 + math.ceil(120.0 * spread)),
        )


def tilted(beam: Beam, angle: float) -> Beam:
    """Rotationally symmetric beam seen by a sensor that is tilted by ``angle`` [rad]; `AZIMUTHS` times the nodes.

    A ray at ``θ`` to the axis, at azimuth ``φ``, falls on the sensor at ``cos θ' = cos θ cos α + sin θ sin α cos φ``.
    """
    azimuth = (np.arange(AZIMUTHS) + 0.5) * math.pi / AZIMUTHS
    cosine = np.cos(beam.theta)[:, None] * math.cos(angle)
    cosine = cosine + np.sin(beam.theta)[:, None] * math.sin(angle) * np.cos(azimuth)
    return Beam(np.arccos(np.clip(cosine, -1.0, 1.0)).ravel(), np.repeat(beam.weight, AZIMUTHS) / AZIMUTHS)


def widened(beam: Beam, source: Beam, nodes: int) -> Beam:
    """Beam in which every ray is a cone ``source``, as a Gauss rule of ``nodes`` angles in ``sin²θ``."""
    # Needs a ray tracer to import; most effects do without.
    from ..instrument.telescope import reduce_beam

    parts = [tilted(beam, angle) for angle in source.theta]
    theta = np.concatenate([part.theta for part in parts])
    weight = np.concatenate([w * part.weight for w, part in zip(source.weight, parts, strict=True)])
    return reduce_beam(Beam(theta, weight / weight.sum()), nodes)


class GhostPedestal(PlainNullEffect):
    """A uniform level is added to every exposure, in proportion to its mean."""

    name = "ghost_pedestal"
    title = "scattered light or ghost pedestal"
    acts_on = "response"
    laboratory_only = True
    reference = "uniform ghost of a flat-field illumination"
    parameters = (Parameter("fraction", "", 0.0, (0.0, 20.0), 0.05, "pedestal over mean signal"),)

    def change_response(self, response: FloatArray, values: Values, context: ResponseContext) -> FloatArray:
        """Add a multiple of the phase-averaged response."""
        mean = context.phase_mean.reshape((-1,) + (1,) * (response.ndim - 1))
        return response + values["fraction"] * mean
