"""Electrons that gather with time, told from those that every exposure has."""

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry, activate_effects, apply_to_image
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.array([900.0, 960.0, 985.0])
SECONDS = np.array([10.0, 20.0, 50.0])
LEVEL_E = 20_000.0
DARK_CURRENT = next(effect for effect in EFFECTS if effect.name == "dark_current")


def geometry_of(seconds: np.ndarray | float) -> ImageGeometry:
    return ImageGeometry.of_pixels((4, 16), WAVELENGTHS, LEVEL_E, seconds)


def image_with(settings: dict[str, float], geometry: ImageGeometry) -> np.ndarray:
    image = 1.0 + 0.05 * np.random.default_rng(1).standard_normal((3, 4, 16))
    system = FringeModel.from_setup("ts8_e2v").base_system
    return apply_to_image(activate_effects(settings, EFFECTS), system, image, geometry)


def test_beside_a_pedestal_both_are_parts_of_one_level() -> None:
    plain = image_with({}, geometry_of(SECONDS))
    both = image_with({"dark_current.rate": 40.0, "dark_pedestal.electrons": 3000.0}, geometry_of(SECONDS))
    left = 1.0 - (3000.0 + 40.0 * SECONDS) / LEVEL_E
    np.testing.assert_allclose(
        both - 1.0, left[:, np.newaxis, np.newaxis] * (plain - 1.0), rtol=1e-12, atol=1e-15
    )


def test_in_exposures_of_one_length_it_is_a_pedestal_and_not_looked_for() -> None:
    equal = geometry_of(20.0)
    np.testing.assert_allclose(
        image_with({"dark_current.rate": 40.0}, equal), image_with({"dark_pedestal.electrons": 800.0}, equal)
    )
    with pytest.raises(InputError, match="dark_pedestal"):
        DARK_CURRENT.check_search(equal)
    DARK_CURRENT.check_search(geometry_of(SECONDS))
    for ratio, refused in ((1.049, True), (1.051, False)):
        times = np.full(len(SECONDS), 20.0)
        times[1] *= ratio
        with pytest.raises(InputError, match="different ones") if refused else nullcontext():
            DARK_CURRENT.check_search(geometry_of(times))


def test_exposures_must_state_their_length() -> None:
    with pytest.raises(InputError, match="dark time of the flats"):
        image_with({"dark_current.rate": 40.0}, geometry_of(0.0))
    with pytest.raises(InputError, match="dark times"):
        geometry_of(SECONDS[:2])


@pytest.mark.slow
def test_a_leak_is_named_and_told_from_a_pedestal() -> None:
    """200 electrons per second, a quarter to a half of the level."""
    case = draw_case("none", np.random.default_rng([20, 3]), size=(48, 64))
    cube = case.cube
    seconds = cube.exposures.dark_time_s[:, np.newaxis, np.newaxis]
    assert seconds.max() > 2.0 * seconds.min()
    rng = np.random.default_rng(4)
    leaked = rng.poisson(np.broadcast_to(200.0 * seconds, cube.shape)).astype(np.float32)
    variance = cube.variance + (200.0 * seconds).astype(np.float32)
    leaky = replace(cube, image=cube.image + leaked, variance=variance)
    verdict = discover(leaky, case.setup, rng=np.random.default_rng(0))
    (found,) = verdict.effects
    assert found.name == "dark_current"
    assert "dark_pedestal" not in found.ambiguous_with
    rate = found.parameters["rate"]
    assert math.isclose(rate.value, 200.0, abs_tol=4.0 * rate.sigma)
    assert rate.sigma < 10.0


@pytest.mark.slow
def test_without_times_it_is_told_to_be_left_out() -> None:
    case = draw_case("none", np.random.default_rng([20, 3]), size=(48, 64))
    blind = replace(case.cube.exposures, dark_time_s=np.array(0.0))
    verdict = discover(replace(case.cube, exposures=blind), case.setup, rng=np.random.default_rng(0))
    assert verdict.verdict == "no_discrepancy"
    assert any("dark_current was left out" in note for note in verdict.notes)
