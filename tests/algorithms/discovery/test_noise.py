"""The noise that a search measures, and where there is too little to measure it by."""

from types import SimpleNamespace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.noise import (
    FEWEST,
    measured_noise,
    neighbour_scatter,
    scatter_of_pixels,
)
from lsst.fringe_sim.algorithms.inference import CellShape, Data, Forward, Point, Problem
from lsst.fringe_sim.effects import ImageGeometry
from lsst.fringe_sim.model import FringeModel

FACTOR = np.linspace(0.9, 1.2, 12)
STATED = 0.01


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


@pytest.fixture(scope="module")
def even() -> Point:
    """Sixty rows and columns of cells of a bent plane, at the true thickness; their response may be any."""
    place, waves = np.arange(60.0), np.linspace(880.0, 990.0, 12)
    thickness = 14.0 + 0.02 * place + 0.01 * place[:, np.newaxis] + 1e-4 * place * place[:, np.newaxis]
    geometry = ImageGeometry((60, 60), place, place, waves, np.full(12, 20_000.0))
    limits = float(thickness.min()) - 0.3, float(thickness.max()) + 0.3
    forward = Forward(
        FringeModel.from_setup("ts8_e2v"), (), geometry, CellShape.of_field(thickness, 1), limits
    )
    value = forward.predict({}, thickness.ravel())[0]
    problem = Problem(Data(value, np.full(value.shape, STATED**-2.0)), forward, thickness.ravel(), 0.1)
    return problem.at({}, np.ones(12), thickness.ravel())


@pytest.mark.parametrize("scatter", [0.0, 0.004, 0.01])
@pytest.mark.rng("noise and scatter of cells")
def test_noise_and_scatter_are_measured_apart(even: Point, scatter: float, rng: np.random.Generator) -> None:
    """Beside what is smooth, and cells that have no data."""
    noise = FACTOR[:, np.newaxis] * STATED * rng.standard_normal(even.value.shape)
    response = scatter * rng.standard_normal(3600) + 0.05 * np.sin(np.arange(3600) % 60 / 30.0)
    weight = np.full(even.value.shape, STATED**-2.0)
    weight[:, rng.integers(0, 3600, 80)] = 0.0
    data = Data(np.where(weight > 0.0, even.value * (1.0 + response) + noise, 1e3), weight)
    factor, found = measured_noise(even.problem_with(data), (12, 60, 60))
    assert factor == pytest.approx(FACTOR, rel=0.08)
    assert found == pytest.approx(scatter, rel=0.1, abs=0.2 * STATED)


def test_scatter_of_pixels_is_that_of_their_noise() -> None:
    rng = np.random.default_rng(3)
    y, x = np.indices((120, 140))
    image, good = 5.0 + 0.1 * y + 0.002 * x**2 + 0.7 * rng.standard_normal(y.shape), np.ones(y.shape, bool)
    image[20:22, 30:50], good[20:22, 30:50] = np.nan, False
    assert scatter_of_pixels(image, good) == pytest.approx(0.7, rel=0.06)
    assert scatter_of_pixels(image[:2], good[:2]) == np.inf
    assert scatter_of_pixels(image, good & (y < 5) & (x < 5)) == np.inf
