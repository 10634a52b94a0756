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

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import Float32Array, FloatArray
from ...compiled import kernel, subkernel
from .cells import Cells
from .evidence import IMPOSSIBLE, OrderEvidence

SURE = 60.0
"""Chi-square difference between the best and the next order at which a region is sure of its order."""


def solve_orders(cells: Cells, found: OrderEvidence, sure: float = SURE) -> Float32Array:
    """Join cells into regions and give each region its absolute order.

    ``sure``: regions that are surer of their order than this chi-square difference stay apart where they disagree.
    Returns ``phase + order * m`` [µm]; NaN where a cell has no data, float32, ``(ncy, ncx)``.
    """
    ny, nx = found.phase_um.shape
    rise_y = found.slope_y * np.diff(cells.y_edges).astype(np.float32)[:, None]
    rise_x = found.slope_x * np.diff(cells.x_edges).astype(np.float32)[None, :]
    first, second, turn, key = _links(found.phase_um, rise_y, rise_x, found.order_um)
    ranked = np.argsort(key, kind="stable")
    evidence = found.evidence.reshape(ny * nx, -1).copy()
    root, offset = _join(evidence, first[ranked], second[ranked], turn[ranked], sure)
    valid = np.isfinite(found.phase_um.ravel())
    roots = np.flatnonzero(root == np.arange(len(root)))
    best = np.zeros(len(root), np.int64)
    best[roots] = np.argmin(evidence[roots], axis=1)
    order = best[root] + offset
    thickness = np.where(valid, found.phase_um.ravel() + found.order_um * order, np.nan)
    return thickness.astype(np.float32).reshape(ny, nx)


def _links(
    phase_um: Float32Array, rise_y: Float32Array, rise_x: Float32Array, order_um: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.uint16]]:
    """Pairs of neighbouring cells, the orders between their phases, and how unreliable each pair is.

    The slopes inside the cells foretell the difference; what is left of it, on this link and on the others
    of its two cells, is the unreliability (in 1/4096 of an order).
    """
    ny, nx = phase_um.shape
    # The last axis is for the links to the right and to the cell below.
    beyond, rise = np.full((ny, nx, 2), np.nan, np.float32), np.full((ny, nx, 2), np.nan)
    beyond[:, :-1, 0], rise[:, :-1, 0] = phase_um[:, 1:], 0.5 * (rise_x[:, :-1] + rise_x[:, 1:])
    beyond[:-1, :, 1], rise[:-1, :, 1] = phase_um[1:], 0.5 * (rise_y[:-1] + rise_y[1:])
    difference = beyond - phase_um[..., np.newaxis] - rise
    miss = (difference - order_um * np.rint(difference / order_um)) / order_um
    linked = np.isfinite(miss)
    rough, number = _sums_at_cells(np.where(linked, miss * miss, 0.0)), _sums_at_cells(linked)
    y, x, below = np.nonzero(linked)
    y_next, x_next = y + below, x + 1 - below
    turn = np.rint((phase_um[y, x] + rise[linked] - beyond[linked]) / order_um).astype(np.int64)
    around = rough[y, x] / number[y, x] + rough[y_next, x_next] / number[y_next, x_next]
    key = np.minimum(4096.0 * np.sqrt(miss[linked] ** 2 + 0.5 * around), 65535.0).astype(np.uint16)
    return y * nx + x, y_next * nx + x_next, turn, key


def _sums_at_cells(links: NDArray[Any]) -> FloatArray:
    """Sum over the links that end at each cell, whose last axis is for those to the right and below."""
    total = np.zeros(links.shape[:2])
    total[1:] += links[:-1, :, 1]
    total[:, 1:] += links[:, :-1, 0]
    total += links[..., 0]
    total += links[..., 1]
    return total


@subkernel
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


@subkernel
def _gap(evidence):  # type: ignore[no-untyped-def]
    """Best order of a region, and by how much it is better than the next."""
    best, least, second = 0, evidence[0], np.float32(np.inf)
    for m in range(1, evidence.shape[0]):
        value = evidence[m]
        if value < second:
            if value < least:
                best, least, second = m, value, least
            else:
                second = value
    return best, float(second) - float(least)


@kernel
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
            evidence[a, m] += evidence[b, other] if 0 <= other < orders else IMPOSSIBLE
        parent[b] = a
        shift[b] = offset
        size[a] += size[b]
        best[a], gap[a] = _gap(evidence[a])
    for c in range(cells):
        root, total = _find(parent, shift, c)
        parent[c] = root
        shift[c] = total
    return parent, shift
