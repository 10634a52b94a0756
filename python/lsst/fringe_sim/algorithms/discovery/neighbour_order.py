"""The thickness of cells in the fringe orders of their neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from ...array_types import BoolArray, FloatArray

SIDE = 5
"""Side of the part about a cell whose median tells the slope [cells]; at a corner of the data a quarter has any."""

LEAST = 1e-9  # What every step between neighbours costs at least [orders]: a matrix has no links of 0


def in_order_of_neighbours(field: FloatArray, seen: BoolArray, order_um: float) -> FloatArray:
    """A thickness ``(ny, nx)`` of which cells are moved by whole fringe orders, so that no step is one.

    Steps between neighbours are compared with the median of those about them: a steep sensor has steps of its own.
    Cells are joined along the steps that are nearest to a whole number of orders beside it, as phases are unwrapped
    (Herráez et al. 2002, Appl. Opt. 41, 7437, join them by second differences). Most cells of a connected part stay.

    A few cells in another order, mostly at the rim of a part without data, have a slope that is an order per cell.
    With that slope they fit best where they are.
    """
    number = np.arange(field.size, dtype=np.int64).reshape(field.shape)
    links = [_links(field, seen, order_um, number, axis) for axis in (0, 1)]
    first, second, turns, away = (np.concatenate(part) for part in zip(*links, strict=True))
    shape = (field.size, field.size)
    tree = minimum_spanning_tree(csr_matrix((away + LEAST, (first, second)), shape))
    # Whole orders of a link, from the first to the second cell and back; a matrix that has no link there has 0.
    known = csr_matrix((np.concatenate([turns, -turns]), (np.r_[first, second], np.r_[second, first])), shape)
    moves = np.zeros(field.size)
    count, part = connected_components(tree, directed=False)
    sizes = np.bincount(part, minlength=count)
    for own in np.flatnonzero(sizes > 1):
        cells = np.flatnonzero(part == own)
        order, before = breadth_first_order(tree, cells[0], directed=False)
        steps = np.asarray(known[before[order[1:]], order[1:]]).ravel()
        for cell, step in zip(order[1:], steps, strict=True):
            moves[cell] = moves[before[cell]] - step
        values, counts = np.unique(moves[cells], return_counts=True)
        moves[cells] -= values[counts.argmax()]
    return np.asarray(field + order_um * moves.reshape(field.shape))


def _links(
    field: FloatArray, seen: BoolArray, order_um: float, number: NDArray[np.int64], axis: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, FloatArray]:
    """Neighbours along an axis with data: both cells, whole orders of the step, and how far it is from these."""
    rest = [slice(None), slice(None)]
    rest[axis] = slice(1, None)
    begin = [slice(None), slice(None)]
    begin[axis] = slice(None, -1)
    here, there = tuple(begin), tuple(rest)
    both = seen[here] & seen[there]
    steps = np.where(both, field[there] - field[here], np.nan)
    beside = steps[both]
    if beside.size:
        beside = beside - np.nanmedian(_around(steps, both), axis=-1)
    turns = np.round(beside / order_um)
    return number[here][both], number[there][both], turns, np.abs(beside / order_um - turns)


def _around(values: FloatArray, where: BoolArray) -> FloatArray:
    """Values about every place that is asked for, ``(N, SIDE²)``; beyond the edges there are none."""
    padded = np.pad(values, SIDE // 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (SIDE, SIDE))
    return np.array(windows[where].reshape(-1, SIDE**2))
