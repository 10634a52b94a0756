"""An island on which the adhesive has come off."""

from __future__ import annotations

import math

import numpy as np

from .base import FloatArray, Parameter, Residuals, SearchHints, Values
from .disc_search import find_disc, find_step
from .geometry import ImageGeometry
from .stack import InsertedLayer

LEAST_SLANT = 1e-3
"""Sides of the ramp that the rim of a disc has in a pixel [px], where it runs along the pixel's own side."""


SIZES_PER_REPETITION = 12  # Gaps that are tried, up to one at which the fringes look nearly the same again

THIN = (0.01, 0.02, 0.04, 0.08)
"""Smaller ones, in units of that, where all that is seen is a step of the thickness."""


class Void(InsertedLayer):
    """A round island of the sensor behind which a thin gap lies between adhesive and support.

    Outside it the stack is what it was. Pixels that its rim crosses see both stacks, each with its part of their
    area.
    """

    name = "void"
    title = "island on which the adhesive has come off"
    local, several = True, True
    reference = "Born & Wolf, Principles of Optics, section 1.6 (layered media): a void between two layers"
    layer, medium, before = "void", "vacuum", "support"
    parameters = (
        Parameter("thickness", "nm", 0.0, (0.0, 2000.0), 200.0, "thickness of the gap"),
        Parameter("centre_x", "px", 0.0, (-100.0, 4200.0), 3000.0, "column of its middle"),
        Parameter("centre_y", "px", 0.0, (-100.0, 4200.0), 3000.0, "row of its middle"),
        Parameter("radius", "px", 10.0, (1.0, 2000.0), 100.0, "its radius"),
    )
    search = SearchHints(
        places=("centre_x", "centre_y", "radius"),
        repeats_after={"thickness": 470.0},
        steps={"centre_x": 0.02, "centre_y": 0.02, "radius": 0.02},
    )

    def propose(self, residuals: Residuals) -> tuple[dict[str, float], ...]:
        """The disc in which most is left, with all gaps, and that on which the thickness steps, with thin ones.

        A thin gap moves the fringes and does little else, and a fine thickness takes that up.
        """
        one = self.search.repeats_after["thickness"]
        sizes = one / SIZES_PER_REPETITION * np.arange(1, SIZES_PER_REPETITION + 1)
        found = []
        disc, step = find_disc(residuals), find_step(residuals)
        if disc is not None:
            found += [(disc, size) for size in sizes]
        if step is not None:
            found += [(step, size) for size in one * np.array(THIN)]
        return tuple(
            {"thickness": float(size), "centre_x": column, "centre_y": row, "radius": radius}
            for (row, column, radius), size in found
        )

    def coverage(self, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Part of the area of every sample that lies on the island."""
        edge, _, across = _rim(values, geometry)
        return _below(edge, *across)

    def coverage_moments(self, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Its moments about the middle of every sample: y, x, y², yx, x² [samples]."""
        edge, outward, (down, along) = _rim(values, geometry)
        first, second, product = _moments_below(edge, down, along)
        signs = np.sign(outward[0]), np.sign(outward[1])
        return np.stack([
            signs[0] * first[0] / down, signs[1] * first[1] / along,
            second[0] / down**2, signs[0] * signs[1] * product / (down * along), second[1] / along**2,
        ])  # fmt: skip


def _rim(
    values: Values, geometry: ImageGeometry
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """How far the rim lies beyond the middle of every sample, and its sides y and x across the rim [px].

    In between, the direction in which it lies, in pixels from the middle of the disc.
    """
    down = (geometry.y_px - values["centre_y"])[:, np.newaxis]
    along = (geometry.x_px - values["centre_x"])[np.newaxis, :]
    distance = np.hypot(down, along)
    safe = np.maximum(distance, LEAST_SLANT)
    sides = geometry.cell_px
    across = (
        np.maximum(sides[0] * np.abs(down) / safe, LEAST_SLANT),
        np.maximum(sides[1] * np.abs(along) / safe, LEAST_SLANT),
    )
    # The rim bends away from a straight edge by half the square of the distance along it, over the radius.
    square = ((sides[0] * along) ** 2 + (sides[1] * down) ** 2) / (12.0 * safe**2)
    edge = values["radius"] - distance - 0.5 * square / values["radius"]
    return edge, (down, along), across


def _below(edge: FloatArray, one: FloatArray, two: FloatArray) -> FloatArray:
    """Part of a rectangle on the near side of a straight edge, ``edge`` beyond its middle.

    Seen across the edge, its sides ``one`` and ``two`` are a sum of two uniform distributions.
    """
    half_sum = 0.5 * (one + two)
    part = (_ramp(edge + 0.5 * one, two, 2) - _ramp(edge - 0.5 * one, two, 2)) / one
    # Far inside, differences of large squares have lost their digits.
    return np.asarray(np.where(edge >= half_sum, 1.0, np.clip(part, 0.0, 1.0)))


def _moments_below(
    edge: FloatArray, one: FloatArray, two: FloatArray
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray], FloatArray]:
    """Means of two uniform distances, their squares and their product where their sum is below an edge.

    Their widths are ``one`` and ``two``; means over all of the rectangle, which have 0 beyond the edge.
    """
    first = _first_below(edge, one, two), _first_below(edge, two, one)
    second = _second_below(edge, one, two), _second_below(edge, two, one)
    below = _below(edge, one, two)
    once, twice = (
        (_ramp(edge + 0.5 * one, two, order) - _ramp(edge - 0.5 * one, two, order)) / one for order in (3, 4)
    )
    product = 0.5 * (edge**2 * below - 2.0 * (edge * once - twice) - second[0] - second[1])
    # Where the edge is far away, differences of large numbers have lost their digits.
    crossed, inside = np.abs(edge) < 0.5 * (one + two), edge > 0.0
    return (
        (np.where(crossed, first[0], 0.0), np.where(crossed, first[1], 0.0)),
        (
            np.where(crossed, second[0], np.where(inside, one**2 / 12.0, 0.0)),
            np.where(crossed, second[1], np.where(inside, two**2 / 12.0, 0.0)),
        ),
        np.where(crossed, product, 0.0),
    )


def _first_below(edge: FloatArray, one: FloatArray, two: FloatArray) -> FloatArray:
    """Mean of the first of two uniform distances where their sum is below the edge."""
    ends = edge + 0.5 * one, edge - 0.5 * one
    once = (_ramp(ends[0], two, 3) - _ramp(ends[1], two, 3)) / one
    return np.asarray(once - 0.5 * (_ramp(ends[0], two, 2) + _ramp(ends[1], two, 2)))


def _second_below(edge: FloatArray, one: FloatArray, two: FloatArray) -> FloatArray:
    """Mean of the square of the first of two uniform distances where their sum is below the edge."""
    ends = edge + 0.5 * one, edge - 0.5 * one
    twice = 2.0 * (_ramp(ends[0], two, 4) - _ramp(ends[1], two, 4)) / one
    once = _ramp(ends[0], two, 3) + _ramp(ends[1], two, 3)
    return np.asarray(0.25 * one * (_ramp(ends[0], two, 2) - _ramp(ends[1], two, 2)) - once + twice)


def _ramp(place: FloatArray, width: FloatArray, order: int) -> FloatArray:
    """Repeated integral of a uniform distribution about 0: of second order, that of its cumulative distribution."""
    ends = np.maximum(place + 0.5 * width, 0.0), np.maximum(place - 0.5 * width, 0.0)
    return np.asarray((ends[0] ** order - ends[1] ** order) / (math.factorial(order) * width))
