"""Bias residuals of the amplifiers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import AMPLIFIERS, ImageGeometry

__all__ = ["AmplifierOffset"]


class AmplifierOffset(PlainNullEffect):
    """Each amplifier keeps a level of its own after the bias was taken off."""

    name = "amplifier_offset"
    title = "bias residuals of the amplifiers"
    acts_on = "image"
    exact = True
    exchangeable = True
    reference = "Guo, Walter, Lage & Lupton 2022, section 3.2 (bias subtraction)"
    parameters = tuple(
        Parameter(name, "electron", 0.0, (-5000.0, 5000.0), 50.0, f"offset of {name}") for name in AMPLIFIERS
    )

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Let the offset be its part of the level of the amplifier that reads the sample, and light the rest."""
        offset = np.array([values[name] for name in AMPLIFIERS])
        level = geometry.require_levels(self.name)
        return (1.0 - offset.mean() / level) * image + offset[geometry.amplifier] / level
