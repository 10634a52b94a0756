"""Gain errors of the amplifiers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import AMPLIFIERS, ImageGeometry

__all__ = ["AmplifierGain"]


class AmplifierGain(PlainNullEffect):
    """Each amplifier has another gain (electrons per count) than the tables say, and one that is larger counts fewer.

    A factor common to all does not show in relative flats: the errors are known relative to one another, and the
    uncertainty of each is mostly that of their mean.
    """

    name = "amplifier_gain"
    title = "gain errors of the amplifiers"
    acts_on = "image"
    exact = True
    exchangeable = True
    reference = "Guo, Walter, Lage & Lupton 2022, section 3.2; gains of LSSTCam scatter by a few per cent"
    parameters = tuple(
        Parameter(name, "", 0.0, (-0.5, 0.5), 0.01, f"true over stated gain of {name}, minus 1")
        for name in AMPLIFIERS
    )

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Divide by the gain of the amplifier that reads the sample; a gain common to all is one of the level."""
        counts = 1.0 / np.array([1.0 + values[name] for name in AMPLIFIERS])
        return image * (counts / counts.mean())[geometry.amplifier]
