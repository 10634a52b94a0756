"""Thickness that follows an effect at a finite size, and effects that are found because it does."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.following import ThicknessFollower
from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, prepare
from lsst.fringe_sim.algorithms.discovery.selection import Selector
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

INDEX = 1.6
CATALOGUE = [effect for effect in EFFECTS if effect.name in ("air_gap", "epoxy_index", "support_index")]


def prepared_case(gap_nm: float, seed: int) -> Prepared:
    """A sensor with a gap of some size, as the search gets it."""
    for attempt in range(seed, seed + 1000):  # a gap of about that size
        case = draw_case("one", np.random.default_rng(attempt), size=(48, 48), only=["air_gap"])
        if 0.7 < case.values["air_gap.thickness"] / gap_nm < 1.4:
            return prepare(case.cube, FringeModel.from_setup("ts8_e2v"), CATALOGUE, 20_000)
    raise AssertionError("no such gap was drawn")


@pytest.fixture(scope="module")
def null_sensor() -> Prepared:
    case = draw_case("none", np.random.default_rng(3), size=(48, 48))
    return prepare(case.cube, FringeModel.from_setup("ts8_e2v"), CATALOGUE, 20_000)


def test_the_unchanged_model_stays_where_it_was_fitted(null_sensor) -> None:
    problem = null_sensor.problem
    thickness = problem.basis.expand(null_sensor.null.field)
    moved = ThicknessFollower(problem, thickness, INDEX).places({})
    assert np.abs(moved[0] - thickness).max() < 1e-3


@pytest.mark.parametrize("wrong_um", [-0.12, -0.05, 0.03, 0.1])
def test_a_wrong_thickness_comes_back(null_sensor, wrong_um: float) -> None:
    problem = null_sensor.problem
    thickness = problem.basis.expand(null_sensor.null.field)
    tilt = 0.3 * (thickness - thickness.mean()) / np.ptp(thickness)
    wrong = thickness + wrong_um * (1.0 + tilt)
    assert np.abs(ThicknessFollower(problem, wrong, INDEX).places({})[0] - thickness).max() < 2e-3


def test_an_index_is_taken_up_by_its_thickness(null_sensor) -> None:
    """The same optical path: the layer gets thinner by as much as its index rises."""
    problem = null_sensor.problem
    thickness = problem.basis.expand(null_sensor.null.field)
    moved = ThicknessFollower(problem, thickness, INDEX).places({"epoxy_index.offset": 0.004})[0]
    index = float(null_sensor.index.mean())
    np.testing.assert_allclose(moved, thickness * index / (index + 0.004), atol=2e-3)


def test_another_order_is_found_where_it_fits_better(null_sensor) -> None:
    """A thickness one order away looks like the right one by itself, and not beside it."""
    problem = null_sensor.problem
    thickness = problem.basis.expand(null_sensor.null.field)
    order = 1e-3 * float(np.median(problem.cells.wavelength_nm)) / (2.0 * INDEX)
    near, best = ThicknessFollower(problem, thickness + order, INDEX).places({})
    assert np.abs(near - thickness).mean() > 0.5 * order
    assert np.abs(best - thickness).max() < 5e-3


def test_one_thickness_has_no_slope(null_sensor) -> None:
    problem = null_sensor.problem
    level = np.full(problem.cells.shape[1:], 15.0)
    assert np.isfinite(ThicknessFollower(problem, level, INDEX).places({})).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [23, 11])
def test_a_gap_is_promising(seed: int) -> None:
    """With the thickness held, a gap of a hundredth of a wavelength promises nothing, and no fit is tried."""
    prepared = prepared_case(15.0, seed)
    selector = Selector(
        prepared.problem, CATALOGUE, prepared.null, prepared.index, first_field=prepared.undistorted_field
    )
    (candidate,) = selector.score(prepared.null, ["air_gap"], scan=True)
    fitted = selector.hypothesis(["air_gap"], candidate.start)
    gained = prepared.null.chi2 - fitted.fit.chi2
    assert gained > 25.0
    assert 0.1 * gained < candidate.promise < 1.1 * gained  # of the sizes tried none need be the right one
