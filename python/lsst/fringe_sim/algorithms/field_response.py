"""Response of sensors anywhere in the field of a telescope, with the beam of every pixel.

The beam changes across a sensor: one beam for all of its pixels is wrong by 15 to 100 % of the peak-to-peak of an
LSST sky frame. But a beam is only a distribution of ``s = sin²θ``, and the response under a single angle is a smooth
function of s. It is tabulated once at the nodes of a Gauss-Legendre rule; any beam is then a set of weights for
these nodes, exact as long as the rule resolves the response, and the frames of a whole focal plane share one table
(Eq. 5 of the paper, with the sums over lines and angles exchanged).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..compiled import contiguous, kernel, run_shares
from ..errors import InputError, OutOfRangeError
from ..instrument.bandpass import Bandpass
from ..instrument.detector import Detector
from ..instrument.sky import SkySpectrum, SpectralComponent, blend_components
from ..instrument.telescope import BeamField, Telescope, TracedOptics, reduce_beam
from ..model import FringeModel, ResponseTable
from ..optics import Illumination
from ..products import SensorSection
from .island_response import response_with_islands
from .sky_frame import (
    Response,
    SkyQuadrature,
    SkyResponse,
    bandpass_of,
    component_factors,
    error_samples,
    is_band,
    sky_response,
    sky_with_effects,
    spectral_error,
    split_components,
    tabulate_components,
    white_light,
)

__all__ = [
    "AngularResponse",
    "FieldResponse",
    "FieldTable",
    "SensorPlacement",
    "SensorResponse",
    "angular_response",
    "beam_field",
    "beam_limits",
    "field_response",
    "sensor_response",
]

FloatArray = NDArray[np.float64]

ANGLES = 192
"""Nodes in sin²θ for lines: 3e-5 of the peak-to-peak of an LSST sky frame at any radius (128 give 2e-3)."""

CONTINUUM_ANGLES = 128
"""The same for continua, whose fringes average out over wavelength: 2e-4 of the peak-to-peak where fringes are
faintest (96 give 4e-3)."""

RADIUS_STEP_DEG = 0.005
"""Spacing of the tabulated field radii. Where the pupil is vignetted, beyond 1.75 deg, the phase of the light from
its edge turns once in 0.085 deg."""

_MORE_ANGLES = 12
"""Nodes beyond their share for a part of the angles: a Gauss rule converges once it has a few more than the phase
asks for, whatever the range."""

_LIMIT_RADII = 9
"""Field radii at which the angles of a sensor are looked up; between them the extreme angle bends by 1e-5 of the
range, which the margin of `beam_limits` covers a hundred times."""

_STENCIL = 4

_CELLS = 16_384
"""Cells of the histogram of rays; the phase between two of them differs by less than 0.01 rad."""


@dataclass(frozen=True)
class SensorPlacement:
    """Where the pixels of a sensor lie in the field."""

    # field_x_deg, field_y_deg: field angle of the centre
    field_x_deg: float
    field_y_deg: float
    # width_deg, height_deg: extent along columns and along rows; negative where the pixels are counted
    # the other way round
    width_deg: float
    height_deg: float
    yaw_deg: float = 0.0  # rotation of the sensor in the focal plane

    @classmethod
    def of(
        cls, detector: Detector, pixel_scale_arcsec: float, section: SensorSection | None = None
    ) -> SensorPlacement:
        """Placement of a sensor of a camera, or of a part of it; on the axis where the camera states no angles."""
        seen = SensorSection.whole(detector) if section is None else section
        scale = pixel_scale_arcsec / 3600.0
        on_axis = math.isnan(detector.field_radius_deg)
        rows, columns = detector.shape
        x, y = (
            scale * 0.5 * (first + last + 1 - size)
            for (first, last), size in ((seen.x, columns), (seen.y, rows))
        )
        width, height = (
            scale * math.copysign(abs(last - first) + 1, last - first) for first, last in (seen.x, seen.y)
        )
        turn = math.radians(detector.yaw_deg)
        return cls(
            (0.0 if on_axis else detector.field_x_deg) + math.cos(turn) * x - math.sin(turn) * y,
            (0.0 if on_axis else detector.field_y_deg) + math.sin(turn) * x + math.cos(turn) * y,
            width,
            height,
            detector.yaw_deg,
        )

    def plane(self, shape: tuple[int, int]) -> FloatArray:
        """Field angles as a linear function of pixel indices, for a map of any shape that covers the sensor.

        Returns (2, 3): rows for x and y; ``angle = plane @ (1, column, row)`` [deg].
        """
        turn = math.radians(self.yaw_deg)
        along = np.array([math.cos(turn), math.sin(turn)]) * self.width_deg / shape[1]
        across = np.array([-math.sin(turn), math.cos(turn)]) * self.height_deg / shape[0]
        centre = np.array([self.field_x_deg, self.field_y_deg])
        corner = centre - 0.5 * (shape[1] - 1) * along - 0.5 * (shape[0] - 1) * across
        return np.stack([corner, along, across], axis=1)

    def radius_deg(self, shape: tuple[int, int]) -> FloatArray:
        """Field radius of every pixel of a map that covers the sensor [deg], ``shape``."""
        return self.radius_at_deg(shape, np.arange(shape[0]), np.arange(shape[1]))

    def radius_at_deg(self, shape: tuple[int, int], rows: ArrayLike, columns: ArrayLike) -> FloatArray:
        """Field radius on a grid of rows and columns of such a map [deg], shape ``(rows, columns)``."""
        y, x = np.asarray(rows, dtype=float)[:, None], np.asarray(columns, dtype=float)[None, :]
        return np.asarray(np.hypot(*(line[0] + line[1] * x + line[2] * y for line in self.plane(shape))))

    @property
    def radius_range_deg(self) -> tuple[float, float]:
        """Smallest and largest field radius on the sensor [deg]."""
        turn = math.radians(-self.yaw_deg)
        x = math.cos(turn) * self.field_x_deg - math.sin(turn) * self.field_y_deg
        y = math.sin(turn) * self.field_x_deg + math.cos(turn) * self.field_y_deg
        half = 0.5 * abs(self.width_deg), 0.5 * abs(self.height_deg)
        near = math.hypot(max(abs(x) - half[0], 0.0), max(abs(y) - half[1], 0.0))
        return near, math.hypot(abs(x) + half[0], abs(y) + half[1])


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


@dataclass(frozen=True, eq=False)
class FieldResponse:
    """Response to a sky over field radius."""

    angular: AngularResponse  # response by angle
    # start_deg, step_deg: grid of field radii
    start_deg: float
    step_deg: float
    weights: FloatArray  # (K, A): beam at every field radius
    kept: FloatArray  # (K,): unvignetted share of the pupil relative to the axis

    @property
    def radius_deg(self) -> FloatArray:
        """Tabulated field radii [deg], shape ``(K,)``."""
        return np.asarray(self.start_deg + self.step_deg * np.arange(len(self.weights)), dtype=float)

    def relative_illumination(self, radius_deg: ArrayLike) -> FloatArray:
        """Light at a field radius relative to the axis; that of the last tabulated radius beyond it."""
        return np.asarray(np.interp(np.asarray(radius_deg, dtype=float), self.radius_deg, self.kept))

    def on(self, placement: SensorPlacement) -> SensorResponse:
        """Response of a sensor at its place."""
        low, high = placement.radius_range_deg
        radii = self.radius_deg
        if low < radii[0] - 1e-9 or low > radii[-1]:
            raise OutOfRangeError("field radius [deg]", low, f"{radii[0]:g} to {radii[-1]:g}")
        first = max(0, math.floor((low - self.start_deg) / self.step_deg) - 1)
        last = min(radii.size - 1, math.ceil((high - self.start_deg) / self.step_deg) + 1)
        first = max(0, min(first, last + 1 - _STENCIL))
        part = slice(first, last + 1)
        cut = replace(self, start_deg=float(radii[first]), weights=self.weights[part], kept=self.kept[part])
        return SensorResponse(cut, placement)


@dataclass(frozen=True, eq=False)
class SensorResponse:
    """Response of one sensor with the beam of every pixel; stands for a `SkyResponse` in `simulate_sky_frame`.

    Frames are those of flat-fielded exposures. A flat field of white light sees the same beams and the same silicon
    without fringes of lines; divided by it, frames lose the vignetting (`FieldResponse.relative_illumination`), the
    change of absorption with the angle (0.1 % over a sensor at the edge of the field), and its change with the
    thickness of silicon (0.3 % per micrometre, ten times the fringes of a sensor with black coating).
    """

    field: FieldResponse  # tabulated at the radii of the sensor
    placement: SensorPlacement  # where its pixels lie

    @property
    def component(self) -> tuple[str, ...]:
        """Names of the components of the sky."""
        return self.field.angular.component

    @property
    def bands(self) -> tuple[str, ...]:
        """Those components that are OH bands."""
        return tuple(name for name in self.component if is_band(name))

    @property
    def airmass(self) -> float:
        """Airmass of the sky."""
        return self.field.angular.airmass

    @property
    def quadrature_error(self) -> float:
        """Estimated error of the sums over wavelength and angle, relative to the mean sky."""
        return self.field.angular.quadrature_error

    def factors(self, scale: Mapping[str, float] | None = None) -> FloatArray:
        """Factor on every component, 1 unless named; errors as of `SkyResponse.factors`."""
        return component_factors(self.component, self.field.angular.photons, scale)

    def sky(self, scale: Mapping[str, float] | None = None) -> FieldTable:
        """Electrons s⁻¹ m⁻² arcsec⁻² over field radius and thickness."""
        factors = self.factors(scale)
        angular = self.field.angular
        rates = factors * angular.photons
        rows = self._flat_fielded(np.tensordot(factors, angular.values, axes=1))
        wavelength = float(rates @ angular.wavelength_nm / rates.sum())
        return self._table(rows, wavelength, float(rows.mean()) * angular.interpolation_error)

    def component_tables(self) -> list[FieldTable]:
        """The parts of `sky` that come from each component, all at their reference level."""
        angular = self.field.angular
        rows = [self._flat_fielded(values) for values in angular.values]
        error = float(np.sum(rows, axis=0).mean()) * angular.interpolation_error
        return [self._table(*item, error) for item in zip(rows, angular.wavelength_nm, strict=True)]

    def _flat_fielded(self, values: FloatArray) -> FloatArray:
        """Values ``[angle, thickness]`` for the beam of each field radius, over the flat field there."""
        flat = self.field.weights @ self.field.angular.flat
        return np.asarray((self.field.weights @ values) * (flat.mean() / flat))

    def _table(self, rows: FloatArray, wavelength_nm: float, error: float) -> FieldTable:
        angular = self.field.angular
        table = ResponseTable(
            angular.start_um, angular.step_um, rows, np.full(len(rows), wavelength_nm), error
        )
        return FieldTable(table, self.field.start_deg, self.field.step_deg, self.placement)


@dataclass(frozen=True, eq=False)
class FieldTable:
    """Electrons over field radius and thickness."""

    table: ResponseTable  # one row per field radius
    # start_deg, step_deg: field radii of the rows
    start_deg: float
    step_deg: float
    placement: SensorPlacement  # where the pixels of the frames lie

    @property
    def wavelength_nm(self) -> FloatArray:
        """Mean wavelength [nm], shape ``(1,)``."""
        return self.table.wavelength_nm[:1]

    @property
    def interpolation_error(self) -> float:
        """Largest error of the interpolation in thickness."""
        return self.table.interpolation_error

    def frame(self, thickness_um: ArrayLike) -> NDArray[np.float32]:
        """Image of the sensor.

        ``thickness_um`` (ny, nx): thickness on pixels of any size that cover the sensor; NaN gives NaN.
        Returns (ny, nx), the same bits whatever the number of threads.
        """
        thickness = np.asarray(thickness_um)
        if thickness.dtype not in (np.float32, np.float64):
            thickness = thickness.astype(np.float64)
        if thickness.ndim != 2:
            raise InputError("shape of the thickness map", thickness.shape, "two axes (y, x)")
        low, high = np.nanmin(thickness), np.nanmax(thickness)
        margin = 1e-6
        if not (low >= self.table.start_um - margin and high <= self.table.stop_um + margin):
            allowed = f"{self.table.start_um:.6g} to {self.table.stop_um:.6g} (range of the table)"
            raise OutOfRangeError("thickness [um]", (float(low), float(high)), allowed)
        coefficients = self.table.polynomials.astype(np.float32)
        arguments = (
            contiguous(coefficients.reshape(len(coefficients), -1)),
            self.table.start_um,
            1.0 / self.table.step_um,
            self.start_deg,
            1.0 / self.step_deg,
            contiguous(self.placement.plane((thickness.shape[0], thickness.shape[1])), float),
            contiguous(thickness),
        )
        out = np.empty(thickness.shape, dtype=np.float32)
        run_shares(lambda first, last: _frame_kernel(*arguments, first, last, out), len(out), _LEAST_ROWS)
        return out


def angular_response(
    model: FringeModel,
    sky: SkySpectrum,
    limits: tuple[float, float],
    bandpass: Bandpass | None = None,
    thickness_range_um: tuple[float, float] | None = None,
    quadrature: SkyQuadrature | None = None,
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
    fineness = SkyQuadrature() if quadrature is None else quadrature
    band = bandpass_of(model) if bandpass is None else bandpass
    sky = sky_with_effects(model, sky)
    few_rays = reduce_beam(model.system.beam, fineness.continuum_angles)
    table, photons, level = tabulate_components(model, sky, band, thickness_range_um, fineness, few_rays)
    grid = (table.start_um, table.step_um, table.values.shape[1])
    lines, continua = split_components(sky, band, fineness.continuum_step_nm)
    merged = blend_components(lines, fineness.line_shift_nm) if lines else []
    few = math.ceil(angles * CONTINUUM_ANGLES / ANGLES)
    samples = error_samples((table.start_um, table.stop_um))
    of_lines = [_single_angles(model, item, limits, angles, grid, samples) for item in merged]
    of_continua = [_single_angles(model, item, limits, few, grid, samples) for item in continua]
    refine = _legendre_interpolation(few, angles)
    error = spectral_error(model, sky, band, fineness, samples)
    for components, made in ((merged, of_lines), (continua, of_continua)):
        error += _angular_error(model, components, [sampled for _, sampled in made], limits, samples)
    return AngularResponse(
        tuple(item.name for item in [*merged, *continua]),
        photons,
        table.wavelength_nm,
        limits,
        table.start_um,
        table.step_um,
        np.stack([*(values for values, _ in of_lines), *(refine @ values for values, _ in of_continua)]),
        refine @ _single_angles(model, white_light(band, fineness.continuum_step_nm), limits, few, grid)[0],
        table.interpolation_error,
        error / level,
        sky.airmass,
    )


def field_response(
    angular: AngularResponse,
    beams: BeamField,
    radius_range_deg: tuple[float, float],
    step_deg: float = RADIUS_STEP_DEG,
) -> FieldResponse:
    """Give an angular response the beams of a range of field radii.

    ``radius_range_deg``: field radii to cover; what lies beyond the field of the telescope gets the beam of its
    edge.
    """
    low, high = radius_range_deg
    edge = beams.largest_deg
    if not 0.0 <= low <= high or low > edge:
        raise OutOfRangeError("field radii [deg]", radius_range_deg, f"ascending, from 0 to {edge:g}")
    high = min(high, edge)
    first = max(0.0, low - step_deg)
    cells = max(_STENCIL - 1, math.ceil((min(high + step_deg, edge) - first) / step_deg - 1e-9))
    first = max(0.0, min(first, edge - cells * step_deg))
    weights, kept = [], []
    on_axis = beams.kept_fraction(0.0)
    for number in range(cells + 1):
        rays, share = beams.sin_squared_at(min(first + number * step_deg, edge))
        weights.append(angular.weights(rays))
        kept.append(share / on_axis)
    return FieldResponse(angular, first, step_deg, np.stack(weights), np.array(kept))


def sensor_response(
    model: FringeModel,
    sky: SkySpectrum,
    placement: SensorPlacement,
    thickness_range_um: tuple[float, float] | None = None,
    quadrature: SkyQuadrature | None = None,
) -> Response:
    """Response of one sensor with the beam of every pixel and with its local effects.

    Commands and Tasks make their frames with it, so that one map has one sky.

    It has the one beam of the model behind a cone, and behind a telescope whose beams do not depend on
    the distance from the axis alone.
    """

    def respond(own: FringeModel) -> Response:
        beams = beam_field(own.setup.telescope)
        if beams is None:
            return sky_response(own, sky, None, thickness_range_um, quadrature)
        radii = placement.radius_range_deg
        limits = beam_limits(beams, radii)
        share = (limits[1] - limits[0]) / float(np.subtract(*beam_limits(beams)[::-1]))
        angles = math.ceil(ANGLES * share) + _MORE_ANGLES
        angular = angular_response(own, sky, limits, None, thickness_range_um, quadrature, angles)
        return field_response(angular, beams, radii).on(placement)

    return response_with_islands(model, respond)


@functools.lru_cache(maxsize=2)
def beam_field(telescope: str) -> BeamField | None:
    """Beams at any field radius of a telescope; `None` for a cone, or if they do not depend on the radius alone."""
    if not telescope:
        return None
    found = Telescope.from_name(telescope)
    if not isinstance(found.optics, TracedOptics) or not found.optics.axisymmetric:
        return None
    return BeamField.trace(found)


def beam_limits(beams: BeamField, radius_range_deg: tuple[float, float] | None = None) -> tuple[float, float]:
    """Range of sin²θ of all beams, or of those at some field radii, with room for rays between the traced radii."""
    if radius_range_deg is None:
        low, high = float(beams.sin_squared.min()), float(beams.sin_squared.max())
    else:
        first, last = radius_range_deg
        radii = np.linspace(max(0.0, first - RADIUS_STEP_DEG), last + RADIUS_STEP_DEG, _LIMIT_RADII)
        rays = [beams.sin_squared_at(min(radius, beams.largest_deg))[0] for radius in radii.tolist()]
        low, high = (float(of([of(sine) for sine in rays])) for of in (np.min, np.max))
    margin = 1e-3 * (high - low)
    return max(0.0, low - margin), high + margin


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
        photons * model.finish(reduced, light, reduced.averaged_on_grid(light.weight, *grid), None)
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


_LEAST_ROWS = 16
"""Rows of a frame that are worth a thread."""


@kernel(relaxed=True)
def _frame_kernel(
    polynomials: NDArray,
    start_um: float,
    per_step: float,
    start_deg: float,
    per_deg: float,
    plane: NDArray,
    thickness: NDArray,
    first_row: int,
    last_row: int,
    out: NDArray,
) -> None:  # pragma: no cover - compiled
    """Cubic in thickness within a cell, and through four neighbouring field radii."""
    width = thickness.shape[1]
    rows = polynomials.shape[0]
    last = polynomials.shape[1] // 4 - 1
    for y in range(first_row, last_row):
        for x in range(width):
            d = (float(thickness[y, x]) - start_um) * per_step
            if d != d:  # NaN
                out[y, x] = np.nan
                continue
            cell = min(max(int(d), 0), last)
            t = np.float32(d - cell)
            u = plane[0, 0] + plane[0, 1] * x + plane[0, 2] * y
            v = plane[1, 0] + plane[1, 1] * x + plane[1, 2] * y
            r = min(max((math.sqrt(u * u + v * v) - start_deg) * per_deg, 0.0), rows - 1.0)
            first = min(max(int(r) - 1, 0), rows - 4)
            s = np.float32(r - first)
            one, two, three = s - np.float32(1.0), s - np.float32(2.0), s - np.float32(3.0)
            half, sixth = np.float32(0.5), np.float32(1.0 / 6.0)
            total = np.float32(0.0)
            for k in range(4):
                if k == 0:
                    weight = -sixth * one * two * three
                elif k == 1:
                    weight = half * s * two * three
                elif k == 2:
                    weight = -half * s * one * three
                else:
                    weight = sixth * s * one * two
                c = polynomials[first + k, 4 * cell : 4 * cell + 4]
                total += weight * (c[0] + t * (c[1] + t * (c[2] + t * c[3])))
            out[y, x] = total
