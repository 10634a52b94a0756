"""Discs on which a thickness steps at the rim: what a fine one has taken up, looked for beside a smooth one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse import csr_array

from .channels import State
from .discs import Disc, Discs
from .fit import Design

__all__ = ["best_thickness_step"]

FloatArray = NDArray[np.float64]

SMALLEST_RADIUS, MIDDLES_PER_RADIUS = 2.8, 2.0
"""Radius of the smallest disc of which no smooth thickness takes up all [cells]; how closely the middles lie for
which it is computed what one does take up."""

DISCS_AT_ONCE = 400

LEAST_LEFT = 0.02
"""Part of what a disc does that a smooth thickness must leave."""


def best_thickness_step(state: State) -> tuple[Disc, float]:
    """The disc on which a thickness that steps at its rim explains most of what a smooth one leaves, and the step.

    What is left of a step is seen about the rim, which must be right to a cell: every place is tried. What a smooth
    thickness takes up changes slowly from place to place.

    Returns the fall of χ², row, column and radius [cells], and by how much the layer is thicker there.
    """
    design = state.design
    score, curvature = (design.slope * state.residual).sum(axis=0), (design.slope**2).sum(axis=0)
    about = Discs.of(curvature > 0.0)
    best, step = (0.0, 0.0, 0.0, 0.0), 0.0
    each = zip(about.radii, about.usable, about.sums(score), about.sums(curvature), strict=True)
    for radius, usable, amount, alone in each:
        if radius < SMALLEST_RADIUS:
            continue
        left = np.maximum(_part_left(design, curvature, radius), LEAST_LEFT) * alone
        fall = np.divide(amount**2, left, out=np.zeros(left.shape), where=usable & (left > 0.0))
        row, column = np.unravel_index(int(np.argmax(fall)), fall.shape)
        if fall[row, column] > best[0]:
            best = (float(fall[row, column]), float(row), float(column), radius)
            step = float(amount[row, column] / left[row, column])
    return best, step


def _part_left(design: Design, curvature: FloatArray, radius: float) -> FloatArray:
    """Part of χ² of a disc about every cell that the smooth field of a fit does not take up."""
    shape = curvature.shape
    stride = math.ceil(radius / MIDDLES_PER_RADIUS)
    along = [np.unique(np.append(np.arange(0, side, stride), side - 1)) for side in shape]
    middles = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 2)
    parts = [
        _parts_left(design, curvature, middles[first : first + DISCS_AT_ONCE], radius)
        for first in range(0, len(middles), DISCS_AT_ONCE)
    ]
    between = RegularGridInterpolator(along, np.concatenate(parts).reshape([len(each) for each in along]))
    everywhere = np.meshgrid(*map(np.arange, shape), indexing="ij")
    return np.asarray(between(np.stack(everywhere, axis=-1)))


def _parts_left(
    design: Design, curvature: FloatArray, middles: NDArray[np.int64], radius: float
) -> FloatArray:
    """Part that is left of discs about some cells."""
    reach = math.floor(radius)
    side = np.arange(-reach, reach + 1)
    cells = middles[:, np.newaxis] + np.argwhere(np.hypot(side[:, np.newaxis], side) <= radius) - reach
    disc, number = np.nonzero(((cells >= 0) & (cells < curvature.shape)).all(axis=-1))
    place = np.ravel_multi_index(tuple(cells[disc, number].T), curvature.shape)
    discs = csr_array((curvature.ravel()[place], (disc, place)), shape=(len(middles), curvature.size))
    alone = discs.sum(axis=1)
    gathered = (discs @ design.basis.matrix).toarray().T
    taken = (gathered * design.normal.solve(gathered)).sum(axis=0)
    return np.asarray(1.0 - np.divide(taken, alone, out=np.ones(len(alone)), where=alone > 0.0))
