"""Local effects in a search: several of them, and such as look like a step of the thickness."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from lsst.fringe_sim.algorithms.discovery import critics, discover
from lsst.fringe_sim.algorithms.discovery.catalogue import Catalogue
from lsst.fringe_sim.algorithms.discovery.critics import judge, spot_scores
from lsst.fringe_sim.algorithms.discovery.island_places import moved_island
from lsst.fringe_sim.algorithms.discovery.options import SearchOptions
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.algorithms.discovery.scores import proposed
from lsst.fringe_sim.algorithms.discovery.smooth import beside_smooth
from lsst.fringe_sim.algorithms.discovery.window import Window
from lsst.fringe_sim.algorithms.inference import (
    CellShape,
    Data,
    Forward,
    Point,
    Problem,
    coordinates_of,
    fit,
    in_best_orders,
    relaxed,
)
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry, Residuals
from lsst.fringe_sim.effects.disc_search import find_step
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

WAVELENGTHS = np.linspace(880.0, 990.0, 12)
ELECTRONS = 20_000.0
SIDE = 64


def void(name: str, gap_nm: float, x: float, y: float, radius: float) -> dict[str, float]:
    """Settings of a void."""
    return {
        f"{name}.thickness": gap_nm, f"{name}.centre_x": x, f"{name}.centre_y": y, f"{name}.radius": radius
    }  # fmt: skip


def flats_of(rng: np.random.Generator, effects: dict[str, float]) -> FringeCube:
    """Flats of pixels that see all of their area, with photon noise; the optics are the package's own."""
    coarse, fine = np.arange(float(SIDE)), (np.arange(3.0 * SIDE) + 0.5) / 3.0 - 0.5
    thickness = random_field((SIDE, SIDE), rng, mean=float(rng.uniform(13.0, 19.0)), span=1.5)
    model = FringeModel.from_setup("ts8_e2v", effects)
    geometry = ImageGeometry((SIDE, SIDE), fine, fine, WAVELENGTHS, np.full(12, ELECTRONS))
    flats = model.flat_image(RectBivariateSpline(coarse, coarse, thickness)(fine, fine), geometry)
    flats = flats.reshape(12, SIDE, 3, SIDE, 3).mean(axis=(2, 4))
    image = rng.poisson(ELECTRONS * flats / flats.mean(axis=(1, 2), keepdims=True)).astype(np.float32)
    kelvin, width = model.base_system.temperature_k, model.setup.bandwidth_fwhm_nm
    rows = FlatExposures(WAVELENGTHS, np.full(12, width), np.full(12, kelvin))
    return FringeCube(image, np.maximum(image, 1.0), np.zeros(image.shape, np.int32), rows, "electron")


@pytest.mark.slow
def test_two_voids_are_named() -> None:
    hidden = {"void": (130.0, 20.3, 17.6, 8.2), "void_2": (60.0, 45.0, 44.0, 10.0)}
    settings = {key: value for name, own in hidden.items() for key, value in void(name, *own).items()}
    cube = flats_of(np.random.default_rng([4, 3]), settings)
    verdict = discover(cube, "ts8_e2v", rng=np.random.default_rng(5))
    assert {effect.name for effect in verdict.effects} == set(hidden), verdict.summary()
    for effect in verdict.effects:
        found = effect.parameters
        for key, true in void("", *hidden[effect.name]).items():
            own = found[key.removeprefix(".")]
            assert abs(own.value - true) < 4.0 * own.sigma + 1e-3 * true


