"""Forecasts from moments of patterns, against frames that are really made and corrected."""

import numpy as np
import pytest
from recorded_numbers import Record
from residual_fringe import residual_fringe
from sky_frames import bright_sky

from lsst.fringe_sim.algorithms.field_response import (
    SensorPlacement,
    angular_response,
    beam_field,
    beam_limits,
    field_response,
)
from lsst.fringe_sim.algorithms.focal_plane import (
    ForecastOptions,
    SkyLevel,
    correction_residuals,
    forecast_sensor,
    pattern_moments,
    summary_table,
)
from lsst.fringe_sim.algorithms.pca import fit_pca, fringe_templates, project
from lsst.fringe_sim.algorithms.sky_frame import simulate_night, simulate_sky_frame
from lsst.fringe_sim.algorithms.thickness_stand_in import stand_in_thickness
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.night import NightHistory, StochasticNight
from lsst.fringe_sim.model import FringeModel

DETECTOR = Camera.from_name("lsstCam").detector("R22_S12")
PLACE = SensorPlacement.of(DETECTOR, 0.2)
OPTIONS = ForecastOptions(cells=4)
SHAPE = (801, 820)  # One pixel per arcsecond


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("lsst_e2v", field_x_deg=PLACE.field_x_deg, field_y_deg=PLACE.field_y_deg)


@pytest.fixture(scope="module")
def thickness(model) -> np.ndarray:
    return stand_in_thickness(model.setup, DETECTOR, shape=SHAPE).value


@pytest.fixture(scope="module")
def response(model, thickness):
    beams = beam_field("LSST")
    span = float(thickness.min()) - 0.01, float(thickness.max()) + 0.01
    angular = angular_response(model, bright_sky(40, 1.0), beam_limits(beams), thickness_range_um=span)
    return field_response(angular, beams, PLACE.radius_range_deg).on(PLACE)


@pytest.fixture(scope="module")
def moments(thickness, response):
    return pattern_moments(thickness, response, OPTIONS)


@pytest.fixture(scope="module")
def level(model) -> SkyLevel:
    return SkyLevel.of(bright_sky(40, 1.0), model, DETECTOR.read_noise)


@pytest.fixture(scope="module")
def observed() -> NightHistory:
    return StochasticNight().draw(np.arange(0.0, 10.0, 2.0), np.random.default_rng(12))


def test_rms_is_that_of_a_frame(moments, thickness, model, response):
    frame = simulate_sky_frame(thickness, model, response=response)
    ones = np.ones((1, moments.share.size))
    assert moments.rms(ones, ones)[0, 0] == pytest.approx(frame.metadata["FRINGRMS"], rel=1e-3)
    assert moments.amplitudes.rms == pytest.approx(frame.metadata["FRINGRMS"], rel=1e-4)
    assert moments.share.sum() == pytest.approx(1.0)


def test_apertures_average(moments, thickness, model, response):
    """Rms after averaging over squares of 20 arcsec, from the frame itself."""
    frame = simulate_sky_frame(thickness, model, response=response).fraction()
    blocks = frame[:800, :820].reshape(40, 20, 41, 20).mean(axis=(1, 3))
    ones = np.ones((1, moments.share.size))
    found = moments.rms(ones, ones)[moments.apertures_arcsec.index(20.0), 0]
    assert found == pytest.approx(blocks.std(), rel=0.02)


def test_residuals_are_those_of_real_templates(moments, thickness, model, response, observed):
    """The night of the paper makes the templates; another night is corrected with them."""
    training = NightHistory.guo2022()
    frames = list(simulate_night(thickness, model, response, training))
    templates = fringe_templates(fit_pca(frames, n_components=5), "2026-01-01T00:00:00", least_rms=1e-9)
    factors = [
        np.stack([response.factors(night.band_scale(time, response.bands)) for time in range(len(night))])
        for night in (training, observed)
    ]
    predicted = correction_residuals(moments, *factors, 2)
    for count in (1, 2):
        basis = np.stack([template.image for template in templates[:count]])
        for number, frame in enumerate(simulate_night(thickness, model, response, observed)):
            fit = project(frame.image, basis, variance=1.0)
            left = frame.image - fit.background - np.tensordot(fit.coefficient, basis, axes=1)
            expected = moments.rms(predicted[count - 1], factors[1])[0, number]
            assert expected == pytest.approx(left.std() / frame.mean_electrons, rel=0.05)


def test_a_night_not_used_for_training_meets_the_criterion(thickness, response, level, observed):
    """The residual of two templates stays below a tenth of the shot noise at 20 arcsec; that of one does not."""
    forecast = forecast_sensor(
        thickness, response, DETECTOR, level, NightHistory.guo2022(), observed, options=OPTIONS
    )
    assert forecast.over_noise[-1] > 1.0
    assert forecast.residual_over_noise[0].max() > 0.1
    assert forecast.residual_over_noise[1].max() < 0.1
    assert forecast.templates_needed == 2
    row = forecast.summary()
    assert row["templates_needed"] == 2
    assert row["rms_brightness"] == pytest.approx(1e-2 * row["rms"] * level.microjansky)


def test_noise_is_that_of_the_correction_check(level):
    ones = np.ones(level.electrons.size)
    sky = float(level.electrons.sum())
    image = np.random.default_rng(1).normal(size=(200, 200))
    expected = residual_fringe(image, sky, 100, read_noise_e=level.read_noise_e).shot_noise
    assert level.noise(ones, 20.0) == pytest.approx(expected, rel=1e-9)


def test_cells_cover_the_sensor(thickness, response, level, observed):
    hole = thickness.copy()
    hole[:260, :260] = np.nan
    forecast = forecast_sensor(
        hole, response, DETECTOR, level, NightHistory.guo2022(), observed, stand_in=True, options=OPTIONS
    )
    assert np.isnan(forecast.cell_rms[0, 0])
    assert np.isfinite(forecast.cell_rms[1:, 1:]).all()
    table = forecast.to_table()
    assert len(table) == 16
    assert table["x"].unit == "mm"
    assert table["x"].mean() == pytest.approx(DETECTOR.x_mm)
    assert np.ptp(table["y"]) == pytest.approx(40.04 * 0.75, rel=1e-3)
    assert table.meta["stand_in"] is True
    whole = summary_table([table.meta, forecast.summary()])
    assert len(whole) == 2
    assert whole["sky"].unit == "electron"


def test_what_is_refused(thickness, response, level, observed):
    with pytest.raises(InputError, match="at most 1 arcsec"):
        pattern_moments(thickness[:60, :60], response, OPTIONS)
    with pytest.raises(InputError, match="some finite values"):
        pattern_moments(np.full(SHAPE, np.nan), response, OPTIONS)
    with pytest.raises(OutOfRangeError, match="apertures"):
        ForecastOptions(apertures_arcsec=(0.5,))
    with pytest.raises(OutOfRangeError, match="cells"):
        ForecastOptions(cells=0)
    with pytest.raises(InputError, match="sensors"):
        summary_table([])
    wrong = SkyLevel(level.electrons[:2], 5.0, 0.2, 100.0)
    with pytest.raises(InputError, match="components of the level"):
        forecast_sensor(thickness, response, DETECTOR, wrong, NightHistory.guo2022(), observed)


def test_moments_and_level_are_as_recorded(moments, level, response, observed, recorded: Record) -> None:
    """A record, beside the frames that the tests above compare with."""
    recorded({"moments": moments, "level": level, "response": response, "night": observed})
