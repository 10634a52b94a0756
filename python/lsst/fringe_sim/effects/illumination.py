"""Effects on how the light varies over the sensor."""

from __future__ import annotations

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect, SearchHints, Values
from .geometry import ImageGeometry

REACH_NM = 50.0  # Distance in wavelength at which the pattern of a chromatic illumination is stated

_CURVED = {
    "curvature_xx": ("u²", 0.005, 1),
    "curvature_xy": ("u v", 0.005, 1),
    "curvature_yy": ("v²", 0.005, 1),
    "cubic_xxx": ("u³", 0.002, 2),
    "cubic_xxy": ("u² v", 0.002, 2),
    "cubic_xyy": ("u v²", 0.002, 2),
    "cubic_yyy": ("v³", 0.002, 2),
}


class IlluminationPattern(PlainNullEffect):
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
            Parameter(name, "", 0.0, (-0.3, 0.3), scale, f"coefficient of {term}, both from -1 to 1")
            for name, (term, scale, _) in _CURVED.items()
        ),
    )
    search = SearchHints(refinements={name: degree for name, (_, _, degree) in _CURVED.items()})

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Multiply by the pattern over its mean."""
        v, u = geometry.v, geometry.u
        pattern = 1.0 + 0.5 * values["gradient_x"] * u + 0.5 * values["gradient_y"] * v
        pattern = pattern + values["curvature_xx"] * u**2 + values["curvature_xy"] * u * v
        pattern = pattern + values["curvature_yy"] * v**2 + values["cubic_xxx"] * u**3
        pattern = pattern + values["cubic_xxy"] * u**2 * v + values["cubic_xyy"] * u * v**2
        pattern = pattern + values["cubic_yyy"] * v**3
        return image * (pattern / (1.0 + (values["curvature_xx"] + values["curvature_yy"]) / 3.0))


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
            Parameter(name, "", 0.0, (-0.3, 0.3), scale, f"coefficient of {term} per {REACH_NM:g} nm")
            for name, (term, scale, _) in _TERMS.items()
        ),
        Parameter(
            "even_offset", "nm", 0.0, (-120.0, 120.0), 30.0,
            "wavelength at which it is even, from the middle of the exposures",
        ),
    )  # fmt: skip
    search = SearchHints(
        places=("even_offset",), refinements={name: curved for name, (_, _, curved) in _TERMS.items()}
    )

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
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


class Vignetting(PlainNullEffect):
    """Less light in the corners, as the square of the distance from the centre."""

    name = "vignetting"
    title = "vignetting"
    acts_on = "image"
    laboratory_only = True
    reference = "Reshidko & Sasian 2016, doi 10.1117/1.OE.55.11.115105 (relative illumination)"
    parameters = (Parameter("corner", "", 0.0, (-0.5, 0.9), 0.03, "relative loss in the corners"),)

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Multiply by the pattern over its mean."""
        corner = values["corner"]
        return image * ((1.0 - 0.5 * corner * (geometry.u**2 + geometry.v**2)) / (1.0 - corner / 3.0))
