"""Frames with the beam of every pixel, against models that trace that beam themselves."""

from dataclasses import replace

import numpy as np
import pytest
from sky_frames import bright_sky
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.angular_response import of_other_silicon
from lsst.fringe_sim.algorithms.field_response import (
    SensorPlacement,
    SensorResponse,
    angular_response,
    beam_field,
    beam_limits,
    field_response,
    sensor_response,
)
from lsst.fringe_sim.algorithms.fringe_amplitudes import fringe_amplitudes
from lsst.fringe_sim.algorithms.sky_frame import SkyQuadrature, SkyResponse, simulate_sky_frame, sky_response
from lsst.fringe_sim.algorithms.sky_response import white_light
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.telescope import reduce_beam, telescope_beam
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import Illumination
from lsst.fringe_sim.products import SensorSection

RANGE = (15.0, 17.0)
SCALE = 0.2


@pytest.fixture(scope="module")
def angular():
    beams = beam_field("LSST")
    assert beams is not None
    model = FringeModel.from_setup("lsst_e2v")
    return angular_response(model, bright_sky(), beam_limits(beams), thickness_range_um=RANGE)


def on_sensor(angular, name: str) -> SensorResponse:
    placement = SensorPlacement.of(Camera.from_name("lsstCam").detector(name), SCALE)
    return field_response(angular, beam_field("LSST"), placement.radius_range_deg).on(placement)


@pytest.mark.parametrize("x", [(100, 299), (299, 100)])
def test_a_part_of_a_sensor_has_its_own_place(x) -> None:
    """Also one whose columns are counted from the other side, on a sensor that is turned."""
    detector = replace(Camera.from_name("lsstCam").detector("R14_S02"), yaw_deg=90.0)
    part = SensorPlacement.of(detector, SCALE, SensorSection(detector, x, (3000, 3399)))
    whole = SensorPlacement.of(detector, SCALE)
    columns = np.arange(100, 300)[:: 1 if x[0] < x[1] else -1]
    expected = whole.radius_at_deg(detector.shape, np.arange(3000, 3400), columns)
    np.testing.assert_allclose(part.radius_deg((400, 200)), expected, rtol=1e-10)
    assert part.radius_range_deg == pytest.approx((expected.min(), expected.max()), abs=1e-4)


@pytest.mark.parametrize("name", first_is_quick(["R14_S02", "R22_S11", "R11_S01"]))
def test_every_pixel_has_its_own_beam(angular, name):
    """Within 0.5 % of peak-to-peak of a model with the traced beam of that place, over all thicknesses."""
    sensor = on_sensor(angular, name)
    shape = (200, 1)  # a thickness per row, so that the whole range is seen at nearly one place
    points = np.linspace(*RANGE, shape[0])
    place = sensor.placement
    edge = place.field_x_deg + 0.45 * place.width_deg, place.field_y_deg + 0.3 * place.height_deg
    at_edge = SensorPlacement(*edge, 1e-7, 1e-7)
    frame = SensorResponse(sensor.field, at_edge).sky().frame(points[:, None])[:, 0].astype(float)
    model = FringeModel.from_setup("lsst_e2v")
    # More angles than usual: here the reference must not be the one that errs.
    finer = SkyQuadrature(continuum_angles=128)
    beam = telescope_beam("LSST", *edge, nodes=192)
    model = replace(model, base_system=replace(model.base_system, beam=beam))
    traced = sky_response(model, bright_sky(), thickness_range_um=RANGE, quadrature=finer)
    white = white_light(Bandpass.from_name("lsst_y"), 0.2)
    flat = model.respond(
        Illumination.spectrum(white.wavelength_nm, white.photons, reduce_beam(beam, 128)), points
    )
    exact = traced.sky().lookup(points)[0] / flat[0]
    difference = frame / frame.mean() - exact / exact.mean()
    assert np.abs(difference).max() < 0.005 * np.ptp(exact / exact.mean())


