"""Silicon that is thicker on one side, against the model and against a simulator of its own."""

import numpy as np
import pytest
from field_matrices import DETECTION, LINE_NM, ForeignSensor
from scipy.interpolate import CubicSpline

from lsst.fringe_sim.algorithms import simulate_sky_frame
from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry, activate_effects, apply_to_image
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products.fringe_cube import FlatExposures, FringeCube

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
COLUMNS = 9


def test_every_column_is_that_of_a_sensor_of_its_thickness() -> None:
    """Fringes of the silicon itself averaged, which the effect does not follow."""
    base = FringeModel.from_setup("ts8_e2v")
    thickness = np.linspace(15.0, 16.2, 241)[:, np.newaxis] * np.ones(COLUMNS)
    geometry = ImageGeometry.of_pixels(thickness.shape, WAVELENGTHS, 20_000.0)
    wedge = base.with_effects({"silicon_gradient.gradient_x": 3.0})
    seen = wedge.flat_image(thickness, geometry)
    truth = np.stack(
        [_of_silicon(offset, thickness[:, 0]) for offset in np.linspace(-1.5, 1.5, COLUMNS)], axis=2
    )
    truth /= truth.mean(axis=(1, 2), keepdims=True)
    plain = base.flat_image(thickness, geometry)
    change, error = np.abs(truth - plain).max(axis=(1, 2)), np.abs(seen - truth).max(axis=(1, 2))
    assert np.all(change > 2e-3)
    # What is left are the silicon's own fringes, seen in the deep red, and absent from the average.
    assert np.all(error < 0.01 * change + np.where(WAVELENGTHS < 930.0, 1e-4, 7e-4))


def _of_silicon(offset_um: float, thickness_um: np.ndarray) -> np.ndarray:
    places = offset_um + 0.13 * (np.arange(8) - 3.5) / 8.0
    models = [FringeModel.from_setup("ts8_e2v", {"silicon_thickness.offset": place}) for place in places]
    return np.mean([model.response(thickness_um, WAVELENGTHS) for model in models], axis=0)


def test_both_directions_and_signs() -> None:
    base = FringeModel.from_setup("ts8_e2v").base_system
    geometry = ImageGeometry.of_pixels((21, 21), WAVELENGTHS)
    even = np.ones((12, 21, 21))
    along, down, back = (
        apply_to_image(activate_effects({f"silicon_gradient.{key}": size}, EFFECTS), base, even, geometry)
        for key, size in (("gradient_x", 1.0), ("gradient_y", 1.0), ("gradient_x", -1.0))
    )
    assert np.all(np.diff(along, axis=2) > 0.0)
    np.testing.assert_allclose(along, down.transpose(0, 2, 1), rtol=1e-12)
    np.testing.assert_allclose(along, back[:, :, ::-1], rtol=1e-12)
    rise = along[:, 0, -1] - along[:, 0, 0]
    assert rise[-1] > 3.0 * rise[0]  # the deep red goes through


def test_a_set_up_that_varies_the_silicon_has_no_wedge() -> None:
    model = FringeModel.from_setup("hsc")
    geometry = ImageGeometry.of_pixels((4, 4), WAVELENGTHS)
    active = activate_effects({"silicon_gradient.gradient_x": 1.0}, EFFECTS)
    with pytest.raises(InputError, match="varies another layer"):
        apply_to_image(active, model.base_system, np.ones((12, 4, 4)), geometry)


def test_exposures_of_one_colour_do_not_show_it() -> None:
    (effect,) = (item for item in EFFECTS if item.name == "silicon_gradient")
    with pytest.raises(InputError, match="span of the wavelengths"):
        effect.check_search(ImageGeometry.of_pixels((4, 4), np.array([960.0, 970.0])))
    effect.check_search(ImageGeometry.of_pixels((4, 4), WAVELENGTHS))


@pytest.mark.slow
def test_it_goes_along_to_the_sky() -> None:
    thickness = np.full((24, 32), 15.0)
    plain, wedge = (
        simulate_sky_frame(thickness, FringeModel.from_setup("lsst_e2v", effects)).image
        for effects in ({}, {"silicon_gradient.gradient_x": 2.0})
    )
    rise = (wedge / plain)[:, -1] - (wedge / plain)[:, 0]
    np.testing.assert_allclose(rise, rise[0], rtol=1e-3)
    assert 0.005 < rise[0] < 0.02  # a fiftieth of 100 um of silicon, about half of it seen


def wedge_flats(epoxy_um: np.ndarray, rise_um: float, px: int) -> np.ndarray:
    """Relative flats with a sensor of its own for every column of pixels; ``px`` by ``px`` places in each."""
    grid = np.arange(epoxy_um.min() - 0.05, epoxy_um.max() + 0.06, 0.008)
    away = np.linspace(-3.5, 3.5, 41)
    share = np.exp(-0.5 * away**2) / np.exp(-0.5 * away**2).sum()
    sigma = LINE_NM / np.sqrt(8.0 * np.log(2.0))
    ny, nx = (side // px for side in epoxy_um.shape)
    flats = np.empty((len(WAVELENGTHS), ny, nx))
    for column in range(nx):
        sensor = ForeignSensor(thicker_um={DETECTION: rise_um * (column / (nx - 1) - 0.5)})
        places = epoxy_um[:, column * px : (column + 1) * px]
        for plane, middle in enumerate(WAVELENGTHS):
            response = CubicSpline(grid, share @ sensor.absorbed(middle + sigma * away, grid))
            flats[plane, :, column] = response(places).reshape(ny, px, px).mean(axis=(1, 2))
    return np.asarray(flats / flats.mean(axis=(1, 2), keepdims=True))


@pytest.mark.slow
@pytest.mark.parametrize("rise_um", [-0.7, 2.5])
def test_a_wedge_is_told_from_coloured_light(rise_um: float) -> None:
    """The mean of a wedge changes with wavelength as uneven light may; that its size is one number tells it."""
    rng = np.random.default_rng(17)
    v, u = np.meshgrid(np.linspace(-1.0, 1.0, 64 * 4), np.linspace(-1.0, 1.0, 64 * 4), indexing="ij")
    epoxy = 15.0 + 0.4 * u - 0.3 * v + 0.2 * np.cos(2.0 * u + v)
    electrons = 20_000.0 * wedge_flats(epoxy, rise_um, 4)
    image = rng.poisson(electrons) + 6.0 * rng.standard_normal(electrons.shape)
    cube = FringeCube(
        image.astype(np.float32), (np.maximum(image, 1.0) + 36.0).astype(np.float32),
        np.zeros(image.shape, np.int32),
        FlatExposures(WAVELENGTHS, np.full(12, LINE_NM), np.full(12, 183.15)), "electron", detector="wedge",
    )  # fmt: skip
    verdict = discover(cube, "ts8_e2v", rng=np.random.default_rng(0))
    assert [effect.name for effect in verdict.effects] == ["silicon_gradient"], verdict.summary()
    (effect,) = verdict.effects
    for name, true in (("gradient_x", rise_um), ("gradient_y", 0.0)):
        found = effect.parameters[name]
        assert abs(found.value - true) < 4.0 * found.sigma < 0.2
