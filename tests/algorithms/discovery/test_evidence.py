"""Evidence of sets of effects."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.evidence import log_evidence
from lsst.fringe_sim.algorithms.discovery.fit import Coordinate, Fit
from lsst.fringe_sim.effects import EFFECTS

NULL_CHI2 = 500.0
GRID = np.linspace(-30.0, 30.0, 6001)


def gaussian_fit(best: np.ndarray, information: np.ndarray, refinement: tuple[int, ...]) -> Fit:
    """Fit of parameters of scale 1 to data that know them with this information."""
    coordinates = tuple(
        Coordinate("effect", f"p{i}", 0.0, -40.0, 40.0, 1.0, False, refinement=grade)
        for i, grade in enumerate(refinement)
    )
    settings = {item.key: float(x) for item, x in zip(coordinates, best, strict=True)}
    fall = float(best @ information @ best)
    zero = np.zeros(len(best))
    return Fit(settings, coordinates, best, zero, zero, NULL_CHI2 - fall, information, 5, True)


def integrated(best: np.ndarray, information: np.ndarray, free: tuple[bool, bool]) -> float:
    """Log evidence of two parameters by quadrature, those that are not free at null; Cauchy priors of width 1."""
    x = GRID if free[0] else np.zeros(1)
    y = GRID if free[1] else np.zeros(1)
    dx, dy = x[:, None] - best[0], y[None, :] - best[1]
    chi2 = information[0, 0] * dx**2 + 2.0 * information[0, 1] * dx * dy + information[1, 1] * dy**2
    log = -0.5 * (chi2 - best @ information @ best)
    step = GRID[1] - GRID[0]
    for values, is_free in ((x[:, None], free[0]), (y[None, :], free[1])):
        if is_free:
            log = log - np.log(math.pi * (1.0 + values**2)) + math.log(step)
    top = log.max()
    return float(top + np.log(np.exp(log - top).sum()))


INFORMATION = np.array([[100.0, 30.0], [30.0, 400.0]])


@pytest.mark.parametrize("best", [(1.0, 0.0), (1.0, 0.05), (0.5, 2.0), (0.0, 0.3)])
def test_the_evidence_of_a_refinement_is_the_mean_with_it_and_without(best: tuple[float, float]) -> None:
    position = np.array(best)
    without, full = (integrated(position, INFORMATION, (True, second)) for second in (False, True))
    expected = np.logaddexp(without, full) - math.log(2.0)
    found = log_evidence(gaussian_fit(position, INFORMATION, (0, 1)), NULL_CHI2)
    # Laplace's approximation leaves out the constant of a Cauchy prior, 0.23 for each parameter.
    assert found == pytest.approx(expected, abs=0.55)
    whole = log_evidence(gaussian_fit(position, INFORMATION, (0, 0)), NULL_CHI2)
    assert whole == pytest.approx(full, abs=0.55)


def test_terms_that_are_not_there_cost_next_to_nothing() -> None:
    information = np.diag([1e4, 1e4, 1e6, 1e6, 1e6])
    straight = gaussian_fit(np.array([0.3, -0.2, 0.0, 0.0, 0.0]), information, (0, 0, 1, 1, 2))
    simple = gaussian_fit(np.array([0.3, -0.2]), information[:2, :2], (0, 0))
    missing = log_evidence(simple, NULL_CHI2) - log_evidence(straight, NULL_CHI2)
    assert 0.0 < missing < math.log(3.0) + 1e-6
    curved = gaussian_fit(np.array([0.3, -0.2, 0.1, 0.0, 0.0]), information, (0, 0, 1, 1, 2))
    assert log_evidence(curved, NULL_CHI2) > log_evidence(simple, NULL_CHI2) + 100.0


def test_no_effects_no_evidence() -> None:
    none = np.zeros(0)
    fit = Fit({}, (), none, none, none, NULL_CHI2 - 3.0, np.zeros((0, 0)), 5, True)
    assert log_evidence(fit, NULL_CHI2) == 1.5


def test_every_effect_surely_has_something() -> None:
    for effect in EFFECTS:
        assert min(parameter.refinement for parameter in effect.parameters) == 0, effect.name
