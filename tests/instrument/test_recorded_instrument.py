"""Skies, nights, levels and beams against their formulae, at places where no other test looks, and as recorded."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.continua import ContinuumTerm, airglow_continuum, moonlight, zodiacal_light
from lsst.fringe_sim.instrument.flat_spectrum import FlatSpectrum
from lsst.fringe_sim.instrument.measured_thickness import e2v_321, fit_to_sensor
from lsst.fringe_sim.instrument.night import (
    AirglowField,
    NightHistory,
    StochasticNight,
    join_nights,
    random_nights,
)
from lsst.fringe_sim.instrument.oh_levels import RotationalLevels, boltzmann
from lsst.fringe_sim.instrument.setup import Setup, setup_names
from lsst.fringe_sim.instrument.sky import (
    EmissionLines,
    SkySpectrum,
    SpectralComponent,
    blend_components,
    van_rhijn_factor,
)

WAVE = np.array([905.0, 951.3, 1010.0])


def test_light_without_lines(recorded: Record) -> None:
    """Every term at places in all of its ranges."""
    places = [
        (180.0, 0.0),
        (-100.0, 30.0),
        (250.0, -30.0),
        (60.0, 15.0),
        (40.0, 3.0),
        (20.0, 40.0),
        (400.0, 75.0),
        (0.0, 90.0),
    ]
    moons = [
        (0.0, 30.0, 20.0, 0.0),
        (60.0, 90.0, 60.0, 40.0),
        (170.0, 5.0, 89.0, 85.0),
        (0.0, 180.0, 0.0, 10.0),
    ]
    recorded(
        {
            "air": [airglow_continuum(flux).radiance(WAVE) for flux in (50.0, 129.0, 400.0)],
            "zodiac": [zodiacal_light(*place).radiance(WAVE) for place in places],
            "moon": [moonlight(*moon).radiance(WAVE) for moon in moons],
            "origins": [
                term.origin
                for term in (airglow_continuum(), zodiacal_light(120.0, 60.0), moonlight(*moons[0]))
            ],
        }
    )
    assert not moonlight(10.0, 30.0, 90.0).photon_radiance.any()
    assert moonlight(10.0, 30.0, 89.999).photon_radiance.all()


@pytest.mark.parametrize(
    "call",
    [
        lambda: airglow_continuum(49.9), lambda: airglow_continuum(401.0), lambda: zodiacal_light(0.0, 90.1),
        lambda: zodiacal_light(0.0, 0.0), lambda: moonlight(-0.1, 30.0, 30.0), lambda: moonlight(180.1, 30.0, 30.0),
        lambda: moonlight(0.0, 4.9, 30.0), lambda: moonlight(0.0, 180.1, 30.0), lambda: moonlight(0.0, 30.0, -1.0),
        lambda: moonlight(0.0, 30.0, 181.0), lambda: moonlight(0.0, 30.0, 30.0, 85.1),
        lambda: moonlight(0.0, 30.0, 30.0, -0.1), lambda: airglow_continuum().radiance([900.0, 9000.0]),
        lambda: airglow_continuum().radiance(np.nan), lambda: van_rhijn_factor(0.99),
        lambda: boltzmann(np.ones(3), 0.0), lambda: boltzmann(np.ones(3), np.inf),
        lambda: RotationalLevels.of_reference().thermal(200.0, 500.0, -0.1),
        lambda: StochasticNight(night_sigma=-0.1), lambda: StochasticNight(level_sigma=np.inf),
        lambda: StochasticNight(correlation_h=0.0), lambda: NightHistory.guo2022().band_scale(-1, ["8-4"]),
        lambda: NightHistory.guo2022().band_scale(11, ["8-4"]), lambda: AirglowField.gradient(0.4),
        lambda: AirglowField.imsim().at(3.0, 0.0), lambda: AirglowField.imsim().at(0.0, [0.0, -3.0]),
        lambda: FlatSpectrum(share=1.1), lambda: FlatSpectrum.gaussian(99.0, 10.0),
        lambda: FlatSpectrum.gaussian(3001.0, 10.0), lambda: FlatSpectrum.gaussian(900.0, 0.0),
        lambda: FlatSpectrum.gaussian(900.0, 1000.0),
    ],
)  # fmt: skip
def test_numbers_that_mean_nothing_are_refused(call: Any) -> None:
    with pytest.raises(OutOfRangeError):
        call()


def test_ends_of_ranges_are_in_them() -> None:
    term = ContinuumTerm("x", np.array([900.0, 1000.0]), np.array([1.0, 3.0]), "local")
    assert term.radiance([900.0, 950.0, 1000.0]).tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(OutOfRangeError, match=r"is 899.0; allowed: 900.0 to 1000.0"):
        term.radiance([[900.0, 1000.0], [899.0, 1001.0]])
    field = AirglowField.gradient(0.1, 30.0)
    corner = 2.1 * (math.cos(math.radians(30.0)) + 0.5)
    assert field.at(2.1, 2.1) == pytest.approx(1.0 + 0.1 * corner)
    assert field.at(-2.1, -2.1) == pytest.approx(1.0 - 0.1 * corner)
    assert field.at([0.0, 1.0], [[0.0], [2.0]]).shape == (2, 2)
    nodes = AirglowField.imsim()
    assert nodes.at(nodes.x_deg[3], nodes.y_deg[5]) == pytest.approx(nodes.level[3, 5])
    middle = nodes.at(0.5 * nodes.x_deg[3:5].sum(), nodes.y_deg[5])
    assert middle == pytest.approx(0.5 * nodes.level[3:5, 5].sum())


def test_bands_of_a_night() -> None:
    """Between levels the intensity is interpolated, beyond them it is that of the nearest."""
    night = NightHistory(np.array([0.0, 1.0]), np.array([4.0, 6.0]), np.array([[1.0, 2.0], [3.0, 5.0]]))
    assert len(night) == 2
    assert night.band_scale(1, ["3-0", "4-1", "5-2", "6-2", "9-5"]) == {
        "3-0": 3.0, "4-1": 3.0, "5-2": 4.0, "6-2": 5.0, "9-5": 5.0
    }  # fmt: skip
    for name in ("84", "8-", "x-4", "-4"):
        with pytest.raises(InputError, match="band"):
            night.band_scale(0, [name])
    for wrong in (
        np.array([[1.0, -1.0], [1.0, 1.0]]),
        np.array([[1.0, np.nan], [1.0, 1.0]]),
        np.ones((2, 3)),
    ):
        with pytest.raises(InputError):
            dataclasses.replace(night, intensity=wrong)
    with pytest.raises(InputError, match="ascending"):
        StochasticNight().draw([1.0, 0.5], np.random.default_rng(1))


def test_nights_that_are_drawn(recorded: Record) -> None:
    rng = np.random.default_rng(41)
    drawn = StochasticNight(0.3, 0.2, 0.05, 0.02, 2.0).draw([0.0, 0.5, 0.5, 3.0], rng)
    np.testing.assert_allclose(drawn.intensity[1], drawn.intensity[2])
    several = random_nights(3, 17)
    joined = join_nights([drawn, dataclasses.replace(drawn, hours=drawn.hours + 1.0)])
    assert len(joined) == 8
    recorded({"drawn": drawn, "several": several, "joined": joined})
    with pytest.raises(InputError, match="nights is 0; allowed: one or more"):
        join_nights([])


def test_lines_and_levels(recorded: Record) -> None:
    levels = RotationalLevels.of_reference()
    warm, hot = levels.warmed(220.0), levels.with_hot(1.5, 0.02, 800.0)
    thermal = levels.thermal(180.0, 700.0, 0.05)
    for changed in (warm, hot, thermal):
        held = np.bincount(levels.vibration, weights=levels.weight * (changed.cold + changed.hot))
        if changed is not warm:
            np.testing.assert_allclose(
                held, np.bincount(levels.vibration, weights=levels.weight * (levels.cold + levels.hot))
            )
    lines = EmissionLines.oh()
    recorded(
        {
            "levels": [levels, warm, hot, thermal],
            "vibration": EmissionLines.oh(200.0, 9000.0).photon_radiance,
            "rotated": lines.with_rotation(lambda each: each.warmed(230.0)).photon_radiance,
            "band": lines.of_band("8-4"),
            "dark": SkySpectrum.dark(lines, 1.7).components(Bandpass.from_name("hsc_y"), 0.7),
            "rijn": [van_rhijn_factor(each) for each in (1.0, 1.5, 3.0)],
        }
    )
    with pytest.raises(UnknownNameError):
        lines.of_band("1-0")
    with pytest.raises(InputError, match="rotational levels"):
        dataclasses.replace(lines, levels=None).with_rotation(lambda each: each)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"wavelength_nm": np.array([900.0, 899.0])}, "ascending"),
        ({"wavelength_nm": np.array([299.9, 900.0])}, "300 to 3000"),
        ({"wavelength_nm": np.array([900.0, 3000.1])}, "300 to 3000"),
        ({"wavelength_nm": np.array([900.0, np.nan])}, "finite"),
        ({"photon_radiance": np.array([1.0, -1.0])}, "not negative"),
        ({"transmission": np.array([0.5, 1.1])}, "0 to 1"),
        ({"transmission": np.array([-0.1, 1.0])}, "0 to 1"),
        ({"band": np.array(["8-4"])}, "common shape"),
    ],
)
def test_lines_that_are_none_are_refused(changes: dict[str, Any], said: str) -> None:
    good = EmissionLines(
        np.array([300.0, 3000.0]), np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array(["8-4", "9-5"])
    )
    assert good.bands == ("8-4", "9-5")
    with pytest.raises(InputError, match=said):
        dataclasses.replace(good, **changes)


def test_blended_lines(recorded: Record) -> None:
    rng = np.random.default_rng(42)
    made = [
        SpectralComponent(name, np.sort(rng.uniform(950.0, 960.0, 30)), rng.uniform(0.0, 1.0, 30))
        for name in "ab"
    ]
    made[0].photons[3:6] = 0.0
    recorded(
        [
            [(one.wavelength_nm, one.photons) for one in blend_components(made, shift)]
            for shift in (0.0, 0.02, 0.3, 9.0)
        ]
    )


def test_lamps(recorded: Record) -> None:
    """A lamp beside white light, at the edge of the filter, and one of a table."""
    band = Bandpass.from_name("lsst_y")
    low, high = band.support()
    lamps = [
        FlatSpectrum(),
        FlatSpectrum.gaussian(970.0, 15.0, 0.3),
        FlatSpectrum.gaussian(low, 8.0),
        FlatSpectrum.from_name("gaussian:990:30"),
    ]
    found = [lamp.component(band) for lamp in lamps]
    for one in found:
        assert one.photons.sum() == pytest.approx(1.0)
        assert (np.diff(one.wavelength_nm) >= 0.0).all()
        assert low <= one.wavelength_nm.min() < one.wavelength_nm.max() <= high
    recorded(
        {
            "found": [(one.wavelength_nm, one.photons) for one in found],
            "names": [lamp.share for lamp in lamps],
        }
    )
    for text in ("gaussian:900", "gaussian:900:10:1", "gaussian:a:b", "nosuch"):
        with pytest.raises(InputError):
            FlatSpectrum.from_name(text)
    for wave, photons in (([900.0], [1.0]), ([900.0, 900.0], [1.0, 1.0]), ([900.0, 910.0], [1.0, -1.0])):
        with pytest.raises(InputError, match="spectrum of the flat field"):
            FlatSpectrum("x", np.array(wave), np.array(photons), 0.5)
    with pytest.raises(InputError, match="light from"):
        FlatSpectrum.gaussian(500.0, 5.0).component(band)


@pytest.mark.parametrize("name", setup_names())
def test_facts_of_a_set_up(name: str, recorded: Record) -> None:
    setup = Setup.from_name(name)
    sensor = setup.sensor(None)
    if len(sensor.amplifiers) == 16:
        sensor = sensor.cut_down((80, 128))
    told = {
        each.name: getattr(setup, each.name) for each in dataclasses.fields(setup) if each.name != "stack"
    }
    places = [[amp.x0, amp.y0, amp.width, amp.height, amp.flip_x, amp.flip_y] for amp in sensor.amplifiers]
    raws = [dataclasses.astuple(amp.raw)[2:] for amp in sensor.amplifiers if amp.raw]
    numbers = [[value for part in raw for value in np.ravel(part)] for raw in raws]
    recorded({"setup": told, "facts": setup.facts(), "cut": np.array(places, float).T, "raw": numbers[::5]})


def test_a_measured_map(recorded: Record) -> None:
    whole = e2v_321((60, 64))
    recorded(
        {
            "whole": whole,
            "window": e2v_321((40, 30), sampling="window", corner=(3000, 100)),
            "fitted": [fit_to_sensor(whole, (20, 21)), fit_to_sensor(whole, (90, 100))],
            "cut": fit_to_sensor(whole, (10, 12), sampling="window", corner=(50, 52)),
        }
    )
    for corner in ((51, 0), (0, 53), (-1, 0), (0, -1)):
        with pytest.raises(InputError, match="window of"):
            fit_to_sensor(whole, (10, 12), sampling="window", corner=corner)


@pytest.mark.parametrize("name", ["lsstCam", "ts8", "monocam", "hsc"])
def test_every_sensor_of_a_camera(name: str, recorded: Record) -> None:
    """Places, gains and layouts of all, as sums."""
    camera = Camera.from_name(name)
    numbers = [
        [
            each.id,
            each.field_x_deg,
            each.field_y_deg,
            each.yaw_deg,
            each.pixel_um,
            *each.shape,
            len(each.amplifiers),
        ]
        for each in camera.detectors
    ]
    amplifiers = [
        [
            amp.x0,
            amp.y0,
            amp.width,
            amp.height,
            amp.flip_x,
            amp.flip_y,
            amp.gain,
            amp.read_noise,
            amp.saturation,
        ]
        for each in camera.detectors[::13]
        for amp in each.amplifiers
    ]
    raws = [
        dataclasses.astuple(amp.raw)[2:]
        for each in camera.detectors[::50]
        for amp in each.amplifiers
        if amp.raw
    ]
    recorded(
        {"sensors": np.array(numbers, float).T, "amplifiers": np.array(amplifiers, float).T, "raw": raws[::5]}
    )
