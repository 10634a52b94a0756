"""Response of a sensor to the night sky against thickness: sums over lines and angles, with their error."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import Float32Array, FloatArray
from ..effects import apply_to_sky
from ..errors import InputError, OutOfRangeError, UnknownNameError, named_units
from ..instrument.bandpass import Bandpass
from ..instrument.sky import SkySpectrum, SpectralComponent, blend_components
from ..instrument.telescope import reduce_beam
from ..model import FringeModel, ResponseTable, tabulate
from ..optics import Beam, Illumination
from ..optics.phase_response import PhaseResponse

_ERROR_SAMPLES = 48  # Thicknesses at which the quadrature is compared with a finer one
_BOUND_ANGLES = 6  # Angles that stand for a beam where no phases are involved


@named_units
@dataclass(frozen=True)
class SkyQuadrature:
    """How finely a sky is summed."""

    line_shift_nm: float = 0.003  # rms shift allowed when close lines are merged [nm]
    continuum_step_nm: float = 0.2  # spacing of the wavelengths that stand for a continuum [nm]
    # angles used for a continuum, whose fringes average out over wavelength; lines use all of the beam
    continuum_angles: int = 32
    table_tolerance: float = 3e-7  # interpolation error of a row of the table, relative to the mean sky


class FrameTable(Protocol):
    """What makes frames from thickness: a `ResponseTable` of one row, or a `FieldTable`."""

    @property
    def wavelength_nm(self) -> FloatArray:
        """Mean wavelength [nm], shape ``(1,)``."""

    @property
    def interpolation_error(self) -> float:
        """Largest error of interpolation, in the units of the frame."""

    def frame(self, thickness_um: ArrayLike) -> Float32Array:
        """Frame of a thickness map [µm]."""


class Response(Protocol):
    """Response of a sensor to a sky: a `SkyResponse`, or a `SensorResponse` with the beam of every pixel."""

    @property
    def component(self) -> tuple[str, ...]:
        """Names of the components of the sky."""

    @property
    def bands(self) -> tuple[str, ...]:
        """Those that are OH bands."""

    @property
    def quadrature_error(self) -> float:
        """Estimated error of the sums over lines and angles, relative to the mean sky."""

    @property
    def airmass(self) -> float:
        """Airmass of the sky."""

    def sky(self, scale: Mapping[str, float] | None = None) -> FrameTable:
        """Electrons s⁻¹ m⁻² arcsec⁻² over thickness."""


@dataclass(frozen=True, eq=False)
class SkyResponse:
    """Electrons from the components of a sky, over thickness."""

    component: tuple[str, ...]  # names of the components, C of them
    photons: FloatArray  # (C,): photons behind air and optics [s⁻¹ m⁻² arcsec⁻²]
    # electrons [s⁻¹ m⁻² arcsec⁻²] of all components together, averaged over the tabulated thicknesses
    level: float
    table: ResponseTable  # electrons from each component as a fraction of `level`, one row per component
    quadrature_error: float  # estimated error of the sums over lines and angles, relative to the mean sky
    airmass: float  # airmass of the sky

    @property
    def bands(self) -> tuple[str, ...]:
        """Those components that are OH bands."""
        return tuple(name for name in self.component if is_band(name))

    def factors(self, scale: Mapping[str, float] | None = None) -> FloatArray:
        """Factor on every component, 1 unless named."""
        return component_factors(self.component, self.photons, scale)

    def sky(self, scale: Mapping[str, float] | None = None) -> ResponseTable:
        """Electrons s⁻¹ m⁻² arcsec⁻² as a table of one row.

        ``scale``: factors on components, by name; those not named stay as they are.
        """
        factors = self.factors(scale)
        rates = factors * self.photons
        return ResponseTable(
            self.table.start_um,
            self.table.step_um,
            self.level * (factors @ self.table.values)[None, :],
            np.array([float(rates @ self.table.wavelength_nm / rates.sum())]),
            self.level * self.table.interpolation_error * float(factors.sum()),
        )


def component_factors(
    component: tuple[str, ...], photons: FloatArray, scale: Mapping[str, float] | None
) -> FloatArray:
    """Factor on every component, 1 unless named; errors as of `SkyResponse.factors`."""
    factors = np.ones(len(component))
    for name, factor in (scale or {}).items():
        if name not in component:
            raise UnknownNameError("component of the sky", name, component)
        if not 0.0 <= factor < math.inf:
            raise OutOfRangeError(f"scale of {name}", factor, "finite and not negative")
        factors[component.index(name)] = factor
    if not factors @ photons > 0.0:
        raise OutOfRangeError("photons of the sky", 0.0, "more than none")
    return factors


@named_units
def sky_response(
    model: FringeModel,
    sky: SkySpectrum,
    bandpass: Bandpass | None = None,
    thickness_range_um: tuple[float, float] | None = None,
    quadrature: SkyQuadrature | None = None,
) -> SkyResponse:
    """Tabulate the response of a sensor to a sky; band-pass and thicknesses [µm] are by default the set-up's."""
    fineness = SkyQuadrature() if quadrature is None else quadrature
    band = bandpass_of(model) if bandpass is None else bandpass
    sky = sky_with_effects(model, sky)
    table, photons, level = tabulate_components(model, sky, band, thickness_range_um, fineness)
    samples = error_samples((table.start_um, table.stop_um))
    error = spectral_error(model, sky, band, fineness, samples)
    error += _angular_error(model, sky, band, fineness, samples)
    lines, continua = split_components(sky, band, fineness.continuum_step_nm)
    names = tuple(item.name for item in [*lines, *continua])
    return SkyResponse(names, photons, level, table, error / level, sky.airmass)


