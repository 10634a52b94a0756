"""Errors of single exposures are draws, unless they follow a curve in wavelength."""

from dataclasses import replace

import numpy as np
import pytest
from flat_cubes import relative_flats
from scipy.stats import kstest
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.discovery.trends import trend_channel
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.mock import random_field
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
CATALOGUE = [
    effect
    for effect in EFFECTS
    if effect.name
    in ("wavelength_jitter", "wavelength_scale", "epoxy_index", "illumination", "contrast_loss")
]
PLACE = (WAVELENGTHS - 935.0) / 55.0


def _covariance(rng: np.random.Generator, sigma: float) -> np.ndarray:
    """Errors of which the common one and one trend are known much worse than the rest."""
    root = sigma * rng.uniform(0.5, 2.0, len(PLACE))
    poorly = np.outer(np.ones(len(PLACE)), np.ones(len(PLACE))) + 4.0 * np.outer(PLACE, PLACE)
    return np.asarray(np.diag(root**2) + (10.0 * sigma) ** 2 * poorly)


@pytest.mark.parametrize("sigma", first_is_quick([0.1, 1e-4, 1.0]))
@pytest.mark.rng("draws are draws however well they are known")
@pytest.mark.slow
def test_draws_are_draws_however_well_they_are_known(rng: np.random.Generator, sigma: float) -> None:
    chances = []
    for _ in range(300):
        covariance = _covariance(rng, sigma)
        error = 0.2 * rng.standard_normal(len(PLACE)) + rng.multivariate_normal(
            np.zeros(len(PLACE)), covariance
        )
        chances.append(trend_channel("draws", WAVELENGTHS, error, covariance).probability)
    assert kstest(chances, "uniform").pvalue > 1e-4


@pytest.mark.parametrize(
    "shape",
    [PLACE, PLACE**2, np.sin(np.pi * PLACE), np.exp(1.5 * PLACE)],
    ids=["line", "arc", "wave", "edge"],
)
@pytest.mark.rng("a smooth curve is no row of draws")
def test_a_smooth_curve_is_no_row_of_draws(rng: np.random.Generator, shape: np.ndarray) -> None:
    covariance = 1e-6 * np.eye(len(PLACE))
    error = 0.3 * shape + 0.003 * rng.standard_normal(len(PLACE))
    assert trend_channel("draws", WAVELENGTHS, error, covariance).probability < 1e-4


@pytest.mark.rng("a trend that is not known does not count")
def test_a_trend_that_is_not_known_does_not_count(rng: np.random.Generator) -> None:
    """Another effect of the same set may have any part of it."""
    trend = np.outer(PLACE, PLACE)
    error = 0.3 * PLACE + 0.02 * rng.standard_normal(len(PLACE))
    known, unknown = (
        trend_channel("draws", WAVELENGTHS, error, 1e-6 * np.eye(12) + part * trend) for part in (0, 1)
    )
    assert known.probability < 1e-4
    assert unknown.probability > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [True, False], ids=["wave", "draws"])
def test_a_wave_in_wavelength_is_unexplained_and_draws_are_named(smooth: bool) -> None:
    """Screws of a grating turn the one way; a grating that does not come back, the other."""
    rng = np.random.default_rng(5)
    phase = np.sin(2.0 * np.pi * (WAVELENGTHS - 880.0) / 110.0)
    error = 0.4 * (phase if smooth else rng.permutation(phase))
    thickness = random_field((48, 64), rng, mean=14.0, span=1.5)
    flats = relative_flats(thickness, FringeModel.from_setup("ts8_e2v"), rng, wavelengths=WAVELENGTHS + error)
    cube = replace(flats, exposures=replace(flats.exposures, wavelength_nm=WAVELENGTHS))
    verdict = discover(cube, "ts8_e2v", CATALOGUE, rng=rng)
    assert (verdict.verdict, [effect.name for effect in verdict.effects]) == (
        ("unexplained", []) if smooth else ("named", ["wavelength_jitter"])
    )
