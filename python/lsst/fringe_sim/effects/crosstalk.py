"""Signal of an amplifier in the data of its neighbours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["Crosstalk"]


class Crosstalk(PlainNullEffect):
    """Each amplifier adds a small part of the pixels that its neighbours in x read at the same time.

    The part is one of what the neighbours hold before any crosstalk; all amplifiers read in the same direction.
    """

    name = "crosstalk"
    title = "crosstalk between neighbouring amplifiers"
    acts_on = "image"
    couples_pixels = True
    reference = "O'Connor 2015, doi 10.1088/1748-0221/10/05/C05010 (crosstalk in multi-output CCDs)"
    parameters = (
        Parameter(
            "from_left", "", 0.0, (-0.05, 0.05), 1e-3, "part of the signal of the amplifier at lower x"
        ),
        Parameter(
            "from_right", "", 0.0, (-0.05, 0.05), 1e-3, "part of the signal of the amplifier at higher x"
        ),
    )

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Add the neighbours, shifted by the distance of the amplifiers; all are read in the same direction."""
        result = image
        for side, part in ((-1, values["from_left"]), (1, values["from_right"])):
            if part:
                result = result + part * _neighbour(image, geometry, side)
        return result


def _neighbour(image: FloatArray, geometry: ImageGeometry, side: int) -> FloatArray:
    """What the amplifier next in x holds at the same place; 0 where there is none."""
    edges, x = np.array(geometry.x_edges, dtype=float), geometry.x_px
    own = geometry.amplifier_column
    other = own + side
    there = (other >= 0) & (other <= len(edges) - 2)
    source = x + np.where(there, edges[np.clip(other, 0, len(edges) - 2)] - edges[own], 0.0)
    place = np.clip((source - x[0]) / geometry.cell_px[1], 0.0, max(x.size - 1, 0))
    first = np.minimum(place.astype(np.int64), max(x.size - 2, 0))
    share = place - first
    after = np.minimum(first + 1, x.size - 1)
    shifted: FloatArray = np.where(there, (1.0 - share) * image[..., first] + share * image[..., after], 0.0)
    return shifted
