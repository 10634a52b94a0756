"""What a smooth thickness does not take up of that of the cells."""

from __future__ import annotations

import math

import numpy as np
from scipy import sparse
from scipy.ndimage import median_filter
from scipy.optimize import minimize_scalar

from ...array_types import FloatArray
from ..inference import Point, Problem, kept
from .continuation import curvature_of, factorised

STIFFEST = 12.0
"""Largest logarithm of the stiffness of a smooth thickness over the curvature of the likelihood of a cell, on both
sides of 1: beyond, it is a plane or takes up all."""

TOLERANCE = 0.5  # The same to which the stiffness is known: nothing depends on a factor of less

PLANE, NO_WEIGHT = 3, 1e-12
"""Parameters of a plane, which costs no bending, and weight of cells that are not known."""

TORN = 0.25
"""Distance from the median of its neighbours from which on the thickness of a cell is of another order [orders]."""


def beside_smooth(point: Point) -> tuple[FloatArray, FloatArray]:
    """Score of the thickness of every cell beside a smooth one, and its information alone; each ``(ny, nx)``.

    A smooth thickness is that of a plate that is bent. Its stiffness is the likeliest for the thickness about which
    the problem was made, that of the noise follows from what the plate leaves. In the place of both stands a
    thickness that is known, with its error.
    """
    shape = point.problem.forward.geometry.sample_shape
    if point.problem.known:
        return beside_known(point)
    none = np.zeros(shape)
    if min(shape) < 3 or not point.problem.data.seen.any():
        return none, none
    weight = _weight(point, point.thickness_um)
    _, score, noise = _plate(shape, weight, point.thickness_um, _stiffness(point.problem))
    return (score / noise).reshape(shape), (weight / noise).reshape(shape)


def beside_known(point: Point) -> tuple[FloatArray, FloatArray]:
    """The same beside the thickness that is known: a fit has followed the data by a part of its error."""
    problem = point.problem
    shape, precision = problem.forward.geometry.sample_shape, problem.thickness_sigma_um**-2.0
    score = (point.thickness_um - problem.thickness_um) * precision
    followed = np.where(problem.data.seen, 1.0 - point.thickness_sigma_um**2 * precision, 0.0)
    return score.reshape(shape), (followed.clip(0.0) * precision).reshape(shape)


def _weight(point: Point, thickness_um: FloatArray) -> FloatArray:
    """Information of the cells over the largest; none where there are no data, or where another order begins."""
    problem = point.problem
    field = thickness_um.reshape(problem.forward.geometry.sample_shape)
    torn = np.abs(field - median_filter(field, 3)) > TORN * problem.forward.order_um
    weight = np.where(problem.data.seen & ~torn.ravel(), point.thickness_sigma_um**-2.0, 0.0)
    return np.asarray(weight / weight.max())


@kept(2)
def _stiffness(problem: Problem) -> float:
    """The likeliest stiffness of the first thickness of a problem, in units of the information of a cell."""
    point = problem.at({}, np.ones(len(problem.data.value)), problem.thickness_um)
    shape, weight = problem.forward.geometry.sample_shape, _weight(point, problem.thickness_um)
    found = minimize_scalar(
        lambda x: -_plate(shape, weight, problem.thickness_um, math.exp(x))[0],
        bounds=(-STIFFEST, STIFFEST), method="bounded", options={"xatol": TOLERANCE},
    )  # fmt: skip
    return math.exp(float(found.x))


def _plate(
    shape: tuple[int, int], weight: FloatArray, thickness_um: FloatArray, stiffness: float
) -> tuple[float, FloatArray, float]:
    """Log evidence of a stiffness with the plate integrated, what it leaves times the weight, and the noise [µm²]."""
    away = thickness_um - np.average(thickness_um, weights=weight)
    factor = factorised(sparse.diags(weight + NO_WEIGHT) + stiffness * curvature_of(*shape))
    score = weight * (away - factor.solve(weight * away))
    free = max(int((weight > 0.0).sum()) - PLANE, 1)
    noise = max(float(away @ score), 1e-300) / free
    log_det = float(np.log(np.abs(factor.U.diagonal())).sum())
    return 0.5 * (free * math.log(stiffness / noise) - log_det), score, noise
