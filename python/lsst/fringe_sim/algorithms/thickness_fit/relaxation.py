"""Second thoughts about the orders of cells: lone cells, steps that phases cannot show, and how sure each is.

Joining cells by their phases has two blind spots. Noise can put a single cell on a phase that is no whole order
away from its neighbours (`join_neighbours`); and a step in the layer of exactly one or more orders leaves no mark on
the phases at all. Here every cell is asked again, with the templates as they are normalised by now, what chi-square
it has a few orders above and below its thickness; blocks of cells, from large to small, move to the order that costs
least, where the cost is the chi-square of their cells and a price for each break along their border.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...compiled import kernel, run_threaded, subkernel
from .between_orders import Rises, break_price, join_neighbours, rise_to_neighbour
from .cells import Cells, cell_independence, effective_number
from .evidence import EVIDENCE_CAP, IMPOSSIBLE, OrderEvidence
from .lone_surfaces import settle_lone_surfaces
from .misfit import Misfit, degrees_of_freedom, improbability, judge_cells
from .newton import gauss_newton
from .pixels import SAME_SURFACE
from .templates import FlatTemplates

SHIFTS = 3  # Orders above and below that are tried in one round
_LARGEST_MENDED = 400  # Largest surface, in cells, that is moved onto the one around it, whatever the jump
_MOST_JUDGED = 20_000  # Cells that show how far all are off
_LARGEST_BLOCK = 64
_BOLD_BLOCK = 8
_SWEEPS = 3
_MOST_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class SettledCells:
    """Cells with their final order."""

    # thickness of each cell [µm]; NaN where a cell has no data, float32, ``(ncy, ncx)``
    thickness_um: NDArray[np.float32]
    # number of the connected surface each cell lies on, 0, 1, ... by size; -1 where a cell has no data, int32,
    # ``(ncy, ncx)``
    segment: NDArray[np.int32]
    segment_slip: NDArray[
        np.float64
    ]  # probability that a whole surface has the wrong order, ``(n_segments,)``
    # probability that a cell has another order than its surface suggests, float32, ``(ncy, ncx)``
    cell_slip: NDArray[np.float32]


def settle_orders(
    cells: Cells,
    templates: FlatTemplates,
    thickness_um: NDArray[np.float32],
    slope_y: NDArray[np.float32],
    slope_x: NDArray[np.float32],
    order_um: float,
    found: OrderEvidence,
    *,
    range_um: tuple[float, float],
    temper: float = 1.0,
    correlation_px: float = 0.0,
    threads: int = 2,
) -> SettledCells:
    """Revise the orders of all cells.

    ``thickness_um``: thickness so far [µm]; NaN where a cell has no data, float32, ``(ncy, ncx)``;
    ``slope_y, slope_x``: slopes of the thickness [µm/px], float32, ``(ncy, ncx)``; ``order_um``: thickness of one
    fringe order [µm]; ``range_um``: thicknesses that are possible [µm]; ``temper``: independent cells per cell, as
    for `order_evidence`; ``correlation_px``: standard deviation of the kernel that correlates the noise [px].
    """
    thickness = thickness_um.copy()
    rise_y = slope_y * np.diff(cells.y_edges).astype(np.float32)[:, None]
    rise_x = slope_x * np.diff(cells.x_edges).astype(np.float32)[None, :]
    table = templates.table()
    grid = (templates.start_um, templates.step_um)
    misfit, _ = _judge_cells(cells, templates, thickness, order_um)
    thickness = join_neighbours(
        cells, templates, thickness, Rises(rise_y, rise_x), order_um,
        range_um=range_um, temper=temper, misfit=misfit, threads=threads,
    )  # fmt: skip
    misfit, alike = _judge_cells(cells, templates, thickness, order_um)
    shifted = np.zeros((*thickness.shape, 2 * SHIFTS + 1), np.float32)
    cost = np.zeros_like(shifted)

    def ask(row: int) -> None:
        _ask_row(
            cells.value[row], cells.weight[row], table, *grid, thickness[row], order_um, *range_um, temper,
            misfit.scale, misfit.tail, shifted[row], cost[row],
        )  # fmt: skip

    for _ in range(_MOST_ROUNDS):
        run_threaded(ask, thickness.shape[0], threads)
        label = np.zeros(thickness.shape, np.int64)
        size = _LARGEST_BLOCK
        while size >= 1:
            if size < max(thickness.shape):
                for _ in range(_SWEEPS):
                    if _relax(cost, shifted, label, rise_y, rise_x, order_um, size) == 0:
                        break
            size //= 2
        thickness = np.take_along_axis(shifted, (label + SHIFTS)[..., None], axis=2)[..., 0]
        if not np.any(label):
            break
    segment = _segments(thickness, rise_y, rise_x, order_um)
    price = _segment_prices(cost, shifted, label, segment, rise_y, rise_x, order_um)
    better = np.argmin(price, axis=1) - SHIFTS
    if np.any(better):
        # Whole surfaces move last: blocks of cells had not found their shape.
        label += np.append(better, 0)[segment]
        thickness = np.take_along_axis(shifted, (label + SHIFTS)[..., None], axis=2)[..., 0]
        segment = _segments(thickness, rise_y, rise_x, order_um)
        price = _segment_prices(cost, shifted, label, segment, rise_y, rise_x, order_um)
    share = _small_surfaces(segment, cells, correlation_px) / _alike(segment, alike)
    excess = share[:, None] * (price - price[:, SHIFTS : SHIFTS + 1])
    odds = np.exp(-0.5 * excess.clip(-200.0, 2000.0)).sum(axis=1)
    segment_slip = 1.0 - 1.0 / (odds + _far_odds(found, thickness, segment, share))
    lone = settle_lone_surfaces(
        cells, templates, thickness, segment, share, order_um,
        range_um=range_um, temper=temper, most_cells=_LARGEST_MENDED, threads=threads,
    )  # fmt: skip
    thickness = lone.thickness_um
    segment_slip[lone.surface] = lone.slip
    cell_slip = np.zeros(thickness.shape, np.float32)
    run_threaded(
        lambda row: _cell_slip(cost, shifted, label, rise_y, rise_x, order_um, row, cell_slip[row]),
        len(cell_slip),
        threads,
    )
    return SettledCells(thickness, segment, segment_slip, cell_slip)


def _judge_cells(
    cells: Cells, templates: FlatTemplates, thickness: NDArray[np.float32], order: float
) -> tuple[Misfit, NDArray[np.float64]]:
    """How far cells are off beyond their noise, and how far sums over 1, 2, 4, ... of them err alike."""
    # Whole rows, in which neighbours stay beside each other.
    some = slice(None, None, 1 + thickness.size // _MOST_JUDGED)
    known = np.isfinite(thickness[some])
    value, weight = (part[some][known] for part in (cells.value, cells.weight))
    return judge_cells(value, weight, templates, thickness[some][known], order)


@kernel
def _surfaces(thickness, rise_y, rise_x, limit):  # type: ignore[no-untyped-def]
    """Number of the connected surface each cell lies on, in the order of their first cells; -1 without data."""
    ny, nx = thickness.shape
    parent = np.arange(ny * nx)
    for y in range(ny):
        for x in range(nx):
            for side in range(2):
                b, a = (y - 1, x) if side == 0 else (y, x - 1)
                if b < 0 or a < 0:
                    continue
                rise = rise_to_neighbour(rise_y, rise_x, y, x, b, a)
                if abs(thickness[b, a] - thickness[y, x] - rise) < limit:
                    first, second = _top(parent, y * nx + x), _top(parent, b * nx + a)
                    parent[max(first, second)] = min(first, second)
    number = np.full(ny * nx, -1, np.int64)
    count = 0
    for cell in range(ny * nx):
        if np.isfinite(thickness[cell // nx, cell % nx]):
            root = _top(parent, cell)
            if root == cell:
                number[cell] = count
                count += 1
            else:
                number[cell] = number[root]
    return number.reshape(ny, nx), count


@subkernel
def _top(parent, cell):  # type: ignore[no-untyped-def]
    while parent[cell] != cell:
        parent[cell] = parent[parent[cell]]
        cell = parent[cell]
    return cell


@kernel
def _ask_row(  # type: ignore[no-untyped-def]
    value, weight, table, start, step, thickness, order, low, high, temper, scale, tail, shifted, cost
):
    """Improbability of each cell at whole orders around its thickness, above the least of them."""
    top = table.shape[0] - 1.0
    shifts = shifted.shape[1]
    for c in range(value.shape[0]):
        for k in range(shifts):
            shifted[c, k] = thickness[c]
            cost[c, k] = 0.0
        if not np.isfinite(thickness[c]):
            continue
        least = np.inf
        freedom = degrees_of_freedom(weight, c)
        for k in range(shifts):
            at = thickness[c] + (k - shifts // 2) * order
            if at < low - 0.05 * order or at > high + 0.05 * order:
                shifted[c, k] = at
                cost[c, k] = np.inf
                continue
            place = min(max((at - start) / step, 0.0), top)
            place, _, chi2 = gauss_newton(table, place, value, weight, c, np.int64(3), 0.03 / step)
            found = start + step * place
            # What ran away has no minimum there.
            shifted[c, k] = found if abs(found - at) < SAME_SURFACE * order else at
            cost[c, k] = temper * improbability(chi2, freedom, scale, tail)
            least = min(least, cost[c, k])
        for k in range(shifts):
            if np.isfinite(cost[c, k]):
                cost[c, k] = min(cost[c, k] - least, EVIDENCE_CAP)
            else:
                cost[c, k] = IMPOSSIBLE


@subkernel
def _border_price(shifted, label, rise_y, rise_x, order, y, x, move, top, bottom, left, right):  # type: ignore[no-untyped-def]
    """Price of the links of one cell that leave a block, if the block moves by some orders."""
    ny, nx = label.shape
    middle = shifted.shape[2] // 2
    own = label[y, x] + move + middle
    if not 0 <= own < shifted.shape[2]:
        return IMPOSSIBLE
    here = shifted[y, x, own]
    total = 0.0
    for side in range(4):
        b = y - 1 if side == 0 else (y + 1 if side == 1 else y)
        a = x - 1 if side == 2 else (x + 1 if side == 3 else x)
        inside = top <= b < bottom and left <= a < right
        if inside or not (0 <= b < ny and 0 <= a < nx):
            continue
        there = shifted[b, a, label[b, a] + middle]
        if np.isfinite(there):
            rise = rise_to_neighbour(rise_y, rise_x, y, x, b, a)
            total += break_price(there - here - rise, order)
    return total


@kernel
def _relax(cost, shifted, label, rise_y, rise_x, order, size):  # type: ignore[no-untyped-def]
    """Give every block of cells the shift that costs least beside its neighbours; returns how many moved."""
    ny, nx, shifts = cost.shape
    middle = shifts // 2
    price = np.empty(shifts, np.float64)
    moved = 0
    for top in range(0, ny, size):
        bottom = min(top + size, ny)
        for left in range(0, nx, size):
            right = min(left + size, nx)
            price[:] = 0.0
            filled = 0
            for y in range(top, bottom):
                for x in range(left, right):
                    if np.isfinite(shifted[y, x, middle]):
                        filled += 1
                        for k in range(shifts):
                            at = label[y, x] + k
                            price[k] += cost[y, x, at] if 0 <= at < shifts else IMPOSSIBLE
            # The border can only hold a block back: no need to look at it where the cells agree.
            # Large blocks pay less: many cells do not err together, and someone has to move first.
            share = 1.0 if size < _BOLD_BLOCK else 0.25
            if filled == 0 or (np.argmin(price) == middle and size > 1):
                continue
            for y in range(top, bottom):
                edge = y == top or y == bottom - 1
                for x in range(left, right):
                    if (edge or x == left or x == right - 1) and np.isfinite(shifted[y, x, middle]):
                        for k in range(shifts):
                            price[k] += share * _border_price(
                                shifted, label, rise_y, rise_x, order, y, x, k - middle, top, bottom, left, right
                            )  # fmt: skip
            best = np.argmin(price)
            if price[best] < price[middle] - 1e-3:
                moved += 1
                for y in range(top, bottom):
                    for x in range(left, right):
                        if np.isfinite(shifted[y, x, middle]):
                            label[y, x] += best - middle
    return moved


def _segments(
    thickness: NDArray[np.float32], rise_y: NDArray[np.float32], rise_x: NDArray[np.float32], order: float
) -> NDArray[np.int32]:
    """Connected surfaces, numbered by size; -1 where there is no data."""
    surface, count = _surfaces(thickness, rise_y, rise_x, SAME_SURFACE * order)
    size = np.bincount(surface[surface >= 0], minlength=count)
    place = np.full(count + 1, -1, np.int32)
    place[np.argsort(-size, kind="stable")] = np.arange(count)
    return place[surface]


def _segment_prices(
    cost: NDArray[np.float32],
    shifted: NDArray[np.float32],
    label: NDArray[np.int64],
    segment: NDArray[np.int32],
    rise_y: NDArray[np.float32],
    rise_x: NDArray[np.float32],
    order: float,
) -> NDArray[np.float64]:
    """What each surface would cost at each shift, the others staying: its cells and its borders."""
    shifts = cost.shape[2]
    member = segment.ravel()
    valid = member >= 0
    price = _segment_borders(shifted, label, segment, rise_y, rise_x, order, int(member.max(initial=-1)) + 1)
    for k in range(shifts):
        at = label.ravel() + k
        inside = (at >= 0) & (at < shifts)
        each = np.take_along_axis(cost.reshape(-1, shifts), np.clip(at, 0, shifts - 1)[:, None], axis=1)[:, 0]
        each = np.where(inside, each, IMPOSSIBLE)
        price[:, k] += np.bincount(member[valid], each[valid], minlength=len(price))
    return price


@kernel
def _segment_borders(shifted, label, segment, rise_y, rise_x, order, count):  # type: ignore[no-untyped-def]
    """Price of the borders of each surface at each shift."""
    ny, nx, shifts = shifted.shape
    middle = shifts // 2
    price = np.zeros((count, shifts), np.float64)
    for y in range(ny):
        for x in range(nx):
            for side in range(2):
                b, a = (y + 1, x) if side == 0 else (y, x + 1)
                if b >= ny or a >= nx or segment[y, x] == segment[b, a]:
                    continue
                if segment[y, x] < 0 or segment[b, a] < 0:
                    continue
                rise = rise_to_neighbour(rise_y, rise_x, y, x, b, a)
                jump = shifted[b, a, label[b, a] + middle] - shifted[y, x, label[y, x] + middle] - rise
                for k in range(shifts):
                    price[segment[y, x], k] += break_price(jump - (k - middle) * order, order)
                    price[segment[b, a], k] += break_price(jump + (k - middle) * order, order)
    return price


def _small_surfaces(segment: NDArray[np.int32], cells: Cells, correlation_px: float) -> NDArray[np.float64]:
    """How much more independent the cells of a small surface are than those of an endless one."""
    size = np.bincount(segment[segment >= 0], minlength=1)
    if correlation_px == 0.0:
        return np.ones(len(size))
    pixels = int(np.diff(cells.y_edges).max())
    side = np.minimum(np.rint(np.sqrt(size)).astype(int), _LARGEST_BLOCK)
    endless = cell_independence(pixels, correlation_px)
    factor = {
        int(n): effective_number(n * pixels, n * pixels, correlation_px)
        / (n**2 * effective_number(pixels, pixels, correlation_px) * endless)
        for n in np.unique(side)
    }
    return np.array([max(factor[int(n)], 1.0) for n in side])


def _alike(segment: NDArray[np.int32], alike: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far the cells of each surface err alike, which makes the sum of their evidence worth less."""
    size = np.bincount(segment[segment >= 0], minlength=1)
    return alike[np.minimum(np.log2(np.maximum(size, 1)).astype(int), len(alike) - 1)]


