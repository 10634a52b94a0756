"""A field continued into cells where it is not known, at the cost of those alone."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.ndimage import binary_dilation

from ....array_types import BoolArray, FloatArray
from ..continuation import NO_WEIGHT, STIFFNESS, curvature_of, factorised

REACH = 4
"""Cells about unknown ones whose values are asked: each holds the field by a thousand times its stiffness,
so that those behind it are not felt."""


def filled(field: FloatArray, known: BoolArray) -> FloatArray:
    """A field ``(ny, nx)`` that stays where it is known; elsewhere it is what `continued` makes of it.

    Factors of the whole field take most of the time of a judgement if they are made for every step into the blocks
    that were held out.
    """
    if known.all():
        return field
    near = binary_dilation(~known, iterations=REACH).ravel()
    middle = float(field[known].mean())
    values = np.where(known, field - middle, 0.0).ravel()
    weight = np.where(known, 1.0, NO_WEIGHT).ravel()
    rows = STIFFNESS * sparse.csr_matrix(curvature_of(*field.shape))[near]
    right = weight[near] * values[near] - rows[:, ~near] @ values[~near]
    found = factorised(sparse.diags(weight[near]) + rows[:, near]).solve(right)
    values[near] = found
    return np.where(known, field, middle + values.reshape(field.shape))
