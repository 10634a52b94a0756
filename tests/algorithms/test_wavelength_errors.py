"""Wavelengths that are off their labels: the common error, to which only the labels testify."""

import numpy as np
import pytest
from laboratory_flats import TEN_NM

from lsst.fringe_sim.algorithms.thickness_fit.wavelengths import common_error

ALONG = TEN_NM / TEN_NM.mean()
DRAWS = 300


def relative(offsets_nm: np.ndarray) -> tuple[np.ndarray, float]:
    """Offsets as flats show them, without their common error, and that error."""
    common = float(offsets_nm @ ALONG / (ALONG @ ALONG))
    return offsets_nm - common * ALONG, common


@pytest.mark.parametrize("width", [0.1, 0.3, 0.6])
@pytest.mark.rng("the common error of the wavelengths is as large as stated")
def test_the_common_error_is_as_large_as_stated(width: float, rng: np.random.Generator) -> None:
    pulls = []
    for _ in range(DRAWS):
        shift, truth = relative(width * rng.standard_normal(TEN_NM.size))
        found = common_error(shift, ALONG, 0.5)
        pulls.append((found.mean_nm - truth) / found.sigma_nm)
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.2)


@pytest.mark.rng("one wavelength that is far off does not move the others")
def test_one_wavelength_that_is_far_off_does_not_move_the_others(rng: np.random.Generator) -> None:
    offsets = 0.02 * rng.standard_normal(TEN_NM.size)
    offsets[4] = 2.0
    shift, truth = relative(offsets)
    found = common_error(shift, ALONG, 0.5)
    assert found.mean_nm == pytest.approx(truth, abs=0.05)
    assert found.sigma_nm < 0.05


@pytest.mark.rng("a move of all wavelengths is found again")
def test_a_move_of_all_wavelengths_changes_nothing_but_the_mean(rng: np.random.Generator) -> None:
    shift, _ = relative(0.3 * rng.standard_normal(TEN_NM.size))
    here, there = common_error(shift, ALONG, 0.5), common_error(shift + 3.0 * ALONG, ALONG, 0.5)
    assert there.mean_nm == pytest.approx(here.mean_nm - 3.0, abs=0.01)
    assert there.sigma_nm == pytest.approx(here.sigma_nm, rel=0.05)
    assert there.cost == pytest.approx(here.cost, abs=0.1)
