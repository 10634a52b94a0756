"""Illuminations with as many nodes as a tolerance asks for, and an estimate of the error that is left.

Fringes of thick coherent layers alias: with too few wavelengths two different rules can agree on a wrong answer. Two
precautions: the first rule already resolves the shortest fringe of the whole stack, and rules are compared whose
numbers of nodes have no simple ratio. The rules converge faster than any power of the spacing for Gaussian lines and
for Gauss nodes, so that the change to the denser rule, taken as the error of the denser one, errs on the safe side.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..errors import ConvergenceError, OutOfRangeError
from .illumination import Beam, Illumination
from .system import OpticalSystem

__all__ = ["converged", "converged_flat_fields", "converged_spectrum", "shortest_fringe_nm"]

_RATIO = 1.6
"""Factor between the numbers of nodes of two rules that are compared."""

_THICKNESSES = 257
"""Thicknesses at which two rules are compared; they step through the phase of the fringe irregularly."""

_MOST_NODES = 400_000


def shortest_fringe_nm(system: OpticalSystem, wavelength_nm: float) -> float:
    """Spacing of the fringes between the two outermost faces of the coherent stack [nm].

    ``lambda² / (2 sum n_g d)`` with the group index ``n - lambda dn/dlambda`` of every layer.
    """
    step = 0.5
    index = system.stack.indices(wavelength_nm + step * np.array([-1.0, 0.0, 1.0]), system.temperature_k).real
    group = index[:, 1] - wavelength_nm * (index[:, 2] - index[:, 0]) / (2.0 * step)
    path_nm = 1e3 * float(group[1:-1] @ system.stack.thickness_um[1:-1])
    return wavelength_nm**2 / (2.0 * path_nm)


def converged(
    system: OpticalSystem,
    build: Callable[[float], Illumination],
    thickness_range_um: tuple[float, float],
    tolerance: float,
    first: float = 1.0,
) -> Illumination:
    """Illumination whose quadrature error is below a tolerance.

    Parameters
    ----------
    system : `OpticalSystem`
        The sensor.
    build : callable
        ``density -> Illumination``; the number of nodes must grow with ``density``.
    thickness_range_um : `tuple` [`float`, `float`]
        Thicknesses of the varying layer at which rules are compared [µm].
    tolerance : `float`
        Largest error of the response.
    first : `float`, optional
        First density.

    Returns
    -------
    illumination : `Illumination`
        With its ``error_estimate``.

    Raises
    ------
    ConvergenceError
        More nodes would be needed than is sensible.
    """
    low, high = thickness_range_um
    if not 0.0 <= low < high < math.inf:
        raise OutOfRangeError(
            "thickness range [um]", thickness_range_um, "two increasing, not negative numbers"
        )
    if not tolerance > 0.0:
        raise OutOfRangeError("tolerance", tolerance, "a positive number")
    step = (high - low) / (_THICKNESSES - 0.5)

    def respond(light: Illumination) -> np.ndarray:
        return system.reduce(light).averaged_on_grid(light.weight, low, step, _THICKNESSES)

    density = first
    values = respond(build(density))
    change = math.inf
    while True:
        density *= _RATIO
        light = build(density)
        if light.weight.size > _MOST_NODES:
            raise ConvergenceError(
                f"quadrature over wavelength and angle: error {change:.1e} with {light.weight.size / _RATIO:.0f} "
                f"nodes; asked for {tolerance:.1e}"
            )
        previous, values = values, respond(light)
        change = float(np.abs(values - previous).max())
        if change <= tolerance:
            # Below rounding the change says nothing; the rounding itself is what is left.
            return replace(light, error_estimate=max(change, 1e-14))


def converged_flat_fields(
    system: OpticalSystem,
    wavelength_nm: ArrayLike,
    thickness_range_um: tuple[float, float],
    *,
    tolerance: float = 1e-6,
    beam: Callable[[int], Beam] | None = None,
) -> Illumination:
    """Monochromator flats with as many wavelengths (and angles) as needed.

    Parameters
    ----------
    system : `OpticalSystem`
        The sensor, the line profile and the beam.
    wavelength_nm : array_like, shape ``(W,)``
        Nominal wavelengths [nm].
    thickness_range_um, tolerance
        See `converged`.
    beam : callable, optional
        ``nodes -> Beam``, e.g. ``lambda nodes: Beam.cone(4.0, 0.3, nodes)``; the beam of the system as it is, if not
        given, and then the estimate does not include its error.
    """
    nominal = np.atleast_1d(np.asarray(wavelength_nm, dtype=float))
    first = 0.25 * shortest_fringe_nm(system, float(nominal.min()))

    def build(density: float) -> Illumination:
        chosen = system if beam is None else replace(system, beam=beam(max(4, round(12 * density))))
        return chosen.flat_fields(nominal, first / density)

    return converged(system, build, thickness_range_um, tolerance)


def converged_spectrum(
    system: OpticalSystem,
    wavelength_nm: ArrayLike,
    weight: ArrayLike,
    beam: Callable[[int], Beam],
    thickness_range_um: tuple[float, float],
    *,
    tolerance: float = 1e-6,
) -> Illumination:
    """Emission lines through a beam with as many angles as needed (equation 5 of the paper).

    Parameters
    ----------
    system : `OpticalSystem`
        The sensor.
    wavelength_nm, weight : array_like, shape ``(K,)``
        Lines [nm] and their relative numbers of photons.
    beam : callable
        ``nodes -> Beam``.
    thickness_range_um, tolerance
        See `converged`.
    """

    def build(density: float) -> Illumination:
        return Illumination.spectrum(wavelength_nm, weight, beam(round(20 * density)))

    return converged(system, build, thickness_range_um, tolerance)
