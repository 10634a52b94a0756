"""Slopes of a field that is known at cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, vstack

from ...array_types import BoolArray, FloatArray

BESIDE = ({-1: -0.5, 1: 0.5}, {0: -1.0, 1: 1.0}, {0: 1.0, -1: -1.0})
BEYOND = ({-2: -0.25, 2: 0.25}, {0: -0.5, 2: 0.5}, {0: 0.5, -2: -0.5})
FAR_BEYOND = ({0: -1.0 / 3.0, 3: 1.0 / 3.0}, {0: 1.0 / 3.0, -3: -1.0 / 3.0})
NEIGHBOURS = (*BESIDE, *BEYOND, *FAR_BEYOND)
"""Weights of cells along an axis, best first; they make a wave of ten cells flatter by 6 %. Behind a gap of a cell or
two, as a bad column beside the edge leaves it, it takes those beyond."""

CURVED = (
    {-2: 1.0 / 12.0, -1: -2.0 / 3.0, 1: 2.0 / 3.0, 2: -1.0 / 12.0},
    {-1: -0.5, 1: 0.5},
    {0: -1.5, 1: 2.0, 2: -0.5},
    {0: 1.5, -1: -2.0, -2: 0.5},
    *BESIDE[1:],
    BEYOND[0],
    {0: -5.0 / 6.0, 2: 1.5, 3: -2.0 / 3.0},
    {0: 5.0 / 6.0, -2: -1.5, -3: 2.0 / 3.0},
    *BEYOND[1:],
    *FAR_BEYOND,
)
"""The same to fourth order, at the rim to second."""

REACH = max(abs(step) for stencil in CURVED for step in stencil)  # Farthest neighbour of a cell

LARGEST_CORRECTION = 0.2
"""Part of the slope to the neighbours by which that to fourth order may differ: beyond it the field is no smooth one
there, but in wrong fringe orders."""


class Slopes:
    """Change of a field from cell to cell, from neighbours that are seen.

    ``seen``: cells where the field is known; slopes of others, and of those farther than three from the next, are
    0, ``(ny, nx)``.
    """

    def __init__(self, seen: BoolArray) -> None:
        self.shape = seen.shape
        self._plain, self._curved = (_operator(seen, stencils) for stencils in (NEIGHBOURS, CURVED))

    def __call__(self, field: FloatArray) -> FloatArray:
        """Slopes along rows and columns, shape ``(2, ny, nx)``."""
        plain, curved = (operator @ field.ravel() for operator in (self._plain, self._curved))
        most = LARGEST_CORRECTION * np.abs(plain)
        return np.asarray(plain + np.clip(curved - plain, -most, most)).reshape(2, *self.shape)


def _operator(seen: BoolArray, stencils: Sequence[Mapping[int, float]]) -> csr_matrix:
    """Matrix that turns a field, as one row, into all slopes along y, then those along x."""
    number = np.arange(seen.size).reshape(seen.shape)
    return vstack([_along_first(number, seen, stencils), _along_first(number.T, seen.T, stencils)]).tocsr()


def _along_first(
    number: NDArray[np.intp], seen: BoolArray, stencils: Sequence[Mapping[int, float]]
) -> csr_matrix:
    """Slopes along the first axis, of cells with these numbers."""
    size = len(seen)
    padded = np.pad(seen, ((REACH, REACH), (0, 0)))
    open_cells = seen.copy()
    rows, columns, weights = [], [], []
    for stencil in stencils:
        usable = open_cells.copy()
        for step in stencil:
            usable &= padded[REACH + step : REACH + step + size]
        place, other = np.nonzero(usable)
        for step, weight in stencil.items():
            rows.append(number[place, other])
            columns.append(number[place + step, other])
            weights.append(np.full(place.size, weight))
        open_cells &= ~usable
    shape = (number.size, number.size)
    return csr_matrix((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape)
