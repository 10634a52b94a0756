"""Signal of flats against thickness, as piecewise cubics."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..array_types import FloatArray
from ..compiled import kernel
from ..errors import OutOfRangeError


@dataclass(frozen=True, eq=False)
class SignalTable:
    """Signal as a function of thickness, on a uniform grid.

    Attributes
    ----------
    grid_um : `numpy.ndarray`, shape ``(D,)``
        Thickness of the varying layer [µm].
    signal : `numpy.ndarray`, shape ``(W, D)``
        Detected over incident photons of each flat.
    wavelengths_nm : `tuple` [`float`, ...]
        Nominal wavelength of each flat [nm].
    relative_error : `float`
        Largest relative difference found to a direct calculation with finer wavelength nodes.
    """

    grid_um: FloatArray
    signal: FloatArray
    wavelengths_nm: tuple[float, ...]
    relative_error: float = math.nan

    def evaluate(self, row: int, thickness_um: NDArray[np.floating]) -> FloatArray:
        """Signal of flat number ``row`` at any thickness within the grid, by cubic spline.

        Raises
        ------
        OutOfRangeError
            A thickness that is not on the grid (or not a number).
        """
        thickness = np.asarray(thickness_um)
        low, high = float(self.grid_um[0]), float(self.grid_um[-1])
        smallest, largest = float(np.min(thickness)), float(np.max(thickness))
        if not (smallest >= low and largest <= high):
            raise OutOfRangeError("thickness [um]", (smallest, largest), f"{low:g} to {high:g}")
        pieces = np.ascontiguousarray(CubicSpline(self.grid_um, self.signal[row]).c.T)
        step = (high - low) / (len(self.grid_um) - 1)
        return _evaluate_pieces(pieces, low, step, thickness.ravel()).reshape(thickness.shape)


@kernel
def _evaluate_pieces(
    pieces: FloatArray, low: float, step: float, position: NDArray[np.floating]
) -> FloatArray:  # pragma: no cover - compiled
    result = np.empty(position.size)
    last = pieces.shape[0] - 1
    for i in range(position.size):
        where = (position[i] - low) / step
        piece = min(int(where), last)
        x = position[i] - (low + piece * step)
        c = pieces[piece]
        result[i] = ((c[0] * x + c[1]) * x + c[2]) * x + c[3]
    return result
