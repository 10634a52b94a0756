"""The part of a sensor that is searched where fringes of a few pixels forbid larger cells."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...array_types import BoolArray
from ...effects import ImageGeometry
from ...products.fringe_cube import FringeCube
from ..inference import CellShape
from .cells import CellData, bin_cube

LARGEST_SEARCH = 2
"""Cells, over those wanted, from which on a part of the sensor is searched: time and memory grow with them."""

FEWEST_ROWS = 96  # Rows of cells that a part has, if the sensor has them
ALIGNED_PX = 64  # Places at which a part may begin [px]: the side of the largest cells


@dataclass(frozen=True)
class SensorPart:
    """Rows and columns of pixels."""

    rows: slice
    columns: slice

    @classmethod
    def of(cls, shape: tuple[int, ...], cell_px: int, most_cells: int) -> SensorPart:
        """The part about the middle with about so many cells at most: as wide as may be, to see all amplifiers."""
        number = [size // cell_px for size in shape]
        most = LARGEST_SEARCH * most_cells
        if number[0] * number[1] <= most:
            return cls(slice(0, shape[0]), slice(0, shape[1]))
        high = min(number[0], max(FEWEST_ROWS, most // number[1]))
        wide = min(number[1], max(most // high, 1))
        return cls(*(_middle(size, cell_px * own) for size, own in zip(shape, (high, wide), strict=True)))

    def inside(self, shape: tuple[int, ...]) -> BoolArray:
        """Its pixels in an image."""
        found = np.zeros(shape, dtype=bool)
        found[self.rows, self.columns] = True
        return found

    def in_cells(self, cube: FringeCube, cell_px: int) -> CellData:
        """Its pixels averaged over cells."""
        rows, columns = (
            slice(own.start // cell_px, own.stop // cell_px) for own in (self.rows, self.columns)
        )
        return bin_cube(cube, cell_px).window(rows, columns)


def _middle(size: int, wanted: int) -> slice:
    """About so many pixels of a side about its middle, all of it where no more are wanted."""
    if wanted + ALIGNED_PX > size:
        return slice(0, size)
    wanted -= wanted % ALIGNED_PX
    first = (size - wanted) // 2
    first -= first % ALIGNED_PX
    return slice(first, first + wanted)


def told_of_part(cells: CellData) -> tuple[str, ...]:
    """Which part of the sensor is searched, if it is not the whole."""
    geometry, half = cells.geometry, 0.5 * (cells.cell_px - 1)
    if is_whole(cells):
        return ()
    ends = [
        f"{name} {int(place[0] - half)} to {int(place[-1] + half)}"
        for name, place in (("rows", geometry.y_px), ("columns", geometry.x_px))
    ]
    return (f"the fringes are too narrow for larger cells: searched in {' and '.join(ends)}",)


def is_whole(cells: CellData) -> bool:
    """Whether cells are those of a whole sensor."""
    return cells.shape[1:] == tuple(size // cells.cell_px for size in cells.geometry.shape)


def with_edges_of_sensor(shape: CellShape, cells: CellData) -> CellShape:
    """The same with blurs mirrored at the edges of the sensor, not at those of the part that is searched."""
    if is_whole(cells):
        return shape
    geometry: ImageGeometry = cells.geometry
    places = zip(geometry.shape, (geometry.y_px, geometry.x_px), strict=True)
    away = [np.where(own < 0.5 * (size - 1), own + 0.5, own + 0.5 - size) for size, own in places]
    return replace(shape, edge_px=np.stack([axis.ravel() for axis in np.meshgrid(*away, indexing="ij")]))
