"""Uneven illumination that changes with wavelength."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["ChromaticIllumination"]

REACH_NM = 50.0
"""Distance in wavelength at which the pattern is stated."""

_TERMS = {
    "gradient_x": ("u / 2", 0.01, 0),
    "gradient_y": ("v / 2", 0.01, 0),
    "curvature_xx": ("u²", 0.003, 1),
    "curvature_xy": ("u v", 0.003, 1),
    "curvature_yy": ("v²", 0.003, 1),
}


class ChromaticIllumination(PlainNullEffect):
    """The illumination pattern changes in proportion to the distance from a wavelength at which it is even.

    That lies ``even_offset`` from the middle between the shortest and the longest wavelength of the exposures.
    Coordinates u and v go from -1 at the left and lower edge of the sensor to 1 at the right and upper one.
    """

    name = "chromatic_illumination"
    title = "uneven illumination, changing with wavelength"
    acts_on = "image"
    laboratory_only = True
    reference = "pattern of a diffuser or sphere depends on wavelength; no value is published for TS8"
    parameters = (
        *(
            Parameter(
                name, "", 0.0, (-0.3, 0.3), scale, f"coefficient of {term} per {REACH_NM:g} nm", refinement=curved
            )
            for name, (term, scale, curved) in _TERMS.items()
        ),
        Parameter(
            "even_offset", "nm", 0.0, (-120.0, 120.0), 30.0,
            "wavelength at which it is even, from the middle of the exposures", place=True,
        ),
    )  # fmt: skip

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Multiply each plane by its pattern over its mean."""
        pattern = sum(values[name] * term for name, term in _terms(geometry).items())
        wavelength = geometry.wavelength_nm
        even = 0.5 * (wavelength.min() + wavelength.max()) + values["even_offset"]
        colour = ((wavelength - even) / REACH_NM)[:, np.newaxis, np.newaxis]
        mean = 1.0 + colour * ((values["curvature_xx"] + values["curvature_yy"]) / 3.0)
        return np.asarray(image * (np.maximum(1.0 + colour * pattern, 0.0) / mean))


def _terms(geometry: ImageGeometry) -> dict[str, FloatArray]:
    """Terms of the pattern at the samples, by the name of their coefficient."""
    v, u = geometry.v, geometry.u
    return {
        "gradient_x": 0.5 * u,
        "gradient_y": 0.5 * v,
        "curvature_xx": u**2,
        "curvature_xy": u * v,
        "curvature_yy": v**2,
    }
