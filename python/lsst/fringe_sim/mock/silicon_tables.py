"""Signal of flats against two thicknesses: that of the layer that varies, and that of the detection layer beside it.

The detection layer has fringes of its own, one every 0.13 µm, which a narrow line shows. The signal is tabulated for
evenly spaced detection layers and interpolated between them by a polynomial; how many are needed is measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from ..array_types import FloatArray
from ..compiled import kernel
from ..errors import ConvergenceError
from .optics import RELATIVE_TOLERANCE, FlatFieldOptics
from .signal_table import SignalTable

Seen = Callable[..., FloatArray]

PER_ORDER = 6
"""Detection layers in one of its fringes, at first; twice as many until the error is small enough."""

HALVINGS = 4  # Times that their number is doubled at most
STENCIL = 8  # Neighbours that take part in the interpolation: the polynomial of seventh degree through them

PROBES = 5
"""Places between detection layers, and thicknesses of the varying layer at each, at which the error is measured."""

_SHARE = np.array([(-1.0) ** (STENCIL - 1 - k) * math.comb(STENCIL - 1, k) for k in range(STENCIL)])
_SHARE /= math.factorial(STENCIL - 1)
"""Factors of the polynomials through one of the neighbours and zero at all others."""


@dataclass(frozen=True, eq=False)
class SiliconTables:
    """Signal of flats on a grid of two thicknesses."""

    # (N,): what is added to the detection layer in each table, evenly spaced [µm]; one if it is the same
    # everywhere
    added_um: FloatArray
    tables: tuple[SignalTable, ...]  # Signal against the thickness of the varying layer
    # Largest relative difference found to a direct calculation, of the tables or between them
    relative_error: float = math.nan

    @classmethod
    def of(
        cls,
        optics: FlatFieldOptics,
        thickness_range_um: tuple[float, float],
        added_range_um: tuple[float, float],
        wavelengths_nm: tuple[float, ...],
    ) -> SiliconTables:
        """Tabulate as many detection layers as are needed."""
        low, high = added_range_um
        if high == low:
            table = _thicker(optics, low).table(thickness_range_um, wavelengths_nm)
            return cls(np.array([low]), (table,), table.relative_error)
        film = optics.films[optics.position(optics.detection)]
        shortest = min(optics.true_wavelength(each) for each in wavelengths_nm)
        index = float(film.index(np.array([shortest]), optics.temperature_k)[0].real)
        finest = 0.5e-3 * shortest / index / PER_ORDER / 2**HALVINGS
        known: dict[int, SignalTable] = {}  # by number of the finest steps above the thinnest
        worst = math.inf
        for halving in range(HALVINGS + 1):
            every = 2 ** (HALVINGS - halving)
            last = math.ceil((high - low) / (finest * every))
            numbers = [every * k for k in range(1 - STENCIL // 2, last + STENCIL // 2)]
            for number in numbers:
                if number not in known:
                    layer = _thicker(optics, low + finest * number)
                    known[number] = layer.table(thickness_range_um, wavelengths_nm)
            found = cls(low + finest * np.array(numbers), tuple(known[number] for number in numbers))
            worst = found._measure_error(optics, thickness_range_um, added_range_um)
            if worst < RELATIVE_TOLERANCE:
                return cls(found.added_um, found.tables, worst)
        raise ConvergenceError(
            f"signal between detection layers is off by {worst:.1e} of its value; allowed: {RELATIVE_TOLERANCE:g}"
        )

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """Nominal wavelength of each flat [nm]."""
        return self.tables[0].wavelengths_nm

    def of_flat(self, row: int) -> Seen:
        """Signal of one flat as a function of both thicknesses."""
        if len(self.tables) == 1:
            return lambda thickness_um, *_: self.tables[0].evaluate(row, thickness_um)
        grid = self.tables[0].grid_um
        signal = np.stack([table.signal[row] for table in self.tables])
        pieces = np.ascontiguousarray(CubicSpline(grid, signal, axis=1).c.transpose(2, 1, 0))
        first, spacing = float(self.added_um[0]), float(self.added_um[1] - self.added_um[0])

        def seen(thickness_um: FloatArray, added_um: FloatArray) -> FloatArray:
            place = (np.ravel(thickness_um) - grid[0]) / (grid[1] - grid[0])
            layer = (np.ravel(added_um) - first) / spacing
            found = _between(pieces, float(grid[1] - grid[0]), place, layer, _SHARE)
            return np.asarray(found.reshape(np.shape(thickness_um)))

        return seen

    def _measure_error(
        self,
        optics: FlatFieldOptics,
        thickness_range_um: tuple[float, float],
        added_range_um: tuple[float, float],
    ) -> float:
        """Largest relative difference to a direct calculation in the middle between detection layers."""
        rng = np.random.default_rng(len(self.tables))
        inside = self.added_um[STENCIL // 2 - 1 : -STENCIL // 2]
        middle = rng.choice(inside, min(PROBES, len(inside)), replace=False) + 0.5 * np.diff(self.added_um)[0]
        middle = np.clip(middle, *added_range_um)
        thickness = rng.uniform(*thickness_range_um, PROBES)
        layers = [_thicker(optics, float(added)) for added in middle]
        worst = max(table.relative_error for table in self.tables)
        for row, wavelength in enumerate(self.wavelengths_nm):
            seen = self.of_flat(row)
            for added, layer in zip(middle, layers, strict=True):
                direct = layer.flat_field(thickness, wavelength)
                found = seen(thickness, np.full(thickness.shape, added))
                worst = max(worst, float(np.abs(found / direct - 1.0).max()))
        return worst


def _thicker(optics: FlatFieldOptics, added_um: float) -> FlatFieldOptics:
    nominal = optics.films[optics.position(optics.detection)].thickness_um
    return optics.with_film(optics.detection, thickness_um=nominal + added_um)


@kernel
def _between(
    pieces: FloatArray, step_um: float, place: FloatArray, layer: FloatArray, share: FloatArray
) -> FloatArray:  # pragma: no cover - compiled
    """Signal at places on the grid of the varying layer and of the detection layer, in steps of either."""
    result = np.empty(place.size)
    width, last = share.size, pieces.shape[1] - 1
    for i in range(place.size):
        piece = min(int(place[i]), last)
        x = (place[i] - piece) * step_um
        lowest = min(max(int(layer[i]) - width // 2 + 1, 0), pieces.shape[0] - width)
        total = 0.0
        for k in range(width):
            weight = share[k]
            for other in range(width):
                if other != k:
                    weight *= layer[i] - lowest - other
            c = pieces[lowest + k, piece]
            total += weight * (((c[0] * x + c[1]) * x + c[2]) * x + c[3])
        result[i] = total
    return result
