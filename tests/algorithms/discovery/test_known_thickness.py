"""Thickness maps that are known only so well, or better than they state."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.discovery.forward import Forward
from lsst.fringe_sim.algorithms.discovery.noise import map_variance_share
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.model import FringeModel

STATED_UM = 0.01


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
@pytest.mark.rng("the errors of a map are measured")
def test_the_errors_of_a_map_are_measured(rng: np.random.Generator, share: float) -> None:
    """Also where the noise is not what it was taken for."""
    slope = rng.normal(0.0, 100.0, (12, 60, 60))
    error = np.sqrt(share) * STATED_UM * rng.standard_normal((60, 60))
    residual = slope * error + 1.3 * rng.standard_normal(slope.shape)
    assert map_variance_share(slope, residual, STATED_UM**2) == pytest.approx(share, rel=0.2, abs=0.01)


@pytest.mark.rng("a map is not worse than it states")
def test_a_map_is_not_worse_than_it_states(rng: np.random.Generator) -> None:
    slope = rng.normal(0.0, 100.0, (12, 30, 30))
    residual = slope * 0.05 * rng.standard_normal((30, 30)) + rng.standard_normal(slope.shape)
    assert map_variance_share(slope, residual, STATED_UM**2) == 1.0


@pytest.mark.parametrize("waves", [1, 2])
@pytest.mark.rng("few wavelengths cannot tell")
def test_few_wavelengths_cannot_tell(rng: np.random.Generator, waves: int) -> None:
    slope = rng.normal(0.0, 100.0, (waves, 30, 30))
    assert map_variance_share(slope, rng.standard_normal(slope.shape), STATED_UM**2) == 1.0
    assert map_variance_share(0.0 * slope, rng.standard_normal(slope.shape), STATED_UM**2) == 1.0


@pytest.mark.rng("scatter of the thickness leaves the mean of the fringes")
def test_scatter_of_the_thickness_leaves_the_mean_of_the_fringes(rng: np.random.Generator) -> None:
    """Predictions at places that scatter about the true one have the prediction there as their mean."""
    wavelength, shape = np.array([900.0, 960.0]), (200, 300)
    geometry = ImageGeometry(shape, np.arange(200.0), np.arange(300.0), wavelength, np.full(2, 2e4))
    forward = Forward(FringeModel.from_setup("ts8_e2v"), EFFECTS, geometry, 1, (13.0, 16.0))
    true = np.full(shape, 14.03)
    scattered = true + STATED_UM * rng.standard_normal(shape)
    expected = forward.predict({}, true).value[:, 0, 0]
    weakened = forward.predict({}, scattered).value.mean(axis=(1, 2))
    forward.scatter_um2 = np.full(shape, STATED_UM**2)
    mean = forward.predict({}, scattered).value.mean(axis=(1, 2))
    assert np.abs(mean - expected).max() < 0.3 * np.abs(weakened - expected).max()


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
