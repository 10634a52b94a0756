"""Non-linear response to charge."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["NonLinearity"]


REFERENCE_E = 100_000.0


class NonLinearity(PlainNullEffect):
    """The signal falls behind the charge, in proportion to the charge."""

    name = "non_linearity"
    title = "non-linear response to charge"
    acts_on = "image"
    reference = "Astier et al. 2019, doi 10.1051/0004-6361/201935508; LSSTCam is linear to a few 1e-3"
    parameters = (Parameter("quadratic", "", 0.0, (-0.2, 0.2), 0.02, "relative loss at 100 000 electrons"),)

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Take the quadratic term off.

        The level of the flats is what was counted. More charge is behind it: the root of
        ``counted = charge - quadratic * charge**2``, up to where more charge would count less.
        """
        counted = geometry.require_levels(self.name) / REFERENCE_E
        charge = 2.0 * counted / (1.0 + np.sqrt(np.maximum(1.0 - 4.0 * values["quadratic"] * counted, 0.0)))
        return image * (1.0 - values["quadratic"] * charge * image)
