"""How much likelier the data are with a set of effects than without."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import logsumexp

from ...array_types import FloatArray
from .fit import Coordinate, Fit

WIDTHS = np.geomspace(1e-4, 30.0, 141)
"""Widths of the distribution of exchangeable parameters, in prior scales, over which the evidence is integrated."""


def log_evidence(fit: Fit, null_chi2: float) -> float:
    """Laplace approximation of log Z(fit) - log Z(null) with half-Cauchy or Cauchy priors.

    Parameters that refine an effect may be absent: the evidence is the mean of those with the parameters up to each
    of its refinements. A gradient of the light need not pay for the seven curved terms that it does not have.

    Exchangeable parameters are draws from a Gaussian about null, the width of which has the half-Cauchy prior: what
    sixteen gains are thought to be before the data are seen is one number, not sixteen.

    ``null_chi2``: χ² of the unchanged model, fitted to the same data.
    """
    total = 0.5 * (null_chi2 - fit.chi2)
    if not fit.coordinates:
        return total
    scale = np.array([item.unit_step for item in fit.coordinates])
    likelihood = fit.information * np.outer(scale, scale)
    position = fit.position / scale
    cost = np.array([_cost(item, x) for item, x in zip(fit.coordinates, fit.position, strict=True)])
    precision, drawn = _precision_of_priors(fit.coordinates, likelihood, position)
    information = likelihood + np.diag(precision)
    total += drawn - 0.5 * _log_determinant(information) - float(cost.sum())
    return total + _without_refinements(fit, information, position, cost)


def prior_cost(item: Coordinate, position: float) -> float:
    """Log evidence that the size of a parameter costs, over what a size near zero would."""
    return math.log1p(item.departure(position) ** 2)


def _cost(item: Coordinate, position: float) -> float:
    """Log evidence that the size of a parameter costs by itself; exchangeable ones are judged together."""
    if item.exchangeable:
        return 0.0
    cost = prior_cost(item, position)
    if item.quadratic:  # the prior is one of the parameter, the fit one of its square
        cost += math.log(max(2.0 * item.departure(position), 0.05))
    return cost


def _precision_of_priors(
    coordinates: Sequence[Coordinate], likelihood: FloatArray, position: FloatArray
) -> tuple[FloatArray, float]:
    """Precision of the prior of every parameter, and what the evidence gains from widths that are not known.

    Where it is not exchangeable, no parameter is worse known after the data than before.
    """
    precision = np.ones(len(coordinates))
    owners = np.array([item.effect if item.exchangeable else "" for item in coordinates])
    groups = [np.flatnonzero(owners == name) for name in sorted(set(owners) - {""})]
    if not groups:
        return precision, 0.0
    drawn = np.flatnonzero(owners != "")
    # What the data say of the drawn parameters when the others are free.
    others = np.flatnonzero(owners == "")
    across = likelihood[np.ix_(drawn, others)]
    inner = likelihood[np.ix_(others, others)] + np.eye(len(others))
    own = likelihood[np.ix_(drawn, drawn)] - across @ np.linalg.solve(inner, across.T)
    gains = [0.0] * len(groups)
    for _ in range(len(groups)):  # the width of each, with those of the others at their best
        for number, group in enumerate(groups):
            tried = np.repeat(precision[np.newaxis], len(WIDTHS), axis=0)
            tried[:, group] = WIDTHS[:, np.newaxis] ** -2.0
            curve = _log_density(own, position[drawn], tried[:, drawn])
            best = int(np.argmax(curve))
            precision = tried[best]
            gains[number] = float(logsumexp(curve + _LOG_PRIOR_OF_WIDTHS)) - float(curve[best])
    at_best = float(_log_density(own, position[drawn], precision[np.newaxis, drawn])[0])
    return precision, at_best + 0.5 * _log_determinant(own + np.diag(precision[drawn])) + sum(gains)


_LOG_PRIOR_OF_WIDTHS = np.log(2.0 / math.pi * WIDTHS / (1.0 + WIDTHS**2) * np.gradient(np.log(WIDTHS)))
"""Half-Cauchy prior of the widths, times the steps between them."""


def _log_density(information: FloatArray, position: FloatArray, precision: FloatArray) -> FloatArray:
    """Log evidence of parameters found at ``position`` with Gaussian priors, over that of the best ones.

    One number for each row of ``precision``.
    """
    total = information + precision[:, :, np.newaxis] * np.eye(len(position))
    pull = precision * position
    misfit = position @ information @ np.linalg.solve(total, pull[:, :, np.newaxis])
    freedom = np.linalg.slogdet(total)[1] - np.log(precision).sum(axis=1)
    density: FloatArray = -0.5 * (misfit[..., 0] + freedom)
    return density


def _without_refinements(fit: Fit, information: FloatArray, position: FloatArray, cost: FloatArray) -> float:
    """What the mean over the refinements of the effects adds to the evidence with all parameters.

    By the ratio of Savage and Dickey: how likely it is, after the data, that the parameters left out are null.
    """
    covariance = np.linalg.pinv(information, hermitian=True)
    gain = 0.0
    for name in {item.effect for item in fit.coordinates}:
        refinements = np.array([item.refinement if item.effect == name else -1 for item in fit.coordinates])
        ratios = [0.0]
        for highest in range(int(refinements.max())):
            absent = np.flatnonzero(refinements > highest)
            known = np.linalg.pinv(covariance[np.ix_(absent, absent)], hermitian=True)
            misfit = float(position[absent] @ known @ position[absent])
            ratios.append(0.5 * (_log_determinant(known) - misfit) + float(cost[absent].sum()))
        gain += float(logsumexp(ratios)) - math.log(len(ratios))
    return gain


def _log_determinant(matrix: FloatArray) -> float:
    sign, value = np.linalg.slogdet(matrix)
    return float(value) if sign > 0 else 0.0
