"""Records of what the mock draws and computes from a seed, for edits that are not meant to change it.

`test_mock_optics` compares its optics with other programs. What is drawn has no other truth than its statistics.
"""

import dataclasses
import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from recorded_numbers import Record

from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.mock import (
    HIDDEN_EFFECTS,
    Defects,
    e2v_321,
    materials,
    random_field,
    setup_optics,
    visits,
)
from lsst.fringe_sim.mock.defects import draw_defects
from lsst.fringe_sim.mock.hidden_effects import AmplifierState, hidden_islands, validate_effects
from lsst.fringe_sim.mock.optics import FlatFieldOptics
from lsst.fringe_sim.mock.raw_files import Clock, primary_header, with_raw_layout, write_frame
from lsst.fringe_sim.mock.readout import Readout
from lsst.fringe_sim.mock.sensor_signal import SensorSignal
from lsst.fringe_sim.mock.thickness import PixelArea
from lsst.fringe_sim.mock.visit_sources import Scene, VisitConditions, VisitImage, expected_sources
from lsst.fringe_sim.mock.visits import detected_sky, write_mock_visits

LIGHT = {"pixel_scale_arcsec": 0.2, "bandpass": "lsst_y", "effective_area_m2": 32.4}
SENSOR = Camera.from_name("lsstCam").detector("R22_S11")
COARSE = {"BEAM_NODES": 3, "CONTINUUM_NODES": 2, "CONTINUUM_STEP_NM": 5.0, "BLEND_NM": 5.0}
"""Nodes of the light of the sky that show every line of the code; what they are for is tested elsewhere."""

BUSY = VisitConditions(
    stars_per_arcmin2=30.0,
    galaxies_per_arcmin2=25.0,
    cosmic_rays_per_s_cm2=40.0,
    slope=0.3,
    amplifier_rms=0.1,
    dither_arcsec=4.0,
    moon=2.0,
)


def test_a_visit_full_of_everything(recorded: Record) -> None:
    """Stars that bleed, galaxies, tracks, scattered light, gains that are off."""
    sensor = SENSOR.cut_down((96, 128))
    shallow = [
        dataclasses.replace(amp, saturation=3000.0 + 100.0 * i) for i, amp in enumerate(sensor.amplifiers)
    ]
    sensor = dataclasses.replace(sensor, amplifiers=tuple(shallow))
    rng = np.random.default_rng(11)
    scene = Scene.draw(LIGHT, BUSY, sensor.shape, rng)
    sky = np.full(sensor.shape, 900.0, dtype=np.float32)
    image = VisitImage.expose(scene, sky, sensor, 30.0, rng)
    header = dict(image.pointing.wcs(sensor.shape).to_header())
    recorded(
        {
            "scene": scene,
            "image": image,
            "header": header,
            "sources": {name: image.sources[name] for name in image.sources.dtype.names},
            "number": expected_sources(LIGHT, BUSY, sensor.shape),
        }
    )


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in COARSE.items():
        monkeypatch.setattr(visits, name, value)


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize(
    ("setup", "detector", "thickness_um", "effects"),
    [("lsst_e2v", "R02_S12", (14.9, 15.1), {"contrast_loss.factor": 0.5}), ("hsc", 0, (199.98, 200.02), {})],
)
def test_light_of_the_sky(
    setup: str,
    detector: str | int,
    thickness_um: tuple[float, float],
    effects: dict[str, float],
    recorded: Record,
) -> None:
    """Every band and continuum, at a sensor far from the axis."""
    sensor = Camera.from_name("lsstCam" if setup == "lsst_e2v" else "hsc").detector(detector)
    thickness = np.linspace(*thickness_um, 12).reshape(3, 4)
    recorded(detected_sky(setup, sensor, thickness, effects))


@pytest.mark.usefixtures("coarse")
def test_files_of_two_visits(tmp_path: Path, recorded: Record) -> None:
    made = write_mock_visits(
        tmp_path,
        setup="lsst_e2v",
        detector="R22_S11",
        thickness_um=np.linspace(15.0, 15.03, 32 * 16).reshape(16, 32),
        rng=np.random.default_rng(12),
        conditions=VisitConditions(2),
    )
    recorded({"visits": list(made), "folder": tmp_path})


