"""The fringe order of every cell of a sensor, decided together.

A cell knows its thickness modulo one order well (a few per cent of an order) even where noise makes the order
itself a guess. So the relative orders of cells come from their phases, and the absolute order of a whole
region from the sum of the evidence of all its cells: the chirp of the fringe over the wavelengths.

1. Every cell is compared with templates over the whole thickness range (`order_evidence`): its phase, and the
   least chi-square within each order.
2. Cells are joined along links, the most reliable first (`solve_orders`). The reliability follows
   Herráez et al. (2002): not the difference of two phases, but what is left of it after the slopes inside the
   cells, so that steep is not mistaken for unreliable. When two regions join,
   their evidence is added at the offset that the link tells.
3. Two regions that are each sure of their absolute order, and disagree with the link between them, stay apart:
   there is a step in the layer.

No cell is first, so the answer does not depend on where one starts.

References
----------
Herráez, Burton, Lalor & Gdeisat 2002, Applied Optics 41, 7437 (phase unwrapping along a path of reliability).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from .cells import Cells, run_threaded
from .newton import gauss_newton
from .templates import FringeTemplates, arc_length_nodes

__all__ = ["OrderEvidence", "OrderSolution", "order_evidence", "refine_cells", "solve_orders"]

_MATH = {"reassoc", "contract", "arcp", "nsz"}
NODES_PER_ORDER = 16
"""Templates in one fringe order: the least chi-square from a parabola is then good to 2e-4 of its swing."""
EVIDENCE_CAP = 30.0
"""Largest chi-square difference that one cell may claim, so that no single cell decides alone."""
SURE = 60.0
"""Chi-square difference between the best and the next order at which a region is sure of its order."""
_POLISHED = 6
"""Best minima of each cell that are refined on the full table before they are compared."""
_POLISH_SHARE = 0.01
"""Minima are refined while they lie within this share of the chi-square of a wrong phase."""
MISFIT = 3.0
"""Cells whose chi-square is this many times the median lose their say on the order."""
_IMPOSSIBLE = 1.0e6
"""Chi-square given to an order outside the thickness range."""


@dataclass(frozen=True, eq=False)
class OrderEvidence:
    """What each cell says about its own thickness.

    Attributes
    ----------
    phase_um : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
        Thickness of the best template moved by whole orders into the first order of the range [µm];
        NaN where a cell has no data.
    slope_y, slope_x : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
        Slope of the thickness inside the cells, mean of 3 by 3 cells; the same for every order [µm/px].
    best_um : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
        Thickness of the best template by itself [µm].
    chi2 : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
        Its chi-square.
    evidence : `numpy.ndarray`, float32, shape ``(ncy, ncx, n_orders)``
        Chi-square of each order ``phase + m * order`` above that of the best, scaled down where the best
        itself fits badly and where the noise of neighbouring cells is correlated; at most `EVIDENCE_CAP`.
    order_um : `float`
        Thickness of one order [µm].
    """

    phase_um: NDArray[np.float32]
    slope_y: NDArray[np.float32]
    slope_x: NDArray[np.float32]
    best_um: NDArray[np.float32]
    chi2: NDArray[np.float32]
    evidence: NDArray[np.float32]
    order_um: float


@dataclass(frozen=True, eq=False)
class OrderSolution:
    """The order of every cell.

    Attributes
    ----------
    thickness_um : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
        ``phase + order * m`` [µm]; NaN where a cell has no data.
    region : `numpy.ndarray`, int32, shape ``(ncy, ncx)``
        Number of the region, 0, 1, ... by size; -1 where a cell has no data.
    region_evidence : `numpy.ndarray`, shape ``(n_regions, n_orders)``
        Summed evidence of each region for shifts of -n ... n orders from the solution; 0 at the solution.
    """

    thickness_um: NDArray[np.float32]
    region: NDArray[np.int32]
    region_evidence: NDArray[np.float32]


def order_evidence(
    cells: Cells,
    templates: FringeTemplates,
    order_um: float,
    *,
    range_um: tuple[float, float],
    temper: float = 1.0,
    threads: int = 2,
) -> OrderEvidence:
    """Compare every cell with templates over the whole range.

    Parameters
    ----------
    cells : `Cells`
        Mean amplitudes.
    templates : `FringeTemplates`
        The model; its grid must contain the range.
    order_um : `float`
        Thickness of one fringe order [µm].
    range_um : `tuple` [`float`, `float`]
        Thicknesses that are possible [µm].
    temper : `float`, optional
        Independent cells per cell: below 1 where the noise of neighbouring cells is correlated.
    threads : `int`, optional
        Number of threads; has no influence on the result.
    """
    low = max(round((range_um[0] - templates.start_um) / templates.step_um), 0)
    high = min(round((range_um[1] - templates.start_um) / templates.step_um), len(templates.response) - 1)
    amplitude = templates.amplitude()[low : high + 1]
    span = (high - low) * templates.step_um
    typical = np.median(cells.weight.reshape(-1, cells.weight.shape[-1]), axis=0)[: templates.n_wavelengths]
    if not np.any(typical > 0):
        typical = np.ones_like(typical)
    rows = arc_length_nodes(amplitude, typical, int(NODES_PER_ORDER * span / order_um) + 2)
    nodes = np.ascontiguousarray(amplitude[rows].T.astype(np.float32))
    place = (templates.start_um + templates.step_um * (low + rows)).astype(np.float64)
    orders = int(np.floor(span / order_um)) + 1
    shape = cells.shape
    phase, slope_y, slope_x, best, chi2 = (np.full(shape, np.nan, np.float32) for _ in range(5))
    table = templates.table()
    grid = (templates.start_um, templates.step_um)
    evidence = np.zeros((*shape, orders), np.float32)

    def work(row: int) -> None:
        _evidence_row(
            cells.value[row], cells.weight[row], cells.rise_y[row], cells.rise_x[row],
            nodes, place, table, *grid, order_um, temper,
            phase[row], slope_y[row], slope_x[row], best[row], chi2[row], evidence[row],
        )  # fmt: skip

    run_threaded(work, shape[0], threads)
    _distrust_misfits(evidence, chi2)
    return OrderEvidence(phase, _smooth(slope_y), _smooth(slope_x), best, chi2, evidence, order_um)


def _distrust_misfits(evidence: NDArray[np.float32], chi2: NDArray[np.float32]) -> None:
    """Take evidence from cells that fit worse than most: what spoils them favours some order by chance.

    Steep cells lose contrast, cells across a step are mixtures, and their neighbours err the same way.
    """
    seen = chi2[np.isfinite(chi2)]
    if seen.size == 0:
        return
    limit = MISFIT * max(float(np.median(seen)), 1.0)
    worse = np.nonzero(chi2 > limit)
    inside = evidence[worse] < _IMPOSSIBLE
    evidence[worse] *= np.where(inside, (limit / chi2[worse])[:, None] ** 2, np.float32(1))


@numba.njit(cache=True, nogil=True, fastmath=_MATH)
def _chi2_line(value, weight, nodes, chi2):  # type: ignore[no-untyped-def]
    count = chi2.shape[0]
    used = 0
    for k in range(count):
        chi2[k] = np.float32(0.0)
    for band in range(nodes.shape[0]):
        y, w = value[band], weight[band]
        if w > 0.0:
            used += 1
            line = nodes[band]
            for k in range(count):
                miss = y - line[k]
                chi2[k] += w * miss * miss
    return used


@numba.njit(cache=True, nogil=True)
def _vertex(place, chi2, k):  # type: ignore[no-untyped-def]
    """Place and value of the least of the parabola through nodes ``k-1, k, k+1``."""
    if k == 0 or k == chi2.shape[0] - 1:
        return place[k], float(chi2[k])
    left, right = place[k] - place[k - 1], place[k + 1] - place[k]
    fall, rise = (chi2[k - 1] - chi2[k]) / left, (chi2[k + 1] - chi2[k]) / right
    curvature = (fall + rise) / (left + right)
    if curvature <= 0.0:
        return place[k], float(chi2[k])
    slope = (rise * left - fall * right) / (left + right)
    move = min(max(-0.5 * slope / curvature, -left), right)
    return place[k] + move, chi2[k] + move * (slope + curvature * move)


@numba.njit(cache=True, nogil=True)
def _minima(place, chi2, marks, where, depth):  # type: ignore[no-untyped-def]
    """Every local least of chi-square; returns how many.

    Nodes alone would not do: where the noise is small, the node next to a false order can lie closer to it
    than any node lies to the true one.
    """
    count = chi2.shape[0]
    for k in range(1, count - 1):
        marks[k] = (chi2[k] <= chi2[k - 1]) & (chi2[k] < chi2[k + 1])
    marks[0] = chi2[0] < chi2[1]
    marks[count - 1] = chi2[count - 1] <= chi2[count - 2]
    number = 0
    words = marks.view(np.uint64)
    for word in range(words.shape[0]):
        if words[word] != 0:  # most groups of eight hold no minimum
            for k in range(8 * word, min(8 * word + 8, count)):
                if marks[k] != 0:
                    where[number], depth[number] = _vertex(place, chi2, k)
                    number += 1
    return number


@numba.njit(cache=True, nogil=True)
def _polish(table, start, step, value, weight, slack, where, depth, number):  # type: ignore[no-untyped-def]
    """Refine the deepest minima on the full table; returns the deepest of them."""
    done = np.zeros(number, np.bool_)
    best = -1
    for _ in range(min(_POLISHED, number)):
        at = -1
        for k in range(number):
            if not done[k] and (at < 0 or depth[k] < depth[at]):
                at = k
        if best >= 0 and depth[at] > depth[best] + slack:
            break
        done[at] = True
        place, _, chi2 = gauss_newton(table, (where[at] - start) / step, value, weight, 3, 0.03 / step)
        where[at] = start + step * place
        depth[at] = max(chi2, 0.0)
        if best < 0 or depth[at] < depth[best]:
            best = at
    return best


@numba.njit(cache=True, nogil=True)
def _project(table, place, rise, weight):  # type: ignore[no-untyped-def]
    """Slope of the thickness that gives a slope of the amplitudes, in steps of the table per pixel."""
    below = min(max(int(place), 0), table.shape[0] - 2)
    gain, information = 0.0, 0.0
    for band in range(rise.shape[0]):
        slope = table[below + 1, band] - table[below, band]
        gain += weight[band] * slope * rise[band]
        information += weight[band] * slope * slope
    return gain / information if information > 0.0 else 0.0


@numba.njit(cache=True, nogil=True)
def _evidence_row(  # type: ignore[no-untyped-def]
    value, weight, rise_y, rise_x, nodes, place, table, start, step, order, temper,
    phase, slope_y, slope_x, best, chi2_out, evidence,
):  # fmt: skip
    count = place.shape[0]
    orders = evidence.shape[1]
    last = place[count - 1] + 0.05 * order
    chi2 = np.empty(count, np.float32)
    marks = np.zeros(8 * ((count + 7) // 8), np.uint8)
    where, depth = np.empty(count, np.float64), np.empty(count, np.float64)
    for c in range(value.shape[0]):
        used = _chi2_line(value[c], weight[c], nodes, chi2)
        if used == 0:
            continue
        number = _minima(place, chi2, marks, where, depth)
        slack = _POLISH_SHARE * np.max(chi2) + EVIDENCE_CAP
        at = _polish(table, start, step, value[c], weight[c], slack, where, depth, number)
        thickness, least = where[at], depth[at]
        first = thickness - np.floor((thickness - place[0]) / order) * order
        scale = temper / max(1.0, least / max(used - 1, 1))
        # A missing minimum means that the neighbours' are better by far, or that the order is out of range.
        for m in range(orders):
            evidence[c, m] = EVIDENCE_CAP if first + m * order <= last else _IMPOSSIBLE
        for k in range(number):
            m = int(np.rint((where[k] - first) / order))
            if 0 <= m < orders and evidence[c, m] < _IMPOSSIBLE:
                evidence[c, m] = min(evidence[c, m], max(scale * (depth[k] - least), 0.0))
        phase[c] = first
        best[c] = thickness
        chi2_out[c] = least
        slope_y[c] = step * _project(table, (thickness - start) / step, rise_y[c], weight[c])
        slope_x[c] = step * _project(table, (thickness - start) / step, rise_x[c], weight[c])


def refine_cells(
    cells: Cells, templates: FringeTemplates, thickness_um: NDArray[np.float32], threads: int = 2
) -> NDArray[np.float32]:
    """Least chi-square of every cell near a given thickness; NaN stays NaN.

    Parameters
    ----------
    cells : `Cells`
        Mean amplitudes.
    templates : `FringeTemplates`
        The model.
    thickness_um : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
        Where to begin [µm].
    threads : `int`, optional
        Number of threads; has no influence on the result.
    """
    table = templates.table()
    out = np.full(cells.shape, np.nan, np.float32)

    def work(row: int) -> None:
        _refine_row(
            cells.value[row], cells.weight[row], table, templates.start_um, templates.step_um,
            thickness_um[row], out[row],
        )  # fmt: skip

    run_threaded(work, cells.shape[0], threads)
    return out


@numba.njit(cache=True, nogil=True)
def _refine_row(value, weight, table, start, step, thickness, out):  # type: ignore[no-untyped-def]
    for c in range(value.shape[0]):
        if np.isfinite(thickness[c]):
            place = min(max((thickness[c] - start) / step, 0.0), table.shape[0] - 1.0)
            place, _, _ = gauss_newton(table, place, value[c], weight[c], 4, 0.03 / step)
            out[c] = start + step * place


def solve_orders(cells: Cells, found: OrderEvidence) -> OrderSolution:
    """Join cells into regions and give each region its absolute order.

    Parameters
    ----------
    cells : `Cells`
        The cells; only their edges are used.
    found : `OrderEvidence`
        From `order_evidence`.

    Returns
    -------
    solution : `OrderSolution`
    """
    ny, nx = found.phase_um.shape
    rise_y = found.slope_y * np.diff(cells.y_edges).astype(np.float32)[:, None]
    rise_x = found.slope_x * np.diff(cells.x_edges).astype(np.float32)[None, :]
    first, second, turn, key = _links(found.phase_um, rise_y, rise_x, found.order_um)
    ranked = np.argsort(key, kind="stable")
    evidence = found.evidence.reshape(ny * nx, -1).copy()
    root, offset = _join(evidence, first[ranked], second[ranked], turn[ranked], SURE)
    valid = np.isfinite(found.phase_um.ravel())
    order = np.argmin(evidence, axis=1)[root] + offset
    thickness = np.where(valid, found.phase_um.ravel() + found.order_um * order, np.nan).astype(np.float32)
    roots, member = np.unique(root[valid], return_inverse=True)
    rank = np.argsort(-np.bincount(member, minlength=len(roots)), kind="stable")
    number = np.empty(len(roots), np.int32)
    number[rank] = np.arange(len(roots))
    region = np.full(ny * nx, -1, np.int32)
    region[valid] = number[member]
    around = _centred(evidence[roots[rank]])
    return OrderSolution(thickness.reshape(ny, nx), region.reshape(ny, nx), around)


def _centred(evidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """Evidence relative to the best order of each region, on shifts ``-(n-1) ... n-1``."""
    count = evidence.shape[1]
    out = np.full((len(evidence), 2 * count - 1), _IMPOSSIBLE, np.float32)
    best = np.argmin(evidence, axis=1)
    for row, at in enumerate(best):
        out[row, count - 1 - at : 2 * count - 1 - at] = evidence[row] - evidence[row, at]
    return out


def _smooth(slope: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean over 3 by 3 cells, leaving out those without a value: a slope inside one cell is noisy."""
    good = np.isfinite(slope)
    total = uniform_filter(np.where(good, slope, 0.0).astype(float), 3, mode="constant")
    share = uniform_filter(good.astype(float), 3, mode="constant")
    return np.where(good, total / np.maximum(share, 1e-9), np.nan).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _wrap(difference, order):  # type: ignore[no-untyped-def]
    return difference - order * np.rint(difference / order)


