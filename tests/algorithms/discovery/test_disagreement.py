"""How large a disagreement is said to be."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.validation import disagreement_size

NOISE, VALUES = 0.01, 4000


def size(chi2_per_value: float) -> dict[str, float]:
    pattern = 1.0 + 0.05 * np.sin(np.arange(VALUES // 4)).reshape(1, -1, 1) * np.ones((4, 1, 1))
    cells = SimpleNamespace(noise_rms=NOISE, n_values=VALUES, seen=np.ones(pattern.shape[1:], dtype=bool))
    problem = SimpleNamespace(
        cells=cells,
        field_prior=True,
        level_basis=np.ones((4, 1)),
        amplitudes=lambda levels: (np.ones((4, 1, 1)), None),
        expected_of=lambda fit: pattern,
    )
    fit = SimpleNamespace(chi2=chi2_per_value * (VALUES - 1), coordinates=(), levels=None)
    return disagreement_size(problem, fit)  # type: ignore[arg-type]


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
    assert found["of_fringes"] < found["of_fringes_at_most"] < 1.1 * found["of_fringes"]
