"""Cells and small blocks of pixels from which light, contrast and wavelengths are learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...array_types import FloatArray
from .amplitudes import Amplitudes
from .bands import gather_pixels
from .cells import Cells, effective_number
from .nuisances import Nuisances, light_patterns, patterns_of_cells
from .pixels import CellSurface

MOST_CELLS = 3_000
_MOST_BLOCKS = 6_000
_LARGEST_BLOCK = 6
_LEAST_KEPT = 0.7  # Share of its contrast that a block must keep
_PHASE_SIGMA = 0.1
"""Uncertainty of the phase of a block [rad] at which its noise raises the contrast by half a per cent."""


@dataclass(frozen=True, eq=False)
class LearningCells:
    """Cells from which nuisances are learned, as they came from the flats."""

    value: NDArray[np.float32]
    weight: NDArray[np.float32]
    thickness_um: NDArray[np.float32]
    pattern: FloatArray
    zones: int
    temper: float
    order_um: float

    @classmethod
    def of(
        cls, cells: Cells, thickness_um: NDArray[np.float32], free: Nuisances, temper: float, order_um: float
    ) -> LearningCells:
        """Some thousand cells with a thickness, drawn at random but always the same."""
        good = some_of(np.flatnonzero(np.isfinite(thickness_um)), MOST_CELLS)
        pattern, zones = patterns_of_cells(cells, free, *np.unravel_index(good, cells.shape))
        width = cells.value.shape[-1]
        return cls(
            np.ascontiguousarray(cells.value.reshape(-1, width)[good]),
            np.ascontiguousarray(cells.weight.reshape(-1, width)[good]),
            thickness_um.ravel()[good],
            pattern,
            zones,
            temper,
            order_um,
        )


def sample_blocks(
    data: Amplitudes, surface: CellSurface, free: Nuisances, phase_sigma: float, order_um: float
) -> LearningCells:
    """Small blocks of pixels on the surface of the cells, drawn at random but always the same.

    Cells are steep: their averages lose contrast and overtones. A block is only as large as its noise asks for, as
    the contrast of what is mostly noise would be taken for too high.

    ``phase_sigma``: standard uncertainty of the phase of a single pixel [rad]; ``order_um``: thickness of one order
    [µm].
    """
    _, ny, nx = data.shape
    phase_sigma = np.nan_to_num(phase_sigma, nan=np.inf)  # no phase at all: blocks as large as they may be
    side = int(np.clip(np.ceil(phase_sigma / _PHASE_SIGMA), 1, min(_LARGEST_BLOCK, ny, nx)))
    rng = np.random.default_rng(0)
    count = min(_MOST_BLOCKS, (ny // side) * (nx // side))
    place = np.sort(rng.choice((ny // side) * (nx // side), count, replace=False))
    rows, columns = side * (place // (nx // side)), side * (place % (nx // side))
    parts = [gather_pixels(data, rows + b, columns + a) for b in range(side) for a in range(side)]
    weights = np.asarray(sum(weight for _, weight in parts), np.float32)
    sums = np.asarray(sum(value * weight for value, weight in parts), np.float32)
    middle = (side - 1) // 2
    y, x = rows + middle, columns + middle
    thickness = _surface_at(surface, y, x)
    good = np.isfinite(thickness) & (weights > 0).any(axis=1)
    pattern, zones = light_patterns(
        free, (ny, nx), *(np.asarray(part + 0.5 * (side - 1), dtype=float) for part in (rows, columns))
    )
    values = np.divide(sums, weights, out=np.zeros_like(sums), where=weights > 0)
    # What the average over a block keeps of its fringes.
    turns = [
        0.5 * side / order_um * (_surface_at(surface, *ahead) - _surface_at(surface, *behind))
        for ahead, behind in (
            ((np.minimum(y + 1, ny - 1), x), (np.maximum(y - 1, 0), x)),
            ((y, np.minimum(x + 1, nx - 1)), (y, np.maximum(x - 1, 0))),
        )
    ]
    kept = np.sinc(turns[0]) * np.sinc(turns[1]) if side > 1 else np.ones(y.size)
    good &= kept > _LEAST_KEPT
    values, weights = (
        values / kept[:, None].astype(np.float32),
        weights * (kept**2)[:, None].astype(np.float32),
    )
    temper = effective_number(side, side, data.noise_correlation_px) / side**2
    return LearningCells(
        np.asarray(values[good], np.float32),
        np.asarray(temper * weights[good], np.float32),
        thickness[good],
        pattern[good],
        zones,
        1.0,
        order_um,
    )


def _surface_at(surface: CellSurface, y: NDArray[np.intp], x: NDArray[np.intp]) -> NDArray[np.float32]:
    """Bilinear surface at single places [µm]."""
    order = np.argsort(y, kind="stable")
    out = np.empty(y.size, np.float32)
    for part in np.array_split(order, max(y.size // 200, 1)):
        if part.size:
            rows, place = np.unique(y[part], return_inverse=True)
            out[part] = surface.at(rows, x[part])[place, np.arange(part.size)]
    return out


def some_of(index: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Some of many, drawn at random but always the same."""
    if index.size <= most:
        return index
    return np.sort(np.random.default_rng(0).choice(index, most, replace=False))
