"""Charge that is driven away by the charge already collected."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .band_limited import filtered
from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["BrighterFatter"]

FULL_PIXEL_E = 1e5
MOST_PASSED = 0.2
"""Part of its departure that a pixel may pass on; what is first order here is not beyond."""


class BrighterFatter(PlainNullEffect):
    """What arrives is spread by a variance in proportion to the charge that is there: bright fringes lose height.

    The face between two pixels moves towards the fuller one by their difference of charge and takes the mean of
    their light along. Summed over an exposure in which the charge q grows evenly, every pixel gains a quarter of the
    differences of q² to its four neighbours times the variance that one electron adds.
    """

    name = "brighter_fatter"
    title = "brighter-fatter effect"
    acts_on = "image"
    couples_pixels = True
    blurs = True
    reference = "Antilogus et al. 2014, doi 10.1088/1748-0221/9/03/C03048"
    parameters = (
        Parameter("variance", "px2", 0.0, (0.0, 0.5), 0.1, "spread along one axis behind 100 000 electrons"),
    )

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Add the differences of the square, mirrored at the edges."""
        strength = 0.25 * values["variance"] * geometry.require_levels(self.name) / FULL_PIXEL_E
        return image + strength * _differences(image**2, geometry)

    def noise_correlation(self, values: Mapping[str, float], geometry: ImageGeometry) -> float:
        """What a pixel has too much pushes some of the next electrons into its neighbours.

        First order in the departure from an even level; of a cell, only the pixels at the edge exchange charge.
        """
        level = float(geometry.require_levels(self.name).mean())
        passed = min(values["variance"] * level / FULL_PIXEL_E / max(geometry.cell_px), MOST_PASSED)
        return passed / (1.0 - 2.0 * passed)


def _differences(image: FloatArray, geometry: ImageGeometry) -> FloatArray:
    """Sum of the four neighbouring pixels minus four times the pixel, for the band-limited image of the samples."""
    result = np.zeros(image.shape)
    for axis in (-2, -1):
        if image.shape[axis] > 1:
            result -= filtered(image, geometry, axis, lambda frequency: 2.0 - 2.0 * np.cos(frequency))
    return result