def sky_with_effects(model: FringeModel, sky: SkySpectrum) -> SkySpectrum:
    """The night sky with those effects of a model that act on it."""
    return apply_to_sky(model.effects, model.base_system, sky)


def tabulate_components(
    model: FringeModel,
    sky: SkySpectrum,
    band: Bandpass,
    thickness_range_um: tuple[float, float] | None,
    fineness: SkyQuadrature,
    beam: Beam | None = None,
) -> tuple[ResponseTable, FloatArray, float]:
    """Table of `SkyResponse`, photons of its components, and its level; parameters as of `sky_response`.

    Another beam than that of the model may be given, as where only the grid of the table is wanted.
    """
    low, high = model.setup.thickness_range_um if thickness_range_um is None else thickness_range_um
    if not 0.0 <= low < high < math.inf:
        raise OutOfRangeError("thickness range [um]", (low, high), "two increasing, not negative numbers")
    lights = _lights(sky, band, fineness, model.system.beam if beam is None else beam)
    if not lights:
        raise InputError("sky", "no light behind the bandpass", "lines or a continuum inside it")
    sums = [_SpectralSum.of(model, light) for light in lights]
    flat = _flat_field(model, sky, band, lights[-1].beam, error_samples((low, high)))
    level = float(sum(each.electrons(*error_samples((low, high))).mean() for each in sums))

    def contributions(start_um: float, step_um: float, count: int) -> FloatArray:
        electrons = np.stack([each.electrons(start_um, step_um, count) for each in sums])
        return electrons / (level * flat(start_um, step_um, count))

    late = sky.flat is not None or any(item.effect.acts_on == "response" for item in model.effects)
    table = tabulate(
        contributions,
        (low, high),
        [each.light.mean_wavelength_nm for each in sums],
        # An effect on the response or a flat field may change its derivatives; then they are measured.
        fourth_derivative=None if late else max(each.derivative_bound(4, low) for each in sums) / level,
        tolerance=fineness.table_tolerance,
    )
    return table, np.array([each.light.photons for each in sums]), level


def electrons_on_grid(
    model: FringeModel, sky: SkySpectrum, band: Bandpass, start_um: float, step_um: float, count: int
) -> dict[str, FloatArray]:
    """Electrons s⁻¹ m⁻² arcsec⁻² from each component of a sky on a uniform grid of thickness, by name.

    No flat field has divided them.
    Summed as finely as for a table, but smooth from point to point as derivatives want it.
    """
    lights = _lights(sky_with_effects(model, sky), band, SkyQuadrature(), model.system.beam)
    return {
        light.component.name: _SpectralSum.of(model, light).electrons(start_um, step_um, count)
        for light in lights
    }


def _flat_field(
    model: FringeModel, sky: SkySpectrum, band: Bandpass, beam: Beam, samples: tuple[float, float, int]
) -> Callable[[float, float, int], FloatArray | float]:
    """What the flat field of a sky sees on a uniform grid of thickness, relative to its mean; 1 without one."""
    if sky.flat is None:
        return lambda *_: 1.0
    seen = _SpectralSum.of(model, _Light.of([sky.flat.component(band)], beam))
    mean = float(seen.electrons(*samples).mean())
    return lambda *grid: seen.electrons(*grid) / mean


@dataclass(frozen=True, eq=False)
class _Light:
    """One component (or several together) in a beam."""

    component: SpectralComponent
    beam: Beam
    illumination: Illumination

    @classmethod
    def of(cls, components: list[SpectralComponent], beam: Beam) -> _Light:
        photons = np.concatenate([item.photons for item in components])
        wavelength = np.concatenate([item.wavelength_nm for item in components])
        together = SpectralComponent(" + ".join(item.name for item in components), wavelength, photons)
        return cls(together, beam, Illumination.spectrum(wavelength, photons, beam))

    @property
    def photons(self) -> float:
        return float(self.component.photons.sum())

    @property
    def mean_wavelength_nm(self) -> float:
        return float(self.illumination.mean_wavelength_nm[0])


