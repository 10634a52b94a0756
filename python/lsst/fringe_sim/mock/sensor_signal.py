"""Signal of every pixel of a sensor, whose detection layer may be a wedge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..array_types import FloatArray
from .hidden_effect import RIM_SQUARES
from .hidden_effects import ActiveHiddenEffect, Island, added_silicon, hidden_islands
from .optics import FlatFieldOptics
from .silicon_tables import SiliconTables
from .thickness import PixelArea


@dataclass(frozen=True, eq=False)
class SensorSignal:
    """Signal of flats at every pixel."""

    area: PixelArea  # thickness of the varying layer
    thicker: tuple[PixelArea, ...]  # what is added to the detection layer; none if it is even
    tables: SiliconTables  # signal against both
    # What of the sensor has other optics, and the signal of a sensor that has them everywhere
    islands: tuple[tuple[Island, SensorSignal], ...] = ()

    @classmethod
    def of(
        cls,
        optics: FlatFieldOptics,
        thickness_um: FloatArray,
        wavelengths_nm: Sequence[float],
        thicker_um: FloatArray | None = None,
        islands: Sequence[tuple[Island, FlatFieldOptics]] = (),
    ) -> SensorSignal:
        """Tabulate what the pixels need.

        ``thicker_um`` is added to the detection layer, by default nothing; ``islands`` are parts of the sensor that
        see other optics.
        """
        area = PixelArea.of(thickness_um)
        thicker = () if thicker_um is None else (PixelArea.of(thicker_um),)
        added_um = thicker[0].range_um if thicker else (0.0, 0.0)
        tables = SiliconTables.of(optics, area.range_um, added_um, tuple(wavelengths_nm))
        others = tuple(
            (island, cls.of(inside, thickness_um, wavelengths_nm, thicker_um)) for island, inside in islands
        )
        return cls(area, thicker, tables, others)

    @classmethod
    def with_effects(
        cls,
        optics: FlatFieldOptics,
        thickness_um: FloatArray,
        wavelengths_nm: Sequence[float],
        active: Sequence[ActiveHiddenEffect],
    ) -> SensorSignal:
        """The same with what hidden effects do to parts of the sensor; ``optics`` has what they do to all of it."""
        shape = (thickness_um.shape[0], thickness_um.shape[1])
        silicon, islands = added_silicon(shape, active), hidden_islands(optics, shape, active)
        return cls.of(optics, thickness_um, wavelengths_nm, silicon, islands)

    def flat(self, row: int) -> FloatArray:
        """Signal of one flat.

        Pixels that the rim of an island crosses see each stack at the thickness of their own part of it.
        """
        signal = self._of_all(row)
        for island, inside in self.islands:
            difference = island.part * (inside.flat(row) - signal)
            rim = island.rows, island.columns
            if island.rows.size:  # none where the rim lies outside the sensor
                there = inside._in_squares(row, *rim) - self._in_squares(row, *rim)
                difference[rim] = (island.squares * there).mean(axis=(1, 2))
            signal = signal + difference
        return signal

    def _in_squares(self, row: int, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> FloatArray:
        """Signal in the middle of the equal squares of some pixels, without islands."""
        places = (area.in_squares(rows, columns, RIM_SQUARES) for area in (self.area, *self.thicker))
        return self.tables.of_flat(row)(*places)

    def _of_all(self, row: int) -> FloatArray:
        """Signal outside islands."""
        return self.area.average(self.tables.of_flat(row), *self.thicker)
