"""Telescopes: which directions of light arrive at a place of the focal plane.

A telescope is a YAML file in ``data/telescopes``. Its beams come from a ray trace with batoid, or from a cone of
given focal ratio. What the thin-film model needs of some 10⁵ rays is the distribution of ``sin²θ``; a Gauss rule
with respect to that distribution represents it by a few dozen angles (paper, section 4.2 and Eq. 5).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import batoid
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, OutOfRangeError, ResourceError, UnknownNameError
from ..optics import Beam
from ..resources import list_resources, read_yaml

__all__ = [
    "BeamField",
    "ConeOptics",
    "RayBundle",
    "Telescope",
    "TracedOptics",
    "gauss_rule",
    "reduce_beam",
    "telescope_beam",
]

FloatArray = NDArray[np.float64]

BEAM_NODES = 96
"""Angles in a beam.

At the edge of the LSST field, 64 would do for the round trip through 265 µm of silicon (detection layer and support)
and its second harmonic; the third makes an error of 4 % of the peak-to-peak of a sky frame, with 96 of 0.2 %.
"""

SAME_PLACE = 1e-10
"""Distance of points, relative to half the range of all, at which a Gauss rule takes them for one."""

QUANTILES = 4096
"""Groups of equal light into which the rays are gathered before the Gauss rule is formed."""

TRACED_RADII = 8
"""Field radii through which the rays of a `BeamField` are interpolated: errors of 2e-11 in sin²θ.

