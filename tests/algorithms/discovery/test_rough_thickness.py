"""A thickness rough from pixel to pixel has a value for every cell, and each follows the noise of its cell."""

import numpy as np
import pytest
from flat_cubes import relative_flats
from lsst.fringe_sim.algorithms.discovery.basis import CellBasis
from lsst.fringe_sim.algorithms.discovery.fit import coordinates_of, fit_model
from scipy.ndimage import gaussian_filter

from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, prepare
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
def prepared() -> list[tuple[Prepared, np.ndarray]]:
    """Four sensors at which nothing is missing, and their thickness."""
    found = []
    for seed in range(1, 5):
        rng = np.random.default_rng(seed)
        thickness = _thickness(rng)
        found.append(
            (prepare(relative_flats(thickness, MODEL, rng, NOISE), MODEL, EFFECTS, 20_000), thickness)
        )
    return found


def test_each_cell_has_a_thickness_of_its_own(prepared: list[tuple[Prepared, np.ndarray]]) -> None:
    assert all(isinstance(one.problem.basis, CellBasis) for one, _ in prepared)


def test_noise_is_what_it_is_though_the_thickness_takes_up_a_part(
    prepared: list[tuple[Prepared, np.ndarray]],
) -> None:
    factor = np.mean([one.noise.factor for one, _ in prepared])
    assert factor == pytest.approx(1.0, abs=0.02)  # 0.955 with what the thickness leaves


def test_points_are_told_from_areas(prepared: list[tuple[Prepared, np.ndarray]]) -> None:
    assert [one.problem.forward.places for one, _ in prepared] == [1] * len(prepared)


def test_fringes_do_not_look_stronger_by_the_noise_of_their_phase(
    prepared: list[tuple[Prepared, np.ndarray]],
) -> None:
    pulls = []
    for one, thickness in prepared:
        coordinates = coordinates_of(LOSS, one.problem.forward, thickness)
        fit = fit_model(one.problem, coordinates, np.zeros(1), one.null.field, one.null.levels)
        pulls.append(fit.position[0] / fit.sigma[0])
    assert (
        abs(np.mean(pulls)) < 1.5
    )  # three of a mean of four; 2.9 where the scatter of the phase is forgotten
