"""Response of a sensor to a sky under single angles of incidence, of which any beam is a weighted sum."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError
from ..instrument.bandpass import Bandpass
from ..instrument.ray_bundle import reduce_beam
from ..instrument.sky import SkySpectrum, SpectralComponent, blend_components
from ..model import FringeModel, ResponseTable
from ..optics import Illumination
from .sky_frame import SkyQuadrature, SkyResponse
from .sky_response import (
    bandpass_of,
    error_samples,
    sky_with_effects,
    spectral_error,
    split_components,
    tabulate_components,
    white_light,
)

ANGLES = 192  # Nodes in sin²θ for lines: 3e-5 of the peak-to-peak of an LSST sky frame at any radius (128 give 2e-3)

CONTINUUM_ANGLES = 128
"""The same for continua, whose fringes average out over wavelength: 2e-4 of the peak-to-peak where fringes are
faintest (96 give 4e-3)."""

_SUM_ERROR = 1e-9
"""Error allowed in the sum over lines under one angle, relative to its fringes; interpolation has 3e-7 of the sky."""

_CELLS = 16_384  # Cells of the histogram of rays; the phase between two of them differs by less than 0.01 rad


@dataclass(frozen=True, eq=False)
class AngularResponse:
    """Electrons from the components of a sky at fixed angles of incidence, over thickness."""

    component: tuple[str, ...]  # names of the components, C of them
    photons: FloatArray  # (C,): photons behind air and optics [s⁻¹ m⁻² arcsec⁻²]
    wavelength_nm: FloatArray  # (C,): mean wavelength of every component
    limits: tuple[float, float]  # smallest and largest sin²θ
    # start_um, step_um: grid of thickness
    start_um: float
    step_um: float
    # (C, A, N): electrons s⁻¹ m⁻² arcsec⁻² at the A nodes of a Gauss-Legendre rule in sin²θ and N
    # thicknesses
    values: FloatArray
    flat: FloatArray  # (A, N): the same from the light of a flat field, in arbitrary units
    # interpolation_error, quadrature_error: estimated errors of the interpolation in thickness and of the
    # sums over wavelength and angle, relative to the mean sky
    interpolation_error: float
    quadrature_error: float
    airmass: float  # airmass of the sky
    n_lines: int  # how many of the components are bands of lines; they come first
    silicon_um: float  # thickness of the detection layer

    def weights(self, sin_squared: ArrayLike) -> FloatArray:
        """Weights of the nodes that stand for a beam.

        ``sin_squared`` (R,): sin²θ of rays that carry the same light. Returns weights (A,) that sum to 1; some may be
        negative.
        """
        return _moment_weights(self.values.shape[1]) @ _ray_histogram(sin_squared, self.limits)

    def response(self, sin_squared: ArrayLike) -> SkyResponse:
        """Response of a sensor under one beam; parameter as for `weights`."""
        rows = self.weights(sin_squared) @ self.values
        level = float(rows.sum(axis=0).mean())
        table = ResponseTable(
            self.start_um, self.step_um, rows / level, self.wavelength_nm, self.interpolation_error
        )
        return SkyResponse(self.component, self.photons, level, table, self.quadrature_error, self.airmass)


def angular_response(
    model: FringeModel,
    sky: SkySpectrum,
    limits: tuple[float, float],
    thickness_range_um: tuple[float, float] | None = None,
    angles: int = ANGLES,
) -> AngularResponse:
    """Tabulate the response of a sensor to a sky under single angles.

    ``model``: the sensor, with effects; its own beam only decides how fine the table is in thickness.
    ``limits``: range of sin²θ that the beams may have.
    """
    if not 0.0 <= limits[0] < limits[1] < 1.0:
        raise OutOfRangeError("limits of sin² of the angle", limits, "two increasing numbers within 0 to 1")
    if model.system.beam is not model.base_system.beam:
        raise InputError("effects", sorted(model.effect_settings), "none that changes the beam")
    fineness, band = SkyQuadrature(), bandpass_of(model)
    sky = sky_with_effects(model, sky)
    few_rays = reduce_beam(model.system.beam, fineness.continuum_angles)
    table, photons, level = tabulate_components(model, sky, band, thickness_range_um, fineness, few_rays)
    grid = (table.start_um, table.step_um, table.values.shape[1])
    merged, continua = _components(sky, band, fineness)
    few = math.ceil(angles * CONTINUUM_ANGLES / ANGLES)
    samples = error_samples((table.start_um, table.stop_um))
    of_lines = [_single_angles(model, item, limits, angles, grid, samples) for item in merged]
    of_continua = [_single_angles(model, item, limits, few, grid, samples) for item in continua]
    refine = _legendre_interpolation(few, angles)
    error = spectral_error(model, sky, band, fineness, samples)
    for components, made in ((merged, of_lines), (continua, of_continua)):
        error += _angular_error(model, components, [sampled for _, sampled in made], limits, samples)
    light = white_light(band, fineness.continuum_step_nm) if sky.flat is None else sky.flat.component(band)
    flat = _single_angles(model, light, limits, angles if sky.flat else few, grid)[0]
    return AngularResponse(
        tuple(item.name for item in [*merged, *continua]),
        photons,
        table.wavelength_nm,
        limits,
        table.start_um,
        table.step_um,
        np.stack([*(values for values, _ in of_lines), *(refine @ values for values, _ in of_continua)]),
        flat if sky.flat else refine @ flat,
        table.interpolation_error,
        error / level,
        sky.airmass,
        len(merged),
        silicon_um(model),
    )


def silicon_um(model: FringeModel) -> float:
    """Thickness of the detection layer of a model with its effects [µm]."""
    stack = model.system.stack
    return float(stack.layers[stack.position(model.system.detection)].thickness_um)


def of_other_silicon(
    known: AngularResponse, model: FringeModel, sky: SkySpectrum, other: AngularResponse | None = None
) -> AngularResponse:
    """Another response on the grids of one that is known, with its errors, for silicon of another thickness.

    Errors are found once: they do not depend on a part in a thousand of the silicon. ``other``: one of a third
    thickness. Continua and white light, which do not show the fringes of the silicon, are then those on the straight
    line through the two.
    """
    fineness, band = SkyQuadrature(), bandpass_of(model)
    angles, points = known.flat.shape
    grid = (known.start_um, known.step_um, points)
    sky = sky_with_effects(model, sky)
    merged, continua = _components(sky, band, fineness)
    few = math.ceil(angles * CONTINUUM_ANGLES / ANGLES)
    refine = _legendre_interpolation(few, angles)
    own_um = silicon_um(model)
    lines = [_single_angles(model, item, known.limits, angles, grid)[0] for item in merged]
    if other is not None:
        part = (own_um - known.silicon_um) / (other.silicon_um - known.silicon_um)
        smooth = list((1.0 - part) * known.values[len(merged) :] + part * other.values[len(merged) :])
        flat = (1.0 - part) * known.flat + part * other.flat
    else:
        smooth = [refine @ _single_angles(model, item, known.limits, few, grid)[0] for item in continua]
        flat = known.flat
    if sky.flat is not None:
        flat = _single_angles(model, sky.flat.component(band), known.limits, angles, grid)[0]
    elif other is None:
        light = white_light(band, fineness.continuum_step_nm)
        flat = refine @ _single_angles(model, light, known.limits, few, grid)[0]
    return replace(known, values=np.stack([*lines, *smooth]), flat=flat, silicon_um=own_um)


def _components(
    sky: SkySpectrum, band: Bandpass, fineness: SkyQuadrature
) -> tuple[list[SpectralComponent], list[SpectralComponent]]:
    """Merged lines of each band, and continua."""
    lines, continua = split_components(sky, band, fineness.continuum_step_nm)
    return blend_components(lines, fineness.line_shift_nm) if lines else [], continua


def _single_angles(
    model: FringeModel,
    component: SpectralComponent,
    limits: tuple[float, float],
    angles: int,
    *grids: tuple[float, float, int],
) -> list[FloatArray]:
    """Electrons from one component under every angle on each grid of thickness, ``(angles, thicknesses)``."""
    nodes, _ = np.polynomial.legendre.leggauss(angles)
    sine = 0.5 * (limits[0] + limits[1]) + 0.5 * (limits[1] - limits[0]) * nodes
    shape = (angles, component.photons.size)
    light = Illumination(
        np.broadcast_to(component.wavelength_nm, shape),
        np.broadcast_to(np.arcsin(np.sqrt(sine))[:, None], shape),
        np.broadcast_to(component.photons / component.photons.sum(), shape),
    )
    reduced = model.system.reduce(light)
    photons = float(component.photons.sum())
    return [
        photons
        * model.finish(
            reduced, light, reduced.averaged_on_grid(light.weight, *grid, tolerance=_SUM_ERROR), None
        )
        for grid in grids
    ]


def _legendre_interpolation(few: int, many: int) -> FloatArray:
    """Matrix from values at the nodes of one Gauss-Legendre rule to those of another, shape ``(many, few)``."""
    nodes, rule = np.polynomial.legendre.leggauss(few)
    targets, _ = np.polynomial.legendre.leggauss(many)
    vander = np.polynomial.legendre.legvander
    inner = vander(nodes, few - 1) * (np.arange(few) + 0.5) * rule[:, None]
    return np.asarray(vander(targets, few - 1) @ inner.T)


def _angular_error(
    model: FringeModel,
    components: list[SpectralComponent],
    electrons: list[FloatArray],
    limits: tuple[float, float],
    samples: tuple[float, float, int],
) -> float:
    """Largest change of the electrons under the beam of the model when a sixth of the angles is left out.

    ``electrons`` are those of the components at the samples under all angles. As for `sky_response`, the change is
    several times the error of all angles.
    """
    if not components:
        return 0.0
    beam = model.system.beam
    light = _ray_histogram(np.sin(beam.theta) ** 2, limits, beam.weight)
    fewer = 5 * len(electrons[0]) // 6
    sparse = [_single_angles(model, item, limits, fewer, samples)[0] for item in components]
    sums = [
        (_moment_weights(len(values[0])) @ light) @ np.asarray(sum(values)) for values in (electrons, sparse)
    ]
    return float(np.abs(sums[0] - sums[1]).max())


@functools.lru_cache(maxsize=4)
def _moment_weights(count: int) -> FloatArray:
    """Weights of ``count`` nodes for unit light at each of the cells of the ray histogram."""
    nodes, rule = np.polynomial.legendre.leggauss(count)
    vander = np.polynomial.legendre.legvander
    expansion = vander(nodes, count - 1) * (np.arange(count) + 0.5) * rule[:, None]
    return np.asarray(expansion @ vander(np.linspace(-1.0, 1.0, _CELLS + 1), count - 1).T)


def _ray_histogram(
    sin_squared: ArrayLike, limits: tuple[float, float], weight: FloatArray | float = 1.0
) -> FloatArray:
    """Light at evenly spaced sin²θ; every ray is shared between its neighbours, which keeps the mean."""
    rays = np.asarray(sin_squared, dtype=float)
    place = np.clip((rays - limits[0]) * (_CELLS / (limits[1] - limits[0])), 0.0, _CELLS - 1e-9)
    cell = place.astype(np.int64)
    upper = place - cell
    mass = np.bincount(cell, weight * (1.0 - upper), _CELLS + 1)
    mass += np.bincount(cell + 1, weight * upper, _CELLS + 1)
    return np.asarray(mass / mass.sum())
