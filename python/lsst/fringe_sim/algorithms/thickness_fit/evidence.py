"""What each cell says about its own thickness: its phase, and how well each fringe order fits.

A first few cells are compared with templates over the whole thickness range. They show how many orders away
from the best one anything can still compete; the others look no farther than that from the nearest of the
first, unless what they find there fits badly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter

from ...array_types import Float32Array, FloatArray
from ...compiled import kernel, run_threaded, subkernel
from .cells import Cells
from .newton import gauss_newton
from .templates import FlatTemplates, arc_length_nodes

NODES_PER_ORDER = 16
"""Templates in one fringe order: the least chi-square from a parabola is then good to 2e-4 of its swing."""
EVIDENCE_CAP = 30.0
"""Largest chi-square difference that one cell may claim, so that no single cell decides alone."""
MISFIT = 3.0  # Cells whose chi-square is this many times the median lose their say on the order
IMPOSSIBLE = 1.0e6  # Chi-square given to an order outside the thickness range
_POLISHED = 64
"""Most minima of a cell that are refined on the full table before they are compared: few wavelengths have many."""
_POLISH_SHARE = 0.01  # Minima are refined while they lie within this share of the chi-square of a wrong phase
_STRIDE = 4  # One cell in so many, in both directions, is compared with the whole range first
_MARGIN_ORDERS = 3  # Orders that the others look beyond what the first cells showed to be needed


class OrderEvidence(NamedTuple):
    """What each cell says about its own thickness."""

    # thickness of the best template moved by whole orders into the first order of the range [µm]; NaN where a cell
    # has no data, float32, ``(ncy, ncx)``
    phase_um: Float32Array
    # slope_y, slope_x: slope of the thickness inside the cells, mean of 3 by 3 cells; the same for every order
    # [µm/px], float32, ``(ncy, ncx)``
    slope_y: Float32Array
    slope_x: Float32Array
    best_um: Float32Array  # thickness of the best template by itself [µm], float32, ``(ncy, ncx)``
    chi2: Float32Array  # its chi-square, float32, ``(ncy, ncx)``
    # chi-square of each order ``phase + m * order`` above that of the best, scaled down where the best itself fits
    # badly and where the noise of neighbouring cells is correlated; at most `EVIDENCE_CAP`, float32,
    # ``(ncy, ncx, n_orders)``
    evidence: Float32Array
    order_um: float  # thickness of one order [µm]

    def part(self, where: int | tuple[slice, slice]) -> OrderEvidence:
        """Views of some cells."""
        phase, slope_y, slope_x, best, chi2, evidence = (each[where] for each in self[:-1])
        return OrderEvidence(phase, slope_y, slope_x, best, chi2, evidence, self.order_um)


class _Nodes(NamedTuple):
    """Thicknesses at which cells are compared with templates."""

    amplitude: Float32Array  # ``(n_wavelengths, n_nodes)``
    place: FloatArray  # ascending [µm], ``(n_nodes,)``


def order_evidence(
    cells: Cells,
    templates: FlatTemplates,
    order_um: float,
    *,
    range_um: tuple[float, float],
    temper: float = 1.0,
    threads: int = 2,
) -> OrderEvidence:
    """Compare every cell with templates over the whole range."""
    low = max(round((range_um[0] - templates.start_um) / templates.step_um), 0)
    high = min(round((range_um[1] - templates.start_um) / templates.step_um), len(templates.response) - 1)
    amplitude = templates.amplitude()[low : high + 1]
    span = (high - low) * templates.step_um
    typical = np.median(cells.weight.reshape(-1, cells.weight.shape[-1]), axis=0)[: templates.n_wavelengths]
    if not np.any(typical > 0):
        typical = np.ones_like(typical)
    rows = arc_length_nodes(amplitude, typical, int(NODES_PER_ORDER * span / order_um) + 2)
    nodes = _Nodes(
        np.ascontiguousarray(amplitude[rows].T.astype(np.float32)),
        (templates.start_um + templates.step_um * (low + rows)).astype(np.float64),
    )
    orders = int(np.floor(span / order_um)) + 1
    shape = cells.shape
    phase, slope_y, slope_x, best, chi2 = (np.full(shape, np.nan, np.float32) for _ in range(5))
    evidence = np.zeros((*shape, orders), np.float32)
    found = OrderEvidence(phase, slope_y, slope_x, best, chi2, evidence, order_um)
    grid = templates.grid()

    def ask(row: int, step: int, centre: Float32Array, reach: int, limit: float) -> None:
        own, rises = (cells.value[row], cells.weight[row]), (cells.rise_y[row], cells.rise_x[row])
        _evidence_row(*own, rises, nodes, grid, temper, step, centre, reach, limit, found.part(row))

    nowhere = np.full(shape[1], np.nan, np.float32)
    first = range(0, shape[0], _STRIDE)
    run_threaded(lambda item: ask(first[item], _STRIDE, nowhere, orders, np.inf), len(first), threads)
    every = slice(None, None, _STRIDE)
    some = found.part((every, every))
    known = some.best_um
    reach, limit = _needed_reach(some)
    nearest = np.clip((np.arange(shape[1]) + _STRIDE // 2) // _STRIDE, 0, known.shape[1] - 1)

    def follow(row: int) -> None:
        around = known[min((row + _STRIDE // 2) // _STRIDE, len(known) - 1)][nearest]
        ask(row, 1, around, reach, limit)

    run_threaded(follow, shape[0], threads)
    _distrust_misfits(found.evidence, found.chi2)
    return found._replace(slope_y=_smooth(found.slope_y), slope_x=_smooth(found.slope_x))


def _needed_reach(found: OrderEvidence) -> tuple[int, float]:
    """Orders from the best beyond which nothing competes, and the chi-square above which a cell must look again."""
    phase, _, _, best, chi2, evidence, order = found
    seen = np.isfinite(best)
    if not seen.any():
        return evidence.shape[-1], np.inf
    limit = MISFIT * max(float(np.median(chi2[seen])), 1.0)
    sound = seen & (chi2 <= limit)  # the others look everywhere anyway
    own = np.rint((best[sound] - phase[sound]) / order)
    away = np.abs(np.arange(evidence.shape[-1]) - own[:, None])
    farthest = np.where(evidence[sound] < EVIDENCE_CAP, away, 0).max(axis=1)
    return int(np.percentile(farthest, 99.9)) + _MARGIN_ORDERS, limit


def _distrust_misfits(evidence: Float32Array, chi2: Float32Array) -> None:
    """Take evidence from cells that fit worse than most: what spoils them favours some order by chance.

    Steep cells lose contrast, cells across a step are mixtures, and their neighbours err the same way.
    """
    seen = chi2[np.isfinite(chi2)]
    if seen.size == 0:
        return
    limit = MISFIT * max(float(np.median(seen)), 1.0)
    worse = np.nonzero(chi2 > limit)
    inside = evidence[worse] < IMPOSSIBLE
    evidence[worse] *= np.where(inside, (limit / chi2[worse])[:, None] ** 2, np.float32(1))


@subkernel(relaxed=True)
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


@subkernel
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


@subkernel
def _minima(place, chi2, marks, where, depth):  # type: ignore[no-untyped-def]
    """Every local least of chi-square; returns how many.

    Nodes alone would not do: where the noise is small, the node next to a false order can lie closer to it
    than any node lies to the true one.
    """
    count = chi2.shape[0]
    full = 8 * ((count + 7) // 8)
    for k in range(count - 1, full):
        marks[k] = np.uint8(0)
    for k in range(1, count - 1):
        marks[k] = (chi2[k] <= chi2[k - 1]) & (chi2[k] < chi2[k + 1])
    marks[0] = chi2[0] < chi2[1]
    marks[count - 1] = chi2[count - 1] <= chi2[count - 2]
    number = np.int64(0)
    words = marks[:full].view(np.uint64)
    for word in range(words.shape[0]):
        if words[word] != 0:  # most groups of eight hold no minimum
            for k in range(8 * word, min(8 * word + 8, count)):
                if marks[k] != 0:
                    where[number], depth[number] = _vertex(place, chi2, k)
                    number += 1
    return number


@subkernel
def _polish(grid, value, weight, item, slack, where, depth, number):  # type: ignore[no-untyped-def]
    """Refine the deepest minima on the full table; returns the deepest of them."""
    table, start, step = grid
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
        place, _, chi2 = gauss_newton(
            table, (where[at] - start) / step, value, weight, item, np.int64(3), 0.03 / step
        )
        where[at] = start + step * place
        depth[at] = max(chi2, 0.0)
        if best < 0 or depth[at] < depth[best]:
            best = at
    return best


@subkernel
def _project(table, place, rise, weight, item):  # type: ignore[no-untyped-def]
    """Slope of the thickness that gives a slope of the amplitudes, in steps of the table per pixel."""
    below = min(max(int(place), 0), table.shape[0] - 2)
    gain, information = 0.0, 0.0
    for band in range(table.shape[1]):
        slope = table[below + 1, band] - table[below, band]
        gain += weight[item, band] * slope * rise[item, band]
        information += weight[item, band] * slope * slope
    return gain / information if information > 0.0 else 0.0


@subkernel
def _search(value, weight, item, nodes, grid, low, high, chi2, marks, where, depth):  # type: ignore[no-untyped-def]
    """Minima between two nodes; returns the wavelengths used, the number of minima and the deepest of them."""
    part = chi2[: high - low]
    used = _chi2_line(value[item], weight[item], nodes.amplitude[:, low:high], part)
    if used == 0:
        return 0, 0, -1
    number = _minima(nodes.place[low:high], part, marks, where, depth)
    swing = 0.0
    for k in range(0, high - low, 4):
        swing = max(swing, part[k])
    at = _polish(grid, value, weight, item, _POLISH_SHARE * swing + EVIDENCE_CAP, where, depth, number)
    return used, number, at


@subkernel
def _first_from(place, least):  # type: ignore[no-untyped-def]
    """Number of the first of ascending places that is not below a number."""
    low, high = np.int64(0), np.int64(place.shape[0])
    while low < high:
        middle = (low + high) // 2
        if place[middle] < least:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def _evidence_row(value, weight, rises, nodes, grid, temper, stride, centre, reach, limit, found):  # type: ignore[no-untyped-def]
    """Ask every ``stride``-th cell of a row that has not been asked.

    Where ``centre`` is a number, a cell looks no farther than ``reach`` orders from it, unless its chi-square
    there is above ``limit`` or its best order is the last it looked at.
    """
    place, (table, start, step) = nodes.place, grid
    phase, slope_y, slope_x, best, chi2_out, evidence, order = found
    count = place.shape[0]
    orders = evidence.shape[1]
    last = place[count - 1] + 0.05 * order
    chi2 = np.empty(count, np.float32)
    marks = np.zeros(8 * ((count + 7) // 8), np.uint8)
    where, depth = np.empty(count, np.float64), np.empty(count, np.float64)
    for c in range(0, value.shape[0], stride):
        if np.isfinite(best[c]):
            continue
        low, high = np.int64(0), np.int64(count)
        if np.isfinite(centre[c]):
            low = _first_from(place, centre[c] - (reach + 0.5) * order)
            high = max(_first_from(place, centre[c] + (reach + 0.5) * order), low + 2)
            low = max(min(low, count - 2), 0)  # type: ignore[arg-type]
            high = min(high, count)
        while True:  # of one call the code is there once
            used, number, at = _search(value, weight, c, nodes, grid, low, high, chi2, marks, where, depth)
            if used == 0 or high - low == count:
                break
            near_end = min(where[at] - place[low], place[high - 1] - where[at]) < order
            if not (near_end or depth[at] > limit):
                break
            low, high = np.int64(0), np.int64(count)
        if used == 0:
            continue
        thickness, least = where[at], depth[at]
        first = thickness - np.floor((thickness - place[0]) / order) * order
        scale = temper / max(1.0, least / max(used - 1, 1))
        # A missing minimum means that the neighbours' are better by far, or that the order is out of range.
        for m in range(orders):
            evidence[c, m] = EVIDENCE_CAP if first + m * order <= last else IMPOSSIBLE
        for k in range(number):
            m = int(np.rint((where[k] - first) / order))
            if 0 <= m < orders and evidence[c, m] < IMPOSSIBLE:
                evidence[c, m] = min(evidence[c, m], max(scale * (depth[k] - least), 0.0))
        phase[c] = first
        best[c] = thickness
        chi2_out[c] = least
        slope_y[c] = step * _project(table, (thickness - start) / step, rises[0], weight, c)
        slope_x[c] = step * _project(table, (thickness - start) / step, rises[1], weight, c)


def _smooth(slope: Float32Array) -> Float32Array:
    """Mean over 3 by 3 cells, leaving out those without a value: a slope inside one cell is noisy."""
    good = np.isfinite(slope)
    total = uniform_filter(np.where(good, slope, 0.0).astype(float), 3, mode="constant")
    share = uniform_filter(good.astype(float), 3, mode="constant")
    return np.where(good, total / np.maximum(share, 1e-9), np.nan).astype(np.float32)


def refine_cells(
    cells: Cells, templates: FlatTemplates, thickness_um: Float32Array, threads: int = 2
) -> Float32Array:
    """Least chi-square of every cell near a given thickness; NaN stays NaN.

    ``thickness_um``: where to begin [µm], float32, ``(ncy, ncx)``.
    """
    grid = templates.grid()
    out = np.full(cells.shape, np.nan, np.float32)
    start = np.ascontiguousarray(thickness_um, np.float32)

    def work(row: int) -> None:
        refine_row(cells.value[row], cells.weight[row], *grid, start[row], out[row])

    run_threaded(work, cells.shape[0], threads)
    return out


@kernel
def refine_row(value, weight, table, start, step, thickness, out):  # type: ignore[no-untyped-def]
    """Least chi-square of every cell of a row near its thickness."""
    for c in range(value.shape[0]):
        if np.isfinite(thickness[c]):
            place = min(max((thickness[c] - start) / step, 0.0), table.shape[0] - 1.0)
            place, _, _ = gauss_newton(table, place, value, weight, c, np.int64(4), 0.03 / step)
            out[c] = start + step * place
