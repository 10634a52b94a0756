"""Signal of every pixel of a sensor, whose detection layer may be a wedge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .hidden_effect import RIM_SQUARES
from .hidden_effects import ActiveHiddenEffect, Island, added_silicon, hidden_islands
from .optics import FlatFieldOptics, SignalTable
from .thickness import PixelArea

__all__ = ["SensorSignal"]

FloatArray = NDArray[np.float64]

SILICON_STEP_UM = 0.03
"""Largest step from one detection layer to the next [µm], a quarter of the period of its own fringes."""


@dataclass(frozen=True, eq=False)
class SensorSignal:
    """Signal of flats at every pixel."""

    area: PixelArea  # thickness of the varying layer
    thicker_um: FloatArray  # [y, x]: what is added to the detection layer
    added_um: FloatArray  # (N,): the same for the N tables, increasing
    tables: tuple[SignalTable, ...]  # signal against the thickness of the varying layer
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
        wedge = np.zeros(thickness_um.shape) if thicker_um is None else thicker_um
        low, high = float(wedge.min()), float(wedge.max())
        added = np.linspace(low, high, 1 + math.ceil((high - low) / SILICON_STEP_UM))
        nominal = optics.films[optics.position(optics.detection)].thickness_um
        tables = tuple(
            optics.with_film(optics.detection, thickness_um=nominal + more).table(
                area.range_um, tuple(wavelengths_nm)
            )
            for more in added
        )
        others = tuple(
            (island, cls.of(inside, thickness_um, wavelengths_nm, thicker_um)) for island, inside in islands
        )
        return cls(area, wedge, added, tables, others)

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
        middle = (np.arange(RIM_SQUARES) + 0.5) / RIM_SQUARES - 0.5
        rim = rows, columns
        thickness, slope_y, slope_x = (
            values[rim][:, np.newaxis, np.newaxis]
            for values in (self.area.thickness_um, self.area.slope_y, self.area.slope_x)
        )
        within = thickness + slope_y * middle[:, np.newaxis] + slope_x * middle
        added = np.broadcast_to(self.thicker_um[rim][:, np.newaxis, np.newaxis], within.shape)
        flat = np.zeros(within.shape)
        points = SensorSignal(PixelArea(within, flat, flat), added, self.added_um, self.tables)
        return points._of_all(row)

    def _of_all(self, row: int) -> FloatArray:
        """Signal outside islands, in a straight line between detection layers."""
        if len(self.tables) == 1:
            return self.area.average(partial(self.tables[0].evaluate, row))
        place = (self.thicker_um - self.added_um[0]) / (self.added_um[1] - self.added_um[0])
        signal = np.zeros(place.shape)
        for number, table in enumerate(self.tables):
            share = 1.0 - np.abs(place - number)
            near = share > 0.0
            if not near.any():
                continue
            part = PixelArea(self.area.thickness_um[near], self.area.slope_y[near], self.area.slope_x[near])
            signal[near] += share[near] * part.average(partial(table.evaluate, row))
        return signal
