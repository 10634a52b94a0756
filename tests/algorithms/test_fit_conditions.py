"""What real flats have: steps, illumination, another contrast, gaps, unequal noise, thin and thick adhesive."""

import warnings
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from flat_cubes import TEN_NM, relative_flats
from hard_maps import two_halves
from recorded_numbers import Record
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit import Nuisances
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube, mask_bits

HALF_ORDER_UM = 0.15
SHAPE = (160, 180)
NOISE = 0.002
SPAN_UM = 1.2  # Four orders in 160 pixels: 7 nm per pixel, near the steepest of real sensors (9 nm)


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


def places() -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns from -1 to 1."""
    y, x = np.indices(SHAPE, dtype=float)
    return 2.0 * y / (SHAPE[0] - 1) - 1.0, 2.0 * x / (SHAPE[1] - 1) - 1.0


def pulls_of(fitted, truth: np.ndarray, least: float = 0.95) -> np.ndarray:
    """Pulls of the good pixels, none of which may have another order."""
    good = fitted.mask == 0
    assert good.mean() > least
    error = (fitted.value - truth)[good]
    assert np.count_nonzero(np.abs(error) > HALF_ORDER_UM) == 0
    return np.asarray(error / fitted.sigma[good])


@pytest.mark.slow
@pytest.mark.rng("a step between the halves")
def test_a_step_between_the_halves(model, rng, tmp_path) -> None:
    """As measured: -1.1 % at the midline, a little different at each wavelength."""
    y, _ = places()
    truth = random_field(SHAPE, rng, mean=16.0, span=SPAN_UM)
    steps = -0.011 * (1.0 + 0.2 * rng.standard_normal(TEN_NM.size))
    light = 1.0 + steps[:, None, None] * (y > 0)
    cube = relative_flats(truth, model, rng, light=light)
    free = fit_thickness(cube, model, nuisances=Nuisances(zones="halves"))
    pull = pulls_of(free, truth)
    assert pull.mean() == pytest.approx(0.0, abs=0.05)
    assert pull.std() == pytest.approx(1.0, abs=0.1)
    by_default = fit_thickness(cube, model)
    assert pulls_of(by_default, truth).std() == pytest.approx(1.0, abs=0.1)
    held = fit_thickness(cube, model, nuisances=Nuisances())
    # Of 28 800 pixels the error is known to half a per cent.
    assert (held.value - truth).std() > 1.05 * (by_default.value - truth).std()
    cube.write_fits(tmp_path / "cube.fits")
    arguments = ["fit", str(tmp_path / "cube.fits"), "--out", str(tmp_path / "fit")]
    assert run(arguments) == 0
    value = fits.getdata(tmp_path / "fit" / "thickness.fits", "VALUE")
    np.testing.assert_array_equal(value, by_default.value)


@pytest.mark.rng("slow illumination")
def test_slow_illumination(model, rng) -> None:
    """A gradient and a bowl of a few per cent, free at each wavelength."""
    y, x = places()
    truth = random_field(SHAPE, rng, mean=16.0, span=SPAN_UM)
    size = 0.02 * rng.standard_normal((TEN_NM.size, 3))
    light = 1.0 + np.einsum("wk,kyx->wyx", size, np.stack([x, y, x * x + y * y]))
    cube = relative_flats(truth, model, rng, light=light)
    # The light is even within a cell: on 160 pixels it changes as much from cell to cell as on 4000 over 25 cells.
    fitted = fit_thickness(cube, model, nuisances=Nuisances(illumination_degree=2), cell_px=2)
    pull = pulls_of(fitted, truth)
    assert pull.mean() == pytest.approx(0.0, abs=0.05)
    assert pull.std() == pytest.approx(1.0, abs=0.1)


@pytest.mark.rng("contrast that the model does not know")
def test_contrast_that_the_model_does_not_know(model, rng) -> None:
    truth = random_field(SHAPE, rng, mean=16.0, span=SPAN_UM)
    weak = model.with_effects({"contrast_loss.factor": 0.4})
    fitted = fit_thickness(relative_flats(truth, weak, rng), model, nuisances=Nuisances(contrast="common"))
    assert fitted.metadata["CONTRAST"] == pytest.approx(0.4, rel=0.01)
    assert pulls_of(fitted, truth).std() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("mean", first_is_quick([28.0, 6.5]))
@pytest.mark.rng("thin and thick adhesive")
def test_thin_and_thick_adhesive(mean: float, model, rng) -> None:
    """Both ends of 5 to 30 µm."""
    truth = random_field(SHAPE, rng, mean=mean, span=SPAN_UM)
    pull = pulls_of(fit_thickness(relative_flats(truth, model, rng), model), truth)
    assert pull.std() == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.rng("a sensor cut in two")
def test_a_sensor_cut_in_two(model, rng) -> None:
    """Masked rows that no path crosses: both parts find their order, by themselves or together."""
    truth = random_field(SHAPE, rng, mean=16.0, span=SPAN_UM)
    cube = relative_flats(truth, model, rng)
    mask = cube.mask.copy()
    mask[:, 75:87] = mask_bits("BAD")
    cut = FringeCube(cube.image, cube.variance, mask, cube.exposures, "relative")
    fitted = fit_thickness(cut, model)
    good = fitted.mask == 0
    assert not good[75:87].any()
    assert good[:75].mean() > 0.95
    assert good[87:].mean() > 0.95
    assert np.count_nonzero(np.abs(fitted.value - truth)[good] > HALF_ORDER_UM) == 0


@pytest.mark.rng("unequal noise counts")
@pytest.mark.slow
def test_unequal_noise_counts(model, rng) -> None:
    """A quarter of the sensor and half of the wavelengths are three times noisier; the pulls stay 1 everywhere."""
    truth = random_field(SHAPE, rng, mean=16.0, span=SPAN_UM)
    cube = relative_flats(truth, model, rng, noise=1e-6)
    noise = np.full(cube.shape, NOISE)
    noise[::2] *= 3.0
    noise[:, :80, :90] *= 3.0
    image = cube.image + noise * rng.standard_normal(cube.shape)
    uneven = FringeCube(
        image.astype(np.float32), (noise**2).astype(np.float32), cube.mask, cube.exposures, "relative"
    )
    fitted = fit_thickness(uneven, model)
    pulls_of(fitted, truth)
    pull = (fitted.value - truth) / fitted.sigma
    assert pull[:80, :90].std() == pytest.approx(1.0, abs=0.1)
    assert pull[80:].std() == pytest.approx(1.0, abs=0.1)
    assert np.median(fitted.sigma[:80, :90]) > 2.0 * np.median(fitted.sigma[80:])


@pytest.mark.parametrize("seed", [3, 4, 7, 13])
def test_a_pixel_beyond_measure_where_there_are_no_fringes_is_no_traceback(seed: int, model) -> None:
    """At 720 nm the model has no fringes: the contrast that such a pixel asks for is beyond all numbers."""
    rng = np.random.default_rng(seed)
    thickness = 13.0 + 0.2 * rng.random((4, 6))
    response = model.response(thickness, np.linspace(880.0, 990.0, 3))
    image = response / response.mean() * (1.0 + 0.003 * rng.standard_normal(response.shape))
    image[0, 0, 0] = rng.choice([1871.0, 1e30, -1e4, 3e38])
    hidden = rng.random(image.shape) < rng.choice([0, 0.5])
    exposures = FlatExposures(np.full(3, 720.0), np.array(2.0), np.array(173.0))
    variance = np.full(image.shape, 1e-4, np.float32)
    cube = FringeCube(image.astype(np.float32), variance, hidden.astype(np.int32), exposures, "relative")
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with suppress(InputError):
            assert fit_thickness(cube, model, "global", range_um=(12.5, 13.5)).mask.all()


@pytest.mark.rng("fit conditions one wavelength of some pixels is spoiled")
def test_a_pixel_leaves_out_a_wavelength_that_is_spoiled(model, rng) -> None:
    """As after a cosmic ray that nobody masked: the other wavelengths tell the thickness."""
    truth = random_field((96, 128), rng, mean=14.0, span=0.8)
    cube = relative_flats(truth, model, rng, noise=NOISE)
    image, (rows, columns) = cube.image.copy(), (np.array([20, 47, 70]), np.array([30, 64, 100]))
    image[5, rows, columns] *= 1.2
    fitted = fit_thickness(replace(cube, image=image), model)
    assert (fitted.mask[rows, columns] == 0).all()
    assert (fitted.n_wavelengths[rows, columns] == len(cube.wavelength_nm) - 1).all()
    assert (np.abs(fitted.value - truth)[rows, columns] < 5.0 * fitted.sigma[rows, columns]).all()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"method": "guo2022"},
        {"nuisances": Nuisances(zones="halves", illumination_degree=2)},
        {"nuisances": Nuisances(contrast="common"), "cell_px": 2},
    ],
    ids=["usual", "walk", "free light", "free contrast"],
)
@pytest.mark.rng("a record of fits")
def test_fits_of_two_halves_are_as_recorded(model, rng, options, recorded: Record) -> None:
    """A record of all products of a map with a step, weak fringes and spots, beside the truth of the other tests."""
    truth = two_halves((48, 56))
    truth[10:13, 20:23] += 0.4
    light = np.where(np.arange(48) < 24, 1.0, 0.99)[:, np.newaxis] * np.ones(56)
    weak = model.with_effects({"contrast_loss.factor": 0.5})
    cube = relative_flats(truth, weak, rng, light=light)
    image, mask = cube.image.copy(), cube.mask.copy()
    mask[:, 5, 5] = mask[3:, 6, 30] = mask_bits("BAD")
    image[4, 30:33, 40] += 0.05
    spoiled = FringeCube(image, cube.variance, mask, cube.exposures, "relative")
    recorded(fit_thickness(spoiled, weak, **options))
