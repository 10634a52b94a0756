"""A first thickness that grows from cell to cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...array_types import Float32Array, FloatArray
from ...compiled import kernel, subkernel


def grown(score: Float32Array, rows: int, columns: int, reach: int) -> NDArray[np.int64]:
    """Follow the best correlation from cell to cell, clearest first."""
    clarity = score.max(axis=1).astype(float)
    # The seed lies inside, where it has neighbours on all sides.
    y, x = np.divmod(np.arange(len(score)), columns)
    inside = np.minimum(y, rows - 1 - y) + 1 > rows // 8
    inside &= np.minimum(x, columns - 1 - x) + 1 > columns // 8
    seed = int(np.argmax(np.where(inside & (clarity > 0.0), clarity, 0.0)))
    best = np.full(len(score), -1, np.int64)
    best[seed] = np.argmax(score[seed])
    _grow_from(seed, score, clarity, rows, columns, reach, best)
    return best


@kernel
def _grow_from(
    seed: int,
    score: Float32Array,
    clarity: FloatArray,
    rows: int,
    columns: int,
    reach: int,
    best: NDArray[np.int64],
) -> None:  # pragma: no cover - compiled
    """The cells at the rim of the grown region wait in buckets by their clarity."""
    cells = len(best)
    buckets = 64
    head = np.full(buckets, -1, np.int64)
    follow = np.full(cells, -1, np.int64)
    queued = np.zeros(cells, np.bool_)
    queued[seed] = True
    head[buckets - 1] = seed
    while True:
        level = buckets - 1
        while level >= 0 and head[level] < 0:
            level -= 1
        if level < 0:
            break
        i = head[level]
        head[level] = follow[i]
        if best[i] < 0:
            best[i] = _choose(score, best, rows, columns, i, reach)
        y, x = i // columns, i % columns
        for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            ny, nx = y + dy, x + dx
            if ny < 0 or nx < 0 or ny >= rows or nx >= columns:
                continue
            j = ny * columns + nx
            if not queued[j]:
                queued[j] = True
                place = min(buckets - 1, max(0, int(clarity[j] * (buckets - 1))))
                follow[j] = head[place]
                head[place] = j


@subkernel
def _choose(
    score: Float32Array, best: NDArray[np.int64], rows: int, columns: int, i: int, reach: int
) -> int:  # pragma: no cover - compiled
    """Thickness of a cell: the best correlation near the plane through the grown cells around it."""
    y, x = i // columns, i % columns
    around = 3
    n = sx = sy = sz = sxx = syy = sxy = sxz = syz = 0.0
    for dy in range(-around, around + 1):
        for dx in range(-around, around + 1):
            yy, xx = y + dy, x + dx
            if yy < 0 or xx < 0 or yy >= rows or xx >= columns:
                continue
            value = best[yy * columns + xx]
            if value < 0:
                continue
            w = 1.0 / (dx * dx + dy * dy)
            n += w
            sx += w * dx
            sy += w * dy
            sz += w * value
            sxx += w * dx * dx
            syy += w * dy * dy
            sxy += w * dx * dy
            sxz += w * dx * value
            syz += w * dy * value
    mx, my, mz = sx / n, sy / n, sz / n
    vxx, vyy, vxy = sxx / n - mx * mx + 0.3, syy / n - my * my + 0.3, sxy / n - mx * my
    vxz, vyz = sxz / n - mx * mz, syz / n - my * mz
    determinant = vxx * vyy - vxy * vxy
    gx = (vxz * vyy - vyz * vxy) / determinant
    gy = (vyz * vxx - vxz * vxy) / determinant
    expected = mz - gx * mx - gy * my
    count = score.shape[1]
    low = max(0, round(expected) - reach)
    high = min(count - 1, round(expected) + reach)
    if high < low:
        return min(max(round(expected), 0), count - 1)
    place, largest = low, -1.0
    for k in range(low, high + 1):
        away = (k - expected) / (0.7 * reach)
        value = score[i, k] - 0.3 * away * away
        if value > largest:
            place, largest = k, value
    return place
