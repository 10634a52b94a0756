"""Layers in which the light loses its phase: sums over the phase of a layer.

Inside a pixel (and over its coherence area) a thick layer is not plane to a fraction of a wavelength. What a pixel
collects is the mean over the thicknesses inside it. For a Gaussian spread ``sigma`` the round-trip phase of a layer
has a wrapped normal distribution; the limit ``sigma -> inf`` is the incoherent layer, in which intensities add. The
response is a power series in the phase factor that falls geometrically, so that a sum over N equidistant phases is
exact to ``rho^N``, with ``rho`` the product of the reflectances that enclose the layer.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .transfer_matrix import ComplexArray, FloatArray, interface_coefficients, layer_admittance

_ERROR = 1e-14
_FEWEST, _MOST = 8, 512


@dataclass(frozen=True)
class PhaseState:
    """One combination of extra round-trip phases."""

    phases: dict[int, float]  # extra round-trip phase [rad] by position of the layer
    share: NDArray[np.float64] | float  # weight of the state, for every node


def phase_states(
    index: ComplexArray,
    thickness: FloatArray,
    wavelength: FloatArray,
    theta: FloatArray,
    polarization: str,
    shifted: Sequence[int],
    spread: FloatArray,
) -> list[PhaseState]:
    """Phases over which the response of a stack is to be averaged.

    ``index`` (L, ...). ``thickness`` (L,) or (L, ...): mean thickness of every layer, in the unit of
    ``wavelength``. ``spread`` (L,). ``polarization`` {"s", "p"}. ``shifted``: positions of the layers that are
    not fully coherent. Returns one state without extra phases if ``shifted`` is empty; the shares sum to 1.
    """
    if not shifted:
        return [PhaseState({}, 1.0)]
    normal, admittance = layer_admittance(index, theta, polarization)
    reflect = np.abs(interface_coefficients(admittance).reflect_down)
    rate = 4.0 * np.pi * normal / wavelength
    axes = []
    for layer in shifted:
        below = _largest_reflection(reflect[layer:])
        above = _largest_reflection(reflect[:layer])
        ratio = float(np.max(below * above * np.exp(-rate[layer].imag * thickness[layer])))
        axes.append(_phases_and_shares(ratio, rate[layer].real * spread[layer]))
    states = []
    for choice in itertools.product(*axes):
        phases = {layer: phase for layer, (phase, _) in zip(shifted, choice, strict=True)}
        states.append(PhaseState(phases, math.prod(share for _, share in choice)))
    return states


def _largest_reflection(reflect: FloatArray) -> FloatArray:
    """Upper bound of the reflection of a pile of interfaces, in any order, whatever the phases between them."""
    bound = reflect[0]
    for each in reflect[1:]:
        bound = (each + bound) / (1.0 + each * bound)
    return np.minimum(bound, 1.0)


def _phases_and_shares(
    ratio: float, deviation: FloatArray
) -> list[tuple[float, NDArray[np.float64] | float]]:
    """Equidistant phases and their weights for a wrapped normal distribution of the given deviation [rad]."""
    harmonics = math.log(_ERROR) / math.log(min(max(ratio, 1e-6), 0.95))
    if np.all(np.isinf(deviation)):
        count = int(np.clip(math.ceil(harmonics), _FEWEST, _MOST))
        return [(2.0 * np.pi * n / count, 1.0 / count) for n in range(count)]
    narrow = math.sqrt(-2.0 * math.log(_ERROR)) / max(float(np.min(deviation)), 1e-9)
    count = int(np.clip(math.ceil(harmonics + min(harmonics, narrow)), _FEWEST, _MOST))
    phases = 2.0 * np.pi * np.arange(count) / count
    orders = np.arange(1, (count + 1) // 2)
    damping = np.exp(-0.5 * (orders.reshape(-1, *(1,) * deviation.ndim) * deviation) ** 2)
    return [
        (float(phase), (1.0 + 2.0 * np.tensordot(np.cos(orders * phase), damping, axes=1)) / count)
        for phase in phases
    ]
