"""Minimum of sampled curves, between the samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..array_types import FloatArray


@dataclass(frozen=True, eq=False)
class Minimum:
    """Minima of several curves."""

    place: FloatArray  # (n,): where they are [samples]
    value: FloatArray  # (n,): values there
    bend: FloatArray  # (n,): second differences there


def parabolic_minimum(curves: FloatArray) -> Minimum:
    """Minimum of each column by a parabola through the least sample and its neighbours; at an end, the sample itself.

    ``curves`` (samples, n).
    """
    best, each = np.argmin(curves, axis=0), np.arange(curves.shape[1])
    middle = np.clip(best, 1, len(curves) - 2)
    below, at, above = (curves[middle + step, each] for step in (-1, 0, 1))
    bend = below - 2.0 * at + above
    away = np.clip(np.divide(0.5 * (below - above), bend, out=np.zeros_like(at), where=bend > 0.0), -1.0, 1.0)
    inner = best == middle
    return Minimum(
        np.where(inner, middle + away, best),
        np.where(inner, at - 0.25 * (below - above) * away, curves[best, each]),
        bend,
    )
