"""Effects with which the thickness settles in the wrong fringe order are found in the right one."""

from dataclasses import replace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.classes import classes_of
from lsst.fringe_sim.algorithms.discovery.fit import Fit, Problem, fit_model
from lsst.fringe_sim.algorithms.discovery.orders import fields_in_other_orders
from lsst.fringe_sim.algorithms.discovery.selection import Hypothesis, Selector
from recorded_cases import recorded_case
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.discovery import SearchOptions
from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, prepare, prepare_again
from lsst.fringe_sim.algorithms.discovery.set_search import SetSearch
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

JITTER, CAUSE, RIVAL = "wavelength_jitter", "dark_pedestal", "contrast_loss"
CATALOGUE = [effect for effect in EFFECTS if effect.name in (JITTER, CAUSE, RIVAL)]
INDEX = 1.6


@pytest.fixture(scope="module")
def sensor() -> tuple[Problem, Fit, np.ndarray]:
    """Flats whose wavelengths are off one by one, behind a pedestal; fit with both known; index of the layer."""
    case = draw_case("two", np.random.default_rng(7), size=(48, 48), only=[JITTER, CAUSE])
    without, known = (
        prepare(case.cube, FringeModel.from_setup("ts8_e2v", effects), CATALOGUE, 20_000)
        for effects in ({}, case.values)
    )
    return replace(known.problem, forward=without.problem.forward), known.null, known.index


def fitted_at(
    sensor: tuple[Problem, Fit, np.ndarray], selector: Selector, field: np.ndarray, *names: str
) -> Fit:
    """Fit of some effects that starts from a field."""
    problem, known, _ = sensor
    items = tuple(item for name in names for item in selector.coordinates[name])
    return fit_model(problem, items, np.zeros(len(items)), field, known.levels, iterations=60)


@pytest.fixture
def selector(sensor) -> Selector:
    problem, known, index = sensor
    null = fit_model(problem, (), np.zeros(0), known.field, known.levels)
    return Selector(problem, CATALOGUE, null, index)


def test_fields_lie_whole_orders_away(sensor) -> None:
    problem, known, _ = sensor
    whole = problem.basis.expand(known.field)
    moved = [problem.basis.expand(field) for field in fields_in_other_orders(problem, known.field, INDEX)]
    order = 1e-3 * np.median(problem.cells.wavelength_nm) / (2.0 * INDEX)
    np.testing.assert_allclose([(each - whole).mean() / order for each in moved], [-2, -1, 1, 2], atol=0.01)


@pytest.mark.parametrize("number", first_is_quick(range(4)))
def test_wavelengths_that_are_off_are_found_from_another_order(sensor, selector, number: int) -> None:
    """Each wavelength follows a wrong order by itself, to where only the ends of the spectrum tell."""
    problem, known, _ = sensor
    right = fitted_at(sensor, selector, known.field, CAUSE, JITTER)
    away = fields_in_other_orders(problem, known.field, INDEX)[number]
    wrong = fitted_at(sensor, selector, away, CAUSE, JITTER)
    assert wrong.chi2 > right.chi2 + 50.0
    selector.fitted[frozenset((CAUSE, JITTER))] = Hypothesis((CAUSE, JITTER), wrong, 0.0)
    found = selector.improved((CAUSE, JITTER), wrong, scan=True)
    assert found.fit.chi2 == pytest.approx(right.chi2, abs=2.0)


