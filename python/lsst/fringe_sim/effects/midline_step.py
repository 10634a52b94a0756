"""Step at the middle row."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["MidlineStep"]


class MidlineStep(PlainNullEffect):
    """The upper half of the sensor is brighter or fainter than the lower."""

    name = "midline_step"
    title = "step at the middle row"
    acts_on = "image"
    reference = "Guo, Walter, Lage & Lupton 2022, Fig. 5 (-1.1 % at the midline of E2V-CCD250-321)"
    parameters = (Parameter("fraction", "", 0.0, (-0.2, 0.2), 0.01, "upper over lower half, minus 1"),)

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Scale the upper half, and both so that the mean stays."""
        fraction = values["fraction"]
        factor = np.where(geometry.upper_half, 1.0 + fraction, 1.0) / (1.0 + 0.5 * fraction)
        return image * factor
