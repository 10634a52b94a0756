"""Exact response of a stack as a function of the thickness of one layer.

Only one layer varies over a sensor; what lies above and below it is fixed. With the round-trip phase factor
``z = exp(i kappa d)`` of the varying layer every field above it is ``(u + v z) / (1 + g z)`` and every field in or
below it is proportional to ``sqrt(z) / (1 + g z)``. The fraction of the light that any layer absorbs is therefore

    A(d) = (a + b |z|² + e |z| + 2 Re(c z)) / |1 + g z|²

with six numbers per wavelength, angle and polarisation, however many layers there are. Nothing is approximated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..compiled import contiguous
from ..errors import ConvergenceError, InputError, OutOfRangeError, named_units
from .closed_form import at_thicknesses, derivative_bounds, on_grid
from .coherence import phase_states
from .harmonics import MOST_RATIO, ROUNDING, series_at, series_on_grid
from .phase_kernel import reduce_nodes
from .transfer_matrix import ComplexArray, FloatArray, pure_polarizations

_COEFFICIENTS = ("a", "b", "e", "c", "g", "kappa")

_SHORT_GRID = 256  # Grid points up to which the closed form at every node is the faster way
_LARGEST_RATIO = 0.9  # Ratio of two harmonics above which the series is too long to pay


@named_units
@dataclass(frozen=True)
class PhaseResponse:
    """Coefficients of the closed form, one set per node (wavelength, angle, polarisation).

    Attributes
    ----------
    a, b, e : `numpy.ndarray`, shape ``(P, ...)``
        Real coefficients; the first axis counts states over which the response is averaged: polarisations, and
        phases of layers that are not coherent.
    c, g, kappa : `numpy.ndarray`, complex, shape ``(P, ...)``
        Complex coefficients; ``kappa`` is the round-trip phase per thickness [rad/µm].
    share : `numpy.ndarray`, shape ``(P, ...)``, optional
        Weight of every state; equal if not given.
    spread_um : `float`
        Rms (Gaussian) spread of the thickness inside a pixel [µm], over which the response is averaged.
    """

    a: FloatArray
    b: FloatArray
    e: FloatArray
    c: ComplexArray
    g: ComplexArray
    kappa: ComplexArray
    share: FloatArray | None = None
    spread_um: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.spread_um < math.inf:
            raise OutOfRangeError("thickness spread [um]", self.spread_um, "finite and not negative")
        if self.share is None:
            object.__setattr__(self, "share", np.full(self.a.shape, 1.0 / len(self.a)))
        if self.spread_um > 0.0 and float(np.abs(self.g).max()) > MOST_RATIO:
            raise ConvergenceError(
                f"thickness spread in a layer whose harmonics fall only by {np.abs(self.g).max():.3f}; "
                f"at most {MOST_RATIO} can be summed"
            )

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of the nodes, without the polarisation axis."""
        return self.a.shape[1:]

    def plus(self, other: PhaseResponse, factor: ArrayLike) -> PhaseResponse:
        """Sum of the response and of another one of the same fields, times a factor at every node."""
        sums = {
            name: getattr(self, name) + np.asarray(factor) * getattr(other, name)
            for name in ("a", "b", "e", "c")
        }
        return replace(self, **sums)

    def mixed_with(self, other: PhaseResponse, part: float) -> PhaseResponse:
        """Mean over a pixel of which a part has another response."""
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _COEFFICIENTS
        }
        shares = [(1.0 - part) * np.asarray(self.share), part * np.asarray(other.share)]
        return replace(self, **arrays, share=np.concatenate(shares))

    def with_harmonic(self, multiple: int, cosine: ArrayLike, sine: ArrayLike) -> PhaseResponse:
        """Response with a further wave in a multiple of the phase, parts of the mean over all phases.

        It is one more state, whose phase runs so many times as fast. In a layer that absorbs, waves fade with
        thickness, and the mean is the response of one from whose far side nothing comes back.

        Parameters
        ----------
        multiple : `int`
            Waves per fringe.
        cosine, sine : array_like
            Amplitudes at every node, relative to the mean response.
        """
        clear = self.a + self.b + self.e - 2.0 * (self.c.conj() * self.g).real
        states = np.where(self.kappa.imag > 0.0, self.a, clear / (1.0 - np.abs(self.g) ** 2))
        mean = (np.asarray(self.share) * states).sum(axis=0)
        wave = 0.5 * mean * (np.asarray(cosine) - 1j * np.asarray(sine))
        nothing = np.zeros((1, *self.node_shape))
        added: dict[str, Any] = {
            "a": nothing,
            "b": nothing,
            "e": nothing,
            "g": nothing.astype(complex),
            "c": wave[np.newaxis],
        }
        added["kappa"] = multiple * self.kappa[:1]
        added["share"] = np.ones((1, *self.node_shape))
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), own]) for name, own in added.items()
        }
        return replace(self, **arrays)

    @named_units
    def evaluate(self, thickness_um: ArrayLike) -> FloatArray:
        """Response at every node.

        Parameters
        ----------
        thickness_um : array_like
            Thickness of the varying layer [µm]; broadcasts against the nodes.

        Returns
        -------
        response : `numpy.ndarray`
            Absorbed fraction, mean over polarisations; shape of ``thickness_um`` broadcast with the nodes.
        """
        thickness = _checked_thickness(thickness_um)
        if self.spread_um > 0.0:
            return self._spread_at_nodes(thickness)
        a, b, e, c, g, kappa, share = self._aligned(thickness.ndim)
        z = np.exp(1j * kappa * thickness)
        size = np.abs(z)
        top = a + b * size**2 + e * size + 2.0 * (c * z).real
        return (share * top / np.abs(1.0 + g * z) ** 2).sum(axis=0)

    def _aligned(self, axes: int) -> list[np.ndarray]:
        """Coefficients and shares, the state axis in front of all axes that broadcast."""
        pad = (1,) * max(0, axes - len(self.node_shape))
        names = (*_COEFFICIENTS, "share")
        return [getattr(self, name).reshape(len(self.a), *pad, *self.node_shape) for name in names]

    def _spread_at_nodes(self, thickness: FloatArray) -> FloatArray:
        shape = np.broadcast_shapes(self.node_shape, thickness.shape)
        states = (len(self.a), *shape)

        def column(array: np.ndarray) -> np.ndarray:
            return np.moveaxis(np.broadcast_to(array, states), 0, -1).reshape(-1, len(self.a))

        spread = [column(array) for array in self._aligned(thickness.ndim)]
        place = np.broadcast_to(thickness, shape).ravel()
        out = np.array(
            [
                series_at(tuple(part[i : i + 1] for part in spread), self.spread_um, place[i : i + 1])[0, 0]
                for i in range(place.size)
            ]
        )
        return out.reshape(shape)

    @named_units
    def averaged(self, weight: ArrayLike, thickness_um: ArrayLike) -> FloatArray:
        """Weighted sum over the last node axis.

        Parameters
        ----------
        weight : array_like, shape ``(W, Q)`` (or ``(Q,)``)
            Weights of the nodes; `node_shape` must be ``(W, Q)`` (or ``(Q,)``).
        thickness_um : array_like
            Thickness [µm], any shape.

        Returns
        -------
        response : `numpy.ndarray`, shape ``(W, *thickness.shape)`` (or ``thickness.shape``)
        """
        thickness = _checked_thickness(thickness_um)
        arrays, weights, squeeze = self._grouped(weight)
        flat = np.ascontiguousarray(thickness).ravel()
        if self.spread_um > 0.0:
            out = series_at((*arrays, weights), self.spread_um, flat)
        else:
            out = at_thicknesses(arrays, weights, flat)
        return out[0].reshape(thickness.shape) if squeeze else out.reshape(len(out), *thickness.shape)

    @named_units
    def averaged_on_grid(
        self, weight: ArrayLike, start_um: float, step_um: float, count: int, *, tolerance: float = ROUNDING
    ) -> FloatArray:
        """Like `averaged` on ``start + step * arange(count)``, many times faster.

        On long grids the harmonic series is summed for all nodes at once (see `harmonics`). On short ones, where
        the series converges slowly and in an absorbing layer, the closed form is evaluated at every node, with a
        phase that advances by multiplication and is set anew every 64 steps. Both agree to 1e-13. With a larger
        ``tolerance``, relative to the fringes, the series takes less time.
        """
        _check_grid(start_um, step_um, count)
        arrays, weights, squeeze = self._grouped(weight)
        grid = (float(start_um), float(step_um), int(count))
        if self.spread_um > 0.0 or (count > _SHORT_GRID and self._series_pays()):
            out = series_on_grid(arrays, weights, self.spread_um, *grid, tolerance=tolerance)
        else:
            out = on_grid(arrays, weights, *grid)
        return out[0] if squeeze else out

    @named_units
    def averaged_derivative_on_grid(
        self, weight: ArrayLike, start_um: float, step_um: float, count: int, order: int = 1
    ) -> FloatArray:
        """Thickness derivative of any order of `averaged_on_grid` [1/µm^order]; same shape."""
        _check_grid(start_um, step_um, count)
        if order < 1:
            raise InputError("order of the derivative", order, "1 or more")
        arrays, weights, squeeze = self._grouped(weight)
        grid = (float(start_um), float(step_um), int(count))
        out = series_on_grid(arrays, weights, self.spread_um, *grid, order)
        return out[0] if squeeze else out

    def _series_pays(self) -> bool:
        return bool(np.abs(self.g).max() < _LARGEST_RATIO and not np.any(self.kappa.imag))

    @named_units
    def derivative_bound(self, weight: ArrayLike, order: int, from_um: float = 0.0) -> FloatArray:
        """Upper bound of the magnitude of a thickness derivative of `averaged`.

        Parameters
        ----------
        weight : array_like, shape ``(W, Q)`` (or ``(Q,)``)
            Weights of the nodes.
        order : `int`
            Order of the derivative, 1 or more.
        from_um : `float`, optional
            The bound holds from this thickness upwards [µm].

        Returns
        -------
        bound : `numpy.ndarray`, shape ``(W,)`` (or ``(1,)``)
            In 1/µm to the power ``order``.

        Notes
        -----
        With ``h = -g`` the closed form is the power series ``sum C_jk z^j conj(z)^k``, and the derivative of a term
        is at most ``(|j-k| Re kappa + (j+k) Im kappa)^order |C_jk| |z|^(j+k)``.
        """
        if order < 1:
            raise InputError("order of the derivative", order, "1 or more")
        arrays, weights, _ = self._grouped(weight)
        return derivative_bounds((*arrays, np.abs(weights)), int(order), float(from_um))

    def _grouped(self, weight: ArrayLike) -> tuple[tuple[np.ndarray, ...], FloatArray, bool]:
        """Coefficients as ``(W, P * Q)`` and weights to match."""
        weights = np.asarray(weight, dtype=float)
        if weights.shape != self.node_shape or weights.ndim not in (1, 2):
            raise InputError("shape of the weights", weights.shape, f"{self.node_shape}")
        squeeze = weights.ndim == 1
        groups = 1 if squeeze else weights.shape[0]

        def group(array: np.ndarray) -> np.ndarray:
            split = array.reshape(len(array), groups, -1)
            return contiguous(np.moveaxis(split, 0, 1).reshape(groups, -1))

        return (
            tuple(group(getattr(self, name)) for name in _COEFFICIENTS),
            group(self.share * weights),
            squeeze,
        )


