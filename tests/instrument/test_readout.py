"""Noise statistics and photometric units."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.readout import (
    add_photon_noise,
    add_readout,
    electrons_to_magnitude,
    electrons_to_microjansky,
    magnitude_to_microjansky,
    microjansky_to_magnitude,
    zero_point,
)
from lsst.fringe_sim.resources import read_table


@pytest.mark.parametrize("mean", [0.0, 0.7, 30.0, 2717.0])
@pytest.mark.rng("photon noise is poisson")
def test_photon_noise_is_poisson(mean, rng):
    noisy = add_photon_noise(np.full((300, 300), mean), rng)
    assert np.array_equal(noisy, np.round(noisy))
    if mean == 0.0:
        assert not noisy.any()
        return
    values, counts = np.unique(noisy, return_counts=True)
    expected = noisy.size * stats.poisson.pmf(values, mean)
    common = expected > 20
    chi2 = np.sum((counts[common] - expected[common]) ** 2 / expected[common])
    assert stats.chi2.sf(chi2, common.sum() - 1) > 1e-4


@pytest.mark.rng("readout has the variance of photons and amplifier")
def test_readout_has_the_variance_of_photons_and_amplifier(rng):
    gain, read_noise, level = 1.7, 8.0, 500.0
    adu = add_readout(np.full((400, 400), level), rng, read_noise, gain)
    assert adu.mean() * gain == pytest.approx(level, abs=5 * np.sqrt(level + 64) / 400)
    assert adu.var() * gain**2 == pytest.approx(level + read_noise**2, rel=5 * np.sqrt(2 / adu.size))


@pytest.mark.rng("no light leaves the read noise")
def test_no_light_leaves_the_read_noise(rng):
    adu = add_readout(np.zeros((200, 200)), rng, 5.0, 2.0)
    assert stats.kstest(adu.ravel() * 2.0 / 5.0, "norm").pvalue > 1e-4


def test_noise_is_repeatable_and_leaves_its_input_alone():
    image = np.full((20, 30), 100.0)
    one, two, three = (add_readout(image, np.random.default_rng(seed), 5.0, 1.0) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, three)
    assert np.all(image == 100.0)


def test_zero_points_of_the_standard_throughput():
    facts = {
        (row["system"], row["quantity"]): row["value"]
        for row in read_table("instrument", "telescope_facts.ecsv")
    }
    band = Bandpass.from_name("lsst_y")
    assert zero_point(band, 32.40) == pytest.approx(facts["LSST", "zp_y_v19_hardware"], abs=2e-3)
    assert zero_point(band, 32.40, 1.2) == pytest.approx(facts["LSST", "zp_y_v19_x12"], abs=5e-3)


def test_dark_sky_in_all_units():
    # 18.60 mag arcsec-2 = 131.8 µJy arcsec-2 = 2717 e- per pixel in 30 s
    zero = zero_point(Bandpass.from_name("lsst_y"), 32.40)
    assert electrons_to_magnitude(2717.0, zero, 30.0, 0.2) == pytest.approx(18.60, abs=0.01)
    assert electrons_to_microjansky(2717.0, zero, 30.0, 0.2) == pytest.approx(131.8, rel=0.01)
    assert magnitude_to_microjansky(18.60) == pytest.approx(131.8, rel=0.001)
    # 10 % at 26 AB
    assert 0.1 * magnitude_to_microjansky(26.0) == pytest.approx(0.0145, abs=1e-4)


@pytest.mark.rng("units are inverse to each other")
def test_units_are_inverse_to_each_other(rng):
    flux = rng.uniform(0.1, 1e4, 50)
    np.testing.assert_allclose(magnitude_to_microjansky(microjansky_to_magnitude(flux)), flux)
    electrons = rng.uniform(1, 1e4, 50)
    np.testing.assert_allclose(
        electrons_to_microjansky(electrons, 27.0, 30.0, 0.2),
        magnitude_to_microjansky(electrons_to_magnitude(electrons, 27.0, 30.0, 0.2)),
    )
    assert np.isnan(electrons_to_magnitude([-1.0, 0.0], 27.0, 30.0, 0.2)).all()
    assert np.isnan(microjansky_to_magnitude(0.0))


@pytest.mark.rng("bad input is named")
def test_bad_input_is_named(rng):
    with pytest.raises(InputError, match="expected electrons"):
        add_photon_noise(np.array([[1.0, np.nan]]), rng)
    with pytest.raises(InputError, match="expected electrons"):
        add_readout(np.array([[1.0, -1.0]]), rng, 1.0, 1.0)
    with pytest.raises(InputError, match="two axes"):
        add_photon_noise(np.ones((2, 2, 2)), rng)
    with pytest.raises(OutOfRangeError, match="gain"):
        add_readout(np.ones((2, 2)), rng, 1.0, 0.0)
    with pytest.raises(OutOfRangeError, match="read noise"):
        add_readout(np.ones((2, 2)), rng, -1.0, 1.0)
