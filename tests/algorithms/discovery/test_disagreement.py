"""How large a disagreement is said to be."""

from types import SimpleNamespace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.fit import Whitener
from lsst.fringe_sim.algorithms.discovery.validation import disagreement_size

NOISE, VALUES = 0.01, 4000


def size(chi2_per_value: float) -> dict[str, float]:
    pattern = 1.0 + 0.05 * np.sin(np.arange(VALUES // 4)).reshape(1, -1, 1) * np.ones((4, 1, 1))
    seen = np.ones(pattern.shape[1:], dtype=bool)
    cells = SimpleNamespace(noise_rms=NOISE, n_values=VALUES, seen=seen, response_scatter=0.0)
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


@pytest.mark.rng("size of columns")
def test_what_all_exposures_share_is_measured_beside_pixels_whose_response_scatters(
    rng: np.random.Generator,
) -> None:
    """Columns of 0.0018 behind a scatter of 0.006 and a noise of 0.008 in each of twelve exposures."""
    shape, columns, scatter, noise = (12, 64, 64), 0.0018, 0.006, 0.008
    pattern = 1.0 + 0.05 * np.sin(np.arange(64) / 3.0)[:, np.newaxis] * np.ones(shape)
    pixels = scatter * rng.standard_normal(shape[1:])
    drawn = rng.standard_normal(64)
    shared = pixels + columns * drawn / drawn.std()
    cells = SimpleNamespace(
        noise_rms=np.hypot(noise, scatter), n_values=pattern.size, seen=np.ones(shape[1:], dtype=bool),
        response_scatter=scatter, weight=np.full(shape, noise**-2.0),
        value=pattern * (1.0 + shared) + noise * rng.standard_normal(shape), shape=shape,
    )  # fmt: skip
    whiten = Whitener.of_cells(cells, pattern)  # type: ignore[arg-type]
    problem = SimpleNamespace(
        cells=cells, field_prior=True, level_basis=np.ones((12, 1)), expected_of=lambda fit: pattern,
        amplitudes=lambda levels: (np.ones((12, 1, 1)), None), whitener=lambda value: whiten,
    )  # fmt: skip
    chi2 = float((whiten(cells.value - pattern) ** 2).sum())
    found = disagreement_size(problem, SimpleNamespace(chi2=chi2, coordinates=(), levels=None))  # type: ignore[arg-type]
    assert found["of_counts"] == pytest.approx(columns, rel=0.3)
    assert found["of_counts"] / found["of_fringes"] == pytest.approx(pattern[0].std())
    assert found["of_fringes"] < found["of_fringes_at_most"]
