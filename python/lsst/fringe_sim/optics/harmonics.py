"""The closed form of one layer as a short harmonic series, and its fast sum over many nodes.

With ``h = -g`` the closed form of `PhaseResponse` is a power series in ``z = exp(i kappa d)``::

    A(d) = sum_jk C_jk z^j conj(z)^k ,   C_jk = a T_jk + b T_(j-1)(k-1) + c T_(j-1)k + conj(c) T_j(k-1)

with ``T_jk = h^j conj(h)^k`` (and ``e T_jk |z|`` besides). Every term is ``exp(lambda d)`` with
``lambda = i (j-k) Re kappa - (j+k) Im kappa``. Three things follow.

* A Gaussian spread of the thickness inside a pixel multiplies a term by ``exp(lambda² sigma² / 2)``: exact.
* In a transparent layer only ``m = j - k`` matters, ``A = C_0 + 2 Re sum_m C_m z^m`` with
  ``C_m = h^(m-1) (s h + c + conj(c) h²) / (1 - |h|²)`` and ``s = a + b + e``. The series falls like ``|h|^m``.
* The mean over any number of wavelengths, angles, polarisations and phases is a sum of exponentials on a uniform
  grid of thickness: a non-uniform Fourier transform, whose cost does not depend on (nodes × grid points). It is
  done by Gaussian gridding (Greengard & Lee 2004, SIAM Review 46, 443) with 14 points on either side and twofold
  oversampling, error ``exp(-pi 14 (2/3)) = 2e-13`` of the fringe. In an absorbing layer the slow factor
  ``exp(-p Im kappa d)`` is expanded in powers of the distance from the middle of a segment.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..array_types import FloatArray
from ..compiled import contiguous, kernel, processors, run_shares, run_threaded, subkernel

ROUNDING = 2e-13  # Error of the sum on a grid that is not told to be less exact, relative to the fringes
COARSEST = 1e-3  # Largest error that makes sense
_SMALLEST = 1e-17  # Terms below this are left out; the response is of order one
_LEFT_OUT = 0.01  # Terms that a tolerance allows to leave out, per tolerance: they fall geometrically

_MOST_TERMS = 600

_CACHED = 131_072  # Complex numbers that the second-level cache of a processor holds
MOST_RATIO = 0.94  # Largest ``|g|`` whose harmonics fall below rounding within the terms that are summed
_PIECES = 4  # Shares of the nodes of a single group, which cores take in turn
_LEAST_PIECE = 4096  # Nodes of a share that are worth a grid of their own
_LEAST_SUMS = 2_000  # Nodes times thicknesses that are worth a thread
_POWERS = 12  # Powers of the slow factor ``exp(-p Im kappa d)`` in one segment of an absorbing layer

_SLOW_RANGE = 0.067
"""Largest ``Im kappa`` times half length of a segment, per ``-ln |h|``.

