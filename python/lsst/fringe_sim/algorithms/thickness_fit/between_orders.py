"""Cells whose phase is no whole order away from their neighbours.

Noise makes the order of a cell of weak fringes a guess. Its least chi-square over the whole range may lie many orders
off, and there the wavelengths have other phases than at the true thickness: a whole number of orders back it fits
badly. So it is asked where its neighbours would have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...compiled import kernel, run_threaded, subkernel
from .cells import Cells
from .misfit import Misfit, degrees_of_freedom, improbability
from .newton import gauss_newton
from .pixels import SAME_SURFACE
from .templates import FlatTemplates

BREAK_PRICE = 8.0  # Chi-square that a break of half an order or more between two neighbouring cells costs
_SWEEPS = 6


@dataclass(frozen=True, eq=False)
class Rises:
    """What the thickness rises by within a cell [µm], float32, ``(ncy, ncx)``."""

    y: NDArray[np.float32]
    x: NDArray[np.float32]


def join_neighbours(
    cells: Cells,
    templates: FlatTemplates,
    thickness_um: NDArray[np.float32],
    rises: Rises,
    order_um: float,
    *,
    range_um: tuple[float, float],
    temper: float,
    misfit: Misfit,
    threads: int = 2,
) -> NDArray[np.float32]:
    """Thickness of all cells, each where it is or where a neighbour would have it, whichever is more probable.

    ``thickness_um``: thickness so far [µm]; NaN where a cell has no data, float32, ``(ncy, ncx)``; ``order_um``:
    thickness of one fringe order [µm]; ``range_um``: thicknesses that are possible [µm]; ``temper``: independent
    cells per cell; ``misfit``: how far cells are off beyond their noise. Breaks between cells cost what they do in
    `settle_orders`.
    """
    table, before = templates.table(), thickness_um
    for _ in range(_SWEEPS):
        after = before.copy()

        def ask(row: int, before: NDArray[np.float32] = before, after: NDArray[np.float32] = after) -> None:
            _join_row(
                cells.value[row], cells.weight[row], table, templates.start_um, templates.step_um, before, rises.y,
                rises.x, order_um, *range_um, temper, misfit.scale, misfit.tail, row, after[row],
            )  # fmt: skip

        run_threaded(ask, len(after), threads)
        if np.array_equal(before, after, equal_nan=True):
            break
        before = after
    return before


@subkernel(expand=True)
def break_price(jump, order):  # type: ignore[no-untyped-def]
    """Price of a jump between two neighbours: grows as its square, up to half an order."""
    share = 2.0 * jump / order
    return BREAK_PRICE * min(share * share, 1.0)


@subkernel
def rise_to_neighbour(rise_y, rise_x, y, x, b, a):  # type: ignore[no-untyped-def]
    """What the thickness rises by from a cell to one beside it, ``b, a``."""
    return 0.5 * ((rise_y[y, x] + rise_y[b, a]) * (b - y) + (rise_x[y, x] + rise_x[b, a]) * (a - x))


@subkernel
def _where_neighbours_have_it(thickness, rise_y, rise_x, y, x, near):  # type: ignore[no-untyped-def]
    """Write where the up to four neighbours of a cell would have it; their number."""
    ny, nx = thickness.shape
    number = 0
    for side in range(4):
        b = y - 1 if side == 0 else (y + 1 if side == 1 else y)
        a = x - 1 if side == 2 else (x + 1 if side == 3 else x)
        if 0 <= b < ny and 0 <= a < nx and np.isfinite(thickness[b, a]):
            near[number] = thickness[b, a] - rise_to_neighbour(rise_y, rise_x, y, x, b, a)
            number += 1
    return number


@subkernel
def _breaks(near, number, thickness, order):  # type: ignore[no-untyped-def]
    """Price of a thickness beside its neighbours, and the largest jump to one of them."""
    price, jump = 0.0, 0.0
    for other in range(number):
        price += break_price(near[other] - thickness, order)
        jump = max(jump, abs(near[other] - thickness))
    return price, jump


@kernel
def _join_row(  # type: ignore[no-untyped-def]
    value, weight, table, start, step, thickness, rise_y, rise_x, order, low, high, temper, scale, tail, y, out
):  # fmt: skip
    """Ask the cells of one row that a break parts from a neighbour."""
    top = table.shape[0] - 1.0
    near = np.empty(4, np.float64)
    for x in range(thickness.shape[1]):
        own = thickness[y, x]
        if not np.isfinite(own):
            continue
        number = _where_neighbours_have_it(thickness, rise_y, rise_x, y, x, near)
        price, jump = _breaks(near, number, np.float64(own), order)
        if jump <= SAME_SURFACE * order:
            continue
        freedom = degrees_of_freedom(weight, x)
        place = min(max((own - start) / step, 0.0), top)
        _, _, chi2 = gauss_newton(table, place, value, weight, x, np.int64(3), 0.03 / step)
        least = temper * improbability(chi2, freedom, scale, tail) + price
        for asked in range(number):
            place = min(max((near[asked] - start) / step, 0.0), top)
            place, _, chi2 = gauss_newton(table, place, value, weight, x, np.int64(3), 0.03 / step)
            found = start + step * place
            if abs(found - near[asked]) > SAME_SURFACE * order or not low <= found <= high:
                continue
            cost = temper * improbability(chi2, freedom, scale, tail) + _breaks(near, number, found, order)[0]
            if cost < least - 1e-3:
                least, out[x] = cost, found