def point_of(rng: np.random.Generator, step_um: float, stain: float = 0.0) -> Point:
    """Cells of which each has a thickness of its own, even but for a step on a disc; ``stain``: depth of a spot."""
    place = np.arange(40.0)
    y, x = place[:, np.newaxis], place
    even = 15.0 + 0.02 * x + 0.01 * y + 3e-4 * x * y
    thickness = even + step_um * (np.hypot(y - 14.0, x - 22.0) < 7.0)
    geometry = ImageGeometry((40, 40), place, place, WAVELENGTHS, np.full(12, ELECTRONS))
    limits = float(even.min()) - 0.8, float(even.max()) + 0.8
    forward = Forward(
        FringeModel.from_setup("ts8_e2v"), EFFECTS, geometry, CellShape.of_field(even, 1), limits
    )
    dark = 1.0 - stain * np.exp(-0.5 * ((y - 25.0) ** 2 + (x - 12.0) ** 2) / 3.0**2)
    value = dark.ravel() * forward.predict({}, thickness.ravel())[0] + 0.007 * rng.standard_normal((12, 1600))
    problem = Problem(Data(value, np.full(value.shape, 0.007**-2.0)), forward, even.ravel(), 1e-3)
    return relaxed(problem.at({}, np.ones(12), even.ravel()), rounds=6)


def residuals_of(point: Point) -> Residuals:
    """What is left of the thickness beside a smooth one, and the same everywhere of the data."""
    geometry = point.problem.forward.geometry
    even = np.ones((len(point.value), *geometry.sample_shape))
    return Residuals(even, even, geometry, *beside_smooth(point))


@pytest.mark.rng("step of the thickness")
def test_a_step_of_the_thickness_is_found(rng: np.random.Generator) -> None:
    step = find_step(residuals_of(point_of(rng, -0.008)))
    assert step is not None
    assert np.allclose(step, (14.0, 22.0, 7.0), atol=1.5)


@pytest.mark.rng("step of the thickness")
def test_thin_voids_are_proposed_there(rng: np.random.Generator) -> None:
    (effect,) = (one for one in EFFECTS if one.name == "void")
    starts = effect.propose(residuals_of(point_of(rng, -0.008)))
    assert max(start["thickness"] for start in starts) < 50.0
    assert np.allclose([start["centre_x"] for start in starts], 22.0, atol=1.5)


@pytest.mark.rng("no step of the thickness")
def test_noise_of_the_thickness_has_no_step(rng: np.random.Generator) -> None:
    assert [find_step(residuals_of(point_of(rng, 0.0))) for _ in range(4)] == [None] * 4


@pytest.mark.rng("cells about an island")
def test_cells_about_an_island_say_what_all_of_them_do(rng: np.random.Generator) -> None:
    point = point_of(rng, -0.008)
    geometry = point.problem.forward.geometry
    covered = np.hypot(geometry.y_px[:, np.newaxis] - 14.0, geometry.x_px - 22.0).ravel() < 8.0
    settings = void("void", 40.0, 22.0, 14.0, 7.0)
    whole = in_best_orders(point.moved(point.levels, point.thickness_um, settings), covered, rounds=2)
    window = Window.about(point, covered)
    assert 0 < window.inside.sum() < 0.3 * covered.size
    part = window.point
    start = part.moved(part.levels, part.thickness_um, settings)
    own = in_best_orders(start, covered[window.inside], rounds=2)
    assert part.cost - own.cost == pytest.approx(point.cost - whole.cost, abs=1e-6)
    assert window.joined(own).thickness_um == pytest.approx(whole.thickness_um, abs=1e-12)


@pytest.mark.rng("effects on the image join cells")
def test_all_cells_are_asked_where_effects_join_them(rng: np.random.Generator) -> None:
    point = point_of(rng, 0.0)
    covered = np.zeros(point.thickness_um.size, dtype=bool)
    covered[:5] = True
    joined = point.moved(point.levels, point.thickness_um, {"crosstalk.from_left": 0.004})
    assert Window.about(joined, covered).inside.all()
    assert not Window.about(point, covered).inside.all()


