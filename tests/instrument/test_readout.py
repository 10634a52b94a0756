"""Photometric units."""

import numpy as np
import pytest

from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.readout import (
    electrons_to_microjansky,
    magnitude_to_microjansky,
    microjansky_to_magnitude,
    zero_point,
)
from lsst.fringe_sim.resources import read_table


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
    bright = electrons_to_microjansky(2717.0, zero, 30.0, 0.2)
    assert bright == pytest.approx(131.8, rel=0.01)
    assert microjansky_to_magnitude(bright) == pytest.approx(18.60, abs=0.01)
    assert magnitude_to_microjansky(18.60) == pytest.approx(131.8, rel=0.001)
    # 10 % at 26 AB
    assert 0.1 * magnitude_to_microjansky(26.0) == pytest.approx(0.0145, abs=1e-4)


@pytest.mark.rng("units are inverse to each other")
def test_units_are_inverse_to_each_other(rng):
    flux = rng.uniform(0.1, 1e4, 50)
    np.testing.assert_allclose(magnitude_to_microjansky(microjansky_to_magnitude(flux)), flux)
    assert np.isnan(microjansky_to_magnitude(0.0))
