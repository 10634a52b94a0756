"""Flats minus model: noise where the model is right, the effect where it is not."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.flat_residual import fit_and_compare, flat_residual, relative_flats
from lsst.fringe_sim.effects import ImageGeometry
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.mock import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

NOISE = 0.005
LEVEL_E = 20_000.0
WAVELENGTH_NM = np.arange(880.0, 991.0, 10.0)


def flats(model: FringeModel, thickness_um: np.ndarray, noise: float = 0.0) -> FringeCube:
    rng = np.random.default_rng(2)
    geometry = ImageGeometry.of_pixels(thickness_um.shape, WAVELENGTH_NM, LEVEL_E)
    image = model.flat_image(thickness_um, geometry)
    image += noise * rng.standard_normal(image.shape)
    mask = np.zeros(image.shape, dtype=np.int16)
    mask[3, :5] = 1
    mask[:, 20, 20] = 1
    return FringeCube(
        (LEVEL_E * image).astype(np.float32),
        np.full(image.shape, (LEVEL_E * max(noise, 1e-4)) ** 2, dtype=np.float32),
        mask,
        FlatExposures(WAVELENGTH_NM, np.array(2.0), np.array(183.15), np.array(np.inf)),
        unit="electron",
    )


@pytest.fixture(scope="module")
def thickness_um() -> np.ndarray:
    return random_field((48, 56), np.random.default_rng(1), mean=16.0, span=2.0, scale=30.0)


@pytest.mark.parametrize("effects", [{}, {"bandwidth.fwhm": 3.0}, {"amplifier_gain.C03": 0.02}])
def test_the_right_model_leaves_nothing_of_noiseless_flats(thickness_um, effects) -> None:
    model = FringeModel.from_setup("ts8_e2v", effects)
    residual = flat_residual(flats(model, thickness_um), model, thickness_um)
    assert np.nanmax(np.abs(residual)) < 3e-6
    assert np.isnan(residual[3, :5]).all()
    assert np.isnan(residual[:, 20, 20]).all()
    assert np.isfinite(residual).sum() == residual.size - 5 * 56 - len(WAVELENGTH_NM)


@pytest.mark.parametrize("effects", [{"dark_pedestal.electrons": 900.0}, {"dark_current.rate": 30.0}])
def test_relative_flats_know_their_levels_and_times(thickness_um, effects) -> None:
    """As prepared from raw frames; what is added in electrons needs both."""
    model = FringeModel.from_setup("ts8_e2v", effects)
    level, seconds = np.linspace(15e3, 25e3, 12), np.linspace(10.0, 60.0, 12)
    geometry = ImageGeometry.of_pixels(thickness_um.shape, WAVELENGTH_NM, level, seconds)
    image = model.flat_image(thickness_um, geometry).astype(np.float32)
    rows = FlatExposures(WAVELENGTH_NM, np.array(2.0), np.array(183.15), level_e=level, dark_time_s=seconds)
    cube = FringeCube(image, np.full_like(image, 1e-8), np.zeros(image.shape, np.int16), rows, "relative")
    assert np.abs(flat_residual(cube, model, thickness_um)).max() < 3e-6


def test_an_effect_on_the_image_is_seen_where_it_acts(thickness_um) -> None:
    gain = FringeModel.from_setup("ts8_e2v", {"amplifier_gain.C03": 0.02})
    residual = flat_residual(flats(gain, thickness_um), FringeModel.from_setup("ts8_e2v"), thickness_um)
    step = np.nanmean(residual[:, :24, 21:28]) - np.nanmean(residual[:, 24:, :])
    # The frames were multiplied with a gain that is 2 % too low for this amplifier.
    assert step == pytest.approx(1.0 / 1.02 - 1.0, rel=0.01)


def test_fitted_residual_is_noise_with_the_effect_and_more_without(thickness_um) -> None:
    wide = FringeModel.from_setup("ts8_e2v", {"bandwidth.fwhm": 3.5})
    cube = flats(wide, thickness_um, NOISE)
    after, before = fit_and_compare(cube, wide), fit_and_compare(cube, FringeModel.from_setup("ts8_e2v"))
    # One parameter for twelve flats is fitted at each pixel.
    assert np.sqrt((after.rms**2).mean()) == pytest.approx(NOISE * np.sqrt(11.0 / 12.0), rel=0.02)
    assert (before.rms > 1.3 * NOISE).any()
    assert after.thickness.value.shape == thickness_um.shape


def test_relative_flats_have_mean_zero_and_know_the_mask(thickness_um) -> None:
    relative = relative_flats(flats(FringeModel.from_setup("ts8_e2v"), thickness_um))
    assert np.allclose(np.nanmean(relative, axis=(1, 2)), 0.0, atol=1e-12)
    assert np.isnan(relative[3, :5]).all()


def test_maps_that_do_not_fit_are_refused(thickness_um) -> None:
    model = FringeModel.from_setup("ts8_e2v")
    cube = flats(model, thickness_um)
    with pytest.raises(InputError, match="shape of the thickness map"):
        flat_residual(cube, model, thickness_um[1:])
    with pytest.raises(InputError, match="known pixels"):
        flat_residual(cube, model, np.full_like(thickness_um, np.nan))