@dataclass(frozen=True, eq=False)
class _SpectralSum:
    """Closed form of the electrons from one light."""

    model: FringeModel
    light: _Light
    reduced: PhaseResponse

    @classmethod
    def of(cls, model: FringeModel, light: _Light) -> _SpectralSum:
        return cls(model, light, model.system.reduce(light.illumination))

    def electrons(self, start_um: float, step_um: float, count: int) -> FloatArray:
        """Electrons s⁻¹ m⁻² arcsec⁻² on a uniform grid of thickness, shape ``(count,)``."""
        illumination = self.light.illumination
        response = self.reduced.averaged_on_grid(illumination.weight, start_um, step_um, count)
        return self.light.photons * self.model.finish(self.reduced, illumination, response, None)[0]

    def derivative_bound(self, order: int, from_um: float) -> float:
        """Upper bound of a thickness derivative of `electrons`.

        Sizes of harmonics vary slowly with angle, unlike their phases, so that a few angles give their mean; the
        margin covers the etalons of the fixed layers, which change it by up to 4 %.
        """
        few = _Light.of([self.light.component], reduce_beam(self.light.beam, _BOUND_ANGLES)).illumination
        bound = self.model.system.reduce(few).derivative_bound(few.weight, order, from_um)
        return 1.1 * self.light.photons * float(bound.max())


def split_components(
    sky: SkySpectrum, band: Bandpass, continuum_step_nm: float
) -> tuple[list[SpectralComponent], list[SpectralComponent]]:
    """OH bands and continua behind air and optics."""
    components = sky.components(band, continuum_step_nm)
    lines = [item for item in components if is_band(item.name)]
    return lines, [item for item in components if not is_band(item.name)]


def _lights(sky: SkySpectrum, band: Bandpass, fineness: SkyQuadrature, beam: Beam) -> list[_Light]:
    lines, continua = split_components(sky, band, fineness.continuum_step_nm)
    few = reduce_beam(beam, fineness.continuum_angles)
    merged = blend_components(lines, fineness.line_shift_nm) if lines else []
    return [_Light.of([item], beam) for item in merged] + [_Light.of([item], few) for item in continua]


def error_samples(thickness_range_um: tuple[float, float]) -> tuple[float, float, int]:
    """First, step and number of the thicknesses at which sums are compared with finer ones."""
    low, high = thickness_range_um
    step = (high - low) / _ERROR_SAMPLES
    return low + 0.5 * step, step, _ERROR_SAMPLES


def spectral_error(
    model: FringeModel,
    sky: SkySpectrum,
    band: Bandpass,
    fineness: SkyQuadrature,
    samples: tuple[float, float, int],
) -> float:
    """Largest change of the electrons s⁻¹ m⁻² arcsec⁻² with finer sums over wavelength.

    What merging does to lines shows with few angles as well as with many.
    """
    lines, continua = split_components(sky, band, fineness.continuum_step_nm)
    few = reduce_beam(model.system.beam, fineness.continuum_angles)
    error = 0.0
    if lines:
        merged = blend_components(lines, fineness.line_shift_nm)
        error += _change(model, (merged, few), (lines, few), samples)
    if continua:
        _, halved = split_components(sky, band, 0.5 * fineness.continuum_step_nm)
        error += _change(model, (continua, few), (halved, few), samples)
    return error


def _angular_error(
    model: FringeModel,
    sky: SkySpectrum,
    band: Bandpass,
    fineness: SkyQuadrature,
    samples: tuple[float, float, int],
) -> float:
    """The same with fewer angles.

    Angles cannot be added to a beam; leaving out a sixth of them changes the sum by several times its error.
    """
    lines, continua = split_components(sky, band, fineness.continuum_step_nm)
    beam = model.system.beam
    few = reduce_beam(beam, fineness.continuum_angles)
    error = 0.0
    if lines:
        merged = blend_components(lines, fineness.line_shift_nm)
        error += _change(model, (merged, beam), (merged, _thinned(beam)), samples)
    if continua:
        error += _change(model, (continua, few), (continua, _thinned(few)), samples)
    return error


def _change(
    model: FringeModel,
    one: tuple[list[SpectralComponent], Beam],
    two: tuple[list[SpectralComponent], Beam],
    samples: tuple[float, float, int],
) -> float:
    """Largest difference between the electrons of two lights."""
    sums = [_SpectralSum.of(model, _Light.of(*light)).electrons(*samples) for light in (one, two)]
    return float(np.abs(sums[0] - sums[1]).max())


def _thinned(beam: Beam) -> Beam:
    return reduce_beam(beam, max(1, 5 * beam.theta.size // 6))


def is_band(name: str) -> bool:
    """Whether a component of the sky is an OH band, like ``8-4``."""
    upper, _, lower = name.partition("-")
    return upper.isdigit() and lower.isdigit()


def white_light(band: Bandpass, step_nm: float) -> SpectralComponent:
    """Light of a white flat field: as many photons at every wavelength, behind the filter."""
    low, high = band.support()
    count = math.ceil((high - low) / step_nm)
    wave = low + (np.arange(count) + 0.5) * (high - low) / count
    photons = band.transmission(wave)
    return SpectralComponent("flat field", wave[photons > 0.0], photons[photons > 0.0])


def bandpass_of(model: FringeModel) -> Bandpass:
    """Bandpass that the set-up of a model names."""
    if not model.setup.bandpass:
        raise InputError("set-up", model.setup.name, "one of the sky, or a bandpass")
    return Bandpass.from_name(model.setup.bandpass)