Six would leave 5e-9, and cut off one wrong ray of 240 000 at one radius in sixty.
"""

_FEWEST_RADII = 5
_BEYOND_NODES = 0.2
"""Share of the range of a ray at five or more field radii by which its squared radius may leave that range elsewhere;
a parabola leaves it by at most 0.11."""

_ROUNDING_M2 = 1e-9
"""Rounding of squared radii [m²]."""

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


@dataclass(frozen=True, eq=False)
class RayBundle:
    """Rays that reach one place of the focal plane; every ray carries the same light.

    Attributes
    ----------
    slope_x, slope_y : `numpy.ndarray`, shape ``(N,)``
        Slopes dx/dz and dy/dz against the normal of the sensor, z pointing into it.
    kept_fraction : `float`
        Share of the rays launched over the entrance pupil that was not vignetted.
    """

    slope_x: FloatArray
    slope_y: FloatArray
    kept_fraction: float

    @property
    def sin_squared(self) -> FloatArray:
        """Squared sine of the angle of incidence, shape ``(N,)``."""
        tangent = self.slope_x**2 + self.slope_y**2
        return tangent / (1.0 + tangent)

    @property
    def theta(self) -> FloatArray:
        """Angle of incidence ``arccos(|v_z| / |v|)`` [rad], shape ``(N,)``."""
        return np.arctan(np.hypot(self.slope_x, self.slope_y))

    def quantiles(self, groups: int = QUANTILES) -> FloatArray:
        """Mean of ``sin²θ`` in groups of equal light, ascending, shape ``(groups,)``."""
        return _quantiles(self.sin_squared, groups)

    def beam(self, nodes: int = BEAM_NODES) -> Beam:
        """Gauss rule of the bundle."""
        return _beam_of_quantiles(self.quantiles(), nodes)


@dataclass(frozen=True)
class TracedOptics:
    """Optics traced with batoid.

    Attributes
    ----------
    prescription : `str`
        Name of a prescription that ships with batoid, e.g. ``LSST_y.yaml``.
    wavelength_nm : `float`
        Wavelength of the traced rays [nm]; the angles depend on it only through the refracting elements.
    axisymmetric : `bool`
        Whether the beam depends on the distance from the axis alone (no spiders, no tilted elements).
    rings, spokes : `int`
        Rays over the entrance pupil: midpoints of equal areas.
    """

    prescription: str
    wavelength_nm: float
    axisymmetric: bool
    rings: int = 400
    spokes: int = 1200

    def trace(self, field_x_deg: float, field_y_deg: float) -> RayBundle:
        """Trace the light of one field position down to the sensor.

        Raises
        ------
        OutOfRangeError
            No ray arrives.
        """
        if not self.axisymmetric:
            return self._trace_pupil(field_x_deg, field_y_deg, self.spokes, 2.0 * np.pi)
        # Mirror and rotation of one half of the pupil give the rest; no ray is left out.
        half = self._trace_pupil(math.hypot(field_x_deg, field_y_deg), 0.0, self.spokes // 2, np.pi)
        along = np.concatenate([half.slope_x, half.slope_x])
        across = np.concatenate([half.slope_y, -half.slope_y])
        azimuth = math.atan2(field_y_deg, field_x_deg)
        cosine, sine = math.cos(azimuth), math.sin(azimuth)
        return RayBundle(cosine * along - sine * across, sine * along + cosine * across, half.kept_fraction)

    def _trace_pupil(self, field_x_deg: float, field_y_deg: float, spokes: int, reach: float) -> RayBundle:
        rays = self.launch(field_x_deg, field_y_deg, spokes, reach)
        _batoid_optic(self.prescription).trace(rays)  # leaves them in the coordinates of the sensor
        kept = ~(rays.vignetted | rays.failed)
        if not kept.any():
            raise OutOfRangeError(
                "field angle [deg]",
                (field_x_deg, field_y_deg),
                "a place that light reaches",
                source=self.prescription,
            )
        velocity = rays.v[kept]
        # Slopes along the direction of travel, with z into the sensor whatever the sense of batoid's axis.
        depth = np.abs(velocity[:, 2])
        return RayBundle(velocity[:, 0] / depth, velocity[:, 1] / depth, float(kept.mean()))

    def launch(self, field_x_deg: float, field_y_deg: float, spokes: int, reach: float) -> batoid.RayVector:
        """Rays of a field position at midpoints of equal areas of the pupil, azimuth 0 to ``reach`` [rad]."""
        optic = _batoid_optic(self.prescription)
        outer = 0.5 * optic.pupilSize
        inner = outer * optic.pupilObscuration
        ring = np.arange(self.rings)
        radius = np.sqrt(inner**2 + (outer**2 - inner**2) * (ring + 0.5) / self.rings)
        # Every ring starts at another azimuth, so that vignetting edges do not cut all rings alike.
        start = np.mod(ring * _GOLDEN, 1.0)
        azimuth = reach * (np.arange(spokes) + start[:, None]) / spokes
        return batoid.RayVector.fromStop(
            (radius[:, None] * np.cos(azimuth)).ravel(),
            (radius[:, None] * np.sin(azimuth)).ravel(),
            optic=optic,
            wavelength=1e-9 * self.wavelength_nm,
            theta_x=math.radians(field_x_deg),
            theta_y=math.radians(field_y_deg),
        )


@dataclass(frozen=True)
class ConeOptics:
    """An aplanatic cone: the pupil is uniform in the direction sines (Abbe sine condition).

    Attributes
    ----------
    f_number : `float`
        Focal ratio N; the marginal ray arrives at ``arcsin(1 / 2N)``.
    obscuration : `float`
        Linear central obscuration, 0 to below 1.
    rings, spokes : `int`
        Rays over the pupil, where rays are asked for.
    """

    f_number: float
    obscuration: float = 0.0
    rings: int = 400
    spokes: int = 1200

    axisymmetric = True

    def trace(self, field_x_deg: float, field_y_deg: float) -> RayBundle:
        """Rays of the cone; the same at every field position."""
        share = (np.arange(self.rings) + 0.5) / self.rings
        outer = (0.5 / self.f_number) ** 2
        sine = np.sqrt(outer * (self.obscuration**2 + (1.0 - self.obscuration**2) * share))
        tangent = sine / np.sqrt(1.0 - sine**2)
        azimuth = 2.0 * np.pi * (np.arange(self.spokes) + 0.5) / self.spokes
        return RayBundle(
            np.outer(tangent, np.cos(azimuth)).ravel(), np.outer(tangent, np.sin(azimuth)).ravel(), 1.0
        )


@dataclass(frozen=True)
class Telescope:
    """A telescope with its camera.

    Attributes
    ----------
    name : `str`
        Name of the file in ``data/telescopes``.
    optics : `TracedOptics` or `ConeOptics`
        What shapes the beam.
    collecting_area_m2 : `float`
        Effective collecting area on axis [m²].
    pixel_um, pixel_scale_arcsec : `float`
        Pixel pitch [µm] and the angle that it covers [arcsec].
    field_radius_deg : `float`
        Largest field angle at which beams are given [deg].
    """

    name: str
    optics: TracedOptics | ConeOptics
    collecting_area_m2: float
    pixel_um: float
    pixel_scale_arcsec: float
    field_radius_deg: float

    @classmethod
    def from_name(cls, name: str) -> Telescope:
        """Telescope of ``data/telescopes/<name>.yaml``; capitals do not matter.

        Raises
        ------
        UnknownNameError
            There is no such telescope.
        ResourceError
            The file is incomplete.
        """
        known = [entry.removesuffix(".yaml") for entry in list_resources("telescopes")]
        stem = name.casefold()
        if stem not in known:
            raise UnknownNameError("telescope", name, known)
        return cls.from_mapping(stem, read_yaml("telescopes", f"{stem}.yaml"))

    @classmethod
    def from_mapping(cls, name: str, content: Mapping[str, Any]) -> Telescope:
        """Telescope described by the mapping of a YAML file.

        Raises
        ------
        ResourceError
            A key is missing, or the kind of optics is unknown.
        """
        try:
            for key in ("source", "doi", "licence"):
                content[key]
            optics = dict(content["optics"])
            kind = optics.pop("kind")
            builders: dict[str, type[TracedOptics] | type[ConeOptics]] = {
                "traced": TracedOptics,
                "cone": ConeOptics,
            }
            return cls(
                name,
                builders[kind](**optics),
                *(
                    float(content[key])
                    for key in ("collecting_area_m2", "pixel_um", "pixel_scale_arcsec", "field_radius_deg")
                ),
            )
        except (KeyError, TypeError) as error:
            raise ResourceError(f"telescope {name}: wrong or missing entry {error}") from error

    @property
    def pixel_solid_angle_arcsec2(self) -> float:
        """Sky area of a pixel [arcsec²]."""
        return self.pixel_scale_arcsec**2

    def trace(self, field_x_deg: float = 0.0, field_y_deg: float = 0.0) -> RayBundle:
        """Rays that arrive at one field position.

        Raises
        ------
        OutOfRangeError
            The position lies outside the field.
        """
        self._check_field(field_x_deg, field_y_deg)
        return self.optics.trace(field_x_deg, field_y_deg)

    def beam(self, field_x_deg: float = 0.0, field_y_deg: float = 0.0, nodes: int = BEAM_NODES) -> Beam:
        """Angles of incidence at one field position, as a Gauss rule.

        Raises
        ------
        OutOfRangeError
            The position lies outside the field.
        """
        self._check_field(field_x_deg, field_y_deg)
        if isinstance(self.optics, ConeOptics):
            return Beam.cone(self.optics.f_number, self.optics.obscuration, nodes)
        if self.optics.axisymmetric:
            field_x_deg, field_y_deg = math.hypot(field_x_deg, field_y_deg), 0.0
        return _beam_of_quantiles(_traced_quantiles(self.optics, field_x_deg, field_y_deg)[0], nodes)

    def kept_fraction(self, field_x_deg: float = 0.0, field_y_deg: float = 0.0) -> float:
        """Share of the pupil that light from one field position passes; vignetting is its fall off axis."""
        self._check_field(field_x_deg, field_y_deg)
        if isinstance(self.optics, ConeOptics):
            return 1.0
        return _traced_quantiles(self.optics, field_x_deg, field_y_deg)[1]

    def _check_field(self, field_x_deg: float, field_y_deg: float) -> None:
        if not math.hypot(field_x_deg, field_y_deg) <= self.field_radius_deg:
            raise OutOfRangeError(
                "field angle [deg]",
                (field_x_deg, field_y_deg),
                f"within {self.field_radius_deg} deg of the axis",
                source=f"telescope {self.name}",
            )


@dataclass(frozen=True, eq=False)
class BeamField:
    """Beams at any distance from the axis of an axisymmetric telescope, from a few traced field radii.

    What is interpolated is each ray: ``sin²θ`` on the sensor and the squared radius at which the ray meets every
    clear aperture are smooth functions of the field radius, although the beam, with its moving edges and vignetting,
    is not. A polynomial through eight radii gives them to 1e-10, so that the beams are those of a full trace.

    Attributes
    ----------
    nodes_deg : `numpy.ndarray`, shape ``(K,)``
        Traced field radii [deg], Chebyshev points of the field.
    largest_deg : `float`
        Largest field radius [deg].
    sin_squared : `numpy.ndarray`, shape ``(K, N)``
        ``sin²θ`` of every ray.
    edge_ray : `numpy.ndarray`, int32, shape ``(E,)``
        Rays that an aperture cuts off at some field radii, one aperture after the other.
    edge_squared : `numpy.ndarray`, shape ``(K, E)``
        Squared radius at which each of them meets that aperture [m²].
    inner_squared, outer_squared : `numpy.ndarray`, shape ``(E,)``
        Squared limits of that aperture [m²].
    """

    nodes_deg: FloatArray
    largest_deg: float
    sin_squared: FloatArray
    edge_ray: NDArray[np.int32]
    edge_squared: FloatArray
    inner_squared: FloatArray
    outer_squared: FloatArray

    @classmethod
    def trace(cls, telescope: Telescope, nodes: int = TRACED_RADII) -> BeamField:
        """Trace a telescope at a few radii of its field.

        Parameters
        ----------
        telescope : `Telescope`
            An axisymmetric, traced telescope.
        nodes : `int`, optional
            Number of radii, five or more.

        Raises
        ------
        InputError
            The telescope is not axisymmetric, or is a mere cone; ask it for the beam of every position instead.
        OutOfRangeError
            Too few radii.
        """
        if nodes < _FEWEST_RADII:
            raise OutOfRangeError("number of traced radii", nodes, f"{_FEWEST_RADII} or more")
        optics = telescope.optics
        if not isinstance(optics, TracedOptics) or not optics.axisymmetric:
            raise InputError(
                "telescope", telescope.name, "a traced, axisymmetric one; take its beams directly"
            )
        half = 0.5 * telescope.field_radius_deg
        radii = half * (1.0 - np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes))
        surfaces = list(_surfaces(_batoid_optic(optics.prescription)))
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

    def sin_squared_at(self, field_x_deg: float, field_y_deg: float = 0.0) -> tuple[FloatArray, float]:
        """``sin²θ`` of the rays that arrive at a field position, and the unvignetted share of the pupil.

        Raises
        ------
        OutOfRangeError
            The position lies outside the field, or no light arrives.
        """
        radius = math.hypot(field_x_deg, field_y_deg)
        if not radius <= self.largest_deg:
            raise OutOfRangeError("field angle [deg]", radius, f"0 to {self.largest_deg:g}")
        weight = _lagrange_weights(self.nodes_deg, radius)
        crossing = weight @ self.edge_squared
        kept = np.ones(self.sin_squared.shape[1], dtype=bool)
        kept[self.edge_ray[(crossing > self.outer_squared) | (crossing < self.inner_squared)]] = False
        if not kept.any():
            raise OutOfRangeError("field angle [deg]", radius, "a place that light reaches")
        sine = (weight @ self.sin_squared)[kept]
        return sine, sine.size / kept.size

    def beam(self, field_x_deg: float, field_y_deg: float = 0.0, nodes: int = BEAM_NODES) -> Beam:
        """Angles of incidence at one field position; errors as for `sin_squared_at`."""
        sine, _ = self.sin_squared_at(field_x_deg, field_y_deg)
        return _beam_of_quantiles(_quantiles(sine, QUANTILES), nodes)

    def kept_fraction(self, field_x_deg: float, field_y_deg: float = 0.0) -> float:
        """Unvignetted share of the pupil at one field position."""
        return self.sin_squared_at(field_x_deg, field_y_deg)[1]


def telescope_beam(
    telescope: str | Telescope, field_x_deg: float = 0.0, field_y_deg: float = 0.0, nodes: int = BEAM_NODES
) -> Beam:
    """Angles of incidence of a telescope at one field position.

    Parameters
    ----------
    telescope : `str` or `Telescope`
        A telescope or its name (``lsst``, ``hsc``, ``monocam``).
    field_x_deg, field_y_deg : `float`, optional
        Field angle [deg]; the axis by default.
    nodes : `int`, optional
        Number of angles.

    Returns
    -------
    beam : `Beam`

    Raises
    ------
    UnknownNameError
        The telescope is unknown.
    OutOfRangeError
        The position lies outside the field.
    """
    found = Telescope.from_name(telescope) if isinstance(telescope, str) else telescope
    return found.beam(field_x_deg, field_y_deg, nodes)


def gauss_rule(value: ArrayLike, weight: ArrayLike, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Gauss quadrature with respect to a discrete measure.

    The rule integrates polynomials up to degree ``2 nodes - 1`` over the measure exactly (Lanczos process with full
    reorthogonalisation, Golub & Welsch 1969). Where the measure has no more points than that, it is returned as is;
    where many are in the same places, the rule has a node in each of these.

    Parameters
    ----------
    value, weight : array_like, shape ``(N,)``
        Points of the measure and their weights.
    nodes : `int`
        Number of nodes wanted.

    Returns
    -------
    node, node_weight : `numpy.ndarray`
        At most ``nodes`` ascending nodes inside the range of ``value``, and weights that sum to the sum of
        ``weight``.
    """
    if nodes < 1:
        raise OutOfRangeError("number of beam angles", nodes, "1 or more")
    points, mass = np.asarray(value, dtype=float), np.asarray(weight, dtype=float)
    order = np.argsort(points)
    points, mass = points[order], mass[order]
    centre, half = 0.5 * (points[0] + points[-1]), 0.5 * (points[-1] - points[0])
    if points.size <= nodes or half <= 1e-14 * max(1.0, abs(centre)):
        return (points, mass) if half > 0.0 else (points[:1], np.array([mass.sum()]))
    scaled = (points - centre) / half
    total = float(mass.sum())
    basis = np.zeros((nodes, points.size))
    diagonal, off_diagonal = np.zeros(nodes), np.zeros(nodes)
    basis[0] = np.sqrt(mass / total)
    for step in range(nodes):
        vector = scaled * basis[step]
        diagonal[step] = basis[step] @ vector
        for _ in range(2):  # twice is enough
            vector -= basis[: step + 1].T @ (basis[: step + 1] @ vector)
        off_diagonal[step] = np.linalg.norm(vector)
        if step + 1 == nodes or off_diagonal[step] < SAME_PLACE:  # so many nodes are all of the places
            break
        basis[step + 1] = vector / off_diagonal[step]
    eigenvalues, eigenvectors = scipy.linalg.eigh_tridiagonal(diagonal[: step + 1], off_diagonal[:step])
    return centre + half * np.clip(eigenvalues, -1.0, 1.0), total * eigenvectors[0] ** 2


