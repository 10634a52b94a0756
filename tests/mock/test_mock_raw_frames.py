"""Raw frames of the mock: layout, statistics, determinism, and that they keep their secret."""

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from recorded_numbers import Record

from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.raw_frame import RawFrame
from lsst.fringe_sim.mock import (
    Defects,
    MockRun,
    e2v_321,
    parse_size,
    random_field,
    setup_optics,
    write_mock_flats,
)
from lsst.fringe_sim.mock.raw_files import Clock, primary_header, write_frame
from lsst.fringe_sim.resources import read_table

SHAPE = (48, 128)


def write(folder: Path, **changes: Any) -> MockRun:
    arguments: dict[str, Any] = {
        "setup": "ts8_e2v",
        "detector": "R11_S01",
        "thickness_um": e2v_321(SHAPE, sampling="window", corner=(1000, 1000)),
        "wavelengths_nm": [880.0, 960.0],
        "rng": np.random.default_rng(77),
        "size": "128x48",
        "n_bias": 2,
    }
    arguments.update(changes)
    return write_mock_flats(folder, **arguments)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> MockRun:
    return write(tmp_path_factory.mktemp("mock"))


def test_frames_read_as_raw_frames(run: MockRun) -> None:
    assert [path.exists() for path in run.paths] == [True] * 4
    bias, flat = RawFrame.read(run.bias[0].path), RawFrame.read(run.flats[1].path)
    assert bias.metadata.observation_type == "bias"
    assert bias.metadata.wavelength_nm is None
    about = flat.metadata
    assert (about.observation_type, about.test_type, about.wavelength_nm) == ("flat", "lambda", 960.0)
    assert (about.camera, about.raft, about.slot) == ("ts8", "RTM-020", "S01")
    assert about.serial == "E2V-CCD250-321"
    assert about.temperature_k == pytest.approx(183.15)
    assert flat.header["RAFTBAY"] == "R11"
    assert flat.detector_shape == SHAPE


def test_amplifiers_lie_where_the_sensor_has_them(run: MockRun) -> None:
    flat = RawFrame.read(run.flats[0].path)
    for amp, known in zip(flat.amplifiers, run.detector.amplifiers, strict=True):
        assert amp.name == known.name
        assert amp.destination == known.section
        assert (amp.flip_y, amp.flip_x) == (known.flip_y, known.flip_x)
        assert amp.data.dtype.kind == "i"
        assert amp.data.shape == (24 + 46, 10 + 16 + 54)


@pytest.mark.parametrize(("vendor", "serial"), [("e2v", "E2V-CCD250-321"), ("ITL", "ITL-3800C-083")])
def test_full_size_headers_are_those_of_real_files(vendor: str, serial: str, tmp_path: Path) -> None:
    """Every card of the layout table, the swapped y sense of DETSEC (DM-36115) included."""
    sensor = Camera.from_name("lsstCam").detector(serial)
    header = primary_header(
        "lsstCam", sensor, -100.0, 700.0, 3, *Clock(datetime.datetime(2021, 12, 12)).next(700.0)
    )
    images = [np.zeros(amp.raw.shape, np.int32) for amp in sensor.amplifiers if amp.raw is not None]
    path = tmp_path / "full.fits"
    write_frame(path, header, sensor, images)
    layout = read_table("instrument", "lsst_raw_amp_layout.ecsv")
    with fits.open(path) as hdus:
        for row in layout[layout["vendor"] == vendor]:
            hdu = hdus[int(row["hdu"])]
            assert hdu.header["EXTNAME"] == row["extname"]
            assert hdu.header["CHANNEL"] == row["channel"]
            assert (hdu.header["NAXIS1"], hdu.header["NAXIS2"]) == (row["naxis1"], row["naxis2"])
            for keyword in ("DATASEC", "DETSEC", "DETSIZE"):
                assert hdu.header[keyword] == row[keyword]
            assert hdu.header["BITPIX"] == 32


def test_overscan_and_prescan_see_no_light(run: MockRun) -> None:
    for amp in RawFrame.read(run.flats[0].path).amplifiers:
        lit = np.median(amp.data[amp.imaging])
        dark = np.median(amp.data[amp.serial_overscan])
        assert lit - dark > 8_000
        assert np.median(amp.data[:, :10]) - dark == pytest.approx(0.0, abs=15.0)
        assert np.median(amp.data[amp.parallel_overscan]) - dark == pytest.approx(0.0, abs=10.0)


