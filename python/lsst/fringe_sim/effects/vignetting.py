"""Loss of light towards the corners."""

from __future__ import annotations

from collections.abc import Mapping

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["Vignetting"]


class Vignetting(PlainNullEffect):
    """Less light in the corners, as the square of the distance from the centre."""

    name = "vignetting"
    title = "vignetting"
    acts_on = "image"
    laboratory_only = True
    reference = "Reshidko & Sasian 2016, doi 10.1117/1.OE.55.11.115105 (relative illumination)"
    parameters = (Parameter("corner", "", 0.0, (-0.5, 0.9), 0.03, "relative loss in the corners"),)

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Multiply by the pattern over its mean."""
        corner = values["corner"]
        return image * ((1.0 - 0.5 * corner * (geometry.u**2 + geometry.v**2)) / (1.0 - corner / 3.0))
