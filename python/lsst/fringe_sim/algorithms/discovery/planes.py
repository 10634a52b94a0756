"""Thickness from planes on the fringes of many cells at once, where single cells do not tell their order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from ...array_types import BoolArray, Float32Array, FloatArray
from ...compiled import kernel, run_threaded, subkernel
from ...model import FringeModel
from .cells import CellData
from .start import SEARCH_STEP_UM, order_steps, robust_surface, search_template

TORN = 0.01
CLIFF = 0.5
"""Part of neighbouring cells between which there is a cliff from which on a thickness is torn, and the height of one
[fringe orders]."""

SIDE, APART = 6, 3
"""Side of the blocks of cells on each of which a plane is laid, and the distance from one to the next [cells]."""

STEEPEST, SLOPES = 0.35, 17
"""Steepest plane [fringe orders per cell], and slopes along an axis that are tried."""

ORDERS = 4.0
STRIDE = 2  # Fringe orders about a smooth thickness that are tried, and steps of the search at a time
ORDERS_MOVED = 6.0  # Fringe orders by which all joined planes together are moved at most
SURFACE_SPACING = 8.0  # Knots of the smooth thickness [cells]


def is_torn(thickness_um: FloatArray, seen: BoolArray, order_um: float) -> bool:
    """Whether there are cliffs of about a fringe order between many neighbouring cells.

    ``thickness_um`` (ny, nx). ``seen`` (ny, nx).
    """
    cliffs = pairs = 0
    for axis in (0, 1):
        both = np.delete(seen, 0, axis=axis) & np.delete(seen, -1, axis=axis)
        cliffs += int((np.abs(np.diff(thickness_um, axis=axis))[both] > CLIFF * order_um).sum())
        pairs += int(both.sum())
    return cliffs > TORN * max(pairs, 1)


def joined_planes(model: FringeModel, cells: CellData, thickness_um: FloatArray) -> FloatArray | None:
    """Smooth thickness through planes that lie on the fringes of blocks of cells, contrasts free.

    The cells of a block together show fringes that none of them shows alone, and with them a slope of the thickness.
    Planes of neighbouring blocks differ by whole fringe orders where they go on into one another; they are joined
    over a tree of those that do so best, and moved together to where the fringes of all lie on the data.

    ``model``: the model with the effects that are known by now. ``thickness_um`` (ny, nx): thickness so far,
    some orders off in places. Returns (ny, nx): `None` if there are too few cells for blocks.
    """
    rows, columns = cells.shape[1:]
    if min(rows, columns) < 2 * SIDE:
        return None
    low, template = search_template(model, cells)
    order = order_steps(model, cells)
    cross, square = _projections(template, cells)
    surface = robust_surface((thickness_um - low) / SEARCH_STEP_UM, cells.seen, SURFACE_SPACING, order)
    blocks = _Blocks.of(rows, columns)
    middle = np.clip(np.rint(blocks.centre_of(surface)), 0, template.shape[1] - 1).astype(np.int64)
    slopes = np.linspace(-STEEPEST, STEEPEST, SLOPES) * order
    found = np.zeros((len(blocks.top), 4))
    reach = round(ORDERS * order)
    run_threaded(
        lambda block: _best_plane(
            cross, square, columns, blocks.top, blocks.left, middle, slopes, reach, block, found[block]
        ),
        len(found),
    )
    height = blocks.joined(found, order)
    curves = np.zeros((len(found), cross.shape[1]), np.float32)
    run_threaded(
        lambda block: _gains(
            cross, square, columns, blocks.top[block], blocks.left[block], found[block], curves[block]
        ),
        len(found),
    )
    height += _common_move(curves, height, round(ORDERS_MOVED * order))
    joined = blocks.spread(height, found, cells.shape[1:])
    return np.asarray(low + SEARCH_STEP_UM * robust_surface(joined, cells.seen, SURFACE_SPACING, order))


def _projections(template: FloatArray, cells: CellData) -> tuple[Float32Array, Float32Array]:
    """Of every cell on the fringes at all thicknesses, and their squares, an offset of the cell free; ``(N, D)``."""
    waves = cells.shape[0]
    amplitude, weight = (part.reshape(waves, -1).T for part in (cells.value - 1.0, cells.weight))
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    signal = weight * (amplitude - (weight * amplitude).sum(axis=1, keepdims=True) / total)
    share, fringes = (weight / total).astype(np.float32), template.astype(np.float32)
    square = (share @ fringes**2 - (share @ fringes) ** 2) * total.astype(np.float32)
    return signal.astype(np.float32) @ fringes, np.maximum(square, 0.0)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks of cells in rows and columns."""

    shape: tuple[int, int]  # rows and columns of blocks
    # top, left: their first rows and columns of cells
    top: NDArray[np.int64]
    left: NDArray[np.int64]

    @classmethod
    def of(cls, rows: int, columns: int) -> _Blocks:
        """Blocks that cover so many rows and columns of cells."""
        first = [
            np.unique(np.r_[np.arange(0, size - SIDE + 1, APART), size - SIDE]) for size in (rows, columns)
        ]
        top, left = np.meshgrid(*first, indexing="ij")
        return cls((first[0].size, first[1].size), top.ravel(), left.ravel())

    def centre_of(self, field: FloatArray) -> FloatArray:
        """Mean of a field over the cells of each."""
        inside = np.arange(SIDE)
        return np.asarray(
            field[self.top[:, None, None] + inside[:, None], self.left[:, None, None] + inside].mean(
                axis=(1, 2)
            )
        )

    def joined(self, found: FloatArray, order: float) -> FloatArray:
        """Heights of planes moved by whole orders, so that each goes on into the next."""
        number = np.arange(len(self.top)).reshape(self.shape)
        ends = np.concatenate([
            np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1),
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1),
        ])  # fmt: skip
        away = 0.5 * np.stack([np.diff(self.top[ends], axis=1)[:, 0], np.diff(self.left[ends], axis=1)[:, 0]])
        here, there = (
            found[ends[:, side], 0] + sign * (found[ends[:, side], 1:3].T * away).sum(axis=0)
            for side, sign in ((0, 1.0), (1, -1.0))
        )
        orders = (there - here) / order
        clear = np.sqrt(np.maximum(np.minimum(*found[ends, 3].T), 1e-6))
        cost = (0.05 + np.abs(orders - np.rint(orders))) / clear
        size = len(self.top)
        tree = minimum_spanning_tree(coo_array((cost, ends.T), shape=(size, size)).tocsr())
        visited, parent = breadth_first_order(tree, int(found[:, 3].argmax()), directed=False)
        step = {}
        for (one, other), turn in zip(ends.tolist(), np.rint(orders).astype(int).tolist(), strict=True):
            step[one, other], step[other, one] = turn, -turn
        turns = np.zeros(size, dtype=int)
        for block in visited[1:].tolist():
            turns[block] = turns[parent[block]] + step[int(parent[block]), block]
        return np.asarray(found[:, 0] - order * turns)

    def spread(self, height: FloatArray, found: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Mean over the planes at every cell, clearer ones with more weight."""
        total, weight = np.zeros(shape), np.zeros(shape)
        from_middle = np.arange(SIDE) - 0.5 * (SIDE - 1)
        for place, (top, left) in enumerate(zip(self.top.tolist(), self.left.tolist(), strict=True)):
            _, down, along, gain = found[place]
            plane = height[place] + down * from_middle[:, None] + along * from_middle
            own = slice(top, top + SIDE), slice(left, left + SIDE)
            total[own] += (gain + 1e-6) * plane
            weight[own] += gain + 1e-6
        return total / weight


def _common_move(curves: Float32Array, height: FloatArray, reach: int) -> float:
    """Steps by which all planes are moved to where their fringes together lie best on the data."""
    blocks, count = np.arange(len(height)), curves.shape[1]
    places = np.rint(height).astype(np.int64)
    totals = []
    for move in range(-reach, reach + 1):
        at = places + move
        inside = (at >= 0) & (at < count)
        own = curves[blocks, np.clip(at, 0, count - 1)]
        totals.append(float(own[inside].sum()))
    return float(int(np.argmax(totals)) - reach)


@subkernel
def _gain(
    cross: Float32Array, square: Float32Array, own: NDArray[np.int64], away: NDArray[np.int64], at: int
) -> float:  # pragma: no cover - compiled
    """Fall of χ² with a plane on some cells, of one positive contrast."""
    one, two = 0.0, 1e-30
    for cell in range(own.size):
        place = at + away[cell]
        if 0 <= place < cross.shape[1]:
            one += cross[own[cell], place]
            two += square[own[cell], place]
    return one * one / two if one > 0.0 else 0.0


@subkernel
def _plane(
    top: int,
    left: int,
    columns: int,
    down: float,
    along: float,
    own: NDArray[np.int64],
    away: NDArray[np.int64],
) -> None:  # pragma: no cover - compiled
    """Fill in the cells of a block, and the steps of a plane in each from that in its middle."""
    half = 0.5 * (SIDE - 1)
    for row in range(SIDE):
        for column in range(SIDE):
            own[row * SIDE + column] = (top + row) * columns + left + column
            away[row * SIDE + column] = round(down * (row - half) + along * (column - half))


@kernel
def _best_plane(
    cross: Float32Array,
    square: Float32Array,
    columns: int,
    top: NDArray[np.int64],
    left: NDArray[np.int64],
    middle: NDArray[np.int64],
    slopes: FloatArray,
    reach: int,
    block: int,
    found: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Height in the middle, slopes down and along, and gain of the best plane of a block."""
    fine = slopes[1] - slopes[0]
    own, away = np.empty(SIDE * SIDE, np.int64), np.empty(SIDE * SIDE, np.int64)
    found[0] = middle[block]
    for down in slopes:
        for along in slopes:
            _plane(top[block], left[block], columns, down, along, own, away)
            for at in range(middle[block] - reach, middle[block] + reach + 1, STRIDE):
                gain = _gain(cross, square, own, away, at)
                if gain > found[3]:
                    found[0], found[1], found[2] = at, down, along
                    found[3] = gain
    first = found.copy()
    for part_down in range(-2, 3):
        for part_along in range(-2, 3):
            down, along = first[1] + 0.25 * part_down * fine, first[2] + 0.25 * part_along * fine
            _plane(top[block], left[block], columns, down, along, own, away)
            for at in range(int(first[0]) - STRIDE, int(first[0]) + STRIDE + 1):
                gain = _gain(cross, square, own, away, at)
                if gain > found[3]:
                    found[0], found[1], found[2] = at, down, along
                    found[3] = gain


@kernel
def _gains(
    cross: Float32Array,
    square: Float32Array,
    columns: int,
    top: int,
    left: int,
    plane: FloatArray,
    curve: Float32Array,
) -> None:  # pragma: no cover - compiled
    """Gain of a plane of known slopes at every height."""
    own, away = np.empty(SIDE * SIDE, np.int64), np.empty(SIDE * SIDE, np.int64)
    _plane(top, left, columns, plane[1], plane[2], own, away)
    for at in range(cross.shape[1]):
        curve[at] = _gain(cross, square, own, away, at)
