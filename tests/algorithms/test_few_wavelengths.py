"""Sensors of few orders in few wavelengths: mean response, relief and order hang together."""

import numpy as np
import pytest
from flat_cubes import TEN_NM, relative_flats

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit import make_templates
from lsst.fringe_sim.algorithms.thickness_fit.fit import amplitudes_from_cube
from lsst.fringe_sim.algorithms.thickness_fit.shared_misfit import doubt_from_shared_misfit
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel

HALF_ORDER_UM = 0.15
NEIGHBOURS = TEN_NM[:4]


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


def wrong_and_unflagged(fitted, truth) -> float:
    return float(np.mean((np.abs(fitted.value - truth) > HALF_ORDER_UM) & (fitted.mask == 0)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 3, 4])
def test_neighbouring_wavelengths_find_the_order(seed, model) -> None:
    """A mean response that is half a per cent off tears the relief; a torn relief has a wrong mean response."""
    rng = np.random.default_rng(seed)
    truth = random_field((80, 100), rng, mean=15.0, span=0.5)
    fitted = fit_thickness(relative_flats(truth, model, rng, 0.002, NEIGHBOURS), model)
    assert wrong_and_unflagged(fitted, truth) == 0.0
    assert np.mean(fitted.mask == 0) > 0.95
    assert np.median(fitted.chi2) < 1.0


@pytest.mark.parametrize(
    ("bands", "shape", "mean", "span", "noise"),
    [
        pytest.param((0, 1, 2, 3), (160, 200), 15.0, 1.0, 0.002, marks=pytest.mark.slow),
        pytest.param((8, 9, 10, 11), (80, 100), 25.6, 2.5, 0.002, marks=pytest.mark.slow),
        pytest.param((3, 4, 5, 6, 7), (80, 100), 7.0, 0.8, 0.002, marks=pytest.mark.slow),
        pytest.param((0, 1, 2, 3), (48, 64), 8.0, 1.6, 0.005, marks=pytest.mark.slow),
        ((0, 1, 10, 11), (80, 100), 22.0, 0.6, 0.004),
    ],
)
@pytest.mark.rng("any few wavelengths find the order or say so")
def test_any_few_wavelengths_find_the_order_or_say_so(bands, shape, mean, span, noise, model, rng) -> None:
    truth = random_field(shape, rng, mean=mean, span=span)
    fitted = fit_thickness(relative_flats(truth, model, rng, noise, TEN_NM[list(bands)]), model)
    assert wrong_and_unflagged(fitted, truth) < 1e-3


@pytest.mark.rng("a misfit that neighbours share is no certainty")
def test_a_misfit_that_neighbours_share_is_no_certainty(model, rng) -> None:
    """The true map raises no doubt at any noise; one with a wrong mean response does, however large the sensor."""
    truth = random_field((80, 100), rng, mean=15.0, span=0.5)
    cube = relative_flats(truth, model, rng, 0.002, NEIGHBOURS)
    data = amplitudes_from_cube(cube)
    right = make_templates(model, NEIGHBOURS, (5.0, 30.0)).normalised_to(truth)
    order = right.order_um()
    spoilt = right.normalised_to(truth - 0.3 * (truth - truth.min()))
    thickness = truth.astype(np.float32)
    assert doubt_from_shared_misfit(data, right, thickness, order) < 1e-6
    assert doubt_from_shared_misfit(data, spoilt, thickness, order) > 0.05


@pytest.mark.slow
@pytest.mark.rng("a flat sensor says how sure it is")
def test_a_flat_sensor_says_how_sure_it_is(model, rng) -> None:
    """Too flat for the noise: what is said to be sure is right, and what is wrong has been said to be likely."""
    said, wrong = [], []
    for _ in range(24):
        bands = np.sort(rng.choice(12, rng.integers(4, 8), replace=False))
        truth = random_field((32, 40), rng, mean=rng.uniform(9.0, 14.0), span=rng.choice([0.005, 0.01, 0.02]))
        cube = relative_flats(truth, model, rng, 0.008, TEN_NM[bands])
        fitted = fit_thickness(cube, model, range_um=(8.0, 15.0))
        said.append(float(np.median(fitted.slip_probability)))
        wrong.append(float(np.median(np.abs(fitted.value - truth)) > HALF_ORDER_UM))
    doubtful = np.array(said) > 0.01
    assert np.sum(np.array(wrong)[~doubtful]) <= 1
    expected = np.sum(said)
    assert (
        abs(np.sum(wrong) - expected) < 3.0 * np.sqrt(np.sum(np.array(said) * (1.0 - np.array(said)))) + 1.0
    )
