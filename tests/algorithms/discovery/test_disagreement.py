"""How large a disagreement is said to be."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.telling import size_beyond

NOISE, FREEDOM = 0.01, 4000.0
PATTERN = 1.0 + 0.05 * np.sin(np.arange(1000)) * np.ones((4, 1))


def size(chi2_per_value: float) -> dict[str, float]:
    return size_beyond([(NOISE**2, chi2_per_value * FREEDOM, FREEDOM)], PATTERN)


@pytest.mark.parametrize("chi2", [0.8, 0.95, 1.0])
def test_small_noise_excludes_no_more_than_mean_noise(chi2: float) -> None:
    """And a limit is never nothing."""
    found = size(chi2)
    assert found["of_counts"] == 0.0
    assert found["of_fringes_at_most"] == pytest.approx(size(1.0)["of_fringes_at_most"])
    assert found["of_fringes_at_most"] > 0.0


def test_a_clear_disagreement_is_below_its_limit() -> None:
    found = size(2.0)
    assert found["of_counts"] == pytest.approx(NOISE)
    assert found["of_counts"] / found["of_fringes"] == pytest.approx(PATTERN[0].std())
    assert found["of_fringes"] < found["of_fringes_at_most"] < 1.1 * found["of_fringes"]


def test_what_all_exposures_share_is_seen_beside_noise_of_single_ones() -> None:
    """A scatter of the response of 3e-3 that is twice as large in χ² is a disagreement of as much."""
    single, shared = (NOISE**2, FREEDOM, FREEDOM), (9e-6, 2000.0, 1000.0)
    assert size_beyond([single, shared], PATTERN)["of_counts"] == pytest.approx(3e-3)
    assert size_beyond([single, (9e-6, 1000.0, 1000.0)], PATTERN)["of_counts"] == 0.0
