"""Discs in which a local effect promises most."""

from __future__ import annotations

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import islands
from lsst.fringe_sim.algorithms.discovery.basis import CellBasis
from lsst.fringe_sim.algorithms.discovery.cells import bin_cube
from lsst.fringe_sim.algorithms.discovery.fit import Fit, Problem, coordinates_of, fit_model
from lsst.fringe_sim.algorithms.discovery.forward import Forward
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.algorithms.discovery.selection import Selector
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.effects import disc_search as discs_module
from lsst.fringe_sim.effects.disc_search import Discs
from lsst.fringe_sim.model import FringeModel

SHAPE = (40, 56)


def _disc(row: float, column: float, radius: float) -> np.ndarray:
    y, x = np.indices(SHAPE)
    return np.hypot(y - row, x - column) <= radius


def test_sums_over_discs_are_those_of_their_cells() -> None:
    values = np.random.default_rng(3).standard_normal(SHAPE)
    discs = Discs.of(np.ones(SHAPE, bool))
    assert discs.radii[0] == discs_module.SMALLEST_RADIUS
    assert (
        discs_module.LARGEST_PART * 40 / discs_module.RADIUS_RATIO
        < discs.radii[-1]
        <= discs_module.LARGEST_PART * 40
    )
    for radius, sums in zip(discs.radii, discs.sums(values), strict=True):
        for row, column in ((20, 30), (0, 0), (39, 2), (5, 55)):
            assert sums[row, column] == pytest.approx(values[_disc(row, column, radius)].sum(), abs=1e-9)


@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_a_disc_is_found_with_what_it_promises(strength: float) -> None:
    discs = Discs.of(np.ones(SHAPE, bool))
    radius = discs.radii[6]
    own = _disc(18, 33, radius)
    information = np.full(SHAPE, 2.0)
    found = discs.best(np.where(own, 2.0 * strength, 0.0), information)
    assert found[1:] == pytest.approx((18.0, 33.0, radius))
    assert found[0] == pytest.approx(2.0 * strength**2 * own.sum())


def test_what_cannot_be_the_effect_promises_nothing() -> None:
    """Not where it would have to be its own opposite, and not where hardly any data are."""
    seen = np.ones(SHAPE, bool)
    own, information = _disc(18, 47, 5.0), np.full(SHAPE, 2.0)
    assert Discs.of(seen).best(np.where(own, -2.0, 0.0), information)[0] == pytest.approx(0.0, abs=1e-6)
    assert Discs.of(seen).best(np.where(own, 2.0, 0.0), information)[0] > 100.0
    seen[:, 20:] = False
    found = Discs.of(seen).best(np.where(own, 2.0, 0.0), information)
    assert found[0] == pytest.approx(0.0, abs=1e-6)


def test_a_sensor_too_small_for_discs_has_none() -> None:
    discs = Discs.of(np.ones((4, 4), bool))
    assert discs.radii == []
    assert discs.best(np.ones((4, 4)), np.ones((4, 4)))[0] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "cause", "found"), [("outsider", "stains", False), ("one", "void", True)])
def test_stains_are_no_islands(kind: str, cause: str, found: bool) -> None:
    """Along a void they promise much, and the data are farther from one of any size than from none."""
    case = draw_case(kind, np.random.default_rng([7, 77]).spawn(2)[0], only=[cause])
    prepared = prepare(case.cube, FringeModel.from_setup(case.setup), EFFECTS, 20_000)
    problem, null = prepared.problem, prepared.null
    state = Selector(problem, EFFECTS, null, prepared.index).state(null)
    (void,) = (effect for effect in EFFECTS if effect.name == "void")
    coordinates = coordinates_of(void, problem.forward, state.thickness_um)
    level, _ = problem.amplitudes(null.levels)

    assert bool(islands.island_starts(problem, state, {}, coordinates, level)) == found


@pytest.fixture(scope="module")
def steep() -> tuple[Problem, Fit, np.ndarray]:
    """A strong void, its fit at the truth, and the true thickness."""
    rng = np.random.default_rng([3, 9001]).spawn(2)[0]
    case = draw_case("one", rng, size=(96, 96), only=["void"])
    cells, truth = bin_cube(case.cube, 1), case.thickness_um
    limits = (float(truth.min()) - 1.0, float(truth.max()) + 1.0)
    forward = Forward.of_cells(FringeModel.from_setup(case.setup), EFFECTS, cells, limits)
    problem = Problem(cells, forward, CellBasis(truth.shape), np.eye(len(cells.value)))
    (void,) = (effect for effect in EFFECTS if effect.name == "void")
    own = coordinates_of(void, forward, truth)
    position = np.array([item.coordinate(case.values[item.key]) for item in own])
    return problem, fit_model(problem, own, position, truth.ravel(), iterations=0), truth


def test_an_island_that_is_torn_between_orders_is_mended(steep) -> None:
    problem, fit, truth = steep
    on = problem.forward.on_islands(fit.settings)
    right = on & (np.arange(truth.shape[1]) > np.flatnonzero(on.any(axis=0)).mean())
    torn = np.where(right, truth - problem.order_um, truth)
    found = islands.mended_on_islands(problem, fit, torn, truth)
    assert right.sum() > 100
    assert np.abs(found - truth).max() < 0.5 * problem.order_um
    assert np.median(np.abs(found - truth)[right]) < 0.02 * problem.order_um
    np.testing.assert_array_equal(found[~right], truth[~right])


def test_an_island_stays_as_it_is_where_its_order_suits_the_data_better(steep, monkeypatch) -> None:
    """What is about it may lead to another order."""
    problem, fit, truth = steep
    monkeypatch.setattr(islands, "continued", lambda field, known: field - problem.order_um)
    np.testing.assert_array_equal(islands.mended_on_islands(problem, fit, truth, truth), truth)
