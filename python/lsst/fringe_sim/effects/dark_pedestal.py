"""Level that does not come from the light of the exposure."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["DarkPedestal"]


class DarkPedestal(PlainNullEffect):
    """Every exposure holds the same number of electrons that are not from the monochromator."""

    name = "dark_pedestal"
    title = "dark pedestal, the same in every exposure"
    acts_on = "image"
    exact = True
    laboratory_only = True
    reference = "EMVA standard 1288, release 4 (dark signal of a camera)"
    parameters = (
        Parameter("electrons", "electron", 0.0, (-5000.0, 100000.0), 200.0, "level in every exposure"),
    )

    def dark_charge(self, values: Mapping[str, float], geometry: ImageGeometry) -> FloatArray:
        """The pedestal, in every exposure."""
        return np.full((1, 1, 1), values["electrons"])
