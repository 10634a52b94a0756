"""The light of exposures that are searched, where it is not that of flats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ..array_types import FloatArray
from ..effects import ImageGeometry
from ..model import FringeModel


class Exposures(Protocol):
    """The light of the exposures, where it is not that of flats."""

    def response(self, model: FringeModel, start_um: float, step_um: float, count: int) -> FloatArray:
        """Response of every exposure at K places of the field on a uniform grid of thickness, in any unit.

        Shape ``(K * W, count)``, all exposures at one place after the other.
        """

    def place_weight(self, geometry: ImageGeometry) -> FloatArray:
        """Weights of the places for every cell, ``(K, ny, nx)``; their sum is 1."""

    def further(self) -> Sequence[tuple[str, str, Exposures]]:
        """Exposures that could be taken: a key, what to take, the present ones with as many of those behind them."""
