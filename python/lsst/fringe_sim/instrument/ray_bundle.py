"""Rays of a telescope at one place of its field, and beams of few angles that stand for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..errors import OutOfRangeError
from ..optics import Beam

BEAM_NODES = 96
"""Angles in a beam.

At the edge of the LSST field, 64 would do for the round trip through 265 µm of silicon (detection layer and support)
and its second harmonic; the third makes an error of 4 % of the peak-to-peak of a sky frame, with 96 of 0.2 %.
"""

SAME_PLACE = 1e-10
"""Distance of points, relative to half the range of all, at which a Gauss rule takes them for one."""

QUANTILES = 4096  # Groups of equal light into which the rays are gathered before the Gauss rule is formed


@dataclass(frozen=True, eq=False)
class RayBundle:
    """Rays that reach one place of the focal plane; every ray carries the same light."""

    # slope_x, slope_y: (N,): slopes dx/dz and dy/dz against the normal of the sensor, z pointing into it
    slope_x: FloatArray
    slope_y: FloatArray
    kept_fraction: float  # share of the rays launched over the entrance pupil that was not vignetted

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
        return quantiles(self.sin_squared, groups)

    def beam(self, nodes: int = BEAM_NODES) -> Beam:
        """Gauss rule of the bundle."""
        return beam_of_quantiles(self.quantiles(), nodes)


def gauss_rule(value: ArrayLike, weight: ArrayLike, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Gauss quadrature with respect to a discrete measure.

    The rule integrates polynomials up to degree ``2 nodes - 1`` over the measure exactly (Lanczos process with full
    reorthogonalisation, Golub & Welsch 1969). Where the measure has no more points than that, it is returned as is;
    where many are in the same places, the rule has a node in each of these.

    ``value``, ``weight`` ``(N,)``: points of the measure and their weights.
    ``nodes``: number of nodes wanted.
    Returns at most ``nodes`` ascending nodes inside the range of ``value``, and weights that sum to the sum
    of ``weight``.
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
    return np.clip(centre + half * eigenvalues, points[0], points[-1]), total * eigenvectors[0] ** 2


def reduce_beam(beam: Beam, nodes: int) -> Beam:
    """Beam with fewer angles, as a Gauss rule with respect to the given one; the beam itself if it has no more."""
    if beam.theta.size <= nodes:
        return beam
    sine, weight = gauss_rule(np.sin(beam.theta) ** 2, beam.weight, nodes)
    return Beam(np.arcsin(np.sqrt(np.clip(sine, 0.0, 1.0))), weight / weight.sum())


def quantiles(values: FloatArray, groups: int) -> FloatArray:
    """Mean of ascending groups of equal size."""
    # Rays come ring by ring, in each of which the angle rises and falls: such a sort merges what is in order.
    ordered = np.sort(values, kind="stable")
    edges = np.linspace(0.0, ordered.size, groups + 1)
    # Integrating the step function of the sorted rays keeps the groups equal whatever their number.
    cumulative = np.concatenate([[0.0], np.cumsum(ordered)])
    integral = np.interp(edges, np.arange(ordered.size + 1), cumulative)
    return np.diff(integral) / np.diff(edges)


def lagrange_weights(nodes: FloatArray, place: ArrayLike) -> FloatArray:
    """Weights of the values at the nodes in the polynomial through all of them, ``(nodes, *place)``."""
    where = np.asarray(place, dtype=float)
    weights = np.ones((nodes.size, *where.shape))
    for number, node in enumerate(nodes):
        for other in np.delete(nodes, number):
            weights[number] *= (where - other) / (node - other)
    return weights


def beam_of_quantiles(quantile: FloatArray, nodes: int) -> Beam:
    """Beam of few angles from sin²θ of equal light."""
    sine, weight = gauss_rule(quantile, np.full(quantile.size, 1.0 / quantile.size), nodes)
    return Beam(np.arcsin(np.sqrt(np.clip(sine, 0.0, 1.0))), weight / weight.sum())
