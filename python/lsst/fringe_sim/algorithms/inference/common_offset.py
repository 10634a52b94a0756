"""A thickness that is known, moved as a whole to where the data would have it: there the missing phase is small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...array_types import FloatArray
from .marginal import Point, kept

OFFSETS = np.arange(-18, 19) / 12.0
"""Moves of the thickness that are tried [orders]: an effect may shift the fringes by one and a half."""


@kept(8)
def led(point: Point) -> Point:
    """The same problem with the thickness about which the data are linear; the point itself where they are so there.

    An effect that shifts the phase by a radian or more has no derivative that leads to it at the first thickness.
    """
    offset_um, step_um = common_offset_um(point), (OFFSETS[1] - OFFSETS[0]) * point.problem.forward.order_um
    if abs(offset_um) <= 0.5 * step_um:
        return point
    return point.moved(point.levels, point.problem.thickness_um + offset_um)


def with_common_offset(point: Point) -> Point:
    """The same point about a first thickness that is moved as a whole; it is free only while noise is judged."""
    offset_um = common_offset_um(point)
    if offset_um == 0.0:
        return point
    moved = point.problem.thickness_um + offset_um
    return replace(point.problem, thickness_um=moved).at(point.settings, point.levels, moved)


def common_offset_um(point: Point) -> float:
    """Move of the first thickness with which fringes are the most alike, level and contrast being free [µm].

    0 where the thickness is not known, where it is the best of those tried, or where a few cells do not tell level
    and contrast of every exposure.
    """
    if not point.problem.known or point.problem.levels_known:
        return 0.0
    offsets = OFFSETS * point.problem.forward.order_um
    left = np.array([_unlike(point, offset) for offset in offsets])
    best = int(left.argmin())
    if offsets[best] == 0.0 or best in (0, len(offsets) - 1):
        return float(offsets[best])
    before, here, after = left[best - 1 : best + 2]
    curvature = before - 2.0 * here + after
    return float(offsets[best] + 0.5 * (before - after) / max(curvature, 1e-300) * (offsets[1] - offsets[0]))


def _unlike(point: Point, offset_um: float) -> float:
    """χ² with a free level and contrast, not below 0, at each exposure."""
    data = point.problem.data
    value, _ = point.problem.forward.predict(point.settings, point.problem.thickness_um + offset_um)
    sums = np.maximum(data.weight.sum(axis=1, keepdims=True), 1e-300)

    def beside_mean(values: FloatArray) -> FloatArray:
        return np.asarray(values - (data.weight * values).sum(axis=1, keepdims=True) / sums)

    own, seen = beside_mean(value), beside_mean(data.value)
    square = np.maximum((data.weight * own**2).sum(axis=1), 1e-300)
    along = np.maximum((data.weight * own * seen).sum(axis=1), 0.0)
    return float((data.weight * seen**2).sum() - (along**2 / square).sum())