@numba.njit(cache=True, nogil=True)
def _links(phase, rise_y, rise_x, order):  # type: ignore[no-untyped-def]
    """Pairs of neighbouring cells, the orders between their phases, and how unreliable each pair is.

    The slopes inside the cells foretell the difference; what is left of it, on this link and on the others
    of its two cells, is the unreliability (in 1/4096 of an order).
    """
    ny, nx = phase.shape
    rough, number_of = np.zeros((ny, nx), np.float64), np.zeros((ny, nx), np.int64)
    left = np.full((2, ny, nx), np.nan, np.float64)
    for y in range(ny):
        for x in range(nx):
            for k in range(2):
                yy, xx = (y, x + 1) if k == 0 else (y + 1, x)
                if yy >= ny or xx >= nx:
                    continue
                rise = (
                    0.5 * (rise_x[y, x] + rise_x[yy, xx]) if k == 0 else 0.5 * (rise_y[y, x] + rise_y[yy, xx])
                )
                miss = _wrap(float(phase[yy, xx]) - float(phase[y, x]) - rise, order) / order
                if np.isfinite(miss):
                    left[k, y, x] = miss
                    for v, u in ((y, x), (yy, xx)):
                        rough[v, u] += miss * miss
                        number_of[v, u] += 1
    first, second = np.empty(2 * ny * nx, np.int64), np.empty(2 * ny * nx, np.int64)
    turn, key = np.empty(2 * ny * nx, np.int64), np.empty(2 * ny * nx, np.uint16)
    number = 0
    for y in range(ny):
        for x in range(nx):
            for k in range(2):
                if np.isfinite(left[k, y, x]):
                    yy, xx = (y, x + 1) if k == 0 else (y + 1, x)
                    rise = (
                        0.5 * (rise_x[y, x] + rise_x[yy, xx])
                        if k == 0
                        else 0.5 * (rise_y[y, x] + rise_y[yy, xx])
                    )
                    first[number] = y * nx + x
                    second[number] = yy * nx + xx
                    turn[number] = int(np.rint((float(phase[y, x]) + rise - float(phase[yy, xx])) / order))
                    around = rough[y, x] / number_of[y, x] + rough[yy, xx] / number_of[yy, xx]
                    key[number] = min(int(4096.0 * np.sqrt(left[k, y, x] ** 2 + 0.5 * around)), 65535)
                    number += 1
    return first[:number], second[:number], turn[:number], key[:number]


