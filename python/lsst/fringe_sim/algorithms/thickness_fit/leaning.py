"""How far pixels lie from the surface of the cells, which differs from place to place.

In each cell two numbers tell: how far its pixels are off the surface together, and how far they scatter about their
mean beyond their noise. Both are noisy, so what other cells show is the prior of each (empirical Bayes, of a
distribution that is free on a grid: Laird 1978, J. Am. Stat. Assoc. 73, 805).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, Float32Array, FloatArray
from ...compiled import kernel
from .newton import score

_WIDTHS = 8  # Widths that are tried of each kind: none, and others in equal ratios
_MOST_CELLS = 4096  # Cells that show the distribution of widths of all
_ROUNDS, _ROUNDS_AROUND = 400, 4
"""Steps of expectation and maximisation for all cells, and of what the cells around one add."""
_REACH = 2  # Cells on each side of one that are around it
_SQUARE = range(2 * _REACH + 1)
_TINY = 1e-30
_WEIGHTS = np.geomspace(0.5, 512.0, 11).astype(np.float32)
"""Cells around one that all cells together may count for."""


class Leanings(NamedTuple):
    """What the pixels of each cell show about the surface."""

    # number, score, information, squares: pixels; sums of their scores and of their information on the surface, and
    # of the squares of the scores over the information. Distances are in steps of the table, ``(ncy, ncx)``
    number: FloatArray
    score: FloatArray
    information: FloatArray
    squares: FloatArray


def local_variance(
    seen: Leanings, surface_variance: FloatArray, widths: tuple[float, float], independence: float = 1.0
) -> FloatArray:
    """Expected square of the distance of the pixels of each cell from their surface, beyond all noise.

    The distribution of how far pixels move together and how far they scatter is first that of all cells. Then the
    cells around each are believed besides, as far as they foretell it: how many of them all cells together count
    for is the most likely number.

    ``surface_variance``: variance of the surface in each, from the noise of the cells, ``(ncy, ncx)``; ``widths``:
    least and largest width that is tried; ``independence``: independent pixels per pixel of a cell: below 1 where
    noise is correlated. Returns 0 where there are no pixels, ``(ncy, ncx)``.
    """
    squares = np.concatenate([[0.0], np.geomspace(*widths, _WIDTHS - 1) ** 2])
    together, alone = (each.ravel() for each in np.meshgrid(squares, squares, indexing="ij"))
    known, out = seen.number > 0, np.zeros(seen.number.shape)
    if not known.any():
        return out
    likely = _likelihood(seen, surface_variance, together, alone, independence)
    some = likely[:: -(-len(likely) // _MOST_CELLS)].astype(float)
    share = _share_of_widths(some, alone == 0.0)
    foretold = _with_neighbours(likely, share.astype(np.float32), known)
    out[known] = responsibility(likely, foretold) @ (together + alone)
    return out


def _share_of_widths(likely: FloatArray, together: BoolArray) -> FloatArray:
    """Most likely share of each pair of widths; ``together`` are those where no pixel lies apart from its cell.

    Noise hides how far pixels scatter by themselves where that is little. That they do is believed if it makes the
    cells more likely than two free parameters do by themselves, a width and its share (Schwarz 1978, Ann. Stat. 6,
    461): without that, whatever noise would hide would count as possible.
    """
    simple, free = (
        most_likely_shares(likely, asked.astype(float)) for asked in (together, np.ones(together.size))
    )
    none, some = (float(np.log(np.maximum(likely @ share, _TINY)).sum()) for share in (simple, free))
    return free if some - none > np.log(len(likely)) else simple


def most_likely_shares(likely: FloatArray, start: FloatArray) -> FloatArray:
    """Shares of each of some kinds, given the likelihood of each kind (second axis) for a number of cases."""
    share = start / start.sum()
    for _ in range(_ROUNDS):
        share = responsibility(likely, share).mean(axis=0)
    return share


def responsibility(likely: NDArray[np.floating], share: NDArray[np.floating]) -> NDArray[np.floating]:
    """Probability of each kind in each case."""
    mixed = np.maximum(likely * share, _TINY)
    return np.asarray(mixed / mixed.sum(axis=1, keepdims=True))


def _with_neighbours(likely: Float32Array, share: Float32Array, known: BoolArray) -> Float32Array:
    """What is expected of each ``known`` cell before it is asked: ``share``, and what those around it show."""
    place = np.full(np.add(known.shape, 2 * _REACH), len(likely))
    place[_REACH:-_REACH, _REACH:-_REACH][known] = np.arange(len(likely))
    rows, columns = np.nonzero(known)
    neighbours = [
        place[rows + b, columns + a] for b in _SQUARE for a in _SQUARE if (a, b) != (_REACH, _REACH)
    ]
    count = (np.stack(neighbours, axis=1) < len(likely)).sum(axis=1, keepdims=True, dtype=np.float32)
    shown = np.zeros((len(likely) + 1, share.size), np.float32)
    expected: Float32Array = np.broadcast_to(share, likely.shape)
    for _ in range(_ROUNDS_AROUND):
        shown[:-1] = responsibility(likely, expected)
        beside, best = np.zeros_like(likely), -np.inf
        for near in neighbours:
            beside += shown[near]
        for weight in _WEIGHTS:
            tried = (weight * share + beside) / (weight + count)
            total = float(np.log(np.einsum("cw,cw->c", tried, likely), dtype=float).sum())
            if total > best:
                best, expected = total, tried
    return expected


def _likelihood(
    seen: Leanings, surface_variance: FloatArray, together: FloatArray, alone: FloatArray, independence: float
) -> Float32Array:
    """Likelihood of each pair of squared widths in each cell that has pixels, relative to the largest."""
    known = seen.number > 0
    n, total, information, squares, surface = (
        each[known][:, None]
        for each in (seen.number, seen.score, seen.information, seen.squares, surface_variance)
    )
    spread = 1.0 / (independence * information) + surface + together + alone / (independence * n)
    growth = 1.0 + alone * information / n
    freedom = np.maximum(n - 1.0 / independence, 0.0)
    scatter = np.maximum(squares - total**2 / information, 0.0)
    log = -0.5 * (np.log(spread) + (total / information) ** 2 / spread)
    log -= 0.5 * independence * (freedom * np.log(growth) + scatter / growth)
    return np.asarray(np.exp(log - log.max(axis=1, keepdims=True)), np.float32)


@kernel(relaxed=True)
def lean_strip(amplitude, weight, grid, holds, terms, cell_of, away_y, away_x, begin, sums):  # type: ignore[no-untyped-def]
    """One row of cells: the surface at each pixel [µm], and the sums of `Leanings`."""
    (table, start, step), (number, total, known, squares) = grid, sums
    bands, top = amplitude.shape[0], table.shape[0] - 1.0
    value, inverse = np.zeros((1, table.shape[1]), np.float32), np.zeros((1, table.shape[1]), np.float32)
    for r in range(begin.shape[0]):
        y = away_y[r]
        for c in range(begin.shape[1]):
            cell, x = cell_of[c], away_x[c]
            if not holds[cell]:
                continue
            term = terms[cell]
            begin[r, c] = (
                term[0] + term[1] * y + term[2] * x + term[3] * y * y + term[4] * y * x + term[5] * x * x
            )
            for band in range(bands):
                value[0, band], inverse[0, band] = amplitude[band, r, c], weight[band, r, c]
            place = min(max((begin[r, c] - start) / step, 0.0), top)
            gain, information, _ = score(table, place, value, inverse, np.int64(0))
            if information > np.float32(0.0):
                number[cell] += 1.0
                total[cell] += gain
                known[cell] += information
                squares[cell] += gain * gain / information
