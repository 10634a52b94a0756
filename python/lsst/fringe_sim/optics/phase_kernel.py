"""Coefficients of the closed form: one node after the other, nothing but a few numbers in memory."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..compiled import contiguous, kernel, run_shares, subkernel


def reduce_nodes(
    index: NDArray,
    thickness: NDArray,
    light: tuple[NDArray, NDArray],
    p_polarized: bool,
    varying: int,
    layers: NDArray,
    roughness: NDArray,
    phase: NDArray,
) -> tuple[NDArray, ...]:
    """Coefficients ``a, b, e, c, g, kappa`` of every node for one polarisation.

    ``index`` (L, N). ``thickness`` (L,): thickness, in the unit of the wavelength; not used of the ends and of the
    varying layer. ``light``: wavelength and angle [rad], (N,) each. ``layers``: positions of the layers whose
    absorption is wanted. ``roughness`` (L-1,). ``phase`` (L,): extra complex round-trip phase of every layer [rad].
    """
    layer_count, nodes = index.shape
    real, mixed = np.zeros((3, nodes)), np.zeros((3, nodes), dtype=np.complex128)
    # One type of array each, so that the loop is compiled once.
    arrays = tuple(
        contiguous(each, kind)
        for each, kind in (
            (index.T, complex), (thickness, float), (light[0], float), (light[1], float),
            (layers, np.int64), (roughness, float), (phase, complex),
        )
    )  # fmt: skip

    def work(first: int, last: int) -> None:
        room = np.ones((7, 4, layer_count), dtype=np.complex128)
        _reduce_share(first, last, arrays, p_polarized, varying, room, real, mixed)

    run_shares(work, nodes, _LEAST_NODES)
    return (*real, *mixed)


_LEAST_NODES = 256  # Nodes that are worth a thread


@kernel
def _reduce_share(
    first: int,
    last: int,
    given: tuple[NDArray, ...],
    p_polarized: bool,
    varying: int,
    room: NDArray,
    real: NDArray,
    mixed: NDArray,
) -> None:  # pragma: no cover - compiled
    """The nodes from ``first`` to ``last``; ``room`` holds the fields of one node, seven times four rows, ones."""
    index, thickness, wavelength, theta, layers, roughness, phase = given
    # A numpy integer has one type, a number in the source one of its own.
    top, one = np.int64(0), np.int64(1)
    count = index.shape[1]
    a, b, e = real[0], real[1], real[2]
    c, g, kappa = mixed[0], mixed[1], mixed[2]
    normal, admittance, travel = room[0, 0], room[0, 1], room[0, 2]
    down, up, seen, lit, back, low = room[1], room[2], room[3], room[4], room[5], room[6]
    for node in range(first, last):
        wave = wavelength[node]
        _admittances(index[node], theta[node], p_polarized, normal, admittance)
        _interfaces(normal, admittance, roughness, wave, down, up)
        for layer in range(1, count - 1):
            length = 0.0 if layer == varying else thickness[layer]
            travel[layer] = _travelled((2.0 * np.pi / wave * length) * normal[layer] + 0.5 * phase[layer])
        reflect_up, reflect_low = 0j, 0j
        for way in range(3):  # from the top, to the top and to the bottom; the code of one call is there once
            along, against = (up, down) if way == 1 else (down, up)
            start = top if way == 0 else varying
            end = varying if way == 0 else (top if way == 1 else count - one)
            step = -one if way == 1 else one
            reflect_up = reflect_low
            reflect_low = _sweep(along, against, travel, start, end, step, seen, room[4 + way])
        entering = lit[0, varying]
        coupling = entering * reflect_low
        g[node] = -reflect_up * reflect_low
        kappa[node] = 2.0 * (2.0 * np.pi * normal[varying] / wave)
        incident = admittance[0].real
        for layer in layers:
            eta = admittance[layer]
            if layer > varying:
                flux = _flux(low[0, layer], low[1, layer], eta) - _flux(low[2, layer], low[3, layer], eta)
                e[node] += abs(entering) ** 2 * flux / incident
                continue
            if layer == varying:
                flux = ((1.0 + reflect_low) * (eta * (1.0 - reflect_low)).conjugate()).real
                e[node] -= abs(entering) ** 2 * flux / incident
            for face in range(1 if layer == varying else 2):
                if layer == varying:
                    u_forward, u_backward, v_forward, v_backward = entering, 0j, 0j, coupling
                else:
                    # Light from below sees the layer upside down: its lower face is the upper one.
                    other = 2 - 2 * face
                    u_forward, u_backward = lit[2 * face, layer], lit[2 * face + 1, layer]
                    v_forward = g[node] * u_forward + coupling * back[other + 1, layer]
                    v_backward = g[node] * u_backward + coupling * back[other, layer]
                sign = 1.0 - 2.0 * face
                u_sum, u_diff = u_forward + u_backward, eta * (u_forward - u_backward)
                v_sum, v_diff = v_forward + v_backward, eta * (v_forward - v_backward)
                a[node] += sign * (u_sum * u_diff.conjugate()).real / incident
                b[node] += sign * (v_sum * v_diff.conjugate()).real / incident
                c[node] += sign * 0.5 * (u_sum.conjugate() * v_diff + v_sum * u_diff.conjugate()) / incident


@subkernel
def _inverse(value: complex) -> complex:  # pragma: no cover - compiled
    """1 / value, of the order of one, where no care for overflow is needed."""
    size = value.real * value.real + value.imag * value.imag
    return complex(value.real / size, -value.imag / size)


@subkernel
def _admittances(
    index: NDArray, theta: float, p_polarized: bool, normal: NDArray, admittance: NDArray
) -> None:  # pragma: no cover - compiled
    """As `layer_admittance`."""
    parallel = index[0].real * math.sin(theta)
    for layer in range(index.size):
        squared = index[layer] * index[layer]
        difference = squared - parallel * parallel
        if parallel == 0.0:
            normal[layer] = index[layer]
        elif difference.imag == 0.0 and difference.real > 0.0:
            normal[layer] = math.sqrt(difference.real)
        else:
            root = np.sqrt(difference)
            normal[layer] = -root if root.imag < 0.0 else root
        admittance[layer] = squared * _inverse(normal[layer]) if p_polarized else normal[layer]


@subkernel
def _travelled(phase: complex) -> complex:  # pragma: no cover - compiled
    """exp(i phase)."""
    size = 1.0 if phase.imag == 0.0 else math.exp(-phase.imag)
    return complex(size * math.cos(phase.real), size * math.sin(phase.real))


@subkernel
def _interfaces(
    normal: NDArray, admittance: NDArray, roughness: NDArray, wave: float, down: NDArray, up: NDArray
) -> None:  # pragma: no cover - compiled
    """Reflection and transmission of every interface for light from above and from below.

    As `interface_coefficients`.
    """
    for face in range(roughness.size):
        upper, lower = admittance[face], admittance[face + 1]
        over_total = _inverse(upper + lower)
        reflect = (upper - lower) * over_total
        down[0, face], down[1, face] = reflect, 2.0 * upper * over_total
        up[0, face], up[1, face] = -reflect, 2.0 * lower * over_total
        if roughness[face] > 0.0:
            height = 2.0 * np.pi * roughness[face] / wave
            q_upper, q_lower = normal[face] * height, normal[face + 1] * height
            through = np.exp(-0.5 * (q_upper - q_lower) * (q_upper - q_lower))
            down[0, face] *= np.exp(-2.0 * q_upper * q_upper)
            up[0, face] *= np.exp(-2.0 * q_lower * q_lower)
            down[1, face] *= through
            up[1, face] *= through


@subkernel
def _sweep(
    along: NDArray,
    against: NDArray,
    travel: NDArray,
    first: int,
    last: int,
    step: int,
    seen: NDArray,
    fields: NDArray,
) -> complex:  # pragma: no cover - compiled
    """Amplitudes at the faces of the layers from ``first`` to ``last`` for a wave of 1 that arrives in ``first``.

    ``along`` and ``against`` are the interfaces for light in the direction of ``step`` and against it. Rows of
    ``fields``: forward and backward at the face where the wave enters, and at the other. Returns the reflection.
    Rows of ``seen`` on the way: reflection at the far face of a layer; its round trip and transmission, as the layer
    before sees them.
    """
    # Interface between layers i and i + 1 has number i.
    beside = 0 if step > 0 else -1
    layer = last - step
    seen[0, layer] = along[0, layer + beside]
    seen[1, last], seen[2, last] = 0.0, along[1, layer + beside]
    while layer != first:
        behind, layer = layer, layer - step
        face = layer + beside
        below = seen[0, behind] * travel[behind] * travel[behind]
        through = along[1, face] * _inverse(1.0 - against[0, face] * below)
        seen[0, layer] = along[0, face] + through * against[1, face] * below
        seen[1, behind], seen[2, behind] = below, through
    fields[0, first] = fields[2, first] = 1.0
    fields[1, first] = fields[3, first] = seen[0, first]
    while layer != last:
        before, layer = layer, layer + step
        forward = seen[2, layer] * fields[2, before]
        fields[0, layer], fields[1, layer] = forward, forward * seen[1, layer]
        if layer == last:
            fields[2, layer], fields[3, layer] = forward, 0.0
        else:
            fields[2, layer] = forward * travel[layer]
            fields[3, layer] = fields[2, layer] * seen[0, layer]
    return seen[0, first]


@subkernel
def _flux(forward: complex, backward: complex, admittance: complex) -> float:  # pragma: no cover - compiled
    """Energy flow along ``forward``."""
    return ((forward + backward) * (admittance * (forward - backward)).conjugate()).real
