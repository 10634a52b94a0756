"""What no effect explains is learned, judged by other cells, and noise teaches nothing."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.fit import (
    Fit,
    FullColumns,
    PlaneColumns,
    Problem,
    Whitener,
    fit_model,
)

from lsst.fringe_sim.algorithms.discovery.learned_columns import LocalColumns
from lsst.fringe_sim.algorithms.discovery.learning import Learned, Prior, judging_cells
from lsst.fringe_sim.algorithms.discovery.lesson import evidence_of_correction, learned_beside
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.algorithms.discovery.skeleton import effect_skeleton
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import (
    EFFECTS,
    LEARNED,
    ImageGeometry,
    activate_effects,
    apply_to_image,
    effects_from,
)
from lsst.fringe_sim.model import FringeModel

LEAST = 6.0


@pytest.mark.rng("local columns")
def test_columns_that_are_products_are_those_written_out(rng: np.random.Generator) -> None:
    shape = (3, 4, 5)
    direction = rng.uniform(0.5, 1.5, shape)
    whiten = Whitener(rng.uniform(0.5, 1.5, shape), direction, 0.1 / (direction**2).sum(axis=0))
    local = LocalColumns(rng.standard_normal((2, 4, 5)), rng.standard_normal((2, *shape)))
    full = FullColumns(
        (local.terms[:, np.newaxis] * local.patterns[np.newaxis, :, np.newaxis]).reshape(-1, *shape)
    )
    levels = PlaneColumns(rng.standard_normal(shape), np.arange(3), rng.standard_normal((3, 2)), whiten)
    values = rng.standard_normal((6, *shape))
    assert local.dot(values) == pytest.approx(full.dot(values))
    assert local.along(values[0]) == pytest.approx(full.along(values[0]))
    assert local.gram == pytest.approx(full.gram)
    assert local.against(levels) == pytest.approx(full.against(levels))


@pytest.mark.rng("marginal likelihood")
def test_evidence_is_that_of_gaussians(rng: np.random.Generator) -> None:
    """Against the density of the data with the correction in their covariance, at the size that was chosen."""
    columns, data = rng.standard_normal((12, 4)), rng.standard_normal(12) * 3.0
    root = rng.standard_normal((4, 3))
    prior = Prior.of("any", root, columns.T @ columns)
    (evidence,), size = prior.best((columns.T @ data)[np.newaxis])
    covariance = np.eye(12) + size[0] ** 2 * columns @ root @ root.T @ columns.T
    known = -0.5 * data @ np.linalg.solve(covariance, data) - 0.5 * np.linalg.slogdet(covariance)[1]
    assert evidence == pytest.approx(known + 0.5 * data @ data)
    expected = size[0] ** 2 * root @ root.T @ columns.T @ np.linalg.solve(covariance, data)
    assert prior.parameters((columns.T @ data)[np.newaxis], size)[0] == pytest.approx(expected)


def problem_of(seed: int, outsider: str = "") -> tuple[Problem, Fit]:
    """Cells of a small sensor, and the fit of the unchanged model."""
    kind = "outsider" if outsider else "none"
    only = [outsider] if outsider else None
    for number in range(seed, seed + 1000):
        case = draw_case(kind, np.random.default_rng(number), size=(48, 48), only=only)
        if not outsider or case.values[f"{outsider}.size"] > 0.004:
            break
    own = [effect for effect in EFFECTS if not effect.sky_only]
    prepared = prepare(case.cube, FringeModel.from_setup(case.setup), own, 20_000)
    return prepared.problem, prepared.null


def learned_from(problem: Problem, null: Fit) -> Learned | None:
    nowhere = np.zeros(problem.cells.shape[1:], dtype=bool)
    return learned_beside(problem, null, null, nowhere, np.random.default_rng(1), LEAST)


@pytest.fixture(scope="module")
def wandering() -> tuple[Problem, Fit, Learned]:
    problem, null = problem_of(11, "wandering_light")
    found = learned_from(problem, null)
    assert found is not None
    return problem, null, found


@pytest.mark.slow
def test_light_that_wanders_is_learned(wandering: tuple[Problem, Fit, Learned]) -> None:
    """More than half of the variance beyond noise is gone in cells that took no part; all cells say more."""
    problem, null, found = wandering
    assert evidence_of_correction(problem, null) > found.log_evidence > LEAST
    assert found.name == "learned_light"
    assert found.believed
    floor = found.noise_floor**2
    assert found.after_rms**2 - floor < 0.5 * (found.before_rms**2 - floor)


@pytest.mark.slow
def test_cells_that_judge_teach_nothing(wandering: tuple[Problem, Fit, Learned]) -> None:
    """What is planted in them alone moves no parameter, and the correction fares worse."""
    problem, null, found = wandering
    cells = problem.cells
    planted = np.where(judging_cells(cells.shape[1:]), 1.01 + 0.01 * np.sign(np.arange(48) - 20.0), 1.0)
    other = learned_from(problem.with_cells(replace(cells, value=cells.value * planted)), null)
    assert other is not None
    assert other.own == found.own
    assert other.heldout_gain != pytest.approx(found.heldout_gain, rel=0.01)


@pytest.mark.slow
def test_noise_teaches_nothing() -> None:
    """Neither that of the frames nor fresh draws on the fitted model."""
    problem, null = problem_of(5)
    cells, expected = problem.cells, problem.expected_of(null)
    sigma = np.divide(1.0, np.sqrt(cells.weight), out=np.zeros(cells.shape), where=cells.weight > 0.0)
    believed = []
    for seed in range(4):
        if seed:
            noise = np.random.default_rng(seed).standard_normal((2, *cells.shape))
            value = expected * (1.0 + cells.response_scatter * noise[1, 0]) + sigma * noise[0]
            fresh = problem.with_cells(replace(cells, value=value))
            found = learned_from(fresh, fit_model(fresh, (), np.zeros(0), null.field, null.levels))
        else:
            found = learned_from(problem, null)
        believed.append(found is not None and found.believed)
    assert believed == [False] * 4


@pytest.mark.parametrize("name", ["learned_response", "learned_map"])
def test_the_beginning_of_an_effect_does_what_was_learned(name: str, tmp_path: Path) -> None:
    key = "map.y1x2" if name == "learned_map" else "response.cos1_960"
    own = {f"learned_{key}": 0.01}
    if name == "learned_response":
        own = {f"{name}.{wave}{h}_960": 0.01 / h for wave in ("cos", "sin") for h in (1, 2, 3)}
    path = tmp_path / "learned_effect.py"
    verdict = SimpleNamespace(setup="ts8_e2v", learned={"name": name, "own": own})
    path.write_text(effect_skeleton(verdict))
    thickness = np.linspace(14.0, 14.5, 9)
    geometry = ImageGeometry.of_pixels((8, 8), np.array([960.0]))
    with effects_from(path) as (unnamed,):
        catalogue = (*EFFECTS, *LEARNED, unnamed)
        found, wanted, none = (
            FringeModel.from_setup("ts8_e2v", settings, catalogue=catalogue)
            for settings in ({"unnamed.size": 1.0}, own, {"unnamed.size": 0.0})
        )
        told = [model.response(thickness, [960.0]) for model in (found, wanted, none)]
        images = [
            apply_to_image(activate_effects(each, catalogue), found.base_system, np.ones((1, 8, 8)), geometry)
            for each in ({"unnamed.size": 1.0}, own)
        ]
    assert np.array_equal(told[0], told[1])
    assert np.array_equal(images[0], images[1])
    changed = np.ptp(images[0]) if name == "learned_map" else np.abs(told[0] - told[2]).max()
    assert changed > 1e-3
