"""An island on which the adhesive has come off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..optics import Layer, get_medium
from ..optics.system import OpticalSystem
from .base import FloatArray, Parameter, PlainNullEffect
from .image_geometry import ImageGeometry

__all__ = ["Void"]

LEAST_SLANT = 1e-3
"""Sides of the ramp that the rim of a disc has in a pixel [px], where it runs along the pixel's own side."""


class Void(PlainNullEffect):
    """A round island of the sensor behind which a thin gap lies between adhesive and support.

    Outside it the stack is what it was. Pixels that its rim crosses see both stacks, each with its part of their
    area.
    """

    name = "void"
    title = "island on which the adhesive has come off"
    acts_on = "stack"
    local = True
    reference = "Born & Wolf, Principles of Optics, section 1.6 (layered media): a void between two layers"
    parameters = (
        Parameter("thickness", "nm", 0.0, (0.0, 2000.0), 200.0, "thickness of the gap", repeats_after=470.0),
        Parameter("centre_x", "px", 0.0, (-100.0, 4200.0), 3000.0, "column of its middle", place=True, step=0.02),
        Parameter("centre_y", "px", 0.0, (-100.0, 4200.0), 3000.0, "row of its middle", place=True, step=0.02),
        Parameter("radius", "px", 10.0, (1.0, 2000.0), 100.0, "its radius", place=True, step=0.02),
    )  # fmt: skip

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Insert the gap."""
        gap = Layer("void", get_medium("vacuum"), 1e-3 * values["thickness"])
        return replace(system, stack=system.stack.with_inserted(gap, before="support"))

    def coverage(self, values: Mapping[str, float], geometry: ImageGeometry) -> FloatArray:
        """Part of the area of every sample that lies on the island."""
        down = (geometry.y_px - values["centre_y"])[:, np.newaxis]
        along = (geometry.x_px - values["centre_x"])[np.newaxis, :]
        distance = np.hypot(down, along)
        safe = np.maximum(distance, LEAST_SLANT)
        sides = geometry.cell_px
        across = [np.maximum(side * np.abs(part) / safe, LEAST_SLANT)
                  for side, part in zip(sides, (down, along), strict=True)]  # fmt: skip
        # The rim bends away from a straight edge by half the square of the distance along it, over the radius.
        square = ((sides[0] * along) ** 2 + (sides[1] * down) ** 2) / (12.0 * safe**2)
        edge = values["radius"] - distance - 0.5 * square / values["radius"]
        return _below(edge, *across)


def _below(edge: FloatArray, one: FloatArray, two: FloatArray) -> FloatArray:
    """Part of a rectangle on the near side of a straight edge, ``edge`` beyond its middle.

    Seen across the edge, its sides ``one`` and ``two`` are a sum of two uniform distributions.
    """
    half_sum, half_difference = 0.5 * (one + two), 0.5 * (one - two)
    squares = [np.maximum(edge + shift, 0.0) ** 2
               for shift in (half_sum, half_difference, -half_difference, -half_sum)]  # fmt: skip
    part = (squares[0] - squares[1] - squares[2] + squares[3]) / (2.0 * one * two)
    # Far inside, differences of large squares have lost their digits.
    return np.asarray(np.where(edge >= half_sum, 1.0, np.clip(part, 0.0, 1.0)))
