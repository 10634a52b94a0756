"""The noise that a search measures, and where there is too little to measure it by."""

from types import SimpleNamespace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.noise import FEWEST, measured_noise, neighbour_scatter


@pytest.mark.parametrize("shape", [(5, 2, 40), (5, 40, 2), (5, 8, 11), (12, 9, 10)])
def test_the_stated_noise_is_believed_where_too_few_cells_have_neighbours(
    shape: tuple[int, int, int],
) -> None:
    assert (shape[1] - 2) * (shape[2] - 2) < FEWEST
    data = SimpleNamespace(weight=np.ones((shape[0], shape[1] * shape[2])))
    point = SimpleNamespace(problem=SimpleNamespace(data=data, response_sigma=0.25))
    factor, scatter = measured_noise(point, shape)  # type: ignore[arg-type]
    np.testing.assert_array_equal(factor, np.ones(shape[0]))
    assert scatter == 0.25
    field = np.zeros(shape[1:])
    assert neighbour_scatter(field, field == 0.0, 0.5) == 0.5


def test_the_scatter_of_neighbours_is_measured_from_sixty_differences_on() -> None:
    rng = np.random.default_rng(60)
    field = 0.1 * rng.standard_normal((8, 12))
    slope = np.add.outer(np.arange(8.0), 3.0 * np.arange(12.0))
    found = neighbour_scatter(field + slope, np.ones((8, 12), bool), 7.0)
    assert found == pytest.approx(neighbour_scatter(field, np.ones((8, 12), bool), 7.0), rel=1e-12)
    assert found == pytest.approx(0.1, rel=0.4)  # sixty differences that share cells are worth sixteen
    seen = np.ones((8, 12), bool)
    seen[0, 0] = False
    assert neighbour_scatter(field, seen, 7.0) == 7.0