@named_units
def reduce_to_phase(
    n: ArrayLike,
    d: ArrayLike,
    wavelength: ArrayLike,
    theta: ArrayLike = 0.0,
    polarization: str = "mixed",
    *,
    varying: int,
    layers: Sequence[int],
    roughness: ArrayLike | None = None,
    spread: ArrayLike | None = None,
    attenuation: ArrayLike | None = None,
) -> PhaseResponse:
    """Reduce a stack to its closed form in the phase of one layer.

    Parameters
    ----------
    n : array_like, complex, shape ``(L, ...)``
        Index of every layer.
    d : array_like, shape ``(L,)``
        Thickness of every layer [µm]; that of the varying layer is ignored.
    wavelength, theta : array_like
        Wavelength in vacuum [µm] and angle of incidence [rad]; broadcast with the trailing axes of ``n``.
    polarization : {"mixed", "s", "p"}, optional
        ``mixed`` keeps both and averages them.
    varying : `int`
        Position of the layer whose thickness varies; an inner layer.
    layers : sequence of `int`
        Inner layers whose absorption is summed: the detection layer, or all of them for ``1 - R - T``.
    roughness : array_like, shape ``(L-1,)``, optional
        Rms roughness of the interfaces [µm].
    spread : array_like, shape ``(L,)``, optional
        Rms thickness spread of every layer inside a pixel [µm]. Infinite for an incoherent layer (not the varying
        one). The spread changes the phase; the attenuation of a fixed layer is that of its mean thickness.
    attenuation : array_like, shape ``(L,)``, optional
        Logarithm of the power that every passage of a layer takes besides its absorption.

    Returns
    -------
    response : `PhaseResponse`

    Raises
    ------
    InputError
        ``varying`` or an entry of ``layers`` is not an inner layer, or the polarisation is unknown.

    Notes
    -----
    The tangential fields above the varying layer are those for light from above, ``u``, plus those for light from
    below, ``x``, times the upward amplitude ``tau rho z / (1 + g z)`` at the top of the varying layer, with ``tau``
    the transmission into it, ``rho`` the reflection at its lower face and ``g = -rho r_up``.
    """
    index = np.asarray(n, dtype=complex)
    count = len(index)
    thickness = np.asarray(d, dtype=float)
    wave, angle = np.asarray(wavelength, dtype=float), np.asarray(theta, dtype=float)
    for field, value in (("varying layer", varying), *(("absorbing layer", layer) for layer in layers)):
        if not 0 < value < count - 1:
            raise InputError(field, value, f"an inner layer, 1 to {count - 2}")
    if polarization not in ("mixed", "s", "p"):
        raise InputError("polarization", polarization, "mixed, s or p")
    trailing = np.broadcast_shapes(index.shape[1:], wave.shape, angle.shape)
    pad = (count,) + (1,) * (len(trailing) - index.ndim + 1) + index.shape[1:]
    index = np.broadcast_to(index.reshape(pad), (count, *trailing))
    wave, angle = np.broadcast_to(wave, trailing), np.broadcast_to(angle, trailing)
    heights = None if roughness is None else np.asarray(roughness, dtype=float)
    if heights is not None and not np.any(heights):
        heights = None
    extra = np.zeros(count) if attenuation is None else np.asarray(attenuation, dtype=float)
    spreads = np.zeros(count) if spread is None else np.asarray(spread, dtype=float)
    polarizations = pure_polarizations(polarization, angle)
    shifted = [layer for layer in range(1, count - 1) if layer != varying and spreads[layer] > 0.0]
    nodes = np.ascontiguousarray(wave).reshape(-1), np.ascontiguousarray(angle).reshape(-1)
    flat = np.ascontiguousarray(index).reshape(count, -1)
    rough = np.zeros(count - 1) if heights is None else np.broadcast_to(heights, count - 1).copy()
    parts, shares = [], []
    for each in polarizations:
        for state in phase_states(index, thickness, wave, angle, each, shifted, spreads):
            phase = 1j * extra
            phase[list(state.phases)] += list(state.phases.values())
            reduced = reduce_nodes(
                flat, thickness, nodes, each == "p", varying, np.array(layers, dtype=np.int64), rough, phase
            )
            parts.append([part.reshape(trailing) for part in reduced])
            shares.append(np.broadcast_to(state.share / len(polarizations), trailing))
    a, b, e, c, g, kappa = (np.stack(column) for column in zip(*parts, strict=True))
    return PhaseResponse(a, b, e, c, g, kappa, np.stack(shares), float(spreads[varying]))


def _check_grid(start_um: float, step_um: float, count: int) -> None:
    if count < 1 or not math.isfinite(start_um + step_um * count):
        raise InputError("thickness grid", (start_um, step_um, count), "finite, one point or more")
    _checked_thickness([start_um, start_um + step_um * (count - 1)])


def _checked_thickness(thickness_um: ArrayLike) -> FloatArray:
    thickness = np.asarray(thickness_um, dtype=float)
    good = np.isfinite(thickness) & (thickness >= 0.0)
    if not np.all(good):
        wrong = np.atleast_1d(thickness)[~np.atleast_1d(good)]
        raise OutOfRangeError("thickness [um]", float(wrong[0]), "finite and not negative")
    return thickness
