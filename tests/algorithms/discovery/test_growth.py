"""Thickness that grows from where a blurred model fits, and fields that are continued."""

import math
from dataclasses import replace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.basis import CellBasis
from lsst.fringe_sim.algorithms.discovery.fit import Problem, coordinates_of, fit_model
from lsst.fringe_sim.algorithms.discovery.forward import Forward
from lsst.fringe_sim.algorithms.discovery.growth import grown_thickness
from lsst.fringe_sim.algorithms.discovery.selection import Selector
from lsst.fringe_sim.algorithms.discovery.validation import thickness_starts, whole_thickness
from recorded_cases import recorded_case

from lsst.fringe_sim.algorithms.discovery import discover, preparation
from lsst.fringe_sim.algorithms.discovery.cells import bin_cube
from lsst.fringe_sim.algorithms.discovery.continuation import continued
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

BLUR = "charge_diffusion"
ORDER_UM = 0.27


@pytest.fixture(scope="module")
def blurred():
    """A sensor whose fringes a blur nearly takes away where they are narrow, its thickness and its blur."""
    # Between a tenth and a hundredth of the narrowest fringes is left.
    for seed in range(1000):
        case = draw_case("one", np.random.default_rng([77, seed]), size=(64, 64), only=[BLUR])
        slope = np.hypot(*np.gradient(case.thickness_um))
        left = math.exp(-2.0 * (math.pi * slope.max() * case.values[f"{BLUR}.sigma"] / ORDER_UM) ** 2)
        if 0.01 < left < 0.1:
            break
    else:
        pytest.fail("no sensor is blurred as much")
    cells = bin_cube(case.cube, 1).scaled_noise(math.sqrt(case.noise_factor), 0.0)
    truth = case.thickness_um
    limits = (float(truth.min()) - 1.0, float(truth.max()) + 1.0)
    forward = Forward.of_cells(FringeModel.from_setup(case.setup), EFFECTS, cells, limits)
    problem = Problem(cells, forward, CellBasis(truth.shape), np.eye(len(cells.value)))
    return problem, truth, case.values[f"{BLUR}.sigma"]


def _fit_at(problem: Problem, sigma: float, thickness: np.ndarray):
    effect = next(item for item in EFFECTS if item.name == BLUR)
    coordinates = coordinates_of(effect, problem.forward, thickness)
    position = np.array([coordinates[0].coordinate(sigma)])
    return fit_model(problem, coordinates, position, thickness.ravel())


