"""A field continued into cells where nothing is known of it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.ndimage import binary_dilation
from scipy.sparse.linalg import SuperLU, splu

from ...array_types import BoolArray, FloatArray

STIFFNESS, NO_WEIGHT = 1e-3, 1e-12
"""Weights of the curvature and of cells that are not known; those of the others are 1."""

REACH = 4
"""Cells about unknown ones whose values are asked: each holds the field by a thousand times its stiffness,
so that those behind it are not felt."""


def continued(field: FloatArray, known: BoolArray) -> FloatArray:
    """Continue a field from where it is known with the least sum of squares of its second derivatives.

    ``field`` (ny, nx): the field; its values elsewhere do not matter. ``known`` (ny, nx). Returns (ny, nx).
    """
    weight = np.where(known, 1.0, NO_WEIGHT).ravel()
    matrix = sparse.diags(weight) + STIFFNESS * curvature_of(*field.shape)
    middle = float(field[known].mean())
    right = weight * np.where(known, field - middle, 0.0).ravel()
    return np.asarray(middle + factorised(matrix).solve(right).reshape(field.shape))


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


def factorised(matrix: sparse.spmatrix) -> SuperLU:
    """Factors of a matrix that is symmetric and positive: no pivot has to be looked for."""
    options = {"SymmetricMode": True}
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


@lru_cache(maxsize=2)
def curvature_of(rows: int, columns: int) -> sparse.spmatrix:
    """Sum of squares of all second derivatives as a quadratic form in the cells, of every round of a growth."""
    bends = (
        sparse.kron(_differences(rows, 2), sparse.identity(columns)),
        sparse.kron(sparse.identity(rows), _differences(columns, 2)),
        np.sqrt(2.0) * sparse.kron(_differences(rows, 1), _differences(columns, 1)),
    )
    return sum(bend.T @ bend for bend in bends)


def _differences(size: int, order: int) -> sparse.spmatrix:
    """First or second differences of so many values; fewer have none."""
    if size <= order:
        return sparse.csr_matrix((0, size))
    signs = {1: (-1.0, 1.0), 2: (1.0, -2.0, 1.0)}[order]
    return sparse.diags(signs, tuple(range(order + 1)), shape=(size - order, size), dtype=float)