The first neglected power is ``|h|^p (p x)^12 / 12!``, at most ``(12 x / (-e ln|h|))^12 / 12! = 1e-15``.
"""


def series_on_grid(
    coefficients: tuple[np.ndarray, ...],
    weight: FloatArray,
    spread_um: float,
    start_um: float,
    step_um: float,
    count: int,
    order: int = 0,
    tolerance: float = ROUNDING,
) -> FloatArray:
    """Weighted mean of the closed form, or a thickness derivative of it, on a uniform grid.

    ``coefficients`` (W, Q): ``a, b, e, c, g, kappa`` of the nodes of W groups. ``weight`` (W, Q).
    ``spread_um``: rms spread of the thickness inside a pixel. ``start_um``, ``step_um``, ``count``: the grid
    [µm]. ``tolerance``: error allowed, relative to the fringes; the sum takes half the time at 1e-9. Returns
    (W, count).
    """
    if len(weight) == 1 and weight.size >= _PIECES * _LEAST_PIECE:
        # Shares of the nodes for all cores; as many on any machine, so that rounding is the same.
        spare = -weight.size % _PIECES
        *parts, part_weight = (
            np.pad(each, ((0, 0), (0, spare)), mode="edge").reshape(_PIECES, -1)
            for each in (*coefficients, weight)
        )
        part_weight[-1, part_weight.shape[1] - spare :] = 0.0
        whole = (spread_um, start_um, step_um, count, order, tolerance)
        return np.asarray(series_on_grid(tuple(parts), part_weight, *whole).sum(axis=0, keepdims=True))
    rule = _Gridding.of(tolerance)
    slow = float(np.max(coefficients[-1].imag))
    if slow == 0.0:
        return _segment(rule, (*coefficients, weight), spread_um, (start_um, step_um, count), order, 1)
    decay = -math.log(min(max(float(np.abs(coefficients[4]).max()), 0.1), MOST_RATIO))
    pieces = max(1, math.ceil(0.5 * slow * abs(step_um) * count / (_SLOW_RANGE * decay)))
    edges = np.linspace(0, count, pieces + 1).astype(int)
    grids = [(start_um + step_um * low, step_um, high - low) for low, high in itertools.pairwise(edges)]
    parts = [
        _segment(rule, (*coefficients, weight), spread_um, grid, order, _POWERS)
        for grid in grids
        if grid[2] > 0
    ]
    return np.concatenate(parts, axis=1)


class _Gridding(NamedTuple):
    """Points of the frequency grid on either side of a harmonic, their Gaussian, and the terms left out."""

    reach: int
    width: float
    smallest: float

    @classmethod
    def of(cls, tolerance: float) -> _Gridding:
        """The rule whose error is at most a tolerance, for twofold oversampling."""
        error = min(max(tolerance, ROUNDING), COARSEST)
        reach = math.ceil(-1.5 * math.log(error) / math.pi)
        return cls(reach, 2.0 * reach / (4.0 * math.pi * 1.5), max(_SMALLEST, _LEFT_OUT * (error - ROUNDING)))


def _segment(
    rule: _Gridding,
    nodes: tuple[np.ndarray, ...],
    spread_um: float,
    grid_um: tuple[float, float, int],
    order: int,
    powers: int,
) -> FloatArray:
    """The sum on one segment; ``nodes`` are coefficients and weight, ``grid_um`` its start, step and number."""
    start_um, step_um, count = grid_um
    middle = count // 2
    size = scipy.fft.next_fast_len(max(2 * count, 4 * rule.reach))
    offset = np.arange(count) - middle
    window = (
        math.sqrt(4.0 * math.pi * rule.width)
        * np.exp(-rule.width * (2.0 * math.pi * offset / size) ** 2)
        / size
    )
    out = np.empty((len(nodes[0]), count))
    # Few groups at a time: their grids then stay in the cache of the processor.
    many = max(1, min(len(out), _CACHED // (powers * size)))
    grid, fringe = np.empty((many, powers, size), dtype=complex), np.empty((powers, count))
    constant = np.empty((many, powers))
    for first in range(0, len(out), many):
        part = slice(first, first + many)
        groups = len(out[part])
        own = tuple(each[part] for each in nodes)
        _fill_grids(rule, own, spread_um, start_um + step_um * middle, step_um, order, grid, constant)
        wave = scipy.fft.ifft(grid[:groups], axis=-1, workers=processors())
        for group in range(groups):
            fringe[:, middle:] = wave[group, :, : count - middle].real
            fringe[:, :middle] = wave[group, :, size - middle :].real
            fringe /= window
            fringe += constant[group, :, None]
            out[first + group] = fringe[0]
            for power in range(1, powers):
                out[first + group] += fringe[power] * (step_um * offset) ** power
    return out


@subkernel
def _harmonic(
    m: int,
    a: float,
    b: float,
    e: float,
    c: complex,
    h: complex,
    kappa: complex,
    spread: float,
    where: float,
    order: int,
    out: NDArray,
) -> float:  # pragma: no cover - compiled
    """Harmonic ``m`` at thickness ``where``, and its slow factor as powers of the distance; returns a size."""
    kr, ki = kappa.real, kappa.imag
    out[:] = 0.0
    if ki == 0.0:
        norm = 1.0 / (1.0 - abs(h) ** 2)
        s = a + b + e
        if m == 0:
            value = complex(norm * (s + 2.0 * (c.conjugate() * h).real))
        else:
            value = norm * h ** (m - 1) * (s * h + c + c.conjugate() * h * h)
        rate = 1j * m * kr
        value *= math.exp(-0.5 * (m * kr * spread) ** 2)
        if order > 0:
            value *= rate**order
        out[0] = value * np.exp(rate * where)
        return abs(value)
    # C_(m+k)k falls by |h|² from one k to the next, after the first.
    powers = len(out)
    ratio = h.real * h.real + h.imag * h.imag
    hm = h**m
    before = h ** (m - 1) if m > 0 else 0j
    follow = (
        a * hm * ratio + b * hm + c * (before * ratio if m > 0 else h.conjugate()) + c.conjugate() * h * hm
    )
    first, odd = a * hm + c * before, e * hm
    # exp(lambda d + (lambda sigma)²/2) for p = m, m + 1, ...: one factor per step and a Gaussian in p.
    wide, slow = (kr * spread) ** 2, (ki * spread) ** 2
    turn = np.exp(complex(-ki * where, -m * kr * ki * spread * spread))
    carry = np.exp(
        complex(-m * ki * where - 0.5 * m * m * wide, m * kr * where - m * m * kr * ki * spread * spread)
    )
    largest = 0.0
    for k in range(_MOST_TERMS):
        bound = 0.0
        for half in range(2):
            p = m + 2 * k + half
            value = odd if half == 1 else (first if k == 0 else follow)
            value *= carry * math.exp(0.5 * p * p * slow)
            if order > 0:
                value *= complex(-p * ki, m * kr) ** order
            bound += abs(value)
            for power in range(powers):
                out[power] += value
                value *= -p * ki / (power + 1)
            carry *= turn
        if k > 0:
            follow *= ratio
        odd *= ratio
        largest = max(largest, bound)
        # Terms of one harmonic fall geometrically (the first may vanish by symmetry).
        if k >= 2 and bound < _SMALLEST:
            break
    return largest


def _fill_grids(
    rule: _Gridding,
    nodes: tuple[NDArray, ...],
    spread: float,
    where: float,
    step: float,
    order: int,
    grid: NDArray,
    constant: NDArray,
) -> None:
    """Harmonics of the nodes of each group on its frequency grid, and the constant terms."""
    reach, width, smallest = rule
    shape = np.exp(-((np.arange(2 * reach) - (reach - 1.0)) ** 2) / (4.0 * width))
    nodes = tuple(contiguous(each) for each in nodes)
    transparent = not nodes[5].imag.any()
    grid[: len(nodes[0])] = 0.0
    constant[: len(nodes[0])] = 0.0

    def work(group: int) -> None:
        own = tuple(each[group] for each in nodes)
        if transparent:
            sign = complex(1j**order)
            _grid_transparent(
                own, shape, width, smallest, spread, where, step, order, sign, grid[group, 0], constant[group]
            )
        else:
            _grid_absorbing(
                own, shape, width, smallest, spread, where, step, order, grid[group], constant[group]
            )

    run_threaded(work, len(nodes[0]))


@kernel
def _grid_transparent(  # type: ignore[no-untyped-def]
    nodes, shape, width, smallest, spread, where, step, order, sign, grid, constant
):  # pragma: no cover - compiled
    """One group of a transparent layer: harmonics by multiplication, as many roundings as there are harmonics."""
    a, b, e, c, g, kappa, w = nodes
    window = np.empty(shape.size, dtype=np.float64)
    total = 0.0
    for q in range(w.size):
        total += abs(w[q])
    for q in range(w.size):
        if w[q] == 0.0:
            continue
        h, kr = -g[q], kappa[q].real
        least = smallest * total / (w.size * abs(w[q]))  # what has little weight needs few terms
        s = a[q] + b[q] + e[q]
        turn = complex(math.cos(kr * where), math.sin(kr * where))
        norm = 1.0 / (1.0 - abs(h) ** 2)
        if order == 0:
            constant[0] += w[q] * norm * (s + 2.0 * (c[q].conjugate() * h).real)
        follow = (s * h + c[q] + c[q].conjugate() * h * h) * turn * norm
        for m in range(1, _MOST_TERMS):
            value = follow * sign
            if spread > 0.0:
                value *= math.exp(-0.5 * (m * kr * spread) ** 2)
            if order > 0:
                value *= (m * kr) ** order
            amount = abs(value)
            low = _spread_harmonic(m * kr * step, 2.0 * w[q], grid.size, shape, width, window)
            _add_harmonic(value, low, window, grid)
            if m >= 2 and amount < least * (m * kr) ** order:
                break
            follow *= h * turn


@kernel
def _grid_absorbing(  # type: ignore[no-untyped-def]
    nodes, shape, width, smallest, spread, where, step, order, grid, constant
):  # pragma: no cover - compiled
    """One group of an absorbing layer; some of its nodes may be transparent."""
    a, b, e, c, g, kappa, w = nodes
    powers, size = grid.shape
    harmonic = np.empty(powers, dtype=np.complex128)
    window = np.empty(shape.size, dtype=np.float64)
    total = 0.0
    for q in range(w.size):
        total += abs(w[q])
    for q in range(w.size):
        if w[q] == 0.0:
            continue
        least = smallest * total / (w.size * abs(w[q]))
        for m in range(_MOST_TERMS):
            amount = _harmonic(
                m, a[q], b[q], e[q], c[q], -g[q], kappa[q], spread, where, order, harmonic
            )  # fmt: skip
            if m == 0:
                for power in range(powers):
                    constant[power] += w[q] * harmonic[power].real
                continue
            low = _spread_harmonic(m * kappa[q].real * step, 2.0 * w[q], size, shape, width, window)
            for power in range(powers):
                _add_harmonic(harmonic[power], low, window, grid[power])
            if m >= 2 and amount < least * (m * abs(kappa[q])) ** order:
                break


@subkernel
def _spread_harmonic(phase, weight, size, shape, width, window):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Gaussian of a harmonic over the points of the grid around it; returns the first of them."""
    turns = phase / (2.0 * math.pi)
    position = (turns - math.floor(turns)) * size
    first = int(position)
    rest = position - first
    reach = shape.size // 2
    # exp(-(l - rest)²/4w) = exp(-rest²/4w) exp(rest/2w)^l exp(-l²/4w), from l = 1 - reach
    ratio = math.exp(rest / (2.0 * width))
    factor = weight * math.exp(-rest * (rest - 2.0 * (1 - reach)) / (4.0 * width))
    for i in range(shape.size):
        window[i] = factor * shape[i]
        factor *= ratio
    return first + 1 - reach


