"""Cells of a first thickness that lie in a wrong fringe order, taken back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, median, uniform_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ...array_types import BoolArray, Float32Array
from .cells import CellData
from .surface import robust_surface

SEARCH_STEP_UM = 0.01
HALF_WINDOW_UM = 0.12  # Reach of the search around a neighbour's thickness [µm]; below half a fringe order
FEWEST_ROWS = 12  # Rows and columns of cells from which on they are looked at together

PATCH_ROUNDS = 6
LARGEST_PATCH = 0.1
PATCH_LOSS = 0.9
WIDEST_GAP = 4
"""How often patches are taken back, the largest part of the cells that is one, the clarity it may lose, and the gap
in the data across which cells are neighbours [cells]."""

SURFACE_SPACINGS = (16.0, 8.0)
SURFACE_LOSS = 0.999
"""Knots of the smooth surface [cells], and the clarity that all cells together may lose by it."""


def mended(score: Float32Array, best: NDArray[np.int64], cells: CellData, order: float) -> NDArray[np.int64]:
    """Steps of all cells, with those in a wrong fringe order taken back in every way that is known."""
    best = _mend_orders(score, best, cells.shape[1:], order)
    best = _mend_patches(score, best, cells.seen, order)
    return _mend_by_surface(score, best, cells, order)


def _mend_orders(
    score: Float32Array, best: NDArray[np.int64], shape: tuple[int, int], order: float
) -> NDArray[np.int64]:
    """Move patches that grew across a fringe into the wrong order, if that is likelier or leaves fewer cliffs."""
    if min(shape) < FEWEST_ROWS:
        return best
    cells, count = np.arange(len(best)), score.shape[1]
    current = best
    for window in (15, 9, 5):
        totals = []
        for turn in range(-2, 3):
            moved = _nearby_peak(score, np.clip(current + round(turn * order), 0, count - 1))
            power = (score[cells, moved].astype(float) ** 2).reshape(shape)
            totals.append(uniform_filter(power, window, mode="nearest"))
        turns = np.argmax(np.stack(totals), axis=0).ravel() - 2
        mended = np.clip(current + np.rint(turns * order).astype(np.int64), 0, count - 1)
        mended = _nearby_peak(score, mended)
        cliffs = [_cliffs(field.reshape(shape), order) for field in (current, mended)]
        gain = [float((score[cells, field].astype(float) ** 2).mean()) for field in (current, mended)]
        if cliffs[1] < cliffs[0] or (gain[1] > 1.003 * gain[0] and cliffs[1] < 3 * cliffs[0] + 10):
            current = mended
    return current


def _mend_patches(
    score: Float32Array, best: NDArray[np.int64], seen: BoolArray, order: float
) -> NDArray[np.int64]:
    """Take back small patches, single cells among them, that stand whole orders off what surrounds them.

    A patch is what hangs together without a cliff. It is moved by the orders that its border shows, if it then fits
    the data nearly as well as before. What lies beyond the data is whatever it grew to, and joins nothing; narrow
    gaps are between cells with data.
    """
    if min(seen.shape) < FEWEST_ROWS:
        return best
    cells, count = np.arange(len(best)), score.shape[1]
    places = cells.reshape(seen.shape)
    known = _without_gaps(seen).ravel()
    pairs = np.concatenate([
        np.stack([places[:, :-1].ravel(), places[:, 1:].ravel()], axis=1),
        np.stack([places[:-1].ravel(), places[1:].ravel()], axis=1),
    ])  # fmt: skip
    pairs = pairs[known[pairs].all(axis=1)]
    current = best
    for _ in range(PATCH_ROUNDS):
        flat = np.abs(current[pairs[:, 0]] - current[pairs[:, 1]]) < 0.5 * order
        if flat.all():
            break
        links = coo_array((np.ones(int(flat.sum())), pairs[flat].T), shape=(len(best), len(best)))
        patch = connected_components(links, directed=False)[1]
        size = np.bincount(patch)
        turns = _turns_of_patches(current, patch, pairs[~flat], size, order)
        moved = np.clip(current - np.rint(turns[patch] * order).astype(np.int64), 0, count - 1)
        moved = np.where(turns[patch] != 0, _nearby_peak(score, moved, round(0.3 * order)), current)
        power = [np.bincount(patch, score[cells, field].astype(float) ** 2) for field in (current, moved)]
        better = (turns != 0) & (size < LARGEST_PATCH * len(best)) & (power[1] > PATCH_LOSS * power[0])
        if not better.any():
            break
        current = np.where(better[patch], moved, current)
    return current


def _without_gaps(seen: BoolArray) -> BoolArray:
    """Cells with data, and those in gaps between them of a few cells."""
    filled = binary_closing(np.pad(seen, WIDEST_GAP), iterations=WIDEST_GAP // 2)
    inner = slice(WIDEST_GAP, -WIDEST_GAP)
    return np.asarray(seen | filled[inner, inner])


def _mend_by_surface(
    score: Float32Array, best: NDArray[np.int64], cells: CellData, order: float
) -> NDArray[np.int64]:
    """Take back ragged patches: every cell at its best less than half an order from a smooth surface through most.

    Where fringes are weak, cells far from one another may be in the wrong order, without a border to tell by.
    """
    if min(cells.shape[1:]) < FEWEST_ROWS:
        return best
    places, current = np.arange(len(best)), best
    for spacing in SURFACE_SPACINGS:
        moved, away = near_surface(score, current, cells, spacing, order)
        power = [float((score[places, field].astype(float) ** 2).mean()) for field in (current, moved)]
        if not away.any() or power[1] < SURFACE_LOSS * power[0]:
            continue
        current = moved
    return current


def near_surface(
    score: Float32Array, current: NDArray[np.int64], cells: CellData, spacing: float, order: float
) -> tuple[NDArray[np.int64], BoolArray]:
    """Steps with those more than half an order from a smooth surface moved to their best less far from it; which."""
    surface = robust_surface(current.reshape(cells.shape[1:]).astype(float), cells.seen, spacing, order)
    middle = np.clip(np.rint(surface.ravel()).astype(np.int64), 0, score.shape[1] - 1)
    away = np.abs(current - middle) > 0.5 * order
    reach = int(HALF_WINDOW_UM / SEARCH_STEP_UM)
    return np.where(away, _nearby_peak(score, middle, reach), current), away


def _turns_of_patches(
    best: NDArray[np.int64], patch: NDArray[np.int32], border: NDArray[np.int64], size: NDArray[np.int64],
    order: float,
) -> NDArray[np.int64]:  # fmt: skip
    """Orders by which each patch stands above the largest of its neighbours; of two of a size, one is the larger."""
    turns = np.zeros(size.size, dtype=np.int64)
    both = np.concatenate([border, border[:, ::-1]])
    own, other = patch[both[:, 0]], patch[both[:, 1]]
    jump = best[both[:, 0]] - best[both[:, 1]]
    larger = size[other] > size[own]
    use = larger | ((size[other] == size[own]) & (other < own))  # halves of the same size are two as well
    if not use.any():  # a cliff within a patch
        return turns
    own, other, jump = own[use], other[use], jump[use]
    largest = np.full(size.size, -1)
    by_size = np.lexsort((-other, size[other]))
    largest[own[by_size]] = other[by_size]  # the last one written is the largest
    use = other == largest[own]
    patches = np.unique(own[use])
    turns[patches] = np.rint(median(jump[use], own[use], patches) / order).astype(np.int64)
    return turns


def _nearby_peak(score: Float32Array, best: NDArray[np.int64], reach: int = 4) -> NDArray[np.int64]:
    """Best thickness within a few search steps."""
    around = np.clip(best[:, np.newaxis] + np.arange(-reach, reach + 1), 0, score.shape[1] - 1)
    choice = np.argmax(np.take_along_axis(score, around, axis=1), axis=1)
    return np.take_along_axis(around, choice[:, np.newaxis], axis=1)[:, 0]


def _cliffs(field: NDArray[np.int64], order: float) -> int:
    """Number of neighbours that differ by most of a fringe order from a straight continuation."""
    return sum(int((np.abs(np.diff(field, 2, axis=axis)) > 0.6 * order).sum()) for axis in (0, 1))
