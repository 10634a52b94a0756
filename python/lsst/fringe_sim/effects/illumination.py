"""Uneven illumination, the same at all wavelengths."""

from __future__ import annotations

from collections.abc import Mapping

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["Illumination"]


_CURVED = (
    ("curvature_xx", "u²", 0.005, 1),
    ("curvature_xy", "u v", 0.005, 1),
    ("curvature_yy", "v²", 0.005, 1),
    ("cubic_xxx", "u³", 0.002, 2),
    ("cubic_xxy", "u² v", 0.002, 2),
    ("cubic_xyy", "u v²", 0.002, 2),
    ("cubic_yyy", "v³", 0.002, 2),
)


class Illumination(PlainNullEffect):
    """The light varies over the sensor as a polynomial of third degree in position."""

    name = "illumination"
    title = "uneven illumination"
    acts_on = "image"
    laboratory_only = True
    reference = "Guo, Walter, Lage & Lupton 2022, Fig. 5 (sawtooth of 0.4-0.7 % over each half)"
    parameters = (
        Parameter("gradient_x", "", 0.0, (-0.5, 0.5), 0.02, "relative rise from the left to the right edge"),
        Parameter("gradient_y", "", 0.0, (-0.5, 0.5), 0.02, "relative rise from the lower to the upper edge"),
        *(
            Parameter(
                name,
                "",
                0.0,
                (-0.3, 0.3),
                scale,
                f"coefficient of {term}, both from -1 to 1",
                refinement=degree,
            )
            for name, term, scale, degree in _CURVED
        ),
    )

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Multiply by the pattern over its mean."""
        v, u = geometry.v, geometry.u
        pattern = 1.0 + 0.5 * values["gradient_x"] * u + 0.5 * values["gradient_y"] * v
        pattern = pattern + values["curvature_xx"] * u**2 + values["curvature_xy"] * u * v
        pattern = pattern + values["curvature_yy"] * v**2 + values["cubic_xxx"] * u**3
        pattern = pattern + values["cubic_xxy"] * u**2 * v + values["cubic_xyy"] * u * v**2
        pattern = pattern + values["cubic_yyy"] * v**3
        return image * (pattern / (1.0 + (values["curvature_xx"] + values["curvature_yy"]) / 3.0))