def reduce_beam(beam: Beam, nodes: int) -> Beam:
    """Beam with fewer angles, as a Gauss rule with respect to the given one; the beam itself if it has no more."""
    if beam.theta.size <= nodes:
        return beam
    sine, weight = gauss_rule(np.sin(beam.theta) ** 2, beam.weight, nodes)
    return Beam(np.arcsin(np.sqrt(np.clip(sine, 0.0, 1.0))), weight / weight.sum())


def _quantiles(values: FloatArray, groups: int) -> FloatArray:
    """Mean of ascending groups of equal size."""
    # Rays come ring by ring, in each of which the angle rises and falls: such a sort merges what is in order.
    ordered = np.sort(values, kind="stable")
    edges = np.linspace(0.0, ordered.size, groups + 1)
    # Integrating the step function of the sorted rays keeps the groups equal whatever their number.
    cumulative = np.concatenate([[0.0], np.cumsum(ordered)])
    integral = np.interp(edges, np.arange(ordered.size + 1), cumulative)
    return np.diff(integral) / np.diff(edges)


def _lagrange_weights(nodes: FloatArray, place: float) -> FloatArray:
    """Weights of the values at the nodes in the polynomial through all of them."""
    difference = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(difference, 1.0)
    above = np.broadcast_to(place - nodes, difference.shape).copy()
    np.fill_diagonal(above, 1.0)
    return np.prod(above / difference, axis=1)


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


def _beam_of_quantiles(quantile: FloatArray, nodes: int) -> Beam:
    sine, weight = gauss_rule(quantile, np.full(quantile.size, 1.0 / quantile.size), nodes)
    return Beam(np.arcsin(np.sqrt(np.clip(sine, 0.0, 1.0))), weight / weight.sum())


@functools.lru_cache(maxsize=8)
def _batoid_optic(prescription: str) -> batoid.Optic:
    try:
        return batoid.Optic.fromYaml(prescription)
    except FileNotFoundError as error:
        raise ResourceError(f"batoid has no prescription {prescription}") from error


@functools.lru_cache(maxsize=64)
def _traced_quantiles(
    optics: TracedOptics, field_x_deg: float, field_y_deg: float
) -> tuple[FloatArray, float]:
    bundle = optics.trace(field_x_deg, field_y_deg)
    quantile = bundle.quantiles()
    quantile.flags.writeable = False
    return quantile, bundle.kept_fraction