VARIANTS: dict[str, dict[str, Any]] = {
    "usual": {},
    "rough": {"roughness_nm": 30.0, "rough_face": "adhesive"},
    "rough_gates": {
        "roughness_nm": 12.0,
        "rough_face": "detection",
        "theta": (0.1, 0.4),
        "theta_weight": (0.3, 0.7),
    },
    "spread": {"spread_nm": 20.0, "height_step_nm": 15.0, "line_step_nm": 0.2},
    "support": {"support_spread_um": 0.02, "theta": (0.2,), "line_step_nm": 0.2},
    "triangular": {"line_shape": "triangular", "bandwidth_fwhm_nm": 3.0},
    "lorentzian": {"line_shape": "lorentzian", "bandwidth_fwhm_nm": 0.5, "line_step_nm": 0.1},
    "wing": {"other_lines": (("lorentzian", 0.2), ("triangular", 0.5)), "line_step_nm": 0.1},
    "lamp": {"lamp_lines": ((959.0, 0.7, 1.5), (963.0, 0.2, 0.8))},
    "shifted": {
        "wavelength_offset_nm": 0.4,
        "wavelength_stretch": 0.01,
        "wavelength_errors_nm": ((900.0, 0.5), (990.0, -0.3)),
        "coherent_part": 0.6,
    },
    "silicon": {"varying": "detection", "detection": "detection"},
    "below": {"varying": "support"},
    "above": {"varying": "ar_outer"},
}


def test_flats_of_other_optics(recorded: Record) -> None:
    """Of all that the optics can have, in each order of the layer that varies and of the one that detects."""
    thickness = np.linspace(14.0, 14.4, 5)
    usual = setup_optics("ts8_e2v")[0]
    found: dict[str, Any] = {}
    for name, changes in VARIANTS.items():
        optics = dataclasses.replace(usual, **changes)
        found[name] = [*(optics.flat_field(thickness, wave) for wave in (905.0, 960.0)), optics._line(960.0)]
    film = dataclasses.replace(usual.films[4], index_shift=0.01, cauchy_um2=0.02, extinction_scale=3.0)
    found["film"] = film.index(np.array([880.0, 1000.0]), 200.0)
    found["table"] = usual.table((14.0, 14.02), [940.0])
    recorded(found)


@pytest.mark.parametrize("kelvin", [120.0, 183.0, 320.0])
def test_indices_of_materials(kelvin: float, recorded: Record) -> None:
    wave = np.linspace(720.0, 1040.0, 9)
    names = materials.read_yaml("media", "media.yaml")
    recorded({name: materials.material_index(name, wave, kelvin) for name in names})


def changed_fields(changed: FlatFieldOptics, usual: FlatFieldOptics) -> dict[str, Any]:
    """What an effect has made of the optics, and the films that it has changed."""
    found = {each.name: getattr(changed, each.name) for each in dataclasses.fields(usual)}
    found["films"] = [film for film in changed.films if film not in usual.films]
    return {name: value for name, value in found.items() if value != getattr(usual, name)}


def test_everything_that_hides(recorded: Record) -> None:
    """Each effect at three eighths of the bounds of its parameters, wherever it acts."""
    optics = setup_optics("ts8_e2v")[0]
    shape, found = (16, 24), {}
    light = 1.0 + 0.05 * np.sin(e2v_321(shape) / 0.05)
    state = AmplifierState("C03", 1.5, 6.0, 150_000.0, 3.0, 5.0, 0.7)
    for effect in HIDDEN_EFFECTS:
        values = {
            each.name: each.bounds[0] + 0.375 * (each.bounds[1] - each.bounds[0])
            for each in effect.parameters
        }
        if effect.name in ("void", "tree_rings"):
            values |= {"centre_x": 9.2, "centre_y": 5.4} | ({"radius": 4.7} if effect.name == "void" else {})
        done: list[Any] = []
        if effect.on_optics is not None:
            done.append(changed_fields(effect.on_optics(optics, values), optics))
        if effect.on_island is not None:
            done.append(effect.on_island(shape, values))
        if effect.on_silicon is not None:
            done.append(effect.on_silicon(shape, values))
        if effect.on_light is not None:
            done += [effect.on_light(light, 970.0, values), effect.on_light(light, 890.0, values)]
        if effect.on_charge is not None:
            done.append(effect.on_charge(20_000.0 * light, values))
        if effect.on_amplifier is not None:
            done += [after := effect.on_amplifier(state, values, 1.3), after.dark_signal_e(7.0)]
        found[effect.name] = done
    recorded(list(found.items()))


def test_signal_of_a_wedge_with_an_island(recorded: Record) -> None:
    """Tables of two thicknesses, their stated error, and pixels that see both stacks."""
    optics, _ = setup_optics("bnl_ts8_e2v")
    thickness = 15.0 + 0.01 * np.add.outer(np.arange(8.0) ** 1.5, np.arange(10.0)) / 30.0
    added = np.linspace(-0.004, 0.004, 10) * np.ones((8, 1))
    active = validate_effects({"void": {"thickness": 120.0, "centre_x": 4.0, "centre_y": 3.0, "radius": 2.5}})
    islands = hidden_islands(optics, thickness.shape, active)
    signal = SensorSignal.of(optics, thickness, [960.0], added, islands)
    tables = signal.tables
    area = PixelArea.of(thickness)
    recorded(
        {
            "flat": signal.flat(0),
            "added": tables.added_um,
            "error": tables.relative_error,
            "area": area,
            "range": area.range_um,
            "squares": area.in_squares(np.array([1, 3]), np.array([2, 9]), 4),
        }
    )


