"""Charge that arrives in a neighbouring pixel."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .band_limited import filtered
from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["ChargeDiffusion"]


class ChargeDiffusion(PlainNullEffect):
    """The image is blurred by a Gaussian: fine fringes lose contrast, coarse ones do not."""

    name = "charge_diffusion"
    title = "charge diffusion"
    acts_on = "image"
    couples_pixels = True
    blurs = True
    reference = "Lage 2019, doi 10.48550/arXiv.1911.09577 (a few um rms in 100 um of silicon)"
    parameters = (Parameter("sigma", "px", 0.0, (0.0, 5.0), 0.4, "rms radius along one axis"),)

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Blur along both axes; exact for the band-limited image that the samples define, mirrored at the edges."""
        for axis in (-2, -1):
            if image.shape[axis] > 1:
                image = filtered(
                    image, geometry, axis, lambda frequency: np.exp(-0.5 * (values["sigma"] * frequency) ** 2)
                )
        return image

    def blur_px(self, values: Mapping[str, float]) -> float:
        """The rms radius."""
        return values["sigma"]
