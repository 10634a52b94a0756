"""Variation through a night and over the field."""

import numpy as np
import pytest

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.night import AirglowField, NightHistory, StochasticNight
from lsst.fringe_sim.instrument.sky import EmissionLines
from lsst.fringe_sim.resources import read_table

BANDS = EmissionLines.oh().bands


def test_night_of_the_paper():
    night = NightHistory.guo2022()
    table = read_table("sky", "oh_temporal_guo2022_noll2015.ecsv")
    assert len(night) == 11
    for hour in range(11):
        scale = night.band_scale(hour, BANDS)
        for band in ("3-0", "4-1", "5-2", "8-4", "9-5"):
            assert scale[band] == table[f"I_{band.replace('-', '_')}"][hour]
        # the same upper level varies alike
        assert scale["5-1"] == scale["5-2"]
        assert scale["4-0"] == scale["4-1"]
        # v' = 7 lies two thirds of the way from 5 to 8
        assert scale["7-3"] == pytest.approx(scale["5-2"] / 3 + 2 * scale["8-4"] / 3)


@pytest.mark.rng("stochastic nights have the statistics they promise")
def test_stochastic_nights_have_the_statistics_they_promise(rng):
    process = StochasticNight()
    hours = np.linspace(0, 10, 11)
    log = np.log([process.draw(hours, rng).intensity for _ in range(3000)])  # (nights, times, levels)
    middle = log[:, :, 3]
    assert middle.std() == pytest.approx(np.sqrt(0.23**2 + 0.21**2 + 0.01**2), rel=0.05)
    assert np.exp(log).mean() == pytest.approx(1.0, abs=0.02)
    slope = np.polyfit(np.arange(3, 10), log.reshape(-1, 7).T, 1)[0]
    assert slope.std() == pytest.approx(np.hypot(0.03, 0.01 / np.sqrt(28)), rel=0.05)
    # within a night the autocorrelation of the tilt falls as exp(-t / 1.5 h)
    slope = slope.reshape(3000, 11)
    for lag in (1, 2, 4):
        measured = np.mean(slope[:, lag:] * slope[:, :-lag]) / np.mean(slope**2)
        assert measured == pytest.approx(np.exp(-lag / 1.5), abs=0.05)


def test_stochastic_night_is_repeatable_and_seeded():
    hours = np.arange(5.0)
    draw = [StochasticNight().draw(hours, np.random.default_rng(seed)).intensity for seed in (1, 1, 2)]
    np.testing.assert_array_equal(draw[0], draw[1])
    assert not np.array_equal(draw[0], draw[2])


@pytest.mark.rng("constant night when nothing varies")
def test_constant_night_when_nothing_varies(rng):
    night = StochasticNight(0.0, 0.0, 0.0, 0.0).draw([0.0, 3.0], rng)
    np.testing.assert_array_equal(night.intensity, 1.0)


def test_airglow_over_the_field():
    field = AirglowField.imsim()
    assert field.at(0.0, 0.0) == pytest.approx(1.0, abs=0.01)
    assert 0.97 < field.level.min() < field.level.max() < 1.98
    table = read_table("sky", "oh_spatial_variation_imsim.ecsv")
    np.testing.assert_allclose(field.at(table["dx"][::50], table["dy"][::50]), table["level"][::50])
    assert field.at(np.zeros((3, 1)), np.linspace(-1, 1, 4)).shape == (3, 4)


def test_linear_gradient():
    field = AirglowField.gradient(0.1, 90.0)
    assert field.at(1.3, 0.5) == pytest.approx(1.05)
    assert field.at(-1.0, -2.0) == pytest.approx(0.8)


@pytest.mark.rng("bad input is named")
def test_bad_input_is_named(rng):
    night = NightHistory.guo2022()
    with pytest.raises(OutOfRangeError, match="index of the time"):
        night.band_scale(11, BANDS)
    with pytest.raises(InputError, match="a name like 8-4"):
        night.band_scale(0, ["eight"])
    with pytest.raises(OutOfRangeError, match="correlation time"):
        StochasticNight(correlation_h=0.0)
    with pytest.raises(OutOfRangeError, match="tilt_sigma"):
        StochasticNight(tilt_sigma=-1.0)
    with pytest.raises(InputError, match="ascending"):
        StochasticNight().draw([1.0, 0.0], rng)
    with pytest.raises(OutOfRangeError, match="field angle"):
        AirglowField.imsim().at(3.0, 0.0)
    with pytest.raises(OutOfRangeError, match="gradient"):
        AirglowField.gradient(1.0)
    with pytest.raises(InputError, match="times, levels"):
        NightHistory(np.zeros(2), np.zeros(3), np.zeros((3, 2)))
