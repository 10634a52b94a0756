"""Exact derivatives of the response with respect to everything optical.

For uncertainties and Fisher forecasts. The stack is differentiated by dual numbers through the same recursion that
gives the value (see `dual`), the media by the derivatives of their interpolants, the closed form by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, UnknownNameError
from .coherence import phase_states
from .dual import Dual
from .illumination import Illumination
from .phase_response import _checked_thickness, reduce_polarization
from .system import OpticalSystem
from .transfer_matrix import FloatArray, pure_polarizations

__all__ = ["LAYER_PARAMETERS", "SYSTEM_PARAMETERS", "ResponseGradient", "response_gradient"]

LAYER_PARAMETERS = {
    "thickness": "1/um",
    "index": "1",
    "extinction": "1",
    "roughness": "1/nm",
}
"""Parameters of a layer, written ``<parameter>.<layer>``, and the unit of the derivative."""

SYSTEM_PARAMETERS = {
    "temperature": "1/K",
    "wavelength_offset": "1/nm",
    "wavelength_stretch": "1",
    "bandwidth": "1/nm",
    "beam_scale": "1",
    "thickness_spread": "1/um",
}
"""Parameters of the system and the unit of the derivative.

``bandwidth`` is the FWHM of the line, ``beam_scale`` a factor on the sines of all angles of incidence (1 / f-number),
``thickness_spread`` that of the varying layer.
"""


@dataclass(frozen=True)
class ResponseGradient:
    """Response and its derivatives.

    Attributes
    ----------
    parameters : `tuple` [`str`, ...]
        Names, as they were asked for.
    response : `numpy.ndarray`, shape ``(W, *thickness.shape)``
        Response.
    gradient : `numpy.ndarray`, shape ``(K, W, *thickness.shape)``
        Derivative with respect to each parameter.
    """

    parameters: tuple[str, ...]
    response: FloatArray
    gradient: FloatArray


@dataclass(frozen=True)
class _Inputs:
    """What enters the recursion, with tangents; shapes ``(L, W, Q)``, ``(L,)``, ``(L-1,)``, ``(W, Q)``."""

    index: Dual
    thickness: Dual
    roughness: Dual
    wavelength: Dual
    theta: Dual


def response_gradient(
    system: OpticalSystem, illumination: Illumination, thickness_um: ArrayLike, parameters: Sequence[str]
) -> ResponseGradient:
    """Response and its exact derivatives.

    Parameters
    ----------
    system : `OpticalSystem`
        The sensor.
    illumination : `Illumination`
        The light of W exposures.
    thickness_um : array_like
        Thickness of the varying layer [µm], any shape.
    parameters : sequence of `str`
        ``<parameter>.<layer>`` with a key of `LAYER_PARAMETERS`, or a key of `SYSTEM_PARAMETERS`.

    Returns
    -------
    gradient : `ResponseGradient`

    Raises
    ------
    UnknownNameError
        An unknown parameter or layer.
    InputError
        A derivative that does not exist: of the bandwidth of a line without one, of wavelengths behind a lamp
        with a spectrum, in a stack with a partially coherent fixed layer.

    Notes
    -----
    A Gaussian spread obeys the heat equation, so that the derivative with respect to ``thickness_spread`` is its
    value times the second derivative in thickness; it vanishes at zero spread.
    """
    thickness = _checked_thickness(thickness_um)
    names = tuple(parameters)
    own_layer = f"thickness.{system.varying}"
    traced = [name for name in names if name not in ("thickness_spread", own_layer)]
    spreads = system.stack.thickness_spread_um.copy()
    spreads[system.stack.position(system.varying)] = 0.0
    if np.any((spreads > 0.0) & np.isfinite(spreads)):
        raise InputError("thickness spread of a fixed layer [um]", spreads.tolist(), "zero or infinite")
    reduced = system.reduce(illumination)
    flat = np.ascontiguousarray(thickness).ravel()
    response = reduced.averaged(illumination.weight, flat)
    parts = np.empty((0, *response.shape))
    if traced:
        inputs = _seeded(system, illumination, traced)
        values, tangents, weight = _coefficients(system, inputs, spreads, illumination.weight, len(traced))
        parts = _blurred(
            lambda place: _tangent_kernel(*values, *tangents, weight, place), flat, reduced.spread_um
        )
    gradient = np.empty((len(names), *response.shape))
    for row, name in enumerate(names):
        if name == own_layer:
            gradient[row] = reduced.averaged_derivative(illumination.weight, flat)
        elif name == "thickness_spread":
            gradient[row] = reduced.spread_um * _second_derivative(reduced, illumination.weight, flat)
        else:
            gradient[row] = parts[traced.index(name)]
    shape = (len(response), *thickness.shape)
    return ResponseGradient(names, response.reshape(shape), gradient.reshape(len(names), *shape))


def _second_derivative(reduced: Any, weight: FloatArray, thickness: FloatArray) -> FloatArray:
    if reduced.spread_um == 0.0:
        return np.zeros((len(weight), thickness.size))
    return np.stack(
        [reduced.averaged_derivative_on_grid(weight, place, 1.0, 1, 2)[:, 0] for place in thickness], axis=1
    )


def _blurred(
    tangent: Callable[[FloatArray], FloatArray], thickness: FloatArray, spread_um: float
) -> FloatArray:
    """Mean over the Gaussian spread of the varying layer, by a trapezoidal sum that converges exponentially."""
    if spread_um == 0.0:
        return tangent(thickness)
    place = np.linspace(-8.5, 8.5, 171)
    weight = np.exp(-0.5 * place**2)
    around = (thickness[:, None] + spread_um * place).ravel()
    blurred: FloatArray = tangent(around).reshape(*tangent(thickness[:1]).shape[:2], -1, len(place)) @ (
        weight / weight.sum()
    )
    return blurred


def _seeded(system: OpticalSystem, illumination: Illumination, names: Sequence[str]) -> _Inputs:
    stack, count = system.stack, len(names)
    wave_nm, theta = illumination.wavelength_nm, illumination.theta
    index = Dual.constant(stack.indices(wave_nm, system.temperature_k), count)
    finite = np.where(np.isinf(stack.thickness_um), 0.0, stack.thickness_um)
    thickness = Dual.constant(finite, count)
    roughness = Dual.constant(1e-3 * stack.roughness_nm, count)
    wavelength = Dual.constant(1e-3 * wave_nm, count)
    angle = Dual.constant(np.array(theta), count)
    slopes = [layer.medium.slopes(wave_nm, system.temperature_k) for layer in stack.layers]
    for row, name in enumerate(names):
        kind, _, layer = name.partition(".")
        if layer:
            if kind not in LAYER_PARAMETERS:
                raise UnknownNameError("parameter of a layer", kind, LAYER_PARAMETERS)
            position = stack.position(layer)
            if kind == "thickness":
                _demand_inner(stack.names, position)
                thickness.tangent[row, position] = 1.0
            elif kind == "roughness":
                if position == 0:
                    raise InputError("roughness of layer", layer, "a layer with an upper face")
                roughness.tangent[row, position - 1] = 1e-3
            else:
                index.tangent[row, position] = 1.0 if kind == "index" else 1j
        elif name == "temperature":
            index.tangent[row] = np.stack([slope[1] for slope in slopes])
        elif name == "beam_scale":
            angle.tangent[row] = np.tan(theta)
        elif name in SYSTEM_PARAMETERS:
            moved = _wavelength_shift(system, illumination, name)
            wavelength.tangent[row] = 1e-3 * moved
            index.tangent[row] = np.stack([slope[0] for slope in slopes]) * moved
        else:
            raise UnknownNameError("parameter", name, [*SYSTEM_PARAMETERS, *LAYER_PARAMETERS])
    return _Inputs(index, thickness, roughness, wavelength, angle)


def _wavelength_shift(system: OpticalSystem, illumination: Illumination, name: str) -> FloatArray:
    """Derivative of the wavelength of every node [nm per unit of the parameter]."""
    if system.lamp is not None:
        raise InputError("derivative with respect to", name, "a white lamp")
    wavelength = illumination.wavelength_nm
    if name == "wavelength_offset":
        return np.ones(wavelength.shape)
    centre = illumination.mean_wavelength_nm[:, None]
    if name == "wavelength_stretch":
        return np.broadcast_to(system.nominal_wavelength(centre) - system.stretch_pivot_nm, wavelength.shape)
    fwhm = getattr(system.profile, "fwhm_nm", None)
    if fwhm is None:
        raise InputError("derivative with respect to", name, "a line profile with a FWHM")
    return np.asarray((wavelength - centre) / fwhm)


def _demand_inner(names: tuple[str, ...], position: int) -> None:
    if not 0 < position < len(names) - 1:
        raise InputError("thickness of layer", names[position], "an inner layer")


def _coefficients(
    system: OpticalSystem, inputs: _Inputs, spreads: FloatArray, weight: FloatArray, count: int
) -> tuple[list[np.ndarray], list[np.ndarray], FloatArray]:
    """Coefficients ``(W, S Q)``, their tangents ``(K, W, S Q)`` and weights of all states."""
    stack = system.stack
    varying = stack.position(system.varying)
    inner = range(1, len(stack.layers) - 1)
    layers = [stack.position(system.detection)] if system.observable == "detection" else list(inner)
    shifted = [layer for layer in inner if spreads[layer] > 0.0]
    theta = inputs.theta.value
    rough = np.any(inputs.roughness.value) or np.any(inputs.roughness.tangent)
    parts, weights = [], []
    polarizations = pure_polarizations(system.polarization, theta)
    for each in polarizations:
        states = phase_states(
            inputs.index.value, inputs.thickness.value, inputs.wavelength.value, theta, each, shifted, spreads
        )
        for state in states:
            index: Any = inputs.index
            depth: Any = inputs.thickness
            wavelength: Any = inputs.wavelength
            angle: Any = inputs.theta
            heights: Any = inputs.roughness if rough else None
            parts.append(
                reduce_polarization(
                    index, depth, wavelength, angle, each, varying, layers, heights, state.phases
                )
            )
            weights.append(weight * state.share / len(polarizations))
    values, tangents = [], []
    for column in zip(*parts, strict=True):
        lifted = [item if isinstance(item, Dual) else Dual.constant(item, count) for item in column]
        values.append(np.concatenate([item.value for item in lifted], axis=1))
        tangents.append(np.concatenate([item.tangent for item in lifted], axis=2))
    return values, tangents, np.concatenate(weights, axis=1)


@numba.njit(cache=True, error_model="numpy")
def _tangent_kernel(
    a: NDArray,
    b: NDArray,
    e: NDArray,
    c: NDArray,
    g: NDArray,
    kappa: NDArray,
    ta: NDArray,
    tb: NDArray,
    te: NDArray,
    tc: NDArray,
    tg: NDArray,
    tk: NDArray,
    w: NDArray,
    d: NDArray,
) -> NDArray:  # pragma: no cover - compiled
    """Derivative of the weighted mean with respect to K parameters, shape ``(K, W, N)``."""
    count, groups, nodes = ta.shape
    out = np.zeros((count, groups, d.size))
    for i in range(d.size):
        for m in range(groups):
            for q in range(nodes):
                z = np.exp(1j * kappa[m, q] * d[i])
                size = math.exp(-kappa[m, q].imag * d[i])
                top = a[m, q] + b[m, q] * size * size + e[m, q] * size + 2.0 * (c[m, q] * z).real
                field = 1.0 + g[m, q] * z
                bottom = field.real * field.real + field.imag * field.imag
                for p in range(count):
                    dz = 1j * d[i] * tk[p, m, q] * z
                    dsize = -d[i] * tk[p, m, q].imag * size
                    dtop = ta[p, m, q] + tb[p, m, q] * size * size + te[p, m, q] * size
                    dtop += (2.0 * b[m, q] * size + e[m, q]) * dsize
                    dtop += 2.0 * (tc[p, m, q] * z + c[m, q] * dz).real
                    dfield = tg[p, m, q] * z + g[m, q] * dz
                    dbottom = 2.0 * (field.conjugate() * dfield).real
                    out[p, m, i] += w[m, q] * (dtop - top * dbottom / bottom) / bottom
    return out