def test_level_and_noise_are_those_asked_for(run: MockRun, tmp_path: Path) -> None:
    for exposure in run.flats:
        assert run.truth.expected_electrons(exposure).mean() == pytest.approx(exposure.level_e, rel=1e-6)
        assert exposure.level_e == pytest.approx(20_000.0, rel=0.05)
    assert write(tmp_path, level_e=500.0).flats[0].level_e == pytest.approx(500.0, rel=0.05)


def test_same_generator_same_files(run: MockRun, tmp_path: Path) -> None:
    again = write(tmp_path)
    for first, second in zip(run.paths, again.paths, strict=True):
        assert first.name == second.name
        assert first.read_bytes() == second.read_bytes()
    other = write(tmp_path / "other", rng=np.random.default_rng(78))
    assert run.paths[-1].read_bytes() != other.paths[-1].read_bytes()


def everything_but_pixels(path: Path) -> str:
    with fits.open(path) as hdus:
        return path.name + "".join(hdu.header.tostring() for hdu in hdus)


@pytest.mark.rng("headers and names do not depend on the truth")
def test_headers_and_names_do_not_depend_on_the_truth(
    run: MockRun, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Other thickness, other seed, other effects, other defects: the same text, so no text can tell."""
    hidden = write(
        tmp_path,
        thickness_um=random_field(SHAPE, rng, mean=12.0, span=3.0),
        rng=np.random.default_rng(123456789),
        effects={
            "bandwidth.fwhm": 3.7,
            "temperature.kelvin": 201.0,
            "wavelength_offset.offset": 1.3,
            "epoxy_index.offset": 0.05,
            "ghost_pedestal.fraction": 0.3,
            "non_linearity.quadratic": 0.05,
            "amplifier_gain.rms": 0.02,
            "amplifier_offset.rms": 20.0,
        },
        defects=Defects(bad_columns=2, hot_pixels=5, prnu_rms=0.01),
    )
    for first, second in zip(run.paths, hidden.paths, strict=True):
        assert everything_but_pixels(first) == everything_but_pixels(second)


def test_no_secret_stands_in_the_files(run: MockRun, tmp_path: Path) -> None:
    hidden = write(
        tmp_path,
        rng=np.random.default_rng(987654321),
        effects={"bandwidth.fwhm": 3.7531, "roughness.sigma": 41.7},
    )
    text = "".join(everything_but_pixels(path) for path in hidden.paths).lower()
    secrets = [
        "987654321",
        "3.7531",
        "41.7",
        "bandwidth",
        "roughness",
        "sigma",
        "seed",
        "truth",
        "effect",
        "thick",
    ]
    assert [secret for secret in secrets if secret in text] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in hidden.paths)


def test_effects_reach_the_pixels(run: MockRun, tmp_path: Path) -> None:
    """Gain, offset, light and charge each change what they should, and only that."""
    changed = write(
        tmp_path,
        effects={
            "amplifier_gain": {"C12": 0.1},
            "amplifier_offset.C05": 3000.0,
            "midline_step.fraction": -0.05,
        },
    )
    plain = {amp.name: amp for amp in RawFrame.read(run.flats[0].path).amplifiers}
    for amp in RawFrame.read(changed.flats[0].path).amplifiers:
        signal, before = (
            float(np.median(a.data[a.imaging]) - np.median(a.data[a.serial_overscan]))
            for a in (amp, plain[amp.name])
        )
        known = run.detector.amplifier(amp.name)
        upper = amp.name.startswith("C1")
        expected = before * (0.95 / 0.975 if upper else 1.0 / 0.975)
        expected /= 1.1 if amp.name == "C12" else 1.0
        expected += 3000.0 / known.gain if amp.name == "C05" else 0.0
        assert signal == pytest.approx(expected, rel=4e-3), amp.name


def test_non_linearity_and_full_well(tmp_path: Path) -> None:
    run = write(tmp_path, level_e=400_000.0, n_bias=0)
    for amp in RawFrame.read(run.flats[0].path).amplifiers:
        signal = np.median(amp.data[amp.imaging]) - np.median(amp.data[amp.serial_overscan])
        limit = run.detector.amplifier(amp.name).saturation
        assert signal == pytest.approx(limit, rel=2e-3)
    bent = write(tmp_path / "bent", effects={"non_linearity.quadratic": 0.1}, level_e=50_000.0, n_bias=0)
    straight = write(tmp_path / "straight", level_e=50_000.0, n_bias=0)
    signals = []
    for made in (bent, straight):
        amp = RawFrame.read(made.flats[0].path).amplifiers[0]
        signals.append(np.mean(amp.data[amp.imaging]) - np.mean(amp.data[amp.serial_overscan]))
    level = straight.truth.expected_electrons(straight.flats[0])[run.detector.amplifiers[0].section].mean()
    assert signals[0] / signals[1] == pytest.approx(1.0 - 0.1 * level / 1e5, abs=2e-3)


def test_repeats_and_times(tmp_path: Path) -> None:
    run = write(tmp_path, repeats=3, n_bias=1, wavelengths_nm=[900.0])
    about = [RawFrame.read(path).metadata for path in run.paths]
    assert [one.observation_type for one in about] == ["bias", "flat", "flat", "flat"]
    assert len({one.exposure_id for one in about}) == 4
    ends = [one.date_obs + datetime.timedelta(seconds=one.exposure_time_s) for one in about]
    assert all(end < later.date_obs for end, later in zip(ends, about[1:], strict=False))


def test_itl_sensor_with_varying_silicon(tmp_path: Path) -> None:
    optics, camera = setup_optics("ts8_itl")
    assert (optics.varying, camera) == ("detection", "ts8")
    run = write(
        tmp_path,
        setup="ts8_itl",
        detector="ITL-3800C-145",
        thickness_um=random_field(SHAPE, np.random.default_rng(3), mean=100.0, span=0.8),
        n_bias=0,
        wavelengths_nm=[980.0],
    )
    flat = RawFrame.read(run.flats[0].path)
    for amp, known in zip(flat.amplifiers, run.detector.amplifiers, strict=True):
        assert amp.destination == known.section
        assert (amp.flip_y, amp.flip_x) == (known.flip_y, known.flip_x)
    assert run.truth.light(980.0).std() > 0.005


def test_sizes_are_columns_by_rows() -> None:
    assert parse_size("256x128") == (128, 256)
    for text in ("256", "256x", "axb", "-8x8", "1.5x2", "0x3", "3x0"):
        with pytest.raises(InputError, match="NXxNY"):
            parse_size(text)


@pytest.mark.parametrize(
    ("changes", "error", "names"),
    [
        ({"setup": "ts8_e2w"}, UnknownNameError, "ts8_e2v"),
        ({"setup": "lsst_e2v"}, InputError, "monochromator"),
        ({"detector": "R11_S04"}, UnknownNameError, "R11_S04"),
        ({"size": "130x48"}, InputError, "8 columns"),
        ({"size": "128x64"}, InputError, "shape of the thickness map"),
        ({"thickness_um": np.full(SHAPE, np.nan)}, OutOfRangeError, "thickness"),
        ({"thickness_um": np.full(SHAPE, -1.0)}, OutOfRangeError, "thickness"),
        ({"wavelengths_nm": []}, InputError, "at least one"),
        ({"wavelengths_nm": [900.0, 900.0]}, InputError, "once"),
        ({"wavelengths_nm": [1400.0]}, OutOfRangeError, "wavelength"),
        ({"effects": {"bandwidth.fwhm": -2.0}}, OutOfRangeError, "bandwidth.fwhm"),
        ({"effects": {"unheard.of": 1.0}}, UnknownNameError, "unheard"),
        ({"n_bias": -1}, OutOfRangeError, "n_bias"),
        ({"repeats": 0}, OutOfRangeError, "repeats"),
        ({"level_e": np.nan}, OutOfRangeError, "level_e"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(
    changes: dict[str, Any], error: type[Exception], names: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=names):
        write(tmp_path / "out", **changes)
    assert not (tmp_path / "out").exists()


def test_defects_cannot_be_negative() -> None:
    with pytest.raises(OutOfRangeError, match="hot_pixels"):
        Defects(hot_pixels=-1)


def test_frames_are_as_recorded(run: MockRun, recorded: Record) -> None:
    """A record of what the seed gives today, for edits that are not meant to change it."""
    recorded({"frames": run.paths, "headers": [RawFrame.read(path).metadata for path in run.paths]})
