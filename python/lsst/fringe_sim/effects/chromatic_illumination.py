"""Uneven illumination that changes with wavelength."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["ChromaticIllumination"]


_REACH_NM = 50.0


class ChromaticIllumination(PlainNullEffect):
    """The illumination pattern changes in proportion to wavelength about the middle of the exposures.

    The exposures halfway between the shortest and the longest wavelength are evenly lit; u and v go from -1 at the
    left and lower edge of the sensor to 1 at the right and upper one.
    """

    name = "chromatic_illumination"
    title = "uneven illumination, changing with wavelength"
    acts_on = "image"
    laboratory_only = True
    reference = "pattern of a diffuser or sphere depends on wavelength; no value is published for TS8"
    parameters = tuple(
        Parameter(name, "", 0.0, (-0.3, 0.3), scale, f"coefficient of {term} per {_REACH_NM:g} nm")
        for name, term, scale in (
            ("gradient_x", "u / 2", 0.01),
            ("gradient_y", "v / 2", 0.01),
            ("curvature_xx", "u²", 0.003),
            ("curvature_xy", "u v", 0.003),
            ("curvature_yy", "v²", 0.003),
        )
    )

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Multiply each plane by its pattern over its mean."""
        v, u = geometry.v, geometry.u
        pattern = 0.5 * values["gradient_x"] * u + 0.5 * values["gradient_y"] * v
        pattern = pattern + values["curvature_xx"] * u**2 + values["curvature_xy"] * u * v
        pattern = pattern + values["curvature_yy"] * v**2
        wavelength = geometry.wavelength_nm
        middle = 0.5 * (wavelength.min() + wavelength.max())
        colour = ((wavelength - middle) / _REACH_NM)[:, np.newaxis, np.newaxis]
        mean = 1.0 + colour * ((values["curvature_xx"] + values["curvature_yy"]) / 3.0)
        return image * (np.maximum(1.0 + colour * pattern, 0.0) / mean)
