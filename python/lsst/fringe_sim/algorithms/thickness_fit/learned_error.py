"""What an error of all that was learned does to the thickness, which differs from place to place.

It moves a pixel that was fitted by itself as its own phase has it, at one wavelength up and at another down. A
surface through the cells around it has the mean of many phases, and is moved less.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, Float32Array, FloatArray
from .cells import Cells
from .learning import moves_of
from .learning_cells import LearningCells
from .local_surface import shares_of_middle
from .nuisances import NuisanceFit, Nuisances, patterns_of_cells
from .pixels import CellSurface
from .templates import FlatTemplates

_MOST_PLACES = 32  # Places along a side of the sensor at which the surface is asked
_AT_ONCE = 256


def learned_sigma(
    cells: Cells,
    surface: CellSurface,
    leaning: BoolArray,
    base: FlatTemplates,
    free: Nuisances,
    fit: NuisanceFit,
    order_um: float,
) -> Float32Array:
    """Standard uncertainty of the thickness of every pixel from all that was learned but the scale [µm].

    ``leaning``: pixels that have the surface of the cells as their prior, bool, ``(ny, nx)``. Returns float32,
    ``(ny, nx)``.
    """
    if fit.covariance.size == 0 or not surface.known.any():
        return np.zeros(leaning.shape, np.float32)
    rows, columns = (_places(size) for size in cells.shape)
    y, x = (place.ravel() for place in np.meshgrid(rows, columns, indexing="ij"))
    parts = [
        _variances(cells, surface, y[some], x[some], base, free, fit, order_um)
        for some in np.array_split(np.arange(y.size), -(-y.size // _AT_ONCE))
    ]
    alone, together = np.concatenate(parts, axis=1)
    own = float(np.sqrt(np.nanmean(alone))) if np.isfinite(alone).any() else 0.0
    shared = np.where(np.isfinite(together), np.sqrt(together), own).astype(np.float32)
    shared = shared.reshape(len(rows), len(columns))
    near = [
        np.searchsorted(0.5 * (at[1:] + at[:-1]), np.repeat(np.arange(size), np.diff(edges)))
        for at, size, edges in zip((rows, columns), cells.shape, (cells.y_edges, cells.x_edges), strict=True)
    ]
    return np.where(leaning, shared[np.ix_(*near)], np.float32(own))


def _places(size: int) -> NDArray[np.intp]:
    """Some of so many cells at equal distances."""
    stride = -(-size // _MOST_PLACES)
    return np.arange(min(stride // 2, size - 1), size, stride)


def _variances(
    cells: Cells,
    surface: CellSurface,
    y: NDArray[np.intp],
    x: NDArray[np.intp],
    base: FlatTemplates,
    free: Nuisances,
    fit: NuisanceFit,
    order_um: float,
) -> FloatArray:
    """Variance of the thickness of some cells by themselves, and of the surface about each; NaN if unknown."""
    seen = np.where(surface.known & np.isfinite(surface.sigma_um), surface.sigma_um, np.inf)
    b, a, share = shares_of_middle(surface, seen.astype(float) ** -2.0, y, x, order_um)
    rows, columns = (np.concatenate([own[:, None], near], axis=1).ravel() for own, near in ((y, b), (x, a)))
    pattern, zones = patterns_of_cells(cells, free, rows, columns)
    sample = LearningCells(
        cells.value[rows, columns], cells.weight[rows, columns], surface.thickness_um[rows, columns], pattern,
        zones, 1.0, order_um,
    )  # fmt: skip
    moves = moves_of(sample, base, free, fit)[0].reshape(len(fit.covariance), y.size, -1)
    both = moves[..., 0], np.einsum("pnk,nk->pn", moves[..., 1:], share)
    alone, together = (np.einsum("pn,pq,qn->n", each, fit.covariance, each, optimize=True) for each in both)
    return np.where([surface.known[y, x], share.any(axis=1)], [alone, together], np.nan)
