"""How much likelier the data are with a set of effects than without."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from .fit import Coordinate, Fit

__all__ = ["log_evidence", "prior_cost"]

FloatArray = NDArray[np.float64]


def log_evidence(fit: Fit, null_chi2: float) -> float:
    """Laplace approximation of log Z(fit) - log Z(null) with half-Cauchy or Cauchy priors.

    Parameters that refine an effect may be absent: the evidence is the mean of those with the parameters up to each
    of its refinements. A gradient of the light need not pay for the seven curved terms that it does not have.

    Parameters
    ----------
    fit : `Fit`
        The set, fitted with all parameters.
    null_chi2 : `float`
        χ² of the unchanged model, fitted to the same data.

    Returns
    -------
    log_evidence : `float`
    """
    total = 0.5 * (null_chi2 - fit.chi2)
    if not fit.coordinates:
        return total
    scale = np.array([item.unit_step for item in fit.coordinates])
    # In units of the prior scale; no parameter is worse known after the data than before.
    information = fit.information * np.outer(scale, scale) + np.eye(len(scale))
    cost = np.array([_cost(item, x) for item, x in zip(fit.coordinates, fit.position, strict=True)])
    total -= 0.5 * _log_determinant(information) + float(cost.sum())
    return total + _without_refinements(fit, information, fit.position / scale, cost)


def prior_cost(item: Coordinate, position: float) -> float:
    """Log evidence that the size of a parameter costs, over what a size near zero would."""
    return math.log1p(item.departure(position) ** 2)


def _cost(item: Coordinate, position: float) -> float:
    cost = prior_cost(item, position)
    if item.quadratic:  # the prior is one of the parameter, the fit one of its square
        cost += math.log(max(2.0 * item.departure(position), 0.05))
    return cost


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
