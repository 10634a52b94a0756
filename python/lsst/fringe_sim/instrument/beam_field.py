"""Beams at any distance from the axis of an axisymmetric telescope."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import batoid
import numpy as np
from numpy.typing import NDArray

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError, ResourceError, named_units
from ..optics import Beam
from .ray_bundle import BEAM_NODES, QUANTILES, beam_of_quantiles, lagrange_weights, quantiles
from .telescope import Telescope, TracedOptics, batoid_optic

TRACED_RADII = 8
"""Field radii through which the rays of a `BeamField` are interpolated: errors of 2e-11 in sin²θ.

Six would leave 5e-9, and cut off one wrong ray of 240 000 at one radius in sixty.
"""

_FEWEST_RADII = 5

_BEYOND_NODES = 0.2
"""Share of the range of a ray at five or more field radii by which its squared radius may leave that range elsewhere;
a parabola leaves it by at most 0.11."""


_ROUNDING_M2 = 1e-9  # Rounding of squared radii [m²]


@named_units
@dataclass(frozen=True, eq=False)
class BeamField:
    """Beams at any distance from the axis of an axisymmetric telescope, from a few traced field radii.

    What is interpolated is each ray: ``sin²θ`` on the sensor and the squared radius at which the ray meets every
    clear aperture are smooth functions of the field radius, although the beam, with its moving edges and vignetting,
    is not. A polynomial through eight radii gives them to 1e-10, so that the beams are those of a full trace.
    """

    nodes_deg: FloatArray  # (K,): traced field radii [deg], Chebyshev points of the field
    largest_deg: float  # Largest field radius [deg]
    sin_squared: FloatArray  # (K, N): ``sin²θ`` of every ray
    # (E,): rays that an aperture cuts off at some field radii, one aperture after the other
    edge_ray: NDArray[np.int32]
    edge_squared: FloatArray  # (K, E): squared radius at which each of them meets that aperture [m²]
    inner_squared: FloatArray  # (E,): squared limits of that aperture [m²]
    outer_squared: FloatArray

    @classmethod
    def trace(cls, telescope: Telescope, nodes: int = TRACED_RADII) -> BeamField:
        """Trace an axisymmetric telescope at a few radii of its field, five or more."""
        if nodes < _FEWEST_RADII:
            raise OutOfRangeError("number of traced radii", nodes, f"{_FEWEST_RADII} or more")
        optics = telescope.optics
        if not isinstance(optics, TracedOptics) or not optics.axisymmetric:
            raise InputError(
                "telescope", telescope.name, "a traced, axisymmetric one; take its beams directly"
            )
        half = 0.5 * telescope.field_radius_deg
        radii = half * (1.0 - np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes))
        surfaces = list(_surfaces(batoid_optic(optics.prescription)))
        sines, crossings = [], []
        for radius in radii:
            rays = optics.launch(float(radius), 0.0, optics.spokes // 2, np.pi)
            crossing = []
            for surface in surfaces:
                surface.trace(rays)
                crossing.append(rays.x**2 + rays.y**2)
            if rays.failed.any():
                raise InputError("telescope", telescope.name, "one in which every ray meets every surface")
            sines.append(1.0 - rays.vz**2 / (rays.vx**2 + rays.vy**2 + rays.vz**2))
            crossings.append(crossing)
        edges = [
            _edge_rays(np.stack([crossing[number] for crossing in crossings]), *_clear_radii(surface))
            for number, surface in enumerate(surfaces)
        ]
        ray, squared, inner, outer = (np.concatenate(part, axis=-1) for part in zip(*edges, strict=True))
        return cls(radii, telescope.field_radius_deg, np.stack(sines), ray, squared, inner, outer)

    @named_units
    def sin_squared_at(self, field_x_deg: float, field_y_deg: float = 0.0) -> tuple[FloatArray, float]:
        """``sin²θ`` of the rays that arrive at a field position, and the unvignetted share of the pupil."""
        radius = math.hypot(field_x_deg, field_y_deg)
        if not radius <= self.largest_deg:
            raise OutOfRangeError("field angle [deg]", radius, f"0 to {self.largest_deg:g}")
        weight = lagrange_weights(self.nodes_deg, radius)
        crossing = weight @ self.edge_squared
        kept = np.ones(self.sin_squared.shape[1], dtype=bool)
        kept[self.edge_ray[(crossing > self.outer_squared) | (crossing < self.inner_squared)]] = False
        if not kept.any():
            raise OutOfRangeError("field angle [deg]", radius, "a place that light reaches")
        sine = (weight @ self.sin_squared)[kept]
        return sine, sine.size / kept.size

    @named_units
    def beam(self, field_x_deg: float, field_y_deg: float = 0.0, nodes: int = BEAM_NODES) -> Beam:
        """Angles of incidence at one field position; errors as for `sin_squared_at`."""
        sine, _ = self.sin_squared_at(field_x_deg, field_y_deg)
        return beam_of_quantiles(quantiles(sine, QUANTILES), nodes)


def _edge_rays(
    squared: FloatArray, inner: float, outer: float
) -> tuple[NDArray[np.int32], FloatArray, FloatArray, FloatArray]:
    """Rays that the edges of an aperture may cut off, their squared radii there, and its squared limits.

    ``squared`` holds the traced radii ``[field radius, ray]``. A smooth function leaves the range of its values at
    Chebyshev points by a few per cent of that range.
    """
    low, high = squared.min(axis=0), squared.max(axis=0)
    room = _BEYOND_NODES * (high - low) + _ROUNDING_M2
    # The pupil itself is where the rays are launched.
    moves = float((high - low).max()) >= _ROUNDING_M2
    near = moves & ((high + room > outer**2) | ((low - room < inner**2) & (inner > 0.0)))
    ray = np.flatnonzero(near)
    # What is interpolated may be a little less than nothing.
    limits = np.full((2, ray.size), [[inner**2 - _ROUNDING_M2 if inner > 0.0 else -np.inf], [outer**2]])
    return ray.astype(np.int32), squared[:, ray], *limits


def _surfaces(optic: batoid.Optic) -> Iterator[batoid.Optic]:
    """Surfaces in the order in which the light meets them."""
    for item in optic.items:
        if hasattr(item, "items"):
            yield from _surfaces(item)
        else:
            yield item


def _clear_radii(surface: batoid.Optic) -> tuple[float, float]:
    """Inner and outer radius of the part of a surface that light may pass [m]."""
    stop = surface.obscuration
    if stop is None:
        return 0.0, math.inf
    clear = stop.original if isinstance(stop, batoid.ObscNegation) else None
    if isinstance(clear, batoid.ObscCircle) and clear.x == clear.y == 0.0:
        return 0.0, clear.radius
    if isinstance(clear, batoid.ObscAnnulus) and clear.x == clear.y == 0.0:
        return clear.inner, clear.outer
    raise ResourceError(f"the aperture of {surface.name} is not a centred circle or annulus: {stop}")