@pytest.mark.parametrize(("name", "least"), [("R22_S11", 0.15), ("R14_S02", 0.15)])
def test_one_beam_for_the_whole_sensor_is_wrong(angular, name, least):
    sensor = on_sensor(angular, name)
    shape = (64, 64)
    thickness = np.random.default_rng(3).uniform(*RANGE, shape)
    varying = sensor.sky().frame(thickness)
    centre = SensorPlacement(sensor.placement.field_x_deg, sensor.placement.field_y_deg, 1e-7, 1e-7)
    fixed = SensorResponse(sensor.field, centre).sky().frame(thickness)
    difference = varying / varying.mean() - fixed / fixed.mean()
    assert np.abs(difference).max() > least * np.ptp(fixed / fixed.mean())


def test_one_beam_gives_an_ordinary_response(angular):
    rays, _ = beam_field("LSST").sin_squared_at(1.0)
    ours = angular.response(rays)
    model = FringeModel.from_setup("lsst_e2v", field_x_deg=1.0)
    theirs = sky_response(model, bright_sky(), thickness_range_um=RANGE)
    points = np.linspace(*RANGE, 57)
    assert ours.component == theirs.component
    one, two = ours.sky().lookup(points)[0], theirs.sky().lookup(points)[0]
    stated = (ours.quadrature_error + theirs.quadrature_error) * two.mean()
    assert np.abs(one - two).max() < stated + 2 * theirs.sky().interpolation_error
    assert ours.quadrature_error < 5e-5


@pytest.mark.slow
def test_too_few_angles_are_confessed():
    model = FringeModel.from_setup("lsst_e2v")
    limits = beam_limits(beam_field("LSST"))
    coarse = angular_response(model, bright_sky(8), limits, thickness_range_um=RANGE, angles=48)
    fine = angular_response(model, bright_sky(8), limits, thickness_range_um=RANGE)
    rays, _ = beam_field("LSST").sin_squared_at(0.3)
    points = np.linspace(*RANGE, 41)
    one, two = (each.response(rays) for each in (coarse, fine))
    error = np.abs(one.sky().lookup(points) - two.sky().lookup(points)).max() / two.level
    assert 3e-4 < error < coarse.quadrature_error
    assert fine.quadrature_error < 5e-5


@pytest.mark.rng("weights of any beam sum to one")
def test_weights_of_any_beam_sum_to_one(angular, rng):
    low, high = angular.limits
    for rays in (np.array([0.1]), rng.uniform(low, high, 500), beam_field("LSST").sin_squared_at(1.9)[0]):
        assert angular.weights(rays).sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.rng("components add up to the sky")
def test_components_add_up_to_the_sky(angular, rng):
    sensor = on_sensor(angular, "R11_S01")
    thickness = rng.uniform(*RANGE, (20, 30))
    parts = sum(table.frame(thickness) for table in sensor.component_tables())
    np.testing.assert_allclose(parts, sensor.sky().frame(thickness), rtol=2e-6)


def test_a_frame_does_not_depend_on_how_finely_the_sensor_is_sampled(angular):
    """The same places of the sensor, as pixels of a fine and of a coarse map."""
    sensor = on_sensor(angular, "R14_S02")
    fine = np.full((99, 99), 16.1)
    coarse = fine[1::3, 1::3]
    np.testing.assert_allclose(sensor.sky().frame(fine)[1::3, 1::3], sensor.sky().frame(coarse), rtol=1e-6)


def test_silicon_of_another_thickness_is_seen_on_the_same_grids():
    """By the same numbers as if it had been calculated alone, but for continua between two that are known."""
    layer, place, few = (15.0, 15.3), (0.03, 0.09), 24
    thick = [f"silicon_thickness.offset={offset}" for offset in (0.0, 0.01, 0.02)]
    models = [
        FringeModel.from_setup("lsst_e2v", {name: float(value)})
        for name, value in (one.split("=") for one in thick)
    ]
    first, middle, last = (angular_response(one, bright_sky(2), place, layer, few) for one in models)
    assert last.silicon_um - first.silicon_um == pytest.approx(0.02, rel=1e-9)
    again = of_other_silicon(first, models[1], bright_sky(2))
    between = of_other_silicon(
        first, models[1], bright_sky(2), of_other_silicon(first, models[2], bright_sky(2))
    )
    for found in (again, between):
        assert found.silicon_um == middle.silicon_um
        assert found.component == middle.component
        np.testing.assert_allclose(found.values, middle.values, rtol=1e-4)
        np.testing.assert_allclose(found.flat, middle.flat, rtol=1e-4)
    lines = slice(first.n_lines)
    assert np.abs(first.values / middle.values - 1.0)[lines].max() > 1e-3
    assert np.abs(between.values - again.values)[lines].max() == 0.0


