"""Sensors of few fringe orders, whose mean response depends on the very thickness that is looked for."""

import numpy as np
import pytest
from flat_cubes import relative_flats
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube

SEARCH_UM = (5.0, 20.0)
HALF_ORDER_UM = 0.15


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


@pytest.mark.parametrize("span", first_is_quick([0.3, 0.05, 0.15, 0.6, 0.85]))
@pytest.mark.rng("order is found together with the mean")
def test_order_is_found_together_with_the_mean(span, model, rng) -> None:
    for _ in range(2):
        truth = random_field((64, 64), rng, mean=rng.uniform(7.0, 15.0), span=span)
        fitted = fit_thickness(relative_flats(truth, model, rng, 0.007), model, range_um=SEARCH_UM)
        good = fitted.mask == 0
        assert good.mean() > 0.99
        assert np.mean(np.abs(fitted.value - truth)[good] > HALF_ORDER_UM) == 0.0
        assert np.abs(np.mean((fitted.value - truth)[good] / fitted.sigma[good])) < 3.0


@pytest.mark.slow
@pytest.mark.rng("uncertainty of the common thickness")
def test_uncertainty_of_the_common_thickness(model, rng) -> None:
    """The mean over a nearly flat sensor errs as much as is stated, and by far more than a mean of pixels."""
    pulls, gain = [], []
    for _ in range(10):
        truth = random_field((32, 32), rng, mean=rng.uniform(9.0, 12.0), span=0.01)
        fitted = fit_thickness(relative_flats(truth, model, rng, 0.002), model, range_um=(8.0, 13.0))
        good = fitted.mask == 0
        if good.mean() > 0.9:
            error = (fitted.value - truth)[good]
            pulls.append(float(error.mean() / np.median(fitted.sigma[good])))
            gain.append(float(abs(error.mean()) / (error.std() / np.sqrt(good.sum()))))
    assert len(pulls) >= 8
    assert np.sqrt(np.mean(np.square(pulls))) < 1.6
    assert np.median(gain) > 3.0


@pytest.mark.rng("what cannot be told is said")
def test_what_cannot_be_told_is_said(model, rng) -> None:
    """Noise that leaves a flat sensor without a fringe: wrong orders are flagged."""
    for span in (0.005, 0.01, 0.02):
        truth = random_field((32, 32), rng, mean=rng.uniform(7.0, 15.0), span=span)
        fitted = fit_thickness(relative_flats(truth, model, rng, 0.01), model, range_um=SEARCH_UM)
        wrong = np.abs(fitted.value - truth) > HALF_ORDER_UM
        assert np.mean(wrong & (fitted.mask == 0)) == 0.0


@pytest.mark.rng("a piece of a larger sensor keeps its level")
def test_a_piece_of_a_larger_sensor_keeps_its_level(model, rng) -> None:
    """Flats over the mean of the whole sensor they were cut from are not forced to a mean of one."""
    truth = random_field((256, 256), rng, mean=12.0, span=5.0)
    whole = relative_flats(truth, model, rng, 0.004)
    part = (slice(100, 124), slice(100, 124))
    piece = FringeCube(
        whole.image[:, *part], whole.variance[:, *part], whole.mask[:, *part], whole.exposures, "relative"
    )
    fitted = fit_thickness(piece, model, range_um=SEARCH_UM)
    good = fitted.mask == 0
    assert good.mean() > 0.9
    assert np.mean(np.abs(fitted.value - truth[part])[good] > HALF_ORDER_UM) == 0.0
