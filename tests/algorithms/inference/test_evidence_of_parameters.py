"""What parameters add to the log likelihood of a fit, against integrals over their priors that are done otherwise."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import cauchy, multivariate_normal

from lsst.fringe_sim.algorithms.inference.coordinates import Coordinate, log_evidence_of_parameters


def coordinate(name: str, **other) -> Coordinate:
    return Coordinate(
        **{"effect": "one", "parameter": name, "null": 0.5, "low": -9.0, "high": 9.0, "scale": 2.0, **other}
    )


def of_likelihood(information: np.ndarray) -> float:
    """Integral of a Gaussian that is one at its highest."""
    return 0.5 * len(information) * np.log(2.0 * np.pi) - 0.5 * float(np.linalg.slogdet(information)[1])


@pytest.mark.parametrize("away", [(0.3, -0.2, 0.25), (1.5, -2.5, 4.0)])
def test_exchangeable_parameters_are_draws_of_one_width_that_is_not_known(away: tuple[float, ...]) -> None:
    information = np.array([[30.0, 4.0, -3.0], [4.0, 50.0, 2.0], [-3.0, 2.0, 20.0]])
    items = [coordinate(name, exchangeable=True) for name in "abc"]
    error = np.linalg.inv(information)

    def density(width: float) -> float:
        """Of the values, as draws that were measured with the error, and of the width."""
        drawn = multivariate_normal.pdf(away, np.zeros(3), error + width**2 * np.eye(3))
        return float(drawn * 2.0 * cauchy.pdf(width, scale=2.0))

    whole = sum(quad(density, *limits, epsabs=0.0)[0] for limits in ((2e-3, 0.5), (0.5, 5.0), (5.0, 60.0)))
    found = log_evidence_of_parameters(items, 0.5 + np.array(away), information)
    assert found == pytest.approx(np.log(whole) + of_likelihood(information), abs=4e-3)


def test_exchangeable_parameters_leave_others_as_they_are() -> None:
    """Where the likelihood does not join them, the sum is that of both alone."""
    groups = [[coordinate(name, exchangeable=True) for name in "ab"], [coordinate("c", effect="two")]]
    information, values = np.diag([30.0, 50.0, 1e4]), np.array([0.8, 0.1, 0.7])
    alone = [
        log_evidence_of_parameters(own, values[part], information[part, part])
        for own, part in zip(groups, (slice(2), slice(2, 3)), strict=True)
    ]
    found = log_evidence_of_parameters([*groups[0], *groups[1]], values, information)
    assert found == pytest.approx(sum(alone), rel=1e-12)


@pytest.mark.parametrize(
    ("low", "high", "factor"),
    [(-9.0, 9.0, 1.0), (0.5, 9.0, 2.0), (-9.0, 0.5, 2.0)],
    ids=["both", "up", "down"],
)
def test_a_sharp_likelihood_meets_a_cauchy_prior(low: float, high: float, factor: float) -> None:
    item, value = coordinate("a", low=low, high=high), 0.5 + (1.5 if high > 1.0 else -1.5)
    expected = np.log(factor * cauchy.pdf(value, 0.5, 2.0)) + of_likelihood(np.array([[1e6]]))
    assert log_evidence_of_parameters([item], np.array([value]), np.array([[1e6]])) == pytest.approx(
        expected, abs=1e-5
    )


def test_a_place_may_be_anywhere() -> None:
    item, information = coordinate("a", place=True, low=-3.0, high=5.0), np.array([[1e6]])
    found = log_evidence_of_parameters([item], np.array([4.0]), information)
    assert found == pytest.approx(-np.log(8.0) + of_likelihood(information), abs=1e-5)


def test_a_place_that_data_do_not_tell_is_somewhere_within_its_bounds() -> None:
    item = coordinate("a", place=True, low=-3.0, high=5.0)
    found = log_evidence_of_parameters([item], np.array([4.0]), np.array([[0.0]]))
    assert found == pytest.approx(0.5 * np.log(2.0 * np.pi), rel=1e-12)


def test_refinements_that_may_be_absent_count_with_the_mean_over_their_numbers() -> None:
    """A Gaussian likelihood with the refined parameters at null, fitted again without them."""
    items = [coordinate(name, refinement=number) for name, number in (("a", 0), ("b", 1), ("c", 1), ("d", 2))]
    root = np.array(
        [[40.0, 8.0, 5.0, 2.0], [0.0, 30.0, 9.0, 4.0], [0.0, 0.0, 50.0, 7.0], [0.0, 0.0, 0.0, 60.0]]
    )
    information, away = root.T @ root, np.array([0.2, 0.03, -0.02, 0.015])
    evidence = []
    for highest in (0, 1, 2):
        kept = np.array([item.refinement <= highest for item in items])
        left, out = information[np.ix_(kept, kept)], ~kept
        # The best of those that are kept moves as the absent ones go to null.
        moved = away[kept] + np.linalg.solve(left, information[np.ix_(kept, out)] @ away[out])
        shift = np.concatenate([moved, np.zeros(out.sum())]) - np.concatenate([away[kept], away[out]])
        lost = 0.5 * float(shift @ information @ shift)
        prior = float(np.sum(cauchy.logpdf(moved, scale=2.0)))
        evidence.append(of_likelihood(left) - lost + prior)
    found = log_evidence_of_parameters(items, 0.5 + away, information)
    assert found == pytest.approx(float(logsumexp(evidence)) - np.log(3.0), abs=0.03)


def test_nothing_adds_nothing() -> None:
    assert log_evidence_of_parameters([], np.zeros(0), np.zeros((0, 0))) == 0.0
