"""Charge that is driven away by the charge already collected."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .band_limited import filtered
from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["BrighterFatter"]

FULL_PIXEL_E = 1e5


class BrighterFatter(PlainNullEffect):
    """What arrives is spread by a variance in proportion to the charge that is there: bright fringes lose height.

    Summed over an exposure in which the charge q grows evenly, the image gains a quarter of the Laplacian of q² times
    the variance that one electron adds.
    """

    name = "brighter_fatter"
    title = "brighter-fatter effect"
    acts_on = "image"
    couples_pixels = True
    reference = "Antilogus et al. 2014, doi 10.1088/1748-0221/9/03/C03048"
    parameters = (
        Parameter("variance", "px2", 0.0, (0.0, 0.5), 0.1, "spread along one axis behind 100 000 electrons"),
    )

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Add the Laplacian of the square, mirrored at the edges."""
        strength = 0.25 * values["variance"] * geometry.require_levels(self.name) / FULL_PIXEL_E
        return image + strength * _laplacian(image**2, geometry)


def _laplacian(image: FloatArray, geometry: ImageGeometry) -> FloatArray:
    """Second derivatives along both axes [1/px²], exact for the band-limited image that the samples define."""
    result = np.zeros(image.shape)
    for axis in (-2, -1):
        if image.shape[axis] > 1:
            result -= filtered(image, geometry, axis, np.square)
    return result
