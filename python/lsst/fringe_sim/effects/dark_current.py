"""Dark current, or light that leaks in while the shutter is open."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..errors import InputError
from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["DarkCurrent"]

LEAST_RATIO = 1.05
"""Longest over shortest exposure from which its length can tell a rate from a level."""


class DarkCurrent(PlainNullEffect):
    """Every exposure gathers electrons that are not from the monochromator in proportion to its length."""

    name = "dark_current"
    title = "dark current or light leak, per second"
    acts_on = "image"
    exact = True
    laboratory_only = True
    reference = "EMVA standard 1288, release 4 (dark current of a camera)"
    parameters = (Parameter("rate", "electron/s", 0.0, (-50.0, 2000.0), 2.0, "electrons per second"),)

    def dark_charge(self, values: Mapping[str, float], geometry: ImageGeometry) -> FloatArray:
        """The rate, times the length of each exposure."""
        return values["rate"] * geometry.require_dark_times(self.name)

    def check_search(self, geometry: ImageGeometry) -> None:
        """Refuse exposures of one length, in which it is `DarkPedestal`."""
        times = geometry.require_dark_times(self.name)
        if np.max(times) < LEAST_RATIO * np.min(times):
            raise InputError(
                "dark times [s]",
                sorted(set(times.ravel().tolist())),
                "different ones, else it is dark_pedestal",
            )