@pytest.mark.rng("second void beside the first")
def test_the_second_of_an_effect_is_looked_for_beside_the_first(rng: np.random.Generator) -> None:
    catalogue = Catalogue.of(EFFECTS, point_of(rng, 0.0).problem, 3)
    assert catalogue.before == {"void_2": "void", "void_3": "void_2"}
    assert catalogue.may_add("void", ("bandwidth",))
    assert not catalogue.may_add("void_2", ("bandwidth",))
    assert catalogue.may_add("void_2", ("void",))
    assert not catalogue.may_leave(("void",), ("void", "void_2"))
    assert catalogue.may_leave(("void_2",), ("void", "void_2"))
    assert catalogue.may_leave(("void", "void_2"), ("void", "void_2", "bandwidth"))


@pytest.mark.rng("stain of the core")
@pytest.mark.parametrize(("depth", "seen"), [(0.0, False), (0.004, True)])
def test_a_stain_is_seen(rng: np.random.Generator, depth: float, seen: bool) -> None:
    null = fit((), (), point_of(rng, 0.0, depth))
    channels = {one.name: one for one in judge(null, null, np.full(12, 1.5), SearchOptions())}
    assert (channels["spots"].probability < 1e-3) == seen
    evidence = spot_scores(null).evidence()
    assert evidence > 5.0 if seen else evidence < 3.0


@pytest.mark.rng("trend of the core")
def test_errors_of_single_exposures_that_follow_a_curve_are_no_draws(rng: np.random.Generator) -> None:
    forward = point_of(rng, 0.0).problem.forward
    (effect,) = (one for one in EFFECTS if one.name == "wavelength_jitter")
    items = coordinates_of(effect, forward)
    draws, curve = rng.standard_normal(len(items)), np.linspace(-1.0, 1.0, len(items)) ** 3
    chances = []
    for values in (draws, curve + 0.02 * draws):
        found = SimpleNamespace(
            items=items, values=values, covariance=1e-4 * np.eye(len(items)),
            point=SimpleNamespace(problem=SimpleNamespace(forward=forward)),
        )  # fmt: skip
        (channel,) = critics._trends(cast(critics.Judged, SimpleNamespace(found=found)))
        chances.append(channel.probability)
    assert chances[0] > 1e-3 > chances[1]


@pytest.mark.rng("an island beside its place")
def test_an_island_moves_to_its_place_with_its_thickness(rng: np.random.Generator) -> None:
    """A fit ends beside it, where the thickness of the cells has followed."""
    first = point_of(rng, 0.0)
    problem, truth = first.problem, first.problem.thickness_um
    right = void("void", 60.0, 21.3, 16.8, 7.4)
    noise = 0.002 * rng.standard_normal(first.value.shape)
    data = Data(problem.forward.predict(right, truth)[0] + noise, np.full(noise.shape, 0.002**-2.0))
    away = {**right, "void.centre_x": 22.1, "void.centre_y": 16.0}
    point = relaxed(replace(problem, data=data).at(away, np.ones(12), truth), rounds=6)
    (effect,) = (one for one in EFFECTS if one.name == "void")
    moved = moved_island(effect, coordinates_of(effect, problem.forward), point)
    assert moved is not None
    for key in ("void.centre_x", "void.centre_y", "void.radius"):
        assert abs(moved.settings[key] - right[key]) < 0.3
    on = (
        effect.coverage(
            {key.partition(".")[2]: value for key, value in right.items()}, problem.forward.geometry
        ).ravel()
        > 0.0
    )
    assert np.abs(moved.thickness_um - truth)[on].mean() < 0.01
    assert moved.cost < point.cost - 10.0


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "cause", "found"), [("outsider", "stains", False), ("one", "void", True)])
def test_stains_are_no_islands(kind: str, cause: str, found: bool) -> None:
    """Data with stains are farther from a void of any size than from none."""
    case = draw_case(kind, np.random.default_rng([7, 77]).spawn(2)[0], only=[cause])
    model, rules = FringeModel.from_setup(case.setup), SearchOptions()
    prepared = prepare(case.cube, model, EFFECTS, rules, np.random.default_rng(5))
    catalogue = Catalogue.of(EFFECTS, prepared.problem)
    scored = proposed(catalogue.effects["void"], catalogue.items["void"], prepared.null)
    assert (scored is not None and scored.gain > catalogue.price) == found
