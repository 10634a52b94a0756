"""Exact response of a sensor in which two layers vary: the adhesive and the silicon that detects.

On the sky 0.1 µm of silicon changes the pattern as much as 0.15 µm of adhesive does. What lies below the silicon
reflects ``rho(z1) = (p + q z1) / (1 + g z1)`` with the phase factor ``z1`` of the adhesive, and with the phase factor
``z2`` of the silicon, ``r = |z2|``, its admittance ``eta`` and the reflection ``u`` at its upper face from within

    A = s B / |1 - u rho z2|²
    B = Re eta (1 - |rho|² r²) + 2 Im eta Im(rho z2) - r [Re eta (1 - |rho|²) + 2 Im eta Im rho]

is the difference of the energy flow at its two faces. Nothing is approximated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..compiled import kernel
from ..errors import InputError, named_units
from .phase_response import _checked_thickness
from .transfer_matrix import (
    ComplexArray,
    FloatArray,
    InterfaceCoefficients,
    WaveFields,
    backward_sweep,
    forward_sweep,
    interface_coefficients,
    layer_admittance,
    pure_polarizations,
)

__all__ = ["ThicknessGrid", "TwoPhaseResponse", "reduce_to_two_phases"]

_COEFFICIENTS = ("scale", "eta", "up", "p", "q", "g", "kappa_lower", "kappa_upper")

_BLOCK = 16
"""Thicknesses of the lower layer that share one set of phase factors of the upper one."""


@named_units
@dataclass(frozen=True)
class ThicknessGrid:
    """Uniform grid ``start + step * arange(count)`` [µm]."""

    start_um: float
    step_um: float
    count: int

    def __post_init__(self) -> None:
        if self.count < 1 or not math.isfinite(self.start_um + self.step_um * self.count):
            raise InputError(
                "thickness grid", (self.start_um, self.step_um, self.count), "finite, one or more"
            )
        _checked_thickness([self.start_um, self.start_um + self.step_um * (self.count - 1)])

    @property
    def thickness_um(self) -> FloatArray:
        """The thicknesses [µm], shape ``(count,)``."""
        return np.asarray(self.start_um + self.step_um * np.arange(self.count), dtype=np.float64)


@dataclass(frozen=True)
class TwoPhaseResponse:
    """Coefficients of the closed form, one set per node (wavelength, angle, polarisation).

    Attributes
    ----------
    scale : `numpy.ndarray`, real, shape ``(P, ...)``
        Light that enters the upper varying layer; the first axis is the polarisation.
    eta, up, p, q, g : `numpy.ndarray`, complex, shape ``(P, ...)``
        Admittance of the upper layer, reflection at its upper face, and the reflection below it.
    kappa_lower, kappa_upper : `numpy.ndarray`, complex, shape ``(P, ...)``
        Round-trip phase per thickness [rad/µm].
    """

    scale: FloatArray
    eta: ComplexArray
    up: ComplexArray
    p: ComplexArray
    q: ComplexArray
    g: ComplexArray
    kappa_lower: ComplexArray
    kappa_upper: ComplexArray

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of the nodes, without the polarisation axis."""
        return self.scale.shape[1:]

    @named_units
    def averaged(self, weight: ArrayLike, lower_um: ArrayLike, upper_um: ArrayLike) -> FloatArray:
        """Weighted mean over the last node axis.

        Parameters
        ----------
        weight : array_like, shape ``(W, Q)``
            Weights of the nodes.
        lower_um, upper_um : array_like
            Thickness of the two layers [µm]; broadcast against each other.

        Returns
        -------
        response : `numpy.ndarray`, shape ``(W, *thickness.shape)``
        """
        return self._at_points(weight, lower_um, upper_um)[0]

    @named_units
    def averaged_derivatives(
        self, weight: ArrayLike, lower_um: ArrayLike, upper_um: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Exact derivatives of `averaged` with respect to the lower and the upper thickness [1/µm]."""
        _, lower, upper = self._at_points(weight, lower_um, upper_um)
        return lower, upper

    def averaged_on_grid(self, weight: ArrayLike, lower: ThicknessGrid, upper: ThicknessGrid) -> FloatArray:
        """Like `averaged` on the product of two grids; shape ``(W, lower.count, upper.count)``."""
        arrays, weights = self._grouped(weight)
        return _grid_kernel(
            *arrays,
            weights,
            lower.thickness_um,
            float(upper.start_um),
            float(upper.step_um),
            int(upper.count),
        )

    def _at_points(
        self, weight: ArrayLike, lower_um: ArrayLike, upper_um: ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        lower, upper = np.broadcast_arrays(_checked_thickness(lower_um), _checked_thickness(upper_um))
        arrays, weights = self._grouped(weight)
        out = _point_kernel(
            *arrays, weights, np.ascontiguousarray(lower).ravel(), np.ascontiguousarray(upper).ravel()
        )
        value, by_lower, by_upper = (part.reshape(len(part), *lower.shape) for part in out)
        return value, by_lower, by_upper

    def _grouped(self, weight: ArrayLike) -> tuple[tuple[np.ndarray, ...], FloatArray]:
        weights = np.asarray(weight, dtype=float)
        if weights.ndim != 2 or weights.shape != self.node_shape:
            raise InputError("shape of the weights", weights.shape, f"{self.node_shape}")
        polarizations, groups = len(self.scale), len(weights)

        def group(array: np.ndarray) -> np.ndarray:
            split = array.reshape(polarizations, groups, -1)
            return np.ascontiguousarray(np.moveaxis(split, 0, 1).reshape(groups, -1))

        spread = np.tile(weights / polarizations, (1, polarizations))
        return tuple(group(getattr(self, name)) for name in _COEFFICIENTS), spread


@named_units
def reduce_to_two_phases(
    n: ArrayLike,
    d: ArrayLike,
    wavelength: ArrayLike,
    theta: ArrayLike = 0.0,
    polarization: str = "mixed",
    *,
    upper: int,
    lower: int,
    roughness: ArrayLike | None = None,
) -> TwoPhaseResponse:
    """Reduce a stack to its closed form in the phases of two layers, the upper of which detects.

    Parameters
    ----------
    n : array_like, complex, shape ``(L, ...)``
        Index of every layer.
    d : array_like, shape ``(L,)``
        Thickness of every layer [µm]; those of the varying layers are ignored.
    wavelength, theta : array_like
        Wavelength in vacuum [µm] and angle of incidence [rad]; broadcast with the trailing axes of ``n``.
    polarization : {"mixed", "s", "p"}, optional
        ``mixed`` keeps both and averages them.
    upper, lower : `int`
        Positions of the detecting layer and of the varying layer below it.
    roughness : array_like, shape ``(L-1,)``, optional
        Rms roughness of the interfaces [µm].

    Raises
    ------
    InputError
        The layers are not two inner ones in this order, or the polarisation is unknown.
    """
    index = np.asarray(n, dtype=complex)
    count = len(index)
    wave, angle = np.asarray(wavelength, dtype=float), np.asarray(theta, dtype=float)
    if not 0 < upper < lower < count - 1:
        raise InputError("varying layers", (upper, lower), f"two inner layers, 1 to {count - 2}, upper first")
    if polarization not in ("mixed", "s", "p"):
        raise InputError("polarization", polarization, "mixed, s or p")
    trailing = np.broadcast_shapes(index.shape[1:], wave.shape, angle.shape)
    pad = (count,) + (1,) * (len(trailing) - index.ndim + 1) + index.shape[1:]
    index = np.broadcast_to(index.reshape(pad), (count, *trailing))
    wave, angle = np.broadcast_to(wave, trailing), np.broadcast_to(angle, trailing)
    column = (-1,) + (1,) * len(trailing)
    heights = None if roughness is None else np.asarray(roughness, dtype=float)
    rough = None if heights is None or not np.any(heights) else heights.reshape(column) / wave
    inner = np.asarray(d, dtype=float)[1:-1].reshape(column)
    parts = []
    for each in pure_polarizations(polarization, angle):
        normal, admittance = layer_admittance(index, angle, each)
        coefficients = interface_coefficients(admittance, normal, rough)
        propagation = np.exp(1j * (2.0 * np.pi * normal[1:-1] / wave) * inner)
        above = _slice(coefficients, slice(None, upper))
        between = _slice(coefficients, slice(upper, lower))
        from_above, _ = _solve(above, propagation[: upper - 1])
        _, up = _solve(_upside_down(above), propagation[: upper - 1][::-1])
        down_fields, p = _solve(between, propagation[upper : lower - 1])
        up_fields, back = _solve(_upside_down(between), propagation[upper : lower - 1][::-1])
        _, bottom = _solve(_slice(coefficients, slice(lower, None)), propagation[lower:])
        g = -back * bottom
        q = g * p + down_fields.forward_top[-1] * up_fields.forward_top[-1] * bottom
        scale = np.abs(from_above.forward_top[upper]) ** 2 / admittance[0].real
        kappa = 4.0 * np.pi * normal / wave
        parts.append((scale, admittance[upper], up, p, q, g, kappa[lower], kappa[upper]))
    return TwoPhaseResponse(*(np.stack(each) for each in zip(*parts, strict=True)))


def _solve(coefficients: InterfaceCoefficients, propagation: ComplexArray) -> tuple[WaveFields, ComplexArray]:
    reflection = backward_sweep(coefficients, propagation)
    return forward_sweep(coefficients, propagation, reflection), reflection[0]


def _slice(coefficients: InterfaceCoefficients, part: slice) -> InterfaceCoefficients:
    return InterfaceCoefficients(
        coefficients.reflect_down[part],
        coefficients.transmit_down[part],
        coefficients.reflect_up[part],
        coefficients.transmit_up[part],
    )


def _upside_down(coefficients: InterfaceCoefficients) -> InterfaceCoefficients:
    return InterfaceCoefficients(
        coefficients.reflect_up[::-1],
        coefficients.transmit_up[::-1],
        coefficients.reflect_down[::-1],
        coefficients.transmit_down[::-1],
    )


@kernel(parallel=True)
def _point_kernel(
    scale: NDArray,
    eta: NDArray,
    up: NDArray,
    p: NDArray,
    q: NDArray,
    g: NDArray,
    kappa_lower: NDArray,
    kappa_upper: NDArray,
    w: NDArray,
    lower: NDArray,
    upper: NDArray,
) -> NDArray:  # pragma: no cover - compiled
    """Value and derivatives with respect to both thicknesses, shape ``(3, W, N)``."""
    groups, nodes = w.shape
    out = np.zeros((3, groups, lower.size))
    for i in numba.prange(lower.size):
        for m in range(groups):
            for k in range(nodes):
                z1 = np.exp(1j * kappa_lower[m, k] * lower[i])
                z2 = np.exp(1j * kappa_upper[m, k] * upper[i])
                r = math.exp(-kappa_upper[m, k].imag * upper[i])
                under = 1.0 + g[m, k] * z1
                rho = (p[m, k] + q[m, k] * z1) / under
                drho = (q[m, k] - p[m, k] * g[m, k]) / (under * under) * 1j * kappa_lower[m, k] * z1
                dz2 = 1j * kappa_upper[m, k] * z2
                dr = -kappa_upper[m, k].imag * r
                er, ei = eta[m, k].real, eta[m, k].imag
                power = rho.real * rho.real + rho.imag * rho.imag
                dpower = 2.0 * (rho.conjugate() * drho).real
                field = 1.0 - up[m, k] * rho * z2
                bottom = field.real * field.real + field.imag * field.imag
                top = er * (1.0 - power * r * r) + 2.0 * ei * (rho * z2).imag
                top -= r * (er * (1.0 - power) + 2.0 * ei * rho.imag)
                top_lower = -er * dpower * r * r + 2.0 * ei * (drho * z2).imag
                top_lower -= r * (-er * dpower + 2.0 * ei * drho.imag)
                top_upper = -2.0 * er * power * r * dr + 2.0 * ei * (rho * dz2).imag
                top_upper -= dr * (er * (1.0 - power) + 2.0 * ei * rho.imag)
                bottom_lower = -2.0 * (field.conjugate() * up[m, k] * drho * z2).real
                bottom_upper = -2.0 * (field.conjugate() * up[m, k] * rho * dz2).real
                factor = w[m, k] * scale[m, k] / bottom
                out[0, m, i] += factor * top
                out[1, m, i] += factor * (top_lower - top * bottom_lower / bottom)
                out[2, m, i] += factor * (top_upper - top * bottom_upper / bottom)
    return out


@kernel(relaxed={"contract", "arcp", "reassoc"}, parallel=True)
def _grid_kernel(
    scale: NDArray,
    eta: NDArray,
    up: NDArray,
    p: NDArray,
    q: NDArray,
    g: NDArray,
    kappa_lower: NDArray,
    kappa_upper: NDArray,
    w: NDArray,
    lower: NDArray,
    start: float,
    step: float,
    count: int,
) -> NDArray:  # pragma: no cover - compiled
    groups, nodes = w.shape
    out = np.zeros((groups, lower.size, count))
    blocks = (lower.size + _BLOCK - 1) // _BLOCK
    for task in numba.prange(groups * blocks):
        m, block = task // blocks, task % blocks
        x, y, r = np.empty(count), np.empty(count), np.empty(count)
        for k in range(nodes):
            kr, ki = kappa_upper[m, k].real, kappa_upper[m, k].imag
            for j in range(count):
                if j % 32 == 0:
                    d = start + step * j
                    size = math.exp(-ki * d)
                    x[j], y[j], r[j] = size * math.cos(kr * d), size * math.sin(kr * d), size
                    decay = math.exp(-ki * step)
                    fx, fy = decay * math.cos(kr * step), decay * math.sin(kr * step)
                else:
                    x[j] = x[j - 1] * fx - y[j - 1] * fy
                    y[j] = x[j - 1] * fy + y[j - 1] * fx
                    r[j] = r[j - 1] * decay
            er, ei = eta[m, k].real, eta[m, k].imag
            factor = w[m, k] * scale[m, k]
            for i in range(block * _BLOCK, min(lower.size, (block + 1) * _BLOCK)):
                z1 = np.exp(1j * kappa_lower[m, k] * lower[i])
                rho = (p[m, k] + q[m, k] * z1) / (1.0 + g[m, k] * z1)
                loop = up[m, k] * rho
                lr, li = loop.real, loop.imag
                power = rho.real * rho.real + rho.imag * rho.imag
                straight = er * (1.0 - power) + 2.0 * ei * rho.imag
                pr, pi = 2.0 * ei * rho.real, 2.0 * ei * rho.imag
                row = out[m, i]
                for j in range(count):
                    top = er - r[j] * (straight + er * power * r[j]) + pr * y[j] + pi * x[j]
                    u = 1.0 - lr * x[j] + li * y[j]
                    v = lr * y[j] + li * x[j]
                    row[j] += factor * top / (u * u + v * v)
    return out
