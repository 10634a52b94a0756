"""Gain errors of the amplifiers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import AMPLIFIERS, ImageGeometry

__all__ = ["AmplifierGain"]


class AmplifierGain(PlainNullEffect):
    """Each amplifier has another gain than the tables say; a common factor does not show in relative flats."""

    name = "amplifier_gain"
    title = "gain errors of the amplifiers"
    acts_on = "image"
    reference = "Guo, Walter, Lage & Lupton 2022, section 3.2; gains of LSSTCam scatter by a few per cent"
    parameters = tuple(
        Parameter(name, "", 0.0, (-0.5, 0.5), 0.01, f"relative gain error of {name}") for name in AMPLIFIERS
    )

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Divide by the gain of the amplifier that reads the sample; a gain common to all is one of the level."""
        counts = 1.0 / np.array([1.0 + values[name] for name in AMPLIFIERS])
        return image * (counts / counts.mean())[geometry.amplifier]