def _is_wrong(field: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.abs(field - truth) > 0.5 * ORDER_UM


@pytest.mark.slow
def test_what_lies_behind_a_blur_gets_its_order_back(blurred) -> None:
    """An order is lost on the way from the middle to a side, as where no fringes are seen."""
    problem, truth, sigma = blurred
    columns = np.arange(truth.shape[1])
    lost = truth + ORDER_UM / (1.0 + np.exp(-(columns - 44.0) / 1.5))
    assert _is_wrong(lost, truth).mean() > 0.25
    fit = _fit_at(problem, sigma, lost)
    assert _is_wrong(fit.field.reshape(truth.shape), truth).mean() > 0.1  # no fit finds back by itself
    grown = grown_thickness(problem, fit, lost)
    assert grown is not None
    assert _is_wrong(grown.thickness_um, truth).mean() < 0.01
    assert grown.settings[f"{BLUR}.sigma"] == pytest.approx(sigma, rel=0.02)


@pytest.mark.slow
def test_cells_without_data_do_not_stop_it(blurred) -> None:
    """Two sides are masked, a band that the growth has to pass, and single cells."""
    problem, truth, sigma = blurred
    seen = np.random.default_rng(3).random(truth.shape) > 0.1
    seen[:14] = seen[:, :10] = seen[:, 32:40] = False
    masked = problem.with_cells(problem.cells.restricted(seen))
    lost = truth + ORDER_UM / (1.0 + np.exp(-(np.arange(truth.shape[1]) - 44.0) / 1.5))
    fit = _fit_at(masked, sigma, lost)
    assert _is_wrong(fit.field.reshape(truth.shape), truth)[seen].mean() > 0.1
    grown = grown_thickness(masked, fit, lost)
    assert grown is not None
    assert _is_wrong(grown.thickness_um, truth)[seen].mean() < 0.01
    assert grown.settings[f"{BLUR}.sigma"] == pytest.approx(sigma, rel=0.02)


@pytest.mark.slow
def test_where_the_model_fits_nothing_grows(blurred) -> None:
    problem, truth, sigma = blurred
    assert grown_thickness(problem, _fit_at(problem, sigma, truth), truth) is None


@pytest.mark.slow
def test_a_blur_that_is_seen_is_not_taken_for_pixels_without_area(blurred) -> None:
    """With it points and areas are the same but for its size."""
    problem, truth, sigma = blurred
    fit = _fit_at(problem, sigma, truth)
    points = problem.forward.with_places(1)
    chosen, again = preparation._choose_pixels(
        Problem(problem.cells, points, problem.basis, problem.level_basis), fit, fit.settings
    )
    assert chosen.forward.places == 0
    assert again.chi2 == pytest.approx(fit.chi2, rel=1e-2)


@pytest.mark.slow
def test_cells_held_out_follow_a_fit_whose_field_is_another_than_without_effects(blurred) -> None:
    """Added to a field in another order, what the others moved by is no thickness of those held out."""
    problem, truth, sigma = blurred
    held_out = np.zeros(truth.shape, dtype=bool)
    held_out[8:16, 24:32] = held_out[32:40, 40:48] = True
    rng = np.random.default_rng(5)
    spoiled = truth + ORDER_UM * rng.integers(-2, 3, (8, 8)).repeat(8, axis=0).repeat(8, axis=1)
    null = fit_model(problem, (), np.zeros(0), spoiled.ravel(), iterations=0)
    seen = problem.with_cells(problem.cells.restricted(~held_out))
    fit = fit_model(seen, (), np.zeros(0), truth.ravel(), None, {f"{BLUR}.sigma": sigma})
    found = whole_thickness(problem, null, fit, held_out)
    assert not _is_wrong(found, truth).any()
    np.testing.assert_array_equal(found[~held_out], fit.field.reshape(truth.shape)[~held_out])


@pytest.mark.slow
def test_cells_held_out_have_a_second_start_where_their_order_is_open(blurred) -> None:
    """One block of the unchanged model is an order off, which such weak fringes hardly tell before it is fitted."""
    strong, truth, sigma = blurred
    cells, rng = strong.cells, np.random.default_rng(6)
    noise = 0.1 * rng.standard_normal(cells.value.shape)
    weight = np.where(cells.weight > 0.0, 0.1**-2.0, 0.0)
    problem = strong.with_cells(replace(cells, value=cells.value + noise, weight=weight))
    held_out = np.zeros(truth.shape, dtype=bool)
    held_out[8:16, 24:32] = held_out[32:40, 40:48] = True
    spoiled = truth.copy()
    spoiled[8:16, 24:32] += ORDER_UM
    seen = problem.with_cells(problem.cells.restricted(~held_out))
    fit = fit_model(seen, (), np.zeros(0), truth.ravel(), None, {f"{BLUR}.sigma": sigma})
    right, wrong = (fit_model(problem, (), np.zeros(0), f.ravel(), iterations=0) for f in (truth, spoiled))
    assert len(thickness_starts(problem, right, fit, held_out)) == 1
    first, second = thickness_starts(problem, wrong, fit, held_out)
    assert _is_wrong(first, truth)[8:16, 24:32].all()
    assert not _is_wrong(second, truth).any()


def test_a_plane_is_continued_as_a_plane() -> None:
    y, x = np.indices((30, 40))
    plane = 14.0 + 0.02 * x - 0.03 * y
    known = (x - 20) ** 2 + (y - 15) ** 2 < 100
    np.testing.assert_allclose(continued(np.where(known, plane, np.nan), known), plane, atol=1e-3)


@pytest.fixture(scope="module")
def hidden_gap():
    """A sensor of which a blur of 2.2 px leaves no fringes in a band, with a corner behind it, and its generator."""
    case, rng = recorded_case(20491128, "two", 3)
    assert set(case.names) == {BLUR, "bandwidth"}
    return case, rng


@pytest.mark.slow
def test_a_field_judged_with_the_blur_lies_better_on_the_data(hidden_gap) -> None:
    case, _ = hidden_gap
    blur = [effect for effect in EFFECTS if effect.name == BLUR]
    prepared = preparation.prepare(case.cube, FringeModel.from_setup(case.setup), blur, 20_000)
    selector = Selector(prepared.problem, blur, prepared.null, prepared.index)
    fit = selector.hypothesis((BLUR,)).fit
    judged, _ = preparation.prepare_again(prepared, fit, prepared.problem.basis.expand(fit.field))
    assert judged is not None
    rows, columns = prepared.problem.cells.shape[1:]
    px = prepared.problem.cells.cell_px
    truth = case.thickness_um.reshape(rows, px, columns, px).mean(axis=(1, 3))
    before, after = (each.problem.basis.expand(each.undistorted_field) for each in (prepared, judged))
    assert _is_wrong(before, truth).mean() > 0.05
    assert _is_wrong(after, truth).mean() < _is_wrong(before, truth).mean()
    assert preparation.is_judged_better(judged, prepared)
    assert not preparation.is_judged_better(prepared, judged)


@pytest.mark.slow
def test_a_blur_that_takes_fringes_away_is_named_with_what_else_is_there(hidden_gap) -> None:
    """With the thickness of the unchanged model, effects that weaken all fringes explain more than it does."""
    case, rng = hidden_gap
    catalogue = [effect for effect in EFFECTS if effect.name in (BLUR, "bandwidth", "roughness")]
    verdict = discover(case.cube, case.setup, catalogue, rng=rng)
    assert verdict.verdict == "named"
    assert {effect.name for effect in verdict.effects} == {BLUR, "bandwidth"}
    for effect in verdict.effects:
        for name, found in effect.parameters.items():
            assert abs(found.value - case.values[f"{effect.name}.{name}"]) < 4.0 * found.sigma