def _far_odds(
    found: OrderEvidence,
    thickness: NDArray[np.float32],
    segment: NDArray[np.int32],
    share: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Summed odds of the orders farther off than `SHIFTS`, for surfaces too small to rule them out by number."""
    size = np.bincount(segment[segment >= 0])
    odds = np.zeros(len(size))
    small = np.flatnonzero((segment.ravel() >= 0) & (np.append(size, 0)[segment.ravel()] <= _LARGEST_MENDED))
    if small.size == 0:
        return odds
    evidence = found.evidence.reshape(segment.size, -1)[small]
    orders = evidence.shape[1]
    own = np.rint((thickness.ravel()[small] - found.phase_um.ravel()[small]) / found.order_um).astype(int)
    member = segment.ravel()[small]
    here = np.take_along_axis(evidence, np.clip(own, 0, orders - 1)[:, None], axis=1)[:, 0]
    for move in (*range(-orders + 1, -SHIFTS), *range(SHIFTS + 1, orders)):
        at = own + move
        inside = (at >= 0) & (at < orders)
        there = np.take_along_axis(evidence, np.clip(at, 0, orders - 1)[:, None], axis=1)[:, 0]
        excess = np.where(inside, there - here, IMPOSSIBLE)
        total = share * np.bincount(member, excess, minlength=len(odds))
        ruled_out = np.bincount(member, minlength=len(odds)) == 0
        odds += np.where(ruled_out, 0.0, np.exp(-0.5 * total.clip(-200.0, 2000.0)))
    return odds


@kernel
def _cell_slip(cost, shifted, label, rise_y, rise_x, order, y, out):  # type: ignore[no-untyped-def]
    """Probability that a cell of one row has another order, its neighbours staying."""
    _, nx, shifts = cost.shape
    middle = shifts // 2
    for x in range(nx):
        if not np.isfinite(shifted[y, x, middle]):
            continue
        total, own = 0.0, 0.0
        for k in range(shifts):
            at = label[y, x] + k
            if not 0 <= at < shifts:
                continue
            price = cost[y, x, at] + _border_price(
                shifted, label, rise_y, rise_x, order, y, x, k - middle, y, y + 1, x, x + 1
            )
            weight = np.exp(-0.5 * price)
            total += weight
            if k == middle:
                own = weight
        out[x] = 1.0 - own / total if total > 0.0 else 1.0