def test_readout_and_defects(recorded: Record) -> None:
    """Of a sensor whose charge reaches the full well and trails into both overscans."""
    sensor = SENSOR.cut_down((24, 128))
    rng = np.random.default_rng(13)
    states = [
        AmplifierState(amp.name, amp.gain, amp.read_noise, 60_000.0, 50.0, 100.0, 2.0)
        for amp in sensor.amplifiers
    ]
    readout = Readout.of(sensor, tuple(states), rng)
    electrons = np.linspace(10_000.0, 90_000.0, 24 * 128).reshape(24, 128)
    active = validate_effects({"non_linearity.quadratic": 0.1})
    recorded(
        {
            "images": readout.read(electrons, 11.0, active, rng),
            "bias": readout.read(electrons, 0.0, active, rng),
            "bright": readout.read(np.full((24, 128), 1e6), 1.0, (), rng)[:2],
            "defects": draw_defects(sensor, Defects(bad_columns=9, hot_pixels=7, prnu_rms=0.02), rng),
            "field": random_field((20, 30), rng),
            "fine": random_field((20, 30), rng, mean=10.0, span=2.0, scale=3.0),
        }
    )


@pytest.mark.parametrize(
    ("wavelength_nm", "seconds"),
    [(None, 0.0), (700.0, 12.0), (800.0, 12.0), (960.0, 45.524), (1040.0, 88.669)],
)
def test_exposures_are_longer_where_lamp_and_sensor_fade(wavelength_nm: float | None, seconds: float) -> None:
    """To a thousandth of a second, as headers have it; and forty seconds pass between two."""
    clock = Clock(datetime.datetime(2018, 7, 24, 5, 0, 0))
    start, length = clock.next(wavelength_nm)
    assert length == seconds
    assert (clock.next(None)[0] - start).total_seconds() == 40.0 + np.ceil(seconds)


@pytest.mark.parametrize("hole", [0.0, 0.6])
def test_a_beam_that_is_a_cone(hole: float) -> None:
    """The pupil is uniform in the squared sine of the angle."""
    stated = {"kind": "cone", "f_number": 2.0, **({"obscuration": hole} if hole else {})}
    theta, weight = visits._angles(stated, 1.0, 6)
    low, high = (0.25 * hole) ** 2, 0.25**2
    square = np.sin(theta) ** 2
    assert theta.size == 6
    for power in range(4):
        mean = (high ** (power + 1) - low ** (power + 1)) / ((power + 1) * (high - low))
        assert weight @ square**power == pytest.approx(mean, rel=1e-12)


@pytest.mark.parametrize("yaw_deg", [0.0, 37.0, -90.0])
def test_a_sensor_may_lie_turned_in_the_field(yaw_deg: float) -> None:
    """Whole sensors of as many samples as one likes; its middle is at its place in the field."""
    sensor = dataclasses.replace(Camera.from_name("lsstCam").detector("R02_S12"), yaw_deg=yaw_deg)
    found = visits._field_radius_deg(sensor, (5, 3), 0.2)
    y, x = (
        (np.arange(n) - 0.5 * (n - 1)) / n * side * 0.2 / 3600.0
        for n, side in zip((5, 3), sensor.shape, strict=True)
    )
    place = (x + 1j * y[:, np.newaxis]) * np.exp(1j * np.radians(yaw_deg))
    np.testing.assert_allclose(
        found, np.abs(complex(sensor.field_x_deg, sensor.field_y_deg) + place), rtol=1e-12
    )
    assert found[2, 1] == pytest.approx(sensor.field_radius_deg, rel=1e-12)


@pytest.mark.parametrize(
    ("camera", "detector"), [("lsstCam", "R01_S00"), ("ts8", "R11_S01"), ("monocam", 0), ("hsc", 0)]
)
def test_frames_of_a_camera(camera: str, detector: str | int, tmp_path: Path, recorded: Record) -> None:
    """Every header as the mock writes it for each kind of camera, and the times of its exposures."""
    sensor = Camera.from_name(camera).detector(detector)
    sensor = with_raw_layout(sensor) if sensor.own_layout else sensor.cut_down((48, 128))
    segments = [np.zeros(amp.raw.shape, np.int32) for amp in sensor.amplifiers if amp.raw is not None]
    clock, cards = Clock(datetime.datetime(2018, 7, 24, 5, 0, 0)), []
    for number, wave in enumerate((None, 750.0, 960.0, 1040.0)):
        header = primary_header(camera, sensor, -90.0, wave, number, *clock.next(wave))
        write_frame(tmp_path / "frame.fits", header, sensor, segments)
        with fits.open(tmp_path / "frame.fits") as units:
            cards += [unit.header for unit in units[: 17 if number == 1 else 1]]
    (tmp_path / "frame.fits").unlink()
    (tmp_path / "headers.txt").write_text("\n".join(one.tostring(sep="\n") for one in cards))
    recorded({"numbers": tmp_path, "words": [dict(one) for one in cards]})
