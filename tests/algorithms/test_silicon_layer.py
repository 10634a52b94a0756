"""Thickness fits in which the silicon varies: sensors whose adhesive shows no fringes, or is hidden."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel, Setup
from lsst.fringe_sim.products import FlatExposures, FringeCube

SHAPE = (120, 140)
STEPS_NM = 0.25 * 1.07 ** np.arange(15)
"""Growing steps: the fringe spacing of 100 um is 1.2 nm, and equal steps would leave orders that look alike."""


def narrow_line(setup: Setup) -> FringeModel:
    """The sensor of a set-up on a bench with a line of 0.1 nm, in parallel light."""
    bench = replace(
        setup,
        kind="monochromator",
        profile_name="gaussian",
        bandwidth_fwhm_nm=0.1,
        beam_kind="collimated",
        telescope="",
    )
    return FringeModel.from_setup(bench)


@pytest.mark.parametrize(
    ("name", "mean_um", "step_factor", "noise"),
    [("ts8_itl", 100.0, 1.0, 0.004), ("ts8_itl", 100.0, 1.0, 0.001), ("hsc", 200.0, 0.5, 0.004)],
    ids=["itl", "itl, little noise", "hsc"],
)
@pytest.mark.rng("silicon is fitted like adhesive")
def test_silicon_is_fitted_like_adhesive(name, mean_um, step_factor, noise, rng) -> None:
    """Nine orders in 120 pixels: steep for the cells, which must not show in the mean response of the sensor."""
    model = narrow_line(Setup.from_name(name))
    wavelengths = 950.0 + np.concatenate([[0.0], np.cumsum(step_factor * STEPS_NM)])
    truth = random_field(SHAPE, rng, mean=mean_um, span=1.2)
    image = model.response(truth.ravel(), wavelengths).reshape(len(wavelengths), *SHAPE)
    image = image / image.mean(axis=(1, 2), keepdims=True) + noise * rng.standard_normal(image.shape)
    cube = FringeCube(
        image.astype(np.float32),
        np.full(image.shape, noise**2, np.float32),
        np.zeros(image.shape, np.int16),
        FlatExposures(wavelengths, np.array(0.1), np.array(model.setup.temperature_k)),
        "relative",
    )
    fitted = fit_thickness(cube, model)
    good = fitted.mask == 0
    error = (fitted.value - truth)[good]
    order_um = float(model.fringe_order_um(955.0))
    assert fitted.layer == "detection"
    assert order_um == pytest.approx(0.1335, abs=0.002)
    assert good.mean() > 0.99
    assert np.count_nonzero(np.abs(error) > 0.5 * order_um) == 0
    assert (error / fitted.sigma[good]).std() == pytest.approx(1.0, abs=0.1)