@numba.njit(cache=True, nogil=True)
def _find(parent, shift, node):  # type: ignore[no-untyped-def]
    """Root of a cell and the order of the cell relative to it; shortens the path."""
    root, total = node, 0
    while parent[root] != root:
        total += shift[root]
        root = parent[root]
    result = total
    while parent[node] != root and parent[node] != node:
        above, own = parent[node], shift[node]
        parent[node] = root
        shift[node] = total
        total -= own
        node = above
    return root, result


@numba.njit(cache=True, nogil=True)
def _gap(evidence):  # type: ignore[no-untyped-def]
    """Best order of a region, and by how much it is better than the next."""
    best = 0
    for m in range(1, evidence.shape[0]):
        if evidence[m] < evidence[best]:
            best = m
    gap = np.inf
    for m in range(evidence.shape[0]):
        if m != best:
            gap = min(gap, evidence[m] - evidence[best])
    return best, gap


@numba.njit(cache=True, nogil=True)
def _join(evidence, first, second, turn, sure):  # type: ignore[no-untyped-def]
    cells, orders = evidence.shape
    parent = np.arange(cells)
    shift = np.zeros(cells, np.int64)
    size = np.ones(cells, np.int64)
    best, gap = np.zeros(cells, np.int64), np.zeros(cells, np.float64)
    for c in range(cells):
        best[c], gap[c] = _gap(evidence[c])
    for link in range(first.shape[0]):
        a, order_a = _find(parent, shift, first[link])
        b, order_b = _find(parent, shift, second[link])
        if a == b:
            continue
        # Equal thickness: phase_1 + (m_a + order_a) * order + rise = phase_2 + (m_b + order_b) * order.
        offset = turn[link] + order_a - order_b  # m_b = m_a + offset
        if size[a] < size[b]:
            a, b, offset = b, a, -offset
        if gap[a] > sure and gap[b] > sure and best[b] != best[a] + offset:
            continue
        for m in range(orders):
            other = m + offset
            evidence[a, m] += evidence[b, other] if 0 <= other < orders else _IMPOSSIBLE
        parent[b] = a
        shift[b] = offset
        size[a] += size[b]
        best[a], gap[a] = _gap(evidence[a])
    for c in range(cells):
        root, total = _find(parent, shift, c)
        parent[c] = root
        shift[c] = total
    return parent, shift
