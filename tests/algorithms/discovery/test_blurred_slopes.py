"""Where light is carried from cell to cell, a cell sees how the thickness changes around it."""

from dataclasses import replace

import numpy as np
import pytest
from recorded_cases import recorded_case

from lsst.fringe_sim.algorithms.discovery.basis import RIDGE, SplineBasis
from lsst.fringe_sim.algorithms.discovery.cells import bin_cube
from lsst.fringe_sim.algorithms.discovery.fit import Problem, coordinates_of, fit_model
from lsst.fringe_sim.algorithms.discovery.forward import Forward
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

BLUR = "charge_diffusion"


@pytest.fixture(scope="module")
def blurred():
    """A sensor with fringes of seven pixels behind a blur of 3.1 px and a pedestal, its thickness and its effects."""
    case, _ = recorded_case(20491128, "two", 4)
    assert set(case.names) == {BLUR, "ghost_pedestal"}
    cells = bin_cube(case.cube, 1)
    truth = case.thickness_um
    limits = (float(truth.min()) - 1.0, float(truth.max()) + 1.0)
    forward = Forward.of_cells(FringeModel.from_setup(case.setup), EFFECTS, cells, limits)
    problem = Problem(cells, forward, SplineBasis.of_grid(truth.shape, 8.0), np.eye(len(cells.value)))
    return problem, truth, dict(case.values)


@pytest.mark.rng("curvature of changes is that of the written out basis")
def test_curvature_of_changes_is_that_of_the_written_out_basis(rng: np.random.Generator) -> None:
    shape = (21, 17)
    basis = SplineBasis.of_grid(shape, 4.0)
    cells = np.eye(shape[0] * shape[1]).reshape(-1, 1, *shape)
    nothing = np.zeros((1, *shape))
    parts = np.stack([
        np.stack([basis.gather(cell)[:, 0] for cell in cells], axis=1),
        np.stack([basis.gather_changes(np.stack([cell, nothing]))[:, 0] for cell in cells], axis=1),
        np.stack([basis.gather_changes(np.stack([nothing, cell]))[:, 0] for cell in cells], axis=1),
    ])  # fmt: skip
    fields = parts[0].reshape(-1, *shape)
    for number, axis in ((1, 1), (2, 2)):
        np.testing.assert_allclose(
            parts[number].reshape(fields.shape), np.gradient(fields, axis=axis), atol=0.01
        )
    slopes = rng.normal(size=(3, 5, *shape))
    columns = np.einsum("iwc,imc->mwc", slopes.reshape(3, 5, -1), parts).reshape(basis.size, -1)
    normal = columns @ columns.T
    normal += (0.5 + RIDGE * np.diag(normal).max()) * np.eye(basis.size)
    right = rng.normal(size=(basis.size, 2))
    curvature = np.einsum("iwyx,jwyx->ijyx", slopes, slopes)
    found = basis.normal_matrix_with_changes(curvature, 0.5).solve(right)
    np.testing.assert_allclose(found, np.linalg.solve(normal, right), rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_a_tilt_is_exact_and_a_bump_nearly(blurred) -> None:
    problem, truth, settings = blurred
    forward, rows = problem.forward, np.arange(len(truth)) - 40.0
    before = forward.predict(settings, truth)
    along_y, along_x = forward.slope_changes(settings, truth)

    def change(shape: np.ndarray) -> np.ndarray:
        return (forward.predict(settings, truth + 1e-7 * shape).value - before.value) / 1e-7

    def size(error: np.ndarray) -> float:
        return float(np.sqrt(np.mean(error**2)))

    tilt = np.add.outer(rows, 0.5 * rows)
    expected = before.slope * tilt + along_y + 0.5 * along_x
    assert size(change(tilt) - expected) < 1e-3 * size(change(tilt))
    bump = np.exp(-0.5 * (np.add.outer(rows**2, rows**2)) / 8.0**2)
    alone = before.slope * bump
    both = alone + along_y * np.gradient(bump, axis=0) + along_x * np.gradient(bump, axis=1)
    assert size(change(bump) - both) < 0.4 * size(change(bump) - alone)


@pytest.mark.slow
def test_effects_of_the_model_itself_count_as_those_that_are_looked_for(blurred) -> None:
    problem, truth, settings = blurred
    known = {"charge_diffusion.sigma": settings["charge_diffusion.sigma"], "crosstalk.from_left": 1e-3}
    own = replace(problem.forward, model=problem.forward.model.with_effects(known))
    assert own.blur_px({}) == problem.forward.blur_px(settings) == known["charge_diffusion.sigma"]
    nearby = {"charge_diffusion.sigma": known["charge_diffusion.sigma"]}
    expected = problem.forward.slope_changes(nearby, truth)
    # Crosstalk reaches too far for a change that is even.
    np.testing.assert_allclose(own.slope_changes({}, truth), expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
def test_a_fit_from_nearby_ends_where_one_from_the_truth_does(blurred) -> None:
    """With the slope of a field that moves as a whole, no step lowered the misfit from either."""
    problem, truth, settings = blurred
    rows = np.arange(len(truth))
    away = truth + 0.05 * np.sin(np.add.outer(rows / 9.0, rows / 13.0))
    effects = [effect for effect in EFFECTS if effect.name in (BLUR, "ghost_pedestal")]
    coordinates = tuple(item for effect in effects for item in coordinates_of(effect, problem.forward, truth))
    start = np.array([item.coordinate(settings[item.key]) for item in coordinates])
    fits = [
        fit_model(problem, coordinates, start, problem.basis.fit(field, np.ones(truth.shape)))
        for field in (truth, away)
    ]
    assert fits[1].chi2 == pytest.approx(fits[0].chi2, abs=20.0)
    assert np.abs(problem.basis.expand(fits[1].field) - truth).max() < 0.1
    for position, sigma, true in zip(fits[1].position, fits[1].sigma, start, strict=True):
        assert abs(position - true) < 4.0 * sigma
