"""The search where the thickness was measured: a phase that a free thickness would hide."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.discovery import SearchOptions, Verdict, discover
from lsst.fringe_sim.algorithms.discovery.noise import measured_noise
from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, prepare
from lsst.fringe_sim.algorithms.discovery.smooth import beside_smooth
from lsst.fringe_sim.algorithms.inference import (
    CellShape,
    Data,
    Forward,
    Problem,
    coordinates_of,
    fit,
    jumped,
    led,
)
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import ImageGeometry, known_effects
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

WAVELENGTHS = np.linspace(880.0, 990.0, 8)
SIDE, PLACES = 32, 3
ELECTRONS = 20_000.0
STATED_UM = 0.01


def cube_of(
    rng: np.random.Generator, effects: dict[str, float], stated_um: float = STATED_UM, share: float = 1.0
) -> FringeCube:
    """Flats of a small sensor with photon noise and its map, whose errors are a part of those that it states."""
    y, x = (np.mgrid[: SIDE * PLACES, : SIDE * PLACES] + 0.5 - 0.5 * PLACES) / (SIDE * PLACES)
    thickness = 15.0 + 0.5 * x + 0.3 * y**2 - 0.2 * x * y
    model = FringeModel.from_setup("ts8_e2v", effects)
    flats = model.respond(model.system.flat_fields(WAVELENGTHS, 0.1), thickness, WAVELENGTHS)
    flats = flats.reshape(8, SIDE, PLACES, SIDE, PLACES).mean(axis=(2, 4))
    image = rng.poisson(flats * ELECTRONS / flats.mean(axis=(1, 2), keepdims=True)).astype(np.float32)
    middle = thickness[PLACES // 2 :: PLACES, PLACES // 2 :: PLACES]
    measured = middle + share * stated_um * rng.standard_normal(middle.shape)
    rows = FlatExposures(
        WAVELENGTHS, np.full(8, model.setup.bandwidth_fwhm_nm), np.full(8, model.base_system.temperature_k)
    )
    return FringeCube(
        image,
        np.maximum(image, 1.0),
        np.zeros(image.shape, np.int32),
        rows,
        "electron",
        thickness=measured.astype(np.float32),
        thickness_sigma=np.full(middle.shape, stated_um, np.float32),
        layer="adhesive",
    )


def prepared_of(cube: FringeCube) -> Prepared:
    model = FringeModel.from_setup("ts8_e2v")
    effects = [effect for effect in known_effects(None) if not effect.sky_only]
    return prepare(cube, model, effects, SearchOptions(), np.random.default_rng(5))


def verdict_of(cube: FringeCube) -> Verdict:
    return discover(cube, "ts8_e2v", rng=np.random.default_rng(5))


@pytest.mark.parametrize("share", first_is_quick([0.5, 0.1, 1.0]))
@pytest.mark.rng("error of a map that is known")
def test_a_map_has_the_error_that_the_data_show(rng: np.random.Generator, share: float) -> None:
    prepared = prepared_of(cube_of(rng, {}, share=share))
    problem = prepared.problem
    assert problem.known
    assert np.median(problem.thickness_sigma_um) == pytest.approx(share * STATED_UM, rel=0.2)
    assert prepared.noise_factor.mean() == pytest.approx(1.0, abs=0.05)


@pytest.mark.rng("a phase of a radian and more")
def test_a_derivative_leads_to_a_phase_that_is_far(rng: np.random.Generator) -> None:
    """Where the thickness is held half an order beside the data, no derivative does."""
    prepared = prepared_of(cube_of(rng, {"epoxy_index.offset": 0.012}))
    point = prepared.point
    (effect,) = (one for one in known_effects(None) if one.name == "epoxy_index")
    offset, _ = items = coordinates_of(effect, point.problem.forward)
    start = led(point)
    moved = np.median((start.thickness_um - point.problem.thickness_um)[point.problem.data.seen])
    assert moved == pytest.approx(15.2 * 0.012 / 1.5, rel=0.1)
    found = fit(("epoxy_index",), items, jumped(point, items, [0.0118, 0.0]))
    assert found.point.settings[offset.key] == pytest.approx(0.012, abs=2e-4)
    away = found.point.thickness_um - point.problem.thickness_um
    assert np.abs(away).max() < 6.0 * STATED_UM  # no cell is in another order


@pytest.mark.rng("cells that are held out beside a map")
def test_cells_that_are_held_out_lie_where_the_map_has_them(rng: np.random.Generator) -> None:
    cube = cube_of(rng, {})
    assert cube.thickness is not None
    cube = replace(
        cube, thickness=cube.thickness + rng.normal(0.0, 0.05, cube.thickness.shape)
    )  # it is rough
    prepared = prepared_of(cube)
    unseen = prepared.unseen
    assert unseen.thickness_um is not None
    first = prepared.problem.thickness_um.reshape(unseen.shape[1:])
    np.testing.assert_allclose(first[unseen.seen], unseen.thickness_um[unseen.seen], atol=1e-9)


@pytest.mark.rng("errors of a map as large as noise")
def test_a_map_that_followed_its_noise_leaves_all_of_it(rng: np.random.Generator) -> None:
    """With few exposures, and errors of a map that do to them what noise does, a part of which the fit takes."""
    waves, side, electrons, sigma_um = np.array([900.0, 901.0]), 48, 20_000.0, 0.008
    place = np.arange(float(side))
    field = 14.0 + 0.02 * place + 0.01 * place[:, np.newaxis]
    geometry = ImageGeometry((side, side), place, place, waves, np.full(2, electrons))
    model = FringeModel.from_setup("ts8_e2v")
    forward = Forward(model, (), geometry, CellShape.of_field(field, 1), (13.2, 16.3))
    truth = field.ravel()
    value, slope = forward.predict({}, truth)
    data = Data(value + electrons**-0.5 * rng.standard_normal(value.shape), np.full(value.shape, electrons))
    measured = truth + sigma_um * rng.standard_normal(truth.shape)
    problem = Problem(data, forward, measured, 1e-6, np.full(truth.shape, sigma_um), known=True)
    point = fit((), (), problem.at({}, np.ones(2), measured)).point
    error = 1.0 / np.sqrt(2.0 * value.size)
    assert 0.3 < (slope**2).mean() * electrons * sigma_um**2 < 3.0
    assert point.misfit(2) == pytest.approx(1.0, abs=5.0 * error)
    factor, scatter = measured_noise(point, (2, side, side))
    assert factor.mean() == pytest.approx(1.0, abs=0.05)
    assert scatter < 0.4 * electrons**-0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "stated_um"),
    [
        ({}, 0.002),
        ({}, 0.03),
        ({"epoxy_index.offset": 0.005}, STATED_UM),
        ({"wavelength_offset.offset": 0.4}, 0.002),
        ({"contrast_loss.factor": 0.9}, 0.002),
    ],
    ids=str,
)
def test_the_answer_is_what_is_hidden(effects: dict[str, float], stated_um: float) -> None:
    cube = cube_of(np.random.default_rng(list(str(effects).encode())), effects, stated_um)
    verdict = verdict_of(cube)
    assert verdict.verdict == ("named" if effects else "no_discrepancy"), verdict.summary()
    assert len(verdict.effects) == len(effects)
    for effect, hidden in zip(verdict.effects, effects, strict=True):
        name, _, _ = hidden.partition(".")
        assert name in (effect.name, *effect.ambiguous_with)
        for parameter, found in effect.parameters.items() if effect.name == name else ():
            true = effects.get(f"{name}.{parameter}", 0.0)  # a second one is not there
            assert found.value == pytest.approx(true, abs=3.0 * found.sigma)


@pytest.mark.slow
@pytest.mark.parametrize("error_um", [0.0, STATED_UM])
def test_a_contrast_is_measured_without_bias(error_um: float) -> None:
    """A map of 10 nm used to make fringes 4 % stronger, and its errors a diffusion of charge."""
    rng = np.random.default_rng([88, 8])
    case = draw_case("one", rng, only=["wavelength_offset", "contrast_loss"])
    thickness = case.thickness_um + error_um * rng.standard_normal(case.thickness_um.shape)
    cube = replace(
        case.cube,
        thickness=thickness.astype(np.float32),
        thickness_sigma=np.full(thickness.shape, STATED_UM, np.float32),
        layer="adhesive",
    )
    verdict = discover(cube, case.setup, rng=rng)
    assert [effect.name for effect in verdict.effects] == ["contrast_loss"]
    found = verdict.effects[0].parameters["factor"]
    assert abs(found.value - case.values["contrast_loss.factor"]) < 4.0 * found.sigma
    assert found.sigma < 1e-3


def test_cells_beside_a_known_thickness_say_what_their_data_say() -> None:
    """Normal errors: the thickness is where data and map meet, and the map has pulled as hard as the data."""
    shape, rng = (3, 4), np.random.default_rng(1)
    known, sigma = rng.uniform(14.0, 15.0, 12), rng.uniform(0.01, 0.03, 12)
    information, own = rng.uniform(100.0, 20_000.0, 12), known + 0.01 * rng.standard_normal(12)
    seen = np.arange(12) != 5
    information[~seen] = 0.0
    total = sigma**-2.0 + information
    thickness = (known * sigma**-2.0 + own * information) / total
    problem = SimpleNamespace(
        known=True, thickness_um=known, thickness_sigma_um=sigma, data=SimpleNamespace(seen=seen),
        forward=SimpleNamespace(geometry=SimpleNamespace(sample_shape=shape)),
    )  # fmt: skip
    point = SimpleNamespace(problem=problem, thickness_um=thickness, thickness_sigma_um=total**-0.5)
    score, precision = beside_smooth(point)  # type: ignore[arg-type]
    np.testing.assert_allclose(score.ravel(), information * (own - thickness), atol=1e-9)
    # The variance of that score where the map has its stated errors.
    np.testing.assert_allclose(precision.ravel(), information * sigma**-2.0 / total, rtol=1e-9)
    assert score.shape == precision.shape == shape
