"""A thickness rough from pixel to pixel has a value for every cell, and each follows the noise of its cell."""

import numpy as np
import pytest
from flat_cubes import relative_flats
from scipy.ndimage import gaussian_filter

from lsst.fringe_sim.algorithms.discovery import SearchOptions
from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, prepare
from lsst.fringe_sim.algorithms.inference import coordinates_of, fit
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

pytestmark = pytest.mark.slow

MODEL = FringeModel.from_setup("ts8_e2v")
LOSS = next(effect for effect in EFFECTS if effect.name == "contrast_loss")
SIZE, NOISE, ROUGHNESS_UM = 48, 0.02, 0.008


def _thickness(rng: np.random.Generator) -> np.ndarray:
    """Plane with fringes of ten cells, rough by 8 nm from cell to cell."""
    rough = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 0.4)
    y, x = np.indices((SIZE, SIZE))
    return np.asarray(12.5 + 0.033 * (x + 0.4 * y) + ROUGHNESS_UM * rough / rough.std())


@pytest.fixture(scope="module")
def prepared() -> list[Prepared]:
    """Four sensors at which nothing is missing."""
    found = []
    for seed in range(1, 5):
        rng = np.random.default_rng(seed)
        cube = relative_flats(_thickness(rng), MODEL, rng, NOISE)
        found.append(prepare(cube, MODEL, EFFECTS, SearchOptions(), rng))
    return found


def test_noise_is_what_it_is_though_the_thickness_takes_up_a_part(prepared: list[Prepared]) -> None:
    factor = np.mean([one.noise_factor for one in prepared])
    assert factor == pytest.approx(1.0, abs=0.02)


def test_points_are_told_from_areas(prepared: list[Prepared]) -> None:
    assert not any(one.problem.forward.shape.area for one in prepared)


def test_fringes_do_not_look_stronger_by_the_noise_of_their_phase(prepared: list[Prepared]) -> None:
    pulls = []
    for one in prepared:
        found = fit((LOSS.name,), coordinates_of(LOSS, one.problem.forward), one.point)
        pulls.append((found.values[0] - 1.0) / np.sqrt(found.covariance[0, 0]))
    assert abs(np.mean(pulls)) < 1.5  # three of a mean of four
