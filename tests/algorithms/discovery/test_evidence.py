"""Evidence of sets of effects."""

import itertools
import math

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.evidence import log_evidence
from lsst.fringe_sim.algorithms.discovery.fit import Coordinate, Fit
from lsst.fringe_sim.effects import EFFECTS

NULL_CHI2 = 500.0
GRID = np.linspace(-30.0, 30.0, 6001)


def gaussian_fit(
    best: np.ndarray,
    information: np.ndarray,
    refinement: tuple[int, ...],
    exchangeable: tuple[str, ...] = (),
    scale: float = 1.0,
) -> Fit:
    """Fit of parameters of a scale to data that know them with this information.

    Those that are exchangeable belong to the effects named.
    """
    groups = exchangeable or ("",) * len(best)
    coordinates = tuple(
        Coordinate(
            group or "effect",
            f"p{i}",
            0.0,
            -40.0,
            40.0,
            scale,
            False,
            refinement=grade,
            exchangeable=group != "",
        )
        for i, (grade, group) in enumerate(zip(refinement, groups, strict=True))
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


def normal(values: np.ndarray, covariance: np.ndarray) -> float:
    """Log density of a Gaussian about zero, but for the factor of its dimension."""
    return float(-0.5 * (values @ np.linalg.solve(covariance, values) + np.linalg.slogdet(covariance)[1]))


def drawn(best: np.ndarray, information: np.ndarray, groups: tuple[str, ...], *, widths: int = 400) -> float:
    """Log evidence of parameters drawn from Gaussians of half-Cauchy widths, over that of the null, by quadrature."""
    covariance = np.linalg.inv(information)
    names = sorted(set(groups))
    log_width = np.linspace(math.log(1e-5), math.log(1e4), widths)
    prior = (
        np.exp(log_width) * 2.0 / math.pi / (1.0 + np.exp(2.0 * log_width)) * (log_width[1] - log_width[0])
    )
    total = -math.inf
    for places in itertools.product(range(widths), repeat=len(names)):
        square = np.array([math.exp(2.0 * log_width[places[names.index(group)]]) for group in groups])
        weight = float(np.log(prior[list(places)]).sum())
        with_prior = normal(best, covariance + np.diag(square))
        total = np.logaddexp(total, weight + with_prior)
    return float(total - normal(np.zeros(len(best)), covariance))


SIXTEEN = np.diag(np.geomspace(50.0, 5000.0, 16)) + 20.0 * np.ones((16, 16))


@pytest.mark.parametrize("size", [0.0, 0.03, 0.3, 3.0])
def test_sixteen_draws_of_one_width_cost_one_prior(size: float) -> None:
    best = size * np.random.default_rng(7).normal(size=16)
    groups = ("gain",) * 16
    found = log_evidence(gaussian_fit(best, SIXTEEN, (0,) * 16, groups), NULL_CHI2)
    null_fall = float(best @ SIXTEEN @ best)  # of the data, from null to best
    assert found - 0.5 * null_fall == pytest.approx(drawn(best, SIXTEEN, groups), abs=0.05)


def test_two_kinds_of_draws_have_a_width_each() -> None:
    rng = np.random.default_rng(8)
    best = np.concatenate([0.2 * rng.normal(size=8), 2.0 * rng.normal(size=8)])
    groups = ("gain",) * 8 + ("offset",) * 8
    found = log_evidence(gaussian_fit(best, SIXTEEN, (0,) * 16, groups), NULL_CHI2)
    expected = drawn(best, SIXTEEN, groups, widths=80)
    assert found - 0.5 * float(best @ SIXTEEN @ best) == pytest.approx(expected, abs=0.1)


def test_a_prior_scale_counts_once_for_draws_and_each_time_for_others() -> None:
    best = 0.1 * np.random.default_rng(9).normal(size=16)
    lost = {}
    for groups in (("gain",) * 16, ("",) * 16):
        narrow, wide = (
            log_evidence(gaussian_fit(best, SIXTEEN, (0,) * 16, groups, scale), NULL_CHI2)
            for scale in (1.0, 10.0)
        )
        lost[groups[0]] = narrow - wide
    assert lost["gain"] == pytest.approx(math.log(10.0), abs=0.1)
    assert lost[""] == pytest.approx(16.0 * math.log(10.0), abs=1.0)


def test_no_effects_no_evidence() -> None:
    none = np.zeros(0)
    fit = Fit({}, (), none, none, none, NULL_CHI2 - 3.0, np.zeros((0, 0)), 5, True)
    assert log_evidence(fit, NULL_CHI2) == 1.5


def test_every_effect_surely_has_something() -> None:
    for effect in EFFECTS:
        assert len(effect.search.refinements) < len(effect.parameters), effect.name