@pytest.mark.slow
def test_rivals_fitted_in_another_order_are_fitted_again(sensor, selector) -> None:
    """What was compared before the right order was known says nothing."""
    problem, known, _ = sensor
    away = fields_in_other_orders(problem, known.field, INDEX)[1]
    wrong = fitted_at(sensor, selector, away, JITTER, RIVAL)
    selector.fitted[frozenset((JITTER, RIVAL))] = Hypothesis((JITTER, RIVAL), wrong, 0.0)
    chosen = selector.hypothesis((JITTER, CAUSE), None, fitted_at(sensor, selector, known.field, JITTER))
    classes_of(selector, chosen, 5.0)
    rival = selector.hypothesis((JITTER, RIVAL))
    right = fitted_at(sensor, selector, known.field, JITTER, RIVAL)
    assert wrong.chi2 > right.chi2 + 50.0
    assert rival.fit.chi2 == pytest.approx(right.chi2, abs=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("first_seed", [0, 1000, 2000])
def test_a_layer_that_is_far_off_is_found(first_seed: int) -> None:
    """Its misfit has a minimum for every fringe, in every order of the thickness."""
    for seed in range(first_seed, first_seed + 1000):
        case = draw_case("one", np.random.default_rng(seed), only=["gate_thickness"])
        if abs(case.values["gate_thickness.offset"]) > 0.05:
            break
    gate = [effect for effect in EFFECTS if effect.name == "gate_thickness"]
    prepared = prepare(case.cube, FringeModel.from_setup("ts8_e2v"), gate, 20_000)
    selector = Selector(prepared.problem, gate, prepared.null, prepared.index)
    found = selector.improved(("gate_thickness",), prepared.null, scan=True)
    error = found.fit.settings["gate_thickness.offset"] - case.values["gate_thickness.offset"]
    assert abs(error) < 5.0 * max(found.fit.sigma[0], 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [302, 305])
def test_the_deepest_of_many_minima_is_found_from_far_away(seed: int) -> None:
    """A support has fringes of its own: its index has a minimum every 0.003, and the deepest is a hundred away."""
    case = draw_case("one", np.random.default_rng(seed), size=(48, 48), only=["support_index"])
    hidden = case.values["support_index.offset"]
    support = [effect for effect in EFFECTS if effect.name == "support_index"]
    prepared = prepare(case.cube, FringeModel.from_setup(case.setup), support, 20_000)
    selector = Selector(
        prepared.problem, support, prepared.null, prepared.index, first_field=prepared.undistorted_field
    )
    found = selector.hypothesis(("support_index",)).fit
    (item,) = found.coordinates
    assert abs(hidden) > 80 * item.neighbour
    true = fit_model(
        prepared.problem, (item,), np.array([item.coordinate(hidden)]), found.field, found.levels
    )
    assert found.chi2 < true.chi2 + 9.0
    assert abs(found.settings[item.key] - hidden) < 2.5 * item.neighbour


@pytest.mark.slow
def test_a_pair_is_found_where_the_first_by_itself_was_in_another_order() -> None:
    """Insulation makes up for the wavelengths from an order away, as the thickness does: both have to move back."""
    case, _ = recorded_case(20501129, "two", 18)
    assert set(case.names) == {"insulation", "wavelength_scale"}
    both = [effect for effect in EFFECTS if effect.name in case.names]
    prepared = prepare(case.cube, FringeModel.from_setup(case.setup), both, 20_000)
    selector = Selector(
        prepared.problem, both, prepared.null, prepared.index, first_field=prepared.undistorted_field
    )
    alone = selector.improved(("insulation",), prepared.null, scan=True)
    first = selector.hypothesis(("insulation", "wavelength_scale"), None, alone.fit)
    found = selector.improved(first.names, first.fit, scan=True)
    assert found.fit.chi2 < first.fit.chi2 - 1000.0
    for item, position, sigma in zip(found.fit.coordinates, found.fit.position, found.fit.sigma, strict=True):
        assert abs(position - item.coordinate(case.values[item.key])) < 4.0 * sigma


@pytest.mark.slow
def test_field_is_judged_again_with_an_effect_in_its_right_order() -> None:
    """A gate that moves the fringes moves the thickness by three orders, which suits errors of all wavelengths."""
    case, _ = recorded_case(20461126, "two", 1)
    assert set(case.names) == {"gate_thickness", "non_linearity"}
    prepared = prepare(case.cube, FringeModel.from_setup(case.setup), EFFECTS, 20_000)
    selector = Selector(
        prepared.problem, EFFECTS, prepared.null, prepared.index, first_field=prepared.undistorted_field
    )
    sets = SetSearch(selector, SearchOptions(), lambda text: None, lambda found: found)
    singles = sets.refits(selector.null)
    best = sets.to_judge_with(singles)
    assert singles[0].names == (JITTER,)
    assert best.names == ("gate_thickness",)
    order = prepared.problem.forward.model.fringe_order_um(float(np.median(case.cube.wavelength_nm)))

    def away(judged: Prepared) -> float:
        error = judged.problem.basis.expand(judged.undistorted_field) - case.thickness_um
        return float(np.mean(np.abs(error) > 0.5 * order))

    refined, _ = prepare_again(prepared, best.fit, prepared.problem.basis.expand(best.fit.field))
    assert refined is not None
    assert away(prepared) > 0.9
    assert away(refined) == 0.0
