"""Whitened derivatives of the data with respect to what is asked about."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...array_types import FloatArray


@dataclass(frozen=True, eq=False)
class PlaneColumns:
    """Whitened derivatives each of which concerns one wavelength, as those with respect to the levels.

    Written out, such columns would be zeros but for one plane in ``W``.
    """

    amplitude: FloatArray  # (C, ny, nx): derivatives in units of the noise
    plane: NDArray[np.int64]  # (C,): the wavelength that each belongs to
    basis: FloatArray  # (C, L): free parameters of which they are made

    def dot(self, values: FloatArray) -> FloatArray:
        """Products with whitened ``(..., W, ny, nx)``, shape ``(..., L)``."""
        result = np.empty((*values.shape[:-3], len(self.plane)))
        for wave in np.unique(self.plane):
            own = self.plane == wave
            flat = self.amplitude[own].reshape(int(own.sum()), -1)
            result[..., own] = values[..., wave, :, :].reshape(*values.shape[:-3], flat.shape[1]) @ flat.T
        return np.asarray(result @ self.basis)

    def along(self, slope: FloatArray) -> FloatArray:
        """Products cell by cell with a whitened slope ``(W, ny, nx)``, shape ``(L, ny, nx)``."""
        return np.tensordot(self.basis.T, self.amplitude * slope[self.plane], axes=1)

    @functools.cached_property
    def gram(self) -> FloatArray:
        """Products with one another, shape ``(L, L)``."""
        return self.against(self)

    def against(self, levels: PlaneColumns) -> FloatArray:
        """Products with other columns, shape ``(L, their L)``."""
        first, second = (each.amplitude.reshape(len(each.plane), -1) for each in (self, levels))
        planes = np.where(self.plane[:, np.newaxis] == levels.plane, first @ second.T, 0.0)
        return np.asarray(self.basis.T @ planes @ levels.basis)


class Columns(Protocol):
    """Whitened derivatives, written out or not; see `PlaneColumns`."""

    @property
    def gram(self) -> FloatArray:
        """Products with one another, shape ``(L, L)``."""

    def dot(self, values: FloatArray) -> FloatArray:
        """Products with whitened ``(..., W, ny, nx)``, shape ``(..., L)``."""

    def along(self, slope: FloatArray) -> FloatArray:
        """Products cell by cell with a whitened slope ``(W, ny, nx)``, shape ``(L, ny, nx)``."""

    def against(self, levels: PlaneColumns) -> FloatArray:
        """Products with other columns, shape ``(L, their L)``."""


Projected = Callable[[FloatArray, tuple[FloatArray, FloatArray]], FloatArray]
"""Score of columns for a whitened residual and the scores of the nuisances."""
