"""Plane waves in a stack of thin films: reflection, transmission and absorption in every layer.

The fields are found by recursion over interfaces (reflection from the bottom up, amplitudes from the top down).
Every factor in it is a decaying exponential, so opaque and evanescent layers cannot overflow. Both polarisations
use tangential fields: with the admittance ``eta = n cos(theta)`` (s) or ``n / cos(theta)`` (p) the energy flow is
``Re(E conj(H))`` with ``E = F + B`` and ``H = eta (F - B)``, for forward and backward amplitudes ``F`` and ``B``.

References: Guo, Walter, Lage & Lupton 2022, section 2.1; Byrnes 2016, arXiv:1603.02720.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import ComplexArray, FloatArray
from ..errors import InputError, OutOfRangeError, StackError, named_units

__all__ = [
    "POLARIZATIONS",
    "InterfaceCoefficients",
    "WaveFields",
    "backward_sweep",
    "forward_sweep",
    "interface_coefficients",
    "layer_absorption",
    "layer_admittance",
]

POLARIZATIONS = ("s", "p", "mixed")

MOST_WAVELENGTHS = 1e12
"""In one layer; the rounding of a double then moves the phase by 2 pi 1e12 2.2e-16 = 1.4e-3 rad."""


@dataclass(frozen=True)
class InterfaceCoefficients:
    """Amplitude coefficients of the L-1 interfaces, for tangential fields.

    ``down`` is for light that arrives from the side of layer 0, ``up`` for the other. Shape ``(L-1, ...)``.
    """

    reflect_down: ComplexArray
    transmit_down: ComplexArray
    reflect_up: ComplexArray
    transmit_up: ComplexArray


@dataclass(frozen=True)
class WaveFields:
    """Forward and backward amplitude at the two faces of every layer, shape ``(L, ...)``.

    The ambient medium has only a lower face and the substrate only an upper one; the missing faces repeat the
    existing one.
    """

    forward_top: ComplexArray
    backward_top: ComplexArray
    forward_bottom: ComplexArray
    backward_bottom: ComplexArray

    def flux_top(self, admittance: ComplexArray) -> FloatArray:
        """Downward energy flow just inside the upper face of every layer."""
        return _flux(self.forward_top, self.backward_top, admittance)

    def flux_bottom(self, admittance: ComplexArray) -> FloatArray:
        """Downward energy flow just inside the lower face of every layer."""
        return _flux(self.forward_bottom, self.backward_bottom, admittance)


@named_units
def layer_absorption(
    n: ArrayLike,
    d: ArrayLike,
    wavelength: ArrayLike,
    theta: ArrayLike = 0.0,
    polarization: str = "mixed",
    *,
    roughness: ArrayLike | None = None,
) -> FloatArray:
    """Fraction of the incident light that each part of a stack takes.

    Parameters
    ----------
    n : array_like, complex, shape ``(L, ...)``
        Index ``n + i k`` of every layer, ``k >= 0``; that of layer 0 must be real.
    d : array_like, shape ``(L, ...)``
        Thickness of every layer, infinite for the first and the last.
    wavelength : array_like
        Wavelength in vacuum, in the unit of ``d``.
    theta : array_like, optional
        Angle of incidence in layer 0 [rad], 0 ≤ θ < π/2.
    polarization : {"mixed", "s", "p"}, optional
        ``mixed`` is the mean of s and p.
    roughness : array_like, shape ``(L-1,)``, optional
        Rms height of the L-1 interfaces, in the unit of ``d``; see `interface_coefficients`.

    Returns
    -------
    fraction : `numpy.ndarray`, shape ``(L, ...)``
        Reflected fraction first, then the fraction absorbed in each inner layer, transmitted fraction last.
        They sum to 1; what is missing from 1 behind a rough interface is scattered out of the beam.

    Raises
    ------
    StackError
        An end that is not infinite, an inner thickness that is negative or not finite, a layer that amplifies, an
        absorbing ambient medium.
    OutOfRangeError
        A wavelength that is not positive, or an angle outside ``[0, π/2)``.
    InputError
        An unknown polarisation.

    Notes
    -----
    Guo et al. 2022, section 2.1: the absorbed fraction is the difference of the energy flow (Poynting vector)
    at the two faces of the layer.
    """
    index, thickness, wave, angle = checked_stack(n, d, wavelength, theta, polarization)
    heights = None if roughness is None else np.asarray(roughness, dtype=float)
    if heights is not None and (heights.shape != (len(index) - 1,) or not np.all(heights >= 0.0)):
        raise StackError("roughness", heights.tolist(), f"{len(index) - 1} numbers, none negative")
    each = [
        absorption_of(index, thickness, wave, angle, one, roughness=heights)
        for one in pure_polarizations(polarization, angle)
    ]
    return each[0] if len(each) == 1 else 0.5 * (each[0] + each[1])


def pure_polarizations(polarization: str, theta: FloatArray) -> tuple[str, ...]:
    """Polarisations to be averaged; at normal incidence s stands for both."""
    if polarization != "mixed":
        return (polarization,)
    return ("s", "p") if np.any(theta) else ("s",)


@named_units
def layer_admittance(
    index: ComplexArray, theta: FloatArray, polarization: str
) -> tuple[ComplexArray, ComplexArray]:
    """Normal component of the wave vector and admittance of every layer.

    Parameters
    ----------
    index : `numpy.ndarray`, shape ``(L, ...)``
        Complex indices.
    theta : `numpy.ndarray`
        Angle of incidence in layer 0 [rad].
    polarization : {"s", "p"}
        Polarisation.

    Returns
    -------
    normal, admittance : `numpy.ndarray`, shape ``(L, ...)``
        ``n cos(theta)`` in units of the vacuum wave number, of the wave that decays (or travels) downwards, and
        the ratio of the tangential magnetic to electric field of that wave.
    """
    squared = index * index
    # n² - n0² sin² θ, in a form that keeps its digits where the incidence is grazing.
    contrast, along = (index - index[0]) * (index + index[0]), (index[0] * np.cos(theta)) ** 2
    difference = contrast + along
    # At a critical angle the sum vanishes; what it is called there lies within its rounding, and any limit exists.
    rounding = np.finfo(float).eps * (np.abs(contrast) + np.abs(along))
    normal = np.sqrt(np.where(np.abs(difference) < rounding, rounding, difference))
    # The principal root travels upwards when it would grow downwards.
    normal = np.where(normal.imag < 0.0, -normal, normal)
    # At normal incidence the two polarisations are one; the exact index avoids the rounding of the root.
    normal = np.where(np.broadcast_to(theta == 0.0, normal.shape), index, normal)
    return normal, normal if polarization == "s" else squared / normal


def interface_coefficients(
    admittance: ComplexArray,
    normal: ComplexArray | None = None,
    roughness_in_wavelengths: FloatArray | None = None,
) -> InterfaceCoefficients:
    """Fresnel coefficients of all interfaces, dephased where they are rough.

    Parameters
    ----------
    admittance : `numpy.ndarray`, shape ``(L, ...)``
        Admittance of every layer.
    normal : `numpy.ndarray`, shape ``(L, ...)``, optional
        ``n cos(theta)`` of every layer; needed with roughness.
    roughness_in_wavelengths : `numpy.ndarray`, shape ``(L-1, ...)``, optional
        Rms height of each interface over the vacuum wavelength.

    Notes
    -----
    A height ``h`` shifts the reflected wave by ``2 q h`` and the transmitted one by ``(q1 - q2) h`` (``q`` = normal
    wave number). Averaged over Gaussian heights the specular amplitudes fall by ``exp(-2 q² σ²)`` and
    ``exp(-(q1 - q2)² σ² / 2)`` (Debye–Waller; Beckmann & Spizzichino 1963). The rest is scattered.
    """
    upper, lower = admittance[:-1], admittance[1:]
    total = upper + lower
    reflect = (upper - lower) / total
    down, up = 2.0 * upper / total, 2.0 * lower / total
    if roughness_in_wavelengths is None or normal is None:
        return InterfaceCoefficients(reflect, down, -reflect, up)
    phase = 2.0 * np.pi * roughness_in_wavelengths
    q_upper, q_lower = normal[:-1] * phase, normal[1:] * phase
    through = np.exp(-0.5 * (q_upper - q_lower) ** 2)
    return InterfaceCoefficients(
        reflect * np.exp(-2.0 * q_upper**2),
        down * through,
        -reflect * np.exp(-2.0 * q_lower**2),
        up * through,
    )


def backward_sweep(coefficients: InterfaceCoefficients, propagation: ComplexArray) -> ComplexArray:
    """Reflection coefficient seen downwards at the lower face of layers 0…L-2, shape ``(L-1, ...)``.

    Parameters
    ----------
    coefficients : `InterfaceCoefficients`
        Of the L-1 interfaces.
    propagation : `numpy.ndarray`, shape ``(L-2, ...)``
        ``exp(i delta)`` of the inner layers, one way.
    """
    reflection = np.empty_like(coefficients.reflect_down)
    reflection[-1] = coefficients.reflect_down[-1]
    for j in range(len(reflection) - 2, -1, -1):
        below = reflection[j + 1] * propagation[j] ** 2
        reflection[j] = coefficients.reflect_down[j] + (
            coefficients.transmit_down[j] * coefficients.transmit_up[j] * below
        ) / (1.0 - coefficients.reflect_up[j] * below)
    return reflection


def forward_sweep(
    coefficients: InterfaceCoefficients, propagation: ComplexArray, reflection: ComplexArray
) -> WaveFields:
    """Amplitudes at the faces of all layers for a wave of amplitude 1 that arrives in layer 0.

    Parameters
    ----------
    coefficients, propagation
        As for `backward_sweep`.
    reflection : `numpy.ndarray`, shape ``(L-1, ...)``
        What `backward_sweep` returned.
    """
    last = len(reflection) - 1
    zero = np.zeros_like(reflection[0])
    forward, backward = zero + 1.0, reflection[0]
    top_f, top_b, bottom_f, bottom_b = [forward], [backward], [forward], [backward]
    for j in range(last + 1):
        round_trip = reflection[j + 1] * propagation[j] ** 2 if j < last else zero
        forward = (
            coefficients.transmit_down[j] * bottom_f[j] / (1.0 - coefficients.reflect_up[j] * round_trip)
        )
        top_f.append(forward)
        top_b.append(forward * round_trip)
        bottom_f.append(forward * propagation[j] if j < last else forward)
        bottom_b.append(bottom_f[-1] * reflection[j + 1] if j < last else zero)
    return WaveFields(np.stack(top_f), np.stack(top_b), np.stack(bottom_f), np.stack(bottom_b))


def absorption_of(
    index: ComplexArray,
    thickness: FloatArray,
    wavelength: FloatArray,
    theta: FloatArray,
    polarization: str,
    roughness: FloatArray | None = None,
) -> FloatArray:
    """Fractions for one polarisation."""
    normal, admittance = layer_admittance(index, theta, polarization)
    heights = None
    if roughness is not None and np.any(roughness):
        heights = roughness.reshape(-1, *(1,) * wavelength.ndim) / wavelength
    coefficients = interface_coefficients(admittance, normal, heights)
    propagation = np.exp(1j * (2.0 * np.pi * normal[1:-1] / wavelength) * thickness[1:-1])
    reflection = backward_sweep(coefficients, propagation)
    fields = forward_sweep(coefficients, propagation, reflection)
    top, bottom = fields.flux_top(admittance), fields.flux_bottom(admittance)
    incident = admittance[0].real
    fraction = (top - bottom) / incident
    fraction[0] = np.abs(reflection[0]) ** 2
    fraction[-1] = top[-1] / incident
    return fraction


def _flux(forward: ComplexArray, backward: ComplexArray, admittance: ComplexArray) -> FloatArray:
    return ((forward + backward) * np.conj(admittance * (forward - backward))).real


def checked_stack(
    n: ArrayLike, d: ArrayLike, wavelength: ArrayLike, theta: ArrayLike, polarization: str
) -> tuple[ComplexArray, FloatArray, FloatArray, FloatArray]:
    """Arguments of `layer_absorption`, broadcast and checked; same errors."""
    if polarization not in POLARIZATIONS:
        raise InputError("polarization", polarization, "mixed, s or p")
    index, thickness, wave, angle = _broadcast(n, d, wavelength, theta)
    _check(index, thickness, wave, angle)
    return index, thickness, wave, angle


def _broadcast(
    n: ArrayLike, d: ArrayLike, wavelength: ArrayLike, theta: ArrayLike
) -> tuple[ComplexArray, FloatArray, FloatArray, FloatArray]:
    index = np.asarray(n, dtype=complex)
    thickness = np.asarray(d, dtype=float)
    wave = np.asarray(wavelength, dtype=float)
    angle = np.asarray(theta, dtype=float)
    if index.ndim == 0 or thickness.ndim == 0 or len(index) != len(thickness):
        raise StackError(
            "shape of n and d", (index.shape, thickness.shape), "the same number of layers first"
        )
    if len(index) < 2:
        raise StackError("number of layers", len(index), "two or more")
    try:
        trailing = np.broadcast_shapes(index.shape[1:], thickness.shape[1:], wave.shape, angle.shape)
    except ValueError as error:
        shapes = (index.shape, thickness.shape, wave.shape, angle.shape)
        raise StackError(
            "shapes of n, d, wavelength, theta", shapes, "trailing axes that broadcast"
        ) from error
    pad = (1,) * len(trailing)

    def spread(array: np.ndarray) -> np.ndarray:
        own = array.shape[1:]
        padded = array.reshape(len(array), *pad[: len(pad) - len(own)], *own)
        return np.broadcast_to(padded, (len(array), *trailing))

    return spread(index), spread(thickness), np.broadcast_to(wave, trailing), np.broadcast_to(angle, trailing)


def _check(index: ComplexArray, thickness: FloatArray, wavelength: FloatArray, theta: FloatArray) -> None:
    _demand(
        np.isposinf(thickness[[0, -1]]),
        thickness[[0, -1]],
        StackError,
        "thickness of an end layer",
        "infinite",
    )
    inner = thickness[1:-1]
    good = np.isfinite(inner) & (inner >= 0.0)
    _demand(good, inner, StackError, "thickness of an inner layer", "finite and not negative")
    good = np.isfinite(index) & (index.imag >= 0.0) & (index.real >= 0.0) & (index != 0)
    _demand(good, index, StackError, "index n + ik of a layer", "finite, n >= 0 and k >= 0, not zero")
    _demand(index[0].imag == 0.0, index[0], StackError, "index of the ambient medium", "a real number")
    good = np.isfinite(wavelength) & (wavelength > 0.0)
    _demand(good, wavelength, OutOfRangeError, "wavelength", "a positive number")
    good = (theta >= 0.0) & (theta < 0.5 * np.pi)
    _demand(good, theta, OutOfRangeError, "angle of incidence [rad]", "0 to below pi/2")
    with np.errstate(over="ignore"):
        waves = inner / wavelength * np.abs(index[1:-1])
    allowed = f"up to {MOST_WAVELENGTHS:g}: the phase of more is lost in the rounding"
    _demand(waves <= MOST_WAVELENGTHS, waves, StackError, "wavelengths in a layer", allowed)


def _demand(good: np.ndarray, values: np.ndarray, error: type[InputError], field: str, allowed: str) -> None:
    if not np.all(good):
        raise error(field, np.atleast_1d(values)[~np.atleast_1d(good)][0].item(), allowed)
