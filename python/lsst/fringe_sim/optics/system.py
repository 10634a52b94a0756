"""Everything optical that decides how a pixel responds, in one frozen object that effects may change."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError, named_units
from ..notebook import OneLine
from .diffuse import DiffuseReturn
from .illumination import DEFAULT_STEP_NM, Beam, Illumination, LampSpectrum, SpectralProfile
from .phase_response import PhaseResponse, reduce_to_phase
from .stack import LayerStack

__all__ = ["OBSERVABLES", "OpticalSystem", "Structure"]

OBSERVABLES = ("detection", "total")
"""``detection``: absorbed in the detection layer. ``total``: 1 - R - T of the stack, as the paper's fit used."""


@named_units
@dataclass(frozen=True)
class Structure:
    """A part of every pixel in which one layer is thicker; coarse beside a wavelength, so that intensities add."""

    layer: str
    added_um: float
    part: float


@named_units
@dataclass(frozen=True, repr=False)
class OpticalSystem(OneLine):
    """Stack, illumination and observable.

    Attributes
    ----------
    stack : `LayerStack`
        The sensor.
    temperature_k : `float`
        Temperature of the sensor [K].
    profile : `SpectralProfile`
        Shape of the monochromator line.
    beam : `Beam`
        Angles of incidence.
    varying, detection : `str`
        Names of the layer whose thickness varies and of the one whose absorption is detected.
    observable : {"detection", "total"}
        What a pixel responds to.
    polarization : {"mixed", "s", "p"}
        Polarisation of the light.
    wavelength_offset_nm : `float`
        True minus nominal wavelength of every exposure [nm].
    wavelength_stretch : `float`
        Relative error of the wavelength scale, zero at `stretch_pivot_nm`.
    stretch_pivot_nm : `float`
        Wavelength at which the scale error vanishes [nm].
    wavelength_errors_nm : `tuple`
        Further errors, which add up: pairs of nominal wavelength and error [nm], in a straight line between them and
        constant beyond.
    lamp : `LampSpectrum`, optional
        Spectrum of the lamp behind the monochromator; white if not given.
    diffuse : `DiffuseReturn`, optional
        What the gate side scatters back into the silicon; nothing if not given.
    structure : `Structure`, optional
        Part of every pixel in which a layer is thicker; none if not given.
    laboratory_temperature_k : `float`, optional
        Temperature at which thicknesses were measured, for a sensor at a telescope [K].
    added_harmonics : `tuple`
        What is added to the response of the stack: a multiple of the fringe phase, and its nodes of wavelength [nm],
        cosine and sine, parts of the mean response; in a straight line between nodes and constant beyond.
    """

    stack: LayerStack
    temperature_k: float
    profile: SpectralProfile
    beam: Beam
    varying: str = "adhesive"
    detection: str = "detection"
    observable: str = "detection"
    polarization: str = "mixed"
    wavelength_offset_nm: float = 0.0
    wavelength_stretch: float = 0.0
    stretch_pivot_nm: float = 935.0
    wavelength_errors_nm: tuple[tuple[tuple[float, float], ...], ...] = ()
    lamp: LampSpectrum | None = None
    diffuse: DiffuseReturn | None = None
    structure: Structure | None = None
    laboratory_temperature_k: float | None = None
    added_harmonics: tuple[tuple[int, tuple[tuple[float, float, float], ...]], ...] = ()

    def __post_init__(self) -> None:
        self.stack.position(self.varying)
        self.stack.position(self.detection)
        if self.observable not in OBSERVABLES:
            raise InputError("observable", self.observable, " or ".join(OBSERVABLES))

    def with_layer(self, layer: str, **changes: object) -> OpticalSystem:
        """System in which some attributes of one layer of the stack are changed."""
        return replace(self, stack=self.stack.replace_layer(layer, **changes))

    @named_units
    def true_wavelength(self, nominal_nm: ArrayLike) -> np.ndarray:
        """Wavelength that the monochromator really delivers [nm]."""
        nominal = np.asarray(nominal_nm, dtype=float)
        stretched = self.wavelength_stretch * (nominal - self.stretch_pivot_nm)
        return nominal + self.wavelength_offset_nm + stretched + self._single_errors(nominal)

    def _single_errors(self, nominal_nm: np.ndarray) -> np.ndarray:
        total = np.zeros(nominal_nm.shape)
        for errors in self.wavelength_errors_nm:
            total += np.interp(nominal_nm, *np.transpose(errors))
        return total

    @named_units
    def flat_fields(self, wavelength_nm: ArrayLike, step_nm: float = DEFAULT_STEP_NM) -> Illumination:
        """Illumination of monochromator flats at nominal wavelengths [nm]."""
        wavelength = self.true_wavelength(wavelength_nm)
        return Illumination.flat_fields(wavelength, self.profile, self.beam, step_nm, self.lamp)

    def reduce(self, illumination: Illumination) -> PhaseResponse:
        """Closed form of the response in the thickness of the varying layer, one set per node."""
        if self.added_harmonics:
            bare = replace(self, added_harmonics=()).reduce(illumination)
            for harmonic, nodes in self.added_harmonics:
                place, cosine, sine = np.transpose(nodes)
                parts = [np.interp(illumination.wavelength_nm, place, each) for each in (cosine, sine)]
                bare = bare.with_harmonic(harmonic, *parts)
            return bare
        if self.structure is not None:
            here = replace(self, structure=None)
            layer = self.stack.layers[self.stack.position(self.structure.layer)]
            there = here.with_layer(layer.name, thickness_um=layer.thickness_um + self.structure.added_um)
            return here.reduce(illumination).mixed_with(there.reduce(illumination), self.structure.part)
        index = self.stack.indices(illumination.wavelength_nm, self.temperature_k)
        thickness = np.where(np.isinf(self.stack.thickness_um), 0.0, self.stack.thickness_um)
        if self.observable == "detection":
            layers = [self.stack.position(self.detection)]
        else:
            layers = list(range(1, len(self.stack.layers) - 1))
        reduced = functools.partial(
            reduce_to_phase,
            index,
            thickness,
            1e-3 * illumination.wavelength_nm,
            illumination.theta,
            self.polarization,
            varying=self.stack.position(self.varying),
            roughness=1e-3 * self.stack.roughness_nm,
            spread=self.stack.thickness_spread_um,
        )
        if self.diffuse is None:
            return reduced(layers=layers)
        taken = self.diffuse.attenuation(self.stack)
        absorbed, escaped = self.diffuse.fate(
            self.stack, self.detection, illumination.wavelength_nm, self.temperature_k
        )
        seen = absorbed if self.observable == "detection" else -escaped
        response = reduced(layers=layers, attenuation=taken)
        for name, factor in zip(
            (self.diffuse.upper, self.diffuse.lower), self.diffuse.returned(), strict=True
        ):
            response = response.plus(
                reduced(layers=[self.stack.position(name)], attenuation=taken), factor * seen
            )
        return response
