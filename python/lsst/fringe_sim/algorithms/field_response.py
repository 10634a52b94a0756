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

from ..array_types import Float32Array, FloatArray
from ..compiled import contiguous, kernel, run_shares
from ..errors import InputError, OutOfRangeError
from ..instrument.beam_field import BeamField
from ..instrument.sky import SkySpectrum
from ..instrument.telescope import Telescope, TracedOptics
from ..model import FringeModel, ResponseTable
from .angular_response import ANGLES, AngularResponse, angular_response, of_other_silicon
from .island_response import parts_of, response_with_islands
from .sensor_placement import SensorPlacement
from .sky_frame import is_band, sky_response
from .sky_response import Response, component_factors

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
    flat_level: float = 1.0  # of the flat field of the whole sensor, over that of this silicon

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

    def of_other_silicon(
        self, model: FringeModel, sky: SkySpectrum, other: SensorResponse | None = None
    ) -> SensorResponse:
        """The same for silicon of another thickness. Frames are divided by one flat field of the whole sensor.

        ``other``: as of `angular_response.of_other_silicon`.
        """
        known = self.field.angular
        angular = of_other_silicon(known, model, sky, None if other is None else other.field.angular)
        flats = [float((self.field.weights @ each.flat).mean()) for each in (known, angular)]
        field = replace(self.field, angular=angular)
        return replace(self, field=field, flat_level=self.flat_level * flats[0] / flats[1])

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
        return np.asarray((self.field.weights @ values) * (self.flat_level * flat.mean() / flat))

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

    def frame(self, thickness_um: ArrayLike) -> Float32Array:
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


def field_response(
    angular: AngularResponse, beams: BeamField, radius_range_deg: tuple[float, float]
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
    first = max(0.0, low - RADIUS_STEP_DEG)
    cells = max(_STENCIL - 1, math.ceil((min(high + RADIUS_STEP_DEG, edge) - first) / RADIUS_STEP_DEG - 1e-9))
    first = max(0.0, min(first, edge - cells * RADIUS_STEP_DEG))
    weights, kept = [], []
    _, on_axis = beams.sin_squared_at(0.0)
    for number in range(cells + 1):
        rays, share = beams.sin_squared_at(min(first + number * RADIUS_STEP_DEG, edge))
        weights.append(angular.weights(rays))
        kept.append(share / on_axis)
    return FieldResponse(angular, first, RADIUS_STEP_DEG, np.stack(weights), np.array(kept))


def sensor_response(
    model: FringeModel,
    sky: SkySpectrum,
    placement: SensorPlacement,
    thickness_range_um: tuple[float, float] | None = None,
    like: tuple[Response, ...] = (),
) -> Response:
    """Response of one sensor with the beam of every pixel and with its local effects.

    Commands and Tasks make their frames with it, so that one map has one sky.

    It has the one beam of the model behind a cone, and behind a telescope whose beams do not depend on
    the distance from the axis alone. ``like``: that of the same sensor with silicon of another thickness, whose
    grids and errors it takes over; and, if there is a second, that of the other end of a range of the silicon.
    """
    known = zip(*(parts_of(each) for each in like), strict=True)

    def respond(own: FringeModel) -> Response:
        earlier = [each for each in next(known, ()) if isinstance(each, SensorResponse)]
        if earlier:
            return earlier[0].of_other_silicon(own, sky, *earlier[1:])
        beams = beam_field(own.setup.telescope)
        if beams is None:
            return sky_response(own, sky, None, thickness_range_um)
        radii = placement.radius_range_deg
        limits = beam_limits(beams, radii)
        share = (limits[1] - limits[0]) / float(np.subtract(*beam_limits(beams)[::-1]))
        angles = math.ceil(ANGLES * share) + _MORE_ANGLES
        angular = angular_response(own, sky, limits, thickness_range_um, angles)
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


_LEAST_ROWS = 16  # Rows of a frame that are worth a thread


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
