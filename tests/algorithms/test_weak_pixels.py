"""Pixels that do not tell their thickness by themselves lean on the cells around them, as far as the flats allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laboratory_flats import ROWS, judge, make_flats

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit.posterior import learn_prior, local_width, nodes_about
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel

ORDER_UM = 0.3


def chi2_of(measured_um: np.ndarray, noise_um: float) -> np.ndarray:
    """Chi-square of pixels at the nodes, of a measured thickness about the surface."""
    return ((nodes_about(ORDER_UM) - measured_um[:, np.newaxis]) / noise_um) ** 2


@pytest.mark.parametrize("width_um", [0.004, 0.02])
@pytest.mark.rng("weak pixels width of the scatter about a surface")
def test_scatter_about_the_surface_is_learned(width_um, rng) -> None:
    """It is that beyond the noise of pixel and surface."""
    number, noise, surface = 40_000, 0.02, 0.003
    away = np.hypot(width_um, surface) * rng.standard_normal(number)
    chi2 = chi2_of(away + noise * rng.standard_normal(number), noise)
    found = learn_prior(chi2, np.full(number, surface), ORDER_UM)
    assert found.width_um == pytest.approx(width_um, rel=0.3)
    assert found.apart < 1e-3


@pytest.mark.rng("weak pixels that lie apart")
def test_share_of_pixels_that_lie_apart_is_learned(rng) -> None:
    number, noise = 20_000, 0.01
    away = np.where(
        rng.random(number) < 0.1, rng.uniform(-0.15, 0.15, number), 0.004 * rng.standard_normal(number)
    )
    found = learn_prior(
        chi2_of(away + noise * rng.standard_normal(number), noise), np.zeros(number), ORDER_UM
    )
    assert found.apart == pytest.approx(0.1, abs=0.02)


@pytest.mark.rng("weak pixels of a bump")
def test_a_bump_widens_the_prior_and_noise_does_not(rng) -> None:
    """What a prior of 4 nm leaves of pixels with a noise of 11 nm, in a field with a bump of 40 nm."""
    width, noise = 0.004, 0.011
    bump = np.zeros((96, 96))
    bump[40:50, 40:50] = 0.04
    drawn = width**2 / (width**2 + noise**2)
    shift = drawn * (bump + noise * rng.standard_normal(bump.shape))
    sigma = np.full(bump.shape, np.sqrt(drawn) * noise)
    found = local_width(shift, sigma, np.full(bump.shape, width), 9)
    assert found[43:47, 43:47].min() > 0.025
    assert np.mean(found[:30] > width) < 0.01


@pytest.mark.rng("weak pixels of a low bump")
def test_a_bump_of_three_widths_is_no_surprise(rng) -> None:
    """Pixels with a noise of 11 nm on a bump of 15 nm: a prior of 5 nm would leave errors of three times its σ."""
    width, noise, bump = 0.005, 0.011, 0.015
    seen = bump + noise * rng.standard_normal((64, 64))
    drawn = width**2 / (width**2 + noise**2)
    found = local_width(
        drawn * seen, np.full(seen.shape, np.sqrt(drawn) * noise), np.full(seen.shape, width), 5
    )
    drawn = found**2 / (found**2 + noise**2)
    pull = (drawn * seen - bump) / (np.sqrt(drawn) * noise)
    inside = np.s_[4:-4, 4:-4]
    assert np.sqrt(np.mean(pull[inside] ** 2)) < 1.3


@pytest.mark.rng("weak pixels of smoothed noise")
def test_noise_that_neighbours_share_widens_less(rng) -> None:
    """Noise of a standard deviation of 11 nm that is the same in blocks of 4 by 4 pixels."""
    width, noise = 0.005, 0.011
    drawn = width**2 / (width**2 + noise**2)
    shift = drawn * noise * np.kron(rng.standard_normal((24, 24)), np.ones((4, 4)))
    sigma, widths = np.full(shift.shape, np.sqrt(drawn) * noise), np.full(shift.shape, width)
    ignored, known = (
        np.mean(local_width(shift, sigma, widths, 5, independence) ** 2) for independence in (1.0, 1.0 / 16.0)
    )
    assert known < ignored
    assert np.sqrt(known) < noise


@pytest.mark.slow
@pytest.mark.parametrize(
    ("contrast", "electrons", "part"), [(0.13, 5_000.0, 0.5), (0.25, 5_000.0, 0.9), (0.13, 20_000.0, 0.9)]
)
@pytest.mark.rng("weak pixels of another simulator")
def test_weak_fringes_are_better_than_pixels_by_themselves(contrast, electrons, part, rng) -> None:
    """Flats of the other simulator: errors below the Cramer-Rao bound of a pixel alone, and as large as stated."""
    model = FringeModel.from_setup("ts8_e2v")
    truth = random_field((192, 192), rng, mean=15.0, span=1.5)
    laboratory = replace(ROWS["as the model"], contrast=contrast, electrons=electrons)
    cube = make_flats(laboratory, truth, rng)
    fitted = fit_thickness(cube, model)
    result, good = judge(fitted, truth), fitted.mask == 0
    ahead, behind = (model.response(truth + side, cube.wavelength_nm) for side in (0.001, -0.001))
    mean = 0.5 * (ahead + behind).mean(axis=(1, 2), keepdims=True)
    slope = contrast * (ahead - behind) / 0.002 / mean
    alone = 1.0 / np.sqrt((slope**2 / cube.variance).sum(axis=0))
    error = (fitted.value - truth)[good]
    assert result.wrong < 1e-3
    assert np.std(error) < part * np.sqrt(np.mean(alone[good] ** 2))
    assert 0.75 < result.own < 1.25
    assert result.pull < 1.35


@pytest.mark.slow
@pytest.mark.rng("weak pixels keep a structure smaller than a cell")
def test_structure_smaller_than_a_cell_is_kept(rng) -> None:
    """Bumps of a third of an order, three pixels wide, in flats of a contrast of 0.13.

    The layer is one at which the wavelengths do not have their crests together: there a pixel and its mirror image on
    the
    other side are alike, and nothing tells a bump from none.
    """
    y, x = np.indices((128, 128))
    near = np.minimum.reduce([(y - a) ** 2 + (x - b) ** 2 for a in (20, 60, 100) for b in (25, 65, 105)])
    bump = 0.1 * np.exp(-0.5 * near / 1.5**2)
    truth = random_field((128, 128), rng, mean=14.3, span=0.8) + bump
    cube = make_flats(replace(ROWS["as the model"], contrast=0.13), truth, rng)
    fitted = fit_thickness(cube, FringeModel.from_setup("ts8_e2v"))
    good = fitted.mask == 0
    error = fitted.value - truth
    error -= np.mean(error[good & (bump < 0.001)])
    inside = good & (bump > 0.05)
    assert inside.sum() > 0.8 * (bump > 0.05).sum()
    assert np.sqrt(np.mean((error / fitted.sigma)[inside] ** 2)) < 1.3
