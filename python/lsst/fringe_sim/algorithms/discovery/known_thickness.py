"""A thickness that was measured: the prior of the cells is that map with its error, which may be less than stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...array_types import FloatArray
from ..inference import Point, Problem
from .cells import UNSTATED_UM, CellData

LEAST_UM = 1e-4  # Error of the best map [µm]

SHARES = np.geomspace(1e-2, 1.0, 41)
"""Errors of a map over the stated ones, of which the likeliest is taken. None is larger: a phase that is missing in
the model would be taken for errors of the map."""


def as_known(problem: Problem, cells: CellData) -> Problem:
    """The same problem with the map of its cells as first thickness, if there is one."""
    if cells.thickness_um is None:
        return problem
    return replace(problem, thickness_sigma_um=stated_sigma_um(cells), known=True)


def stated_sigma_um(cells: CellData) -> FloatArray:
    """Stated error of the map of the cells, ``(N,)`` [µm]."""
    sigma = np.full(cells.shape[1:], np.nan) if cells.thickness_sigma_um is None else cells.thickness_sigma_um
    known = sigma[np.isfinite(sigma)]
    typical = float(np.median(known)) if known.size else UNSTATED_UM
    sigma = np.where(np.isfinite(sigma), sigma, typical)
    return np.asarray(np.maximum(sigma, LEAST_UM).ravel())


def with_error_of_map(point: Point, cells: CellData) -> Point:
    """The same point of a problem whose map has the likeliest error of those that are not above the stated one.

    A thickness that may move farther than it has to follows the noise: the fringes look stronger by the square of the
    phase by which it may move.
    """
    if not point.problem.known:
        return point
    stated = stated_sigma_um(cells)

    def with_share(share: float) -> Point:
        sigma = np.maximum(share * stated, LEAST_UM)
        return replace(point, problem=replace(point.problem, thickness_sigma_um=sigma))

    return min(map(with_share, SHARES.tolist()), key=lambda one: one.linear_cost)