@subkernel
def _add_harmonic(value, low, window, grid):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Add a harmonic to the grid, which goes on at its other end."""
    size = grid.size
    if low >= 0 and low + window.size <= size:
        for i in range(window.size):
            grid[low + i] += value * window[i]
    else:
        for i in range(window.size):
            grid[(low + i) % size] += value * window[i]


@subkernel
def _transparent_sum(
    s: float, c: complex, h: complex, kr: float, spread: float, where: float
) -> float:  # pragma: no cover - compiled
    """Sum of all harmonics of one node in a transparent layer, by multiplication."""
    norm = 1.0 / (1.0 - abs(h) ** 2)
    turn = h * np.exp(1j * kr * where)
    value = norm * (s * h + c + c.conjugate() * h * h) * np.exp(1j * kr * where)
    total = norm * (s + 2.0 * (c.conjugate() * h).real)
    # exp(-(m sigma)²/2) from one m to the next
    damping = math.exp(-0.5 * (kr * spread) ** 2)
    further, square = damping**3, damping**2
    for m in range(1, _MOST_TERMS):
        term = value * damping
        total += 2.0 * term.real
        if m >= 2 and abs(term) < _SMALLEST:
            break
        value *= turn
        damping *= further
        further *= square
    return total


def series_at(nodes: tuple[NDArray, ...], spread: float, thickness: NDArray) -> NDArray:
    """Weighted mean at any thickness; shapes ``(W, Q)``, ``(N,)`` -> ``(W, N)``."""
    nodes = tuple(contiguous(each) for each in nodes)
    out = np.zeros((len(nodes[-1]), thickness.size))

    def work(first: int, last: int) -> None:
        _series_kernel(nodes, spread, thickness, first, last, out)

    run_shares(work, thickness.size, _LEAST_SUMS // nodes[-1].size)
    return out


@kernel
def _series_kernel(  # type: ignore[no-untyped-def]
    nodes, spread, thickness, first, last, out
):  # pragma: no cover - compiled
    a, b, e, c, g, kappa, w = nodes
    groups, many = w.shape
    for i in range(first, last):
        harmonic = np.empty(1, dtype=np.complex128)
        for group in range(groups):
            total = 0.0
            for q in range(many):
                if kappa[group, q].imag == 0.0:
                    total += w[group, q] * _transparent_sum(
                        a[group, q] + b[group, q] + e[group, q], c[group, q], -g[group, q],
                        abs(kappa[group, q]), spread, thickness[i],
                    )  # fmt: skip
                    continue
                for m in range(_MOST_TERMS):
                    amount = _harmonic(
                        m, a[group, q], b[group, q], e[group, q], c[group, q], -g[group, q], kappa[group, q],
                        spread, thickness[i], 0, harmonic,
                    )  # fmt: skip
                    total += (1.0 if m == 0 else 2.0) * w[group, q] * harmonic[0].real
                    if m >= 2 and amount < _SMALLEST:
                        break
            out[group, i] = total
