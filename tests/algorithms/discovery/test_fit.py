"""Fits say how well they know an effect, and what is large is not drawn to null."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.fit import (
    Coordinate,
    Fit,
    Problem,
    coordinate_derivative,
    coordinates_of,
    fit_model,
)

from lsst.fringe_sim.algorithms.discovery import fit as fit_module
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

TILT = next(effect for effect in EFFECTS if effect.name == "tilt")


@pytest.fixture(scope="module")
def tilted() -> tuple[Problem, Fit]:
    """A sensor that is tilted by so many degrees that only a part of it is not taken up by the thickness."""
    for seed in range(1000):
        case = draw_case("one", np.random.default_rng(seed), size=(48, 48), only=["tilt"])
        if 12.0 < case.values["tilt.angle"] < 18.0:
            break
    without, near = (
        prepare(case.cube, FringeModel.from_setup("ts8_e2v", effects), [TILT], 20_000)
        for effects in ({}, case.values)
    )
    problem, null = replace(near.problem, forward=without.problem.forward), near.null
    coordinates = coordinates_of(TILT, problem.forward, problem.basis.expand(null.field))
    start = np.array([coordinates[0].coordinate(case.values["tilt.angle"])])
    return problem, fit_model(problem, coordinates, start, null.field, null.levels)


def held_at(problem: Problem, fit: Fit, position: float) -> float:
    """χ² with the angle held and thickness and levels free."""
    (item,) = fit.coordinates
    return fit_model(
        problem, (), np.zeros(0), fit.field, fit.levels, {item.key: item.value(position)}, iterations=60
    ).chi2


@pytest.mark.slow
def test_curvature_is_that_of_the_misfit_with_everything_else_free(tilted, monkeypatch) -> None:
    problem, fit = tilted
    monkeypatch.setattr(fit_module, "CONVERGED", 1e-4)
    away = 4.0 * fit.sigma[0]
    middle, below, above = (held_at(problem, fit, fit.position[0] + sign * away) for sign in (0.0, -1.0, 1.0))
    profile = (below + above - 2.0 * middle) / (2.0 * away**2)
    assert fit.information[0, 0] == pytest.approx(profile, rel=0.2)


@pytest.mark.slow
def test_the_prior_draws_a_large_effect_by_a_part_of_its_uncertainty_only(tilted, monkeypatch) -> None:
    problem, fit = tilted
    assert fit.position[0] > 10.0 * fit.coordinates[0].unit_step  # far out in the prior
    monkeypatch.setattr(fit_module, "PRIOR_WIDTH", 1e6)
    free = fit_model(problem, fit.coordinates, fit.position, fit.field, fit.levels)
    assert abs(fit.position[0] - free.position[0]) < 0.2 * fit.sigma[0]


@pytest.mark.slow
def test_a_part_does_not_lean_on_the_thickness_of_the_rest(tilted) -> None:
    """What a spline does where it is held by nothing made the fringes of the cells beside it too weak."""
    problem, fit = tilted
    thickness = problem.basis.expand(fit.field)
    out = np.zeros(thickness.shape, bool)
    out[:12, 8:20] = out[20:, 30:] = True
    part = problem.without_cells(out)
    wild = np.where(out, thickness + 0.3, thickness)
    for forward, same in ((part.forward, True), (problem.forward, False)):
        known, other = (forward.predict(fit.settings, each).value[:, ~out] for each in (thickness, wild))
        assert np.array_equal(known, other) == same
    assert not part.cells.weight[:, out].any()


@pytest.mark.parametrize("at", [0.3, 4.0, 200.0])
@pytest.mark.parametrize("quadratic", [False, True])
def test_derivatives_are_central(at: float, quadratic: bool) -> None:
    """A difference to one side would be wrong by 1 % to 10 % where the phase turns fast."""
    item = Coordinate("tilt", "angle", 0.0, 0.0, 40.0, 3.0, quadratic, "deg")
    at = at if quadratic else 0.1 * at

    def change(low: dict[str, float], high: dict[str, float], thickness: np.ndarray) -> np.ndarray:
        ends = (np.sin(item.coordinate(each["tilt.angle"]) + thickness) for each in (high, low))
        return next(ends) - next(ends)

    phase = np.linspace(0.0, 6.0, 20)
    found = coordinate_derivative(SimpleNamespace(change=change), item, at, {}, phase)  # type: ignore[arg-type]
    np.testing.assert_allclose(found, np.cos(at + phase), atol=0.01)


@pytest.mark.rng("derivatives are central about any null")
def test_derivatives_are_central_about_any_null(rng: np.random.Generator) -> None:
    """Sums with a null of 1.0 or 183.15 are rounded, which is no bound that has been reached."""
    for null, low, high, scale in ((1.0, 0.5, 1.5, 0.05), (183.15, 120.0, 320.0, 3.0)):
        item = Coordinate("coating", "scale", null, low, high, scale, False)
        places: list[tuple[float, float]] = []

        def change(
            below: dict[str, float], above: dict[str, float], thickness: np.ndarray, places: list = places
        ) -> np.ndarray:
            places.append((below["coating.scale"], above["coating.scale"]))
            return np.array(above["coating.scale"] - below["coating.scale"])

        inner = rng.uniform(0.9 * (low - null), 0.9 * (high - null), 200)
        for at in (*inner, low - null, high - null):
            slope = coordinate_derivative(SimpleNamespace(change=change), item, at, {}, inner)  # type: ignore[arg-type]
            assert slope == pytest.approx(1.0, rel=1e-6)
        middle = np.array([0.5 * (below + above) for below, above in places])
        np.testing.assert_allclose(middle[:-2], null + inner, atol=1e-6 * scale)
        assert middle[-2] > low
        assert middle[-1] < high


@pytest.mark.parametrize("exchangeable", [True, False])
def test_what_data_do_not_say_of_draws_is_as_wide_as_they_scatter(exchangeable: bool) -> None:
    """The level common to sixteen gains does not show; it is that of sixteen draws."""
    number, width = 16, 0.1
    position = width * np.random.default_rng(5).standard_normal(number)
    coordinates = tuple(
        Coordinate("gain", f"C{i}", 0.0, -9.0, 9.0, 1.0, False, exchangeable=exchangeable)
        for i in range(number)
    )
    information = 1e6 * (np.eye(number) - 1.0 / number)
    nothing = np.zeros(0)
    fit = Fit({}, coordinates, position, nothing, nothing, 0.0, information)
    expected = width / math.sqrt(number) if exchangeable else fit_module.PRIOR_WIDTH / math.sqrt(number)
    np.testing.assert_allclose(fit.sigma, expected, rtol=0.3)
    few = Fit({}, coordinates[:2], position[:2], nothing, nothing, 0.0, information[:2, :2])
    assert few.sigma.min() > 5e-4


@pytest.mark.parametrize("known", [0.0, 0.3, 1.0, 3.0, 30.0])
def test_uncertainty_of_draws_is_how_far_fits_are_off(known: float) -> None:
    """What the data half know is off by their noise, not by less for the draws having a width."""
    number, width, draws = 12, 0.1, 4000
    rng = np.random.default_rng(7)
    truth = width * rng.standard_normal((draws, number))
    common = np.full((number, number), 1.0 / number)
    information = 1e6 * (np.eye(number) - common) + (known / width) ** 2 * common
    coordinates = tuple(
        Coordinate("gain", f"C{i}", 0.0, -9.0, 9.0, 0.2, False, exchangeable=True) for i in range(number)
    )
    ridge = (fit_module.PRIOR_WIDTH * 0.2) ** -2.0
    root = np.linalg.cholesky(information + 1e-9 * np.eye(number))
    score = truth @ information + rng.standard_normal((draws, number)) @ root.T
    found = score @ np.linalg.inv(information + ridge * np.eye(number))
    nothing = np.zeros(0)
    stated = [Fit({}, coordinates, x, nothing, nothing, 0.0, information).sigma for x in found[:200]]
    error = np.sqrt(((found - truth) ** 2).mean())
    assert np.sqrt(np.mean(np.square(stated))) == pytest.approx(error, rel=0.1)
