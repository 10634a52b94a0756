"""What a search forecasts of further flats, and what it lets a correction be learned from."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.cells import CellData
from lsst.fringe_sim.algorithms.discovery.continuation import continued
from lsst.fringe_sim.algorithms.discovery.learned_columns import LocalColumns
from lsst.fringe_sim.algorithms.discovery.learning import best_evidence, learn
from lsst.fringe_sim.algorithms.discovery.lesson import (
    CellLesson,
    CellPart,
    together,
    unseen_too,
    with_corrections,
)
from lsst.fringe_sim.algorithms.discovery.next_flats import FlatForecast
from lsst.fringe_sim.algorithms.discovery.options import SearchOptions
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.algorithms.inference import (
    CellShape,
    Data,
    Forward,
    Hypothesis,
    Point,
    Problem,
    coordinates_of,
    fit,
)
from lsst.fringe_sim.algorithms.next_measurement import RankedMeasurement
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.linspace(900.0, 985.0, 8)
SIDE = 16
ELECTRONS = 50_000.0
LEAST = 6.0


def forward_of(level_e: float = ELECTRONS) -> tuple[Forward, np.ndarray]:
    place = np.arange(float(SIDE))
    thickness = 14.0 + 0.035 * place + 0.02 * place[:, np.newaxis]
    geometry = ImageGeometry((SIDE, SIDE), place, place, WAVELENGTHS, np.full(8, level_e))
    shape = CellShape.of_field(thickness, 1)
    model = FringeModel.from_setup("ts8_e2v")
    return Forward(model, EFFECTS, geometry, shape, (13.2, 15.3)), thickness


def fitted(problem: Problem, name: str) -> Hypothesis:
    forward = problem.forward
    items = coordinates_of(forward.effect_of(name), forward)
    start = {item.key: item.null + item.difference(item.null) for item in items}
    return fit((name,), items, problem.at(start, np.ones(8), problem.thickness_um), tolerance=1e-6, rounds=40)


def forecast_of(hidden: dict[str, float], level_e: float = ELECTRONS) -> tuple[FlatForecast, Problem]:
    """Of flats without noise: what is expected of those with."""
    forward, thickness = forward_of(level_e)
    value = forward.predict(hidden, thickness.ravel())[0]
    problem = Problem(Data(value, level_e / value), forward, thickness.ravel(), 1e-3)
    shape = (8, SIDE, SIDE)
    cells = CellData(value.reshape(shape), (level_e / value).reshape(shape), forward.geometry, 1, 1e-3)
    return FlatForecast(fitted(problem, next(iter(hidden)).partition(".")[0]), forward.model, cells), problem


def by_name(ranked: tuple[RankedMeasurement, ...]) -> dict[str, RankedMeasurement]:
    return {one.measurement.name: one for one in ranked}


def test_the_separation_is_that_of_the_fits() -> None:
    """To data without noise, the other effect fits worse by its square in χ²."""
    forecast, problem = forecast_of({"bandwidth.fwhm": 2.3})
    rival = fitted(problem, "converging_beam")
    ranked = by_name(forecast.ranked("bandwidth", {"converging_beam": rival}))
    (pair,) = ranked["repeat"].pairs
    assert pair.separation_now**2 == pytest.approx(rival.chi2 - forecast.best.chi2, rel=0.1)
    # As many flats once more know all but the thickness and the response of the cells as well.
    assert pair.separation_now < pair.separation_after <= 1.001 * np.sqrt(2.0) * pair.separation_now
    assert pair.likeness_now > 0.8


def test_flats_of_another_level_tell_electrons_from_a_part_of_the_light() -> None:
    forecast, problem = forecast_of({"dark_pedestal.electrons": 500.0})
    rival = fitted(problem, "ghost_pedestal")
    ranked = forecast.ranked("dark_pedestal", {"ghost_pedestal": rival})
    assert ranked[0].measurement.name == "level"
    assert ranked[0].gain > 3.0


# Corrections ------------------------------------------------------------------------------------------


def noisy_point(rng: np.random.Generator, response: float = 0.003) -> Point:
    forward, thickness = forward_of()
    value = forward.predict({}, thickness.ravel())[0]
    noise = np.sqrt(value / ELECTRONS) * rng.standard_normal(value.shape)
    data = Data(value * (1.0 + response * rng.standard_normal(value.shape[1])) + noise, ELECTRONS / value)
    problem = Problem(data, forward, thickness.ravel(), response)
    return fit((), (), problem.at({}, np.ones(8), thickness.ravel())).point


@pytest.mark.rng("columns beside cells")
def test_corrections_are_projected_as_columns_that_are_written_out(rng: np.random.Generator) -> None:
    """Score and information of products of patterns, beside levels, response and thickness of the cells."""
    point = noisy_point(rng)
    part = CellPart(with_corrections(point), 0.01)
    terms = rng.standard_normal((2, 8, SIDE, SIDE))
    local = LocalColumns(rng.standard_normal((3, SIDE, SIDE)), terms)
    project, information = part.projection(local)
    written = (terms[:, np.newaxis] * local.patterns[np.newaxis, :, np.newaxis]).reshape(6, 8, -1)
    dense, levels = point.bare_columns(written), point.level_columns
    across = np.linalg.solve(point.information(levels, levels), point.information(levels, dense))
    wanted = point.information(dense, dense) - point.information(dense, levels) @ across
    assert information == pytest.approx(wanted)
    score = point.unbiased_score(dense) - across.T @ point.unbiased_score(levels)
    assert project(part.state.residual, part.own_scores_of_data()) == pytest.approx(score)


@pytest.mark.rng("scores of draws")
def test_scores_of_drawn_noise_scatter_as_their_information(rng: np.random.Generator) -> None:
    part = CellPart(with_corrections(noisy_point(rng)), 0.01, "learned_response")
    noise = rng.standard_normal((400, part.planes, SIDE, SIDE))
    (scores,) = part.scores([part.of_noise(one) for one in noise])
    (information,) = part.information
    scale = np.sqrt(np.diag(information))
    assert (scores / scale).std(axis=0).mean() == pytest.approx(1.0, abs=0.03)
    assert np.corrcoef(scores.T) == pytest.approx(information / np.outer(scale, scale), abs=0.2)


@pytest.mark.slow
def test_light_that_wanders_is_learned_and_noise_is_not() -> None:
    for outsider in ("wandering_light", ""):
        only = [outsider] if outsider else None
        rng = np.random.default_rng(12)
        case = draw_case("outsider" if outsider else "none", rng, size=(48, 48), only=only)
        own = [effect for effect in EFFECTS if not effect.sky_only]
        prepared = prepare(
            case.cube, FringeModel.from_setup(case.setup), own, SearchOptions(), np.random.default_rng(5)
        )
        lesson = CellLesson.of(prepared, prepared.null)
        found = learn(lesson, np.random.default_rng(1), LEAST)
        part = CellPart(with_corrections(prepared.point), lesson.noise_floor)
        if not outsider:
            assert found is None or not found.believed
            assert best_evidence(part) < LEAST
            continue
        assert found is not None
        assert best_evidence(part) > LEAST
        assert (found.name, found.believed) == ("learned_light", True)
        floor = found.noise_floor**2
        assert found.after_rms**2 - floor < 0.5 * (found.before_rms**2 - floor)
        assert found.unseen_gain > 0.0
        # What is planted in the cells that judge moves no parameter.
        cells = lesson.cells
        planted = np.where(lesson.judged, 1.01 + 0.01 * np.sign(np.arange(48) - 20.0), 1.0)
        other = replace(lesson, cells=replace(cells, value=cells.value * planted))
        again = learn(other, np.random.default_rng(1), LEAST)
        assert again is not None
        assert again.own == found.own
        assert again.heldout_gain != pytest.approx(found.heldout_gain, rel=0.01)


# Cells held out ------------------------------------------------------------------------------------------


def test_fringes_of_a_few_cells_keep_their_order_where_cells_were_held_out() -> None:
    """A third of an order from cell to cell, and blocks of six cells."""
    case = draw_case("none", np.random.default_rng(12), size=(48, 48))
    prepared = prepare(
        case.cube, FringeModel.from_setup(case.setup), [], SearchOptions(), np.random.default_rng(5)
    )
    point = unseen_too(prepared, prepared.point, together(prepared))
    order = prepared.problem.forward.order_um
    held = prepared.unseen.seen
    away = np.abs(point.thickness_um.reshape(held.shape) - case.thickness_um) / order
    assert away[held].max() < 0.1
    # Continued over whole blocks, it is in another order in some.
    across = continued(prepared.point.thickness_um.reshape(held.shape), prepared.cells.seen)
    assert (np.abs(across - case.thickness_um)[held] / order).max() > 0.5
