"""The noise of cells, and what they scatter by at all wavelengths alike, as measured from made-up residuals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.noise import (
    LEAST_TRIPLES,
    NoiseEstimate,
    estimate_noise,
    noise_ratio,
    scatter_of_pixels,
)

SHAPE = (4, 90, 100)
FACTOR = np.array([0.9, 1.0, 1.1, 1.2])
STATED = 0.01


def cells_of(weight: np.ndarray, scatter: float = 0.123) -> SimpleNamespace:
    return SimpleNamespace(weight=weight, shape=weight.shape, response_scatter=scatter)


def measured(weight: np.ndarray, residual: np.ndarray) -> NoiseEstimate:
    return estimate_noise(cells_of(weight), residual)  # type: ignore[arg-type]


def weights(rng: np.random.Generator) -> np.ndarray:
    """Of noise that is stated to grow along the rows, with some cells that are not there."""
    sigma = STATED * np.linspace(0.5, 1.5, SHAPE[2]) * np.ones(SHAPE)
    weight = sigma**-2.0
    weight[1, rng.integers(0, SHAPE[1], 80), rng.integers(0, SHAPE[2], 80)] = 0.0
    return weight


@pytest.mark.parametrize("scatter", [0.0, 0.004, 0.01])
@pytest.mark.rng("noise and scatter of cells")
def test_noise_and_scatter_are_measured_apart(scatter: float, rng: np.random.Generator) -> None:
    """Beside what is smooth, with some cells that are far off, and others that have no data."""
    weight = weights(rng)
    sigma = np.where(weight > 0.0, np.maximum(weight, 1.0) ** -0.5, 0.0)
    residual = FACTOR[:, None, None] * sigma * rng.standard_normal(SHAPE)
    residual += scatter * rng.standard_normal(SHAPE[1:])
    residual += 0.05 * np.sin(np.arange(SHAPE[2]) / 30.0) + 0.02 * np.linspace(-1.0, 1.0, SHAPE[1])[:, None]
    residual[:, rng.integers(0, SHAPE[1], 20), rng.integers(0, SHAPE[2], 20)] += 1.0
    residual[weight == 0.0] = 1e3
    found = measured(weight, residual)
    assert found.measured
    assert found.factor == pytest.approx(FACTOR, rel=0.08)
    assert found.response_scatter == (pytest.approx(scatter, rel=0.1) if scatter else 0.0)


@pytest.mark.parametrize("beside", [0.0, 0.3, -0.2])
@pytest.mark.rng("noise that neighbours share")
def test_noise_that_neighbours_share_is_told(beside: float, rng: np.random.Generator) -> None:
    """Of moving averages along the rows; second differences of independent noise have −2/3."""
    draw = rng.standard_normal((2, 150, 202))
    residual = draw[:, :, 1:-1] + beside * draw[:, :, 2:]
    lags = [1.0 + beside**2, beside, 0.0, 0.0]
    own = 6.0 * lags[0] - 8.0 * lags[1] + 2.0 * lags[2]
    next_one = -4.0 * lags[0] + 7.0 * lags[1] - 4.0 * lags[2] + lags[3]
    found = measured(np.ones(residual.shape), residual)
    assert found.neighbour_correlation == pytest.approx(next_one / own + 2.0 / 3.0, abs=0.02)


def test_without_enough_cells_the_stated_noise_stands() -> None:
    residual = np.random.default_rng(1).standard_normal((2, 40, 40))
    rows = int(np.ceil(LEAST_TRIPLES / 38)) + 2
    for size, enough in ((rows, True), (rows - 1, False), (2, False)):
        found = measured(np.ones((2, size, 40)), residual[:, :size])
        assert found.measured == enough
        if not enough:
            np.testing.assert_array_equal(found.factor, 1.0)
            assert (found.response_scatter, found.neighbour_correlation) == (0.123, 0.0)


def test_what_a_fit_leaves_of_noise_is_its_ratio() -> None:
    rng = np.random.default_rng(2)
    noise = [rng.standard_normal((3, 30, 30)) for _ in range(2)]
    part, weight = np.array([1.0, 0.5, 0.1])[:, None, None], np.ones((3, 30, 30))
    left = [part * one for one in noise]
    np.testing.assert_allclose(noise_ratio(cells_of(weight), left, noise), [1.0, 0.25, 0.01])  # type: ignore[arg-type]
    weight[2] = 0.0
    assert noise_ratio(cells_of(weight), left, noise)[2] == 1.0  # type: ignore[arg-type]
    taken = NoiseEstimate(np.array([1.0, 2.0]), 0.0, True, 0.0).with_taken(np.array([0.0, 0.75]))
    np.testing.assert_allclose(taken.factor, [1.0, 4.0])


def test_scatter_of_pixels_is_that_of_their_noise() -> None:
    rng = np.random.default_rng(3)
    y, x = np.indices((120, 140))
    image, good = 5.0 + 0.1 * y + 0.002 * x**2 + 0.7 * rng.standard_normal(y.shape), np.ones(y.shape, bool)
    image[20:22, 30:50], good[20:22, 30:50] = np.nan, False
    assert scatter_of_pixels(image, good) == pytest.approx(0.7, rel=0.06)
    assert scatter_of_pixels(image[:2], good[:2]) == np.inf
    assert scatter_of_pixels(image, good & (y < 5) & (x < 5)) == np.inf
