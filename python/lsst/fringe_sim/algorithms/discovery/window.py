"""A part of the cells by itself, for what concerns no others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...array_types import BoolArray, FloatArray
from ..inference import Data, Point

MARGIN = 1  # Cells about those that are asked for, so that their distance is known


@dataclass(frozen=True, eq=False)
class Window:
    """The cells of a rectangle at a point; all of them where effects on the image make cells depend on each other."""

    whole: Point
    point: Point  # the same of the cells in the rectangle
    inside: BoolArray  # (N,)

    @classmethod
    def about(cls, whole: Point, where: BoolArray) -> Window:
        """The smallest rectangle about cells ``(N,)``."""
        problem, forward = whole.problem, whole.problem.forward
        rows, columns = (
            _reach(np.asarray(where.reshape(forward.geometry.sample_shape).any(axis=axis))) for axis in (1, 0)
        )
        inside = np.zeros(forward.geometry.sample_shape, dtype=bool)
        inside[rows, columns] = True
        own = inside.ravel()
        if own.all() or forward.on_image(whole.settings):
            return cls(whole, whole, np.ones(own.size, dtype=bool))
        sigma, data = problem.thickness_sigma_um, problem.data
        part = replace(
            problem,
            data=Data(data.value[:, own], data.weight[:, own]),
            forward=forward.of_cells(rows, columns, own),
            thickness_um=problem.thickness_um[own],
            thickness_sigma_um=sigma if np.ndim(sigma) == 0 else np.asarray(sigma)[own],
        )
        value, slope = whole.value[:, own], whole.slope[:, own]
        return cls(
            whole, Point(part, whole.settings, whole.levels, whole.thickness_um[own], value, slope), own
        )

    def joined(self, part: Point) -> Point:
        """A point in which these cells and their effects are as in another one, and all other cells as they were."""
        thickness: FloatArray = self.whole.thickness_um.copy()
        thickness[self.inside] = part.thickness_um
        return self.whole.moved(part.levels, thickness, part.settings)


def _reach(where: BoolArray) -> slice:
    """From the first to the last place along an axis, and the margin."""
    places = np.flatnonzero(where)
    return slice(max(int(places[0]) - MARGIN, 0), int(places[-1]) + 1 + MARGIN)
