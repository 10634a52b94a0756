"""From one wavelength to two hundred, and adhesives beyond the usual range."""

import numpy as np
import pytest
from flat_cubes import TEN_NM, relative_flats
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import mask_bits

HALF_ORDER_UM = 0.15


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


@pytest.mark.parametrize("count", first_is_quick([3, 1, 2]))
@pytest.mark.rng("too few wavelengths are not believed")
def test_too_few_wavelengths_are_not_believed(count: int, model: FringeModel, rng) -> None:
    truth = random_field((48, 64), rng, mean=15.0, span=2.0)
    fitted = fit_thickness(relative_flats(truth, model, rng, 0.002, TEN_NM[[2, 7, 10]][:count]), model)
    assert np.all(fitted.mask & mask_bits("LOW_SIGNAL"))
    assert np.all(fitted.n_wavelengths == count)


@pytest.mark.parametrize("count", first_is_quick([4, 5, 23, 200]))
@pytest.mark.rng("every number from four on is enough")
def test_every_number_from_four_on_is_enough(count: int, model: FringeModel, rng) -> None:
    """Each adds to the certainty; noise is such that the whole of it is about the same."""
    truth = random_field((48, 64), rng, mean=float(rng.uniform(9.0, 18.0)), span=3.0)
    wavelengths = np.sort(rng.choice(np.arange(880.0, 990.0, 0.5), count, replace=False))
    wavelengths[[0, -1]] = 880.0, 990.0
    noise = 0.002 * np.sqrt(count / 12.0)
    fitted = fit_thickness(relative_flats(truth, model, rng, noise, wavelengths), model)
    good = fitted.mask == 0
    assert good.mean() > 0.9
    assert np.mean(np.abs(fitted.value - truth)[good] > HALF_ORDER_UM) < 1e-3
    # Four hardly tell the mean response of so small a sensor, whose error all pixels share; crests are not Gaussian.
    # What the wavelengths have in common moves all pixels by one factor, which one sensor draws once.
    shared = fitted.metadata.get("SCALESIG", 0.0) * fitted.value[good]
    error = (fitted.value - truth)[good]
    assert abs(np.median(error / fitted.value[good])) < 4.0 * np.max(fitted.sigma[good] / fitted.value[good])
    pull = (error - np.median(error)) / np.sqrt(fitted.sigma[good] ** 2 - shared**2)
    assert 1.4826 * np.median(np.abs(pull)) == pytest.approx(1.0, abs=0.1 if count > 4 else 0.4)


@pytest.mark.parametrize("mean", [35.0, 55.0])
@pytest.mark.rng("adhesive beyond the usual range")
def test_adhesive_beyond_the_usual_range(mean: float, model: FringeModel, rng) -> None:
    """Steps of 5 nm, since ten are below the sampling that such fringes need."""
    truth = random_field((64, 64), rng, mean=mean, span=3.0)
    flats = relative_flats(truth, model, rng, 0.002, np.arange(880.0, 991.0, 5.0))
    fitted = fit_thickness(flats, model, range_um=(mean - 12.0, mean + 12.0))
    good = fitted.mask == 0
    assert good.mean() > 0.95
    assert np.mean(np.abs(fitted.value - truth)[good] > HALF_ORDER_UM) < 1e-3
