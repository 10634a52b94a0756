"""The closed form in the phase of one layer, summed over nodes: at thicknesses, on a grid, and its bounds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernel, run_shares
from .transfer_matrix import FloatArray

Nodes = tuple[NDArray[Any], ...]
"""``a, b, e, c, g, kappa`` of the Q nodes of W groups, and their weights, all ``(W, Q)``."""

_LEAST_WORK = 20_000  # Nodes times thicknesses that are worth a thread

_ANCHOR = 64
"""Steps of the phase recurrence between two exact evaluations; keeps its rounding error below 1e-14."""


def at_thicknesses(arrays: tuple[np.ndarray, ...], weights: FloatArray, thickness: FloatArray) -> FloatArray:
    """The closed form at all thicknesses, in threads; ``(W, N)``."""
    out = np.empty((len(weights), thickness.size))

    def work(first: int, last: int) -> None:
        _point_kernel((*arrays, weights), thickness, first, last, out)

    run_shares(work, thickness.size, _LEAST_WORK // weights.size)
    return out


def on_grid(
    arrays: tuple[np.ndarray, ...], weights: FloatArray, start: float, step: float, count: int
) -> FloatArray:
    """The closed form on a uniform grid, in threads; ``(W, count)``."""
    out = np.empty((len(weights), count))

    def work(first: int, last: int) -> None:
        _grid_kernel((*arrays, weights), start, step, first, last, out)

    tasks = len(weights) * -(-count // _ANCHOR)
    run_shares(work, tasks, _LEAST_WORK // (_ANCHOR * weights.shape[1]))
    return out


@kernel
def _point_kernel(
    nodes: Nodes, d: NDArray, first: int, last: int, out: NDArray
) -> None:  # pragma: no cover - compiled
    a, b, e, c, g, kappa, w = nodes
    groups, count = w.shape
    for m in range(groups):
        for i in range(first, last):
            total = 0.0
            for q in range(count):
                size = math.exp(-kappa[m, q].imag * d[i])
                angle = kappa[m, q].real * d[i]
                z = complex(size * math.cos(angle), size * math.sin(angle))
                top = a[m, q] + (b[m, q] * size + e[m, q]) * size + 2.0 * (c[m, q] * z).real
                u = 1.0 + g[m, q].real * z.real - g[m, q].imag * z.imag
                v = g[m, q].real * z.imag + g[m, q].imag * z.real
                total += w[m, q] * top / (u * u + v * v)
            out[m, i] = total


@kernel
def derivative_bounds(nodes: Nodes, order: int, start: float) -> NDArray:  # pragma: no cover - compiled
    """Upper bounds of a thickness derivative above ``start``, ``(W,)``; see `PhaseResponse.derivative_bound`."""
    a, b, e, c, g, kappa, w = nodes
    groups, count = w.shape
    out = np.zeros(groups)
    for m in range(groups):
        for q in range(count):
            h, kr, ki = -g[m, q], abs(kappa[m, q].real), kappa[m, q].imag
            r = math.exp(-ki * start)
            total = 0.0
            if ki == 0.0:
                first = (a[m, q] + b[m, q] + e[m, q]) * h + c[m, q] + c[m, q].conjugate() * h * h
                size, term, j = abs(first) / (1.0 - abs(h) ** 2), 1.0, 1
                while term > 1e-20 * total:
                    term = size * (j * kr) ** order
                    total += 2.0 * term
                    size *= abs(h)
                    j += 1
                out[m] += w[m, q] * total
                continue
            reach = max(order, min(400, 2 + int(math.log(1e-18) / math.log(max(abs(h) * r, 1e-9)))))
            for j in range(reach + 1):
                for k in range(j + 1):
                    term = a[m, q] * h**j * h.conjugate() ** k
                    if k > 0:
                        term += b[m, q] * h ** (j - 1) * h.conjugate() ** (k - 1)
                        term += c[m, q].conjugate() * h**j * h.conjugate() ** (k - 1)
                    if j > 0:
                        term += c[m, q] * h ** (j - 1) * h.conjugate() ** k
                    twice = 1.0 if j == k else 2.0
                    rate = ((j - k) * kr + (j + k) * ki) ** order
                    total += twice * rate * abs(term) * r ** (j + k)
                    rate = ((j - k) * kr + (j + k + 1) * ki) ** order
                    total += twice * rate * abs(e[m, q]) * abs(h) ** (j + k) * r ** (j + k + 1)
            out[m] += w[m, q] * total
    return out


@kernel(relaxed=True)
def _grid_kernel(
    nodes: Nodes, start: float, step: float, first_task: int, last_task: int, out: NDArray
) -> None:  # pragma: no cover - compiled
    """Blocks of `_ANCHOR` thicknesses of the groups, counted through."""
    a, b, e, c, g, kappa, w = nodes
    count = out.shape[1]
    blocks = (count + _ANCHOR - 1) // _ANCHOR
    for task in range(first_task, last_task):
        m = task // blocks
        first = (task % blocks) * _ANCHOR
        many = min(_ANCHOR, count - first)
        x, y = np.empty(_ANCHOR), np.empty(_ANCHOR)
        total = np.zeros(_ANCHOR)
        for q in range(w.shape[1]):
            kr, ki = kappa[m, q].real, kappa[m, q].imag
            # Powers of the one-step factor by doubling: log2(64) roundings, and a loop that vectorises.
            angle, size = kr * (start + first * step), math.exp(-ki * (start + first * step))
            x[0], y[0] = size * math.cos(angle), size * math.sin(angle)
            filled = 1
            while filled < _ANCHOR:
                shift, decay = kr * step * filled, math.exp(-ki * step * filled)
                fx, fy = decay * math.cos(shift), decay * math.sin(shift)
                for i in range(filled):
                    x[filled + i] = x[i] * fx - y[i] * fy
                    y[filled + i] = x[i] * fy + y[i] * fx
                filled *= 2
            aq, bq, eq, wq = a[m, q], b[m, q], e[m, q], w[m, q]
            cr, ci = 2.0 * c[m, q].real, 2.0 * c[m, q].imag
            gr, gi = g[m, q].real, g[m, q].imag
            if ki == 0.0:
                flat = aq + bq + eq
                for i in range(_ANCHOR):
                    top = flat + cr * x[i] - ci * y[i]
                    u = 1.0 + gr * x[i] - gi * y[i]
                    v = gr * y[i] + gi * x[i]
                    total[i] += wq * top / (u * u + v * v)
            else:
                for i in range(_ANCHOR):
                    power = x[i] * x[i] + y[i] * y[i]
                    top = aq + bq * power + eq * math.sqrt(power) + cr * x[i] - ci * y[i]
                    u = 1.0 + gr * x[i] - gi * y[i]
                    v = gr * y[i] + gi * x[i]
                    total[i] += wq * top / (u * u + v * v)
        for i in range(many):
            out[m, first + i] = total[i]
