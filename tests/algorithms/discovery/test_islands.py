"""Discs in which a local effect promises most."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from foreign_sky import foreign_map
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.discovery import islands
from lsst.fringe_sim.algorithms.discovery.basis import CellBasis, SplineBasis
from lsst.fringe_sim.algorithms.discovery.cells import bin_cube
from lsst.fringe_sim.algorithms.discovery.fit import Fit, Problem, coordinates_of, fit_model
from lsst.fringe_sim.algorithms.discovery.forward import Forward
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.algorithms.discovery.selection import Selector
from lsst.fringe_sim.challenge.sealed_cases import draw_case, expose
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


def test_a_void_is_found_and_placed_on_its_island(recorded: Record) -> None:
    """Beside a thickness of each cell, and beside a smooth one, where it looks like a step."""
    values = {"void.centre_x": 21.3, "void.centre_y": 16.8, "void.radius": 7.4, "void.thickness": 60.0}
    rng = np.random.default_rng(21)
    truth = foreign_map(rng, (36, 40), 14.0, 14.4)
    cube, _ = expose(truth, values, rng)
    model, cells = FringeModel.from_setup("ts8_e2v"), bin_cube(cube.take(np.arange(0, len(cube.image), 2)), 1)
    limits = (float(truth.min()) - 1.0, float(truth.max()) + 1.0)
    (void,) = catalogue = [effect for effect in EFFECTS if effect.name == "void"]
    forward = Forward.of_cells(model, catalogue, cells, limits)
    problem = Problem(cells, forward, CellBasis(truth.shape), np.eye(len(cells.value)))
    own = coordinates_of(void, forward, truth)
    right = np.array([item.coordinate(values[item.key]) for item in own])
    on = forward.on_islands(values)

    null = fit_model(problem, (), np.zeros(0), truth.ravel())
    level, _ = problem.amplitudes(null.levels)
    selector = Selector(problem, catalogue, null, np.full(len(cells.value), 1.5), generic=False)
    starts = islands.island_starts(problem, selector.state(null), {}, own, level)
    place = [number for number, item in enumerate(own) if item.place]
    assert np.abs(starts[0].position - right)[place].max() < 4.0

    away = right + np.where([item.place for item in own], 0.8, 0.0)
    placed, thickness = islands.placed_on_island(problem, own, away, truth, level)
    assert np.abs(placed - right)[place].max() < 0.5
    assert np.abs(thickness - truth)[on].mean() < 0.01
    moved = islands.followed_on_island(problem, "void", values, truth + 0.03 * on, level)
    assert np.abs(moved - truth)[on].mean() < 0.01
    whole = fit_model(problem, own, right, truth.ravel())
    unknown = on & (np.indices(truth.shape)[0] % 2 == 0)
    told = islands.thickness_on_islands(problem, whole, truth + 0.05 * unknown, unknown)
    assert np.abs(told - truth)[unknown].mean() < 0.01

    smooth = replace(problem, basis=SplineBasis.of_grid(truth.shape, 8.0))
    field = smooth.basis.fit(truth, cells.seen.astype(float))
    beside = fit_model(smooth, (), np.zeros(0), field)
    selector = Selector(smooth, catalogue, beside, np.full(len(cells.value), 1.5), generic=False)
    steps = [selector.at_step("void", beside, least) for least in (0.0, 1e9)]
    assert steps[1] is None
    start = islands.start_at_step(smooth, selector.state(beside), {}, own)
    recorded({
        "starts": starts, "placed": placed, "thickness": thickness, "followed": moved, "told": told,
        "at a step": None if start is None else start, "fit there": steps[0] and steps[0].fit.settings,
    })  # fmt: skip