@pytest.mark.slow
def test_a_flat_field_takes_the_thickness_of_silicon_out():
    """Thicker silicon absorbs more of the y band; behind a black coating that is all that a raw frame shows."""
    model = FringeModel.from_setup("lsst_itl", field_x_deg=1.2)
    span = (99.5, 100.5)
    placement = SensorPlacement(1.2, 0.0, 1e-3, 1e-3)
    thickness = np.linspace(*span, 400)[:, None]
    flat_fielded = fringe_amplitudes(
        sensor_response(model, bright_sky(6), placement, span).sky().frame(thickness)
    )
    raw = fringe_amplitudes(
        sky_response(model, bright_sky(6), thickness_range_um=span).sky().frame(thickness)
    )
    assert flat_fielded.rms < 0.3 * raw.rms


def test_placement_of_a_turned_sensor():
    straight = SensorPlacement(0.5, -0.2, 0.2, 0.1)
    turned = SensorPlacement(0.5, -0.2, 0.1, 0.2, 90.0)
    corners = np.sort(straight.radius_deg((101, 201))[[0, 0, -1, -1], [0, -1, 0, -1]])
    np.testing.assert_allclose(
        np.sort(turned.radius_deg((201, 101))[[0, 0, -1, -1], [0, -1, 0, -1]]), corners
    )
    for place in (straight, turned):
        radius = place.radius_deg((400, 400))
        low, high = place.radius_range_deg
        assert low <= radius.min() < low + 1e-3
        assert high - 1e-3 < radius.max() <= high


@pytest.mark.slow
@pytest.mark.rng("sky frames take either response")
def test_sky_frames_take_either_response(angular, rng):
    sensor = on_sensor(angular, "R22_S11")
    thickness = rng.uniform(*RANGE, (24, 32))
    thickness[2, 3] = np.nan
    model = FringeModel.from_setup("lsst_e2v")
    frame = simulate_sky_frame(thickness, model, response=sensor, mean_electrons=2700.0, seed=4)
    assert frame.mask[2, 3] != 0
    assert np.isfinite(frame.image).all()
    assert frame.quadrature_error == sensor.quadrature_error


@pytest.mark.slow
def test_a_cone_has_one_beam():
    placement = SensorPlacement(0.0, 0.0, 0.4, 0.4)
    for setup, layer in (("monocam", RANGE), ("hsc", (199.9, 200.1))):
        model = FringeModel.from_setup(setup)
        found = sensor_response(model, bright_sky(2), placement, layer)
        assert isinstance(found, SkyResponse)


def test_what_is_refused(angular):
    beams = beam_field("LSST")
    with pytest.raises(OutOfRangeError, match="field radii"):
        field_response(angular, beams, (2.5, 2.6))
    part = field_response(angular, beams, (0.9, 1.1))
    with pytest.raises(OutOfRangeError, match="field radius"):
        part.on(SensorPlacement(0.0, 0.0, 0.2, 0.2))
    sensor = part.on(SensorPlacement(1.0, 0.0, 0.1, 0.1))
    with pytest.raises(OutOfRangeError, match="thickness"):
        sensor.sky().frame(np.full((3, 3), 30.0))
    with pytest.raises(InputError, match="two axes"):
        sensor.sky().frame(np.full(3, 16.0))
    tilted = FringeModel.from_setup("lsst_e2v", {"tilt.angle": 2.0})
    with pytest.raises(InputError, match="none that changes the beam"):
        angular_response(tilted, bright_sky(4), beam_limits(beams), thickness_range_um=RANGE)
    for limits in ((0.0, 1.0), (0.1, 0.1), (-0.01, 0.1)):
        with pytest.raises(OutOfRangeError, match="limits of sin² of the angle"):
            angular_response(
                FringeModel.from_setup("lsst_e2v"), bright_sky(4), limits, thickness_range_um=RANGE
            )
