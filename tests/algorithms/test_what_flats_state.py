"""What headers of flats state beside the set-up: where it is believed, taken to be the same, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.cost_model import PIXELS, FocalPlaneCost
from lsst.fringe_sim.algorithms.flat_conditions import FARTHEST_K, SAME_K, model_of_flats
from lsst.fringe_sim.algorithms.image_correlation import LogBins
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures

WAVELENGTHS = np.array([880.0, 930.0, 990.0])
A_BIT = 1e-6


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


def flats(width_nm: object = 2.0, temperature_k: object = 183.15, **more: object) -> FlatExposures:
    return FlatExposures(WAVELENGTHS, np.array(width_nm), np.array(temperature_k), **more)  # type: ignore[arg-type]


def test_flats_that_state_what_the_set_up_does_have_its_model(model: FringeModel) -> None:
    width, kelvin = model.setup.bandwidth_fwhm_nm, model.base_system.temperature_k
    for one in (
        flats(width, kelvin),
        flats(1.019 * width, kelvin + 0.99 * SAME_K),
        flats([0.0, 0.0, 0.0], kelvin - 0.99 * SAME_K),
        flats([width, 1.01 * width, 1.05 * width], kelvin),  # not one line
    ):
        assert model_of_flats(model, one) is model


def test_another_line_and_another_temperature_are_believed(model: FringeModel) -> None:
    width, kelvin = model.setup.bandwidth_fwhm_nm, model.base_system.temperature_k
    found = model_of_flats(model, flats([0.0, 1.021 * width, 1.031 * width], kelvin + 1.01 * SAME_K))
    assert found.setup.bandwidth_fwhm_nm == pytest.approx(1.026 * width)
    assert found.base_system.temperature_k == pytest.approx(kelvin + 1.01 * SAME_K)
    # The profile is that of the line: fringes are weaker by what another model with it has.
    other = FringeModel.from_setup("ts8_e2v", {"bandwidth.fwhm": 1.026 * width})
    at = (np.array([14.0, 14.1]), WAVELENGTHS)
    still = replace(found, base_system=replace(found.base_system, temperature_k=kelvin))
    np.testing.assert_allclose(still.response(*at), other.response(*at), rtol=1e-9)
    middle = model_of_flats(model, flats(width, [kelvin + 1.0, kelvin + 2.0, kelvin + 5.9]))
    assert middle.base_system.temperature_k == pytest.approx(kelvin + 2.0)


def test_a_model_of_single_wavelengths_takes_no_line_from_flats(model: FringeModel) -> None:
    sharp = replace(model, setup=replace(model.setup, bandwidth_fwhm_nm=0.0))
    assert model_of_flats(sharp, flats(2.0)) is sharp


def test_an_effect_wins_over_the_headers() -> None:
    chosen = FringeModel.from_setup("ts8_e2v", {"bandwidth.fwhm": 3.0, "temperature.kelvin": 180.0})
    assert model_of_flats(chosen, flats(1.5, 190.0)) is chosen


def test_what_no_flats_of_one_series_have_is_refused(model: FringeModel) -> None:
    width, kelvin = model.setup.bandwidth_fwhm_nm, model.base_system.temperature_k
    apart = FARTHEST_K - A_BIT
    assert model_of_flats(model, flats(width, [kelvin, kelvin, kelvin + apart])) is model
    with pytest.raises(InputError, match="temperature of the flats"):
        model_of_flats(model, flats(width, [kelvin, kelvin, kelvin + FARTHEST_K + 1e-3]))
    assert model_of_flats(model, flats((5.0 - A_BIT) * width)).setup.bandwidth_fwhm_nm > width
    with pytest.raises(OutOfRangeError, match="bandwidth"):
        model_of_flats(model, flats([0.0, width, (5.0 + A_BIT) * width]))
    with pytest.raises(OutOfRangeError, match="temperature of the flats"):
        model_of_flats(model, flats(width, 5.0))


def test_bins_of_separation_are_one_or_more() -> None:
    one = LogBins(2.0, 32.0, 1)
    np.testing.assert_allclose(one.edges_px, [2.0, 32.0])
    assert one.size == pytest.approx(np.log(16.0))
    assert LogBins(2.0, 32.0, 4).size == pytest.approx(np.log(2.0))
    np.testing.assert_allclose(LogBins(2.0, 32.0, 4).edges_px, [2.0, 4.0, 8.0, 16.0, 32.0])
    with pytest.raises(OutOfRangeError, match="number of bins"):
        LogBins(2.0, 32.0, 0)
    for limits in ((0.0, 2.0), (2.0, 2.0), (3.0, 2.0), (2.0, np.inf)):
        with pytest.raises(OutOfRangeError, match="separations"):
            LogBins(*limits)


def test_a_forecast_of_the_focal_plane_costs_what_its_products_hold() -> None:
    """Images of four bytes a pixel: two of a frame, three of the templates, four of the mean and its components."""
    cost = FocalPlaneCost(sensors=5, exposures=7)
    assert cost.disk_bytes == 5 * 4 * PIXELS * (7 * 2 + 3 + 4)
    assert cost.frame_bytes == 4 * PIXELS * 2
    assert cost.quanta == 5 * 7 + 5 + 5 + 1
    assert cost.jobs == 5 + 5 + 1
    more = FocalPlaneCost(sensors=5, exposures=8), FocalPlaneCost(sensors=6, exposures=7)
    assert more[0].sensor_night_s > cost.sensor_night_s
    assert more[0].pipeline_s - cost.pipeline_s > 5 * (more[0].sensor_night_s - cost.sensor_night_s)
    assert more[1].pipeline_s == pytest.approx(6.0 / 5.0 * cost.pipeline_s)
    assert more[1].sampled_s > cost.sampled_s == more[0].sampled_s
    assert cost.pipeline_s > cost.sampled_s
