"""Illumination that changes with wavelength, wherever it is even."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry, activate_effects, apply_to_image
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.array([900.0, 950.0, 980.0])


def test_the_exposure_at_its_wavelength_is_evenly_lit() -> None:
    geometry = ImageGeometry.of_pixels((20, 24), WAVELENGTHS)
    image = np.ones((3, 20, 24))
    settings = {"gradient_x": 0.02, "curvature_yy": 0.01, "even_offset": 10.0}
    active = activate_effects({"chromatic_illumination": settings}, EFFECTS)
    lit = apply_to_image(active, FringeModel.from_setup("ts8_e2v").base_system, image, geometry)
    np.testing.assert_array_equal(lit[1], image[1])  # 940 + 10 nm
    assert np.ptp(lit[0][10]) == pytest.approx(0.02, rel=0.01)  # 50 nm away
    slope = [np.ptp(plane[10]) for plane in lit]
    assert slope[2] / slope[0] == pytest.approx(30.0 / 50.0, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("even_nm", [910.0, 975.0])
def test_light_that_is_even_at_any_wavelength_is_one_effect(even_nm: float) -> None:
    """It is no change with wavelength beside a pattern that all exposures have."""
    case = draw_case("none", np.random.default_rng(31), size=(48, 64))
    u = np.linspace(-1.0, 1.0, 64)
    colour = (case.cube.wavelength_nm - even_nm)[:, np.newaxis, np.newaxis] / 50.0
    pattern = (1.0 + colour * (0.006 * u - 0.004 * u**2)).astype(np.float32)
    cube = replace(case.cube, image=case.cube.image * pattern, variance=case.cube.variance * pattern**2)
    verdict = discover(cube, case.setup, rng=np.random.default_rng(0))
    assert [effect.name for effect in verdict.effects] == ["chromatic_illumination"]
    found = verdict.effects[0].parameters
    waves = case.cube.wavelength_nm
    even = 0.5 * (waves.min() + waves.max()) + found["even_offset"].value
    assert abs(even - even_nm) < 4.0 * found["even_offset"].sigma
    assert found["even_offset"].sigma < 5.0
    assert abs(found["gradient_x"].value - 0.012) < 4.0 * found["gradient_x"].sigma


@pytest.mark.slow
def test_a_pattern_that_all_exposures_have_does_not_change_with_wavelength() -> None:
    case = draw_case("none", np.random.default_rng(32), size=(48, 64))
    u = np.linspace(-1.0, 1.0, 64)
    pattern = np.broadcast_to(1.0 + 0.002 * u - 0.001 * u**2, (48, 64)).astype(np.float32)
    cube = replace(case.cube, image=case.cube.image * pattern, variance=case.cube.variance * pattern**2)
    verdict = discover(cube, case.setup, rng=np.random.default_rng(0))
    assert [effect.name for effect in verdict.effects] == ["illumination"]
