"""Random fields in place of thickness maps that nobody has measured."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.thickness_stand_in import ThicknessField, stand_in_thickness
from lsst.fringe_sim.errors import OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.model import Setup

CAMERA = Camera.from_name("lsstCam")


@pytest.mark.parametrize(("setup", "name"), [("lsst_e2v", "R22_S11"), ("lsst_itl", "R01_S00")])
def test_range_is_that_of_the_statistics_and_within_the_searched_one(setup, name):
    chosen = Setup.from_name(setup)
    field = ThicknessField.of(chosen)
    found = stand_in_thickness(chosen, CAMERA.detector(name), shape=(120, 120))
    assert found.layer == chosen.varying == field.layer
    span = np.ptp(found.value)
    assert 0.98 * field.span_um[0] < span < 1.02 * field.span_um[1]
    low, high = chosen.thickness_range_um
    assert low < found.value.min() < field.mean_um < found.value.max() < high
    assert found.metadata["STANDIN"] is True


def test_every_sensor_has_its_own_and_always_the_same():
    setup = Setup.from_name("lsst_e2v")
    one, again, other = (
        stand_in_thickness(setup, CAMERA.detector(name), shape=(30, 30)).value
        for name in ("R22_S11", "R22_S11", "R22_S12")
    )
    np.testing.assert_array_equal(one, again)
    assert not np.allclose(one, other)
    assert not np.allclose(one, stand_in_thickness(setup, CAMERA.detector("R22_S11"), 1, (30, 30)).value)


def test_a_coarse_map_samples_the_same_field():
    setup = Setup.from_name("lsst_e2v")
    detector = CAMERA.detector("R22_S11")
    fine, coarse = (stand_in_thickness(setup, detector, shape=(n, n)).value for n in (270, 90))
    np.testing.assert_allclose(fine[1::3, 1::3], coarse, atol=1e-5)


def test_correlation_is_a_gaussian_of_the_stated_length():
    """Over many fields; ``exp(-r² / 2 l²)`` with l of the statistics."""
    field = ThicknessField("adhesive", 50.0, (9.999, 10.0), 4.0)
    step_mm = 40.0 / 160
    lag = round(4.0 / step_mm)
    pairs = np.zeros(2)
    for number in range(60):
        made = field.draw((160, 160), (40.0, 40.0), np.random.default_rng(number)).astype(float)
        made -= made.mean()
        pairs += (made[:, :-lag] * made[:, lag:]).mean(), (made**2).mean()
    assert pairs[0] / pairs[1] == pytest.approx(np.exp(-0.5), abs=0.06)


def test_what_is_refused():
    with pytest.raises(OutOfRangeError, match="span"):
        ThicknessField("adhesive", 5.0, (1.0, 11.0), 3.0)
    with pytest.raises(OutOfRangeError, match="correlation length"):
        ThicknessField("adhesive", 5.0, (1.0, 2.0), 0.0)


def test_unknown_stack_is_named(monkeypatch):
    monkeypatch.setattr(
        "lsst.fringe_sim.algorithms.thickness_stand_in.read_yaml", lambda *_: {"fields": {"x": {"y": {}}}}
    )
    with pytest.raises(UnknownNameError, match="e2v_ccd250: adhesive"):
        ThicknessField.of(Setup.from_name("lsst_e2v"))
