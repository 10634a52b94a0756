"""``fringe-sim mock-flats`` and ``fringe-sim fit``: the truth comes back, bad input is one clear line."""

import base64
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from raw_frame_maker import write_raw
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.flat_prep_options import FlatPrepOptions
from lsst.fringe_sim.cli.lab_frames import find_series
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.products import FringeCube, ThicknessMap

SIZE = (500, 512)
HALF_ORDER_UM = 0.15


@pytest.fixture(scope="module")
def raws(tmp_path_factory) -> Path:
    """Raw frames of the built-in sensor, cut down."""
    folder = tmp_path_factory.mktemp("raws")
    assert run(["mock-flats", str(folder), "--size", f"{SIZE[1]}x{SIZE[0]}", "--seed", "11"]) == 0
    return folder


@pytest.fixture
def copy(raws, tmp_path) -> Path:
    return Path(shutil.copytree(raws, tmp_path / "copy"))


def flat_at(folder: Path, wavelength: int) -> Path:
    (path,) = folder.glob(f"*flat_{wavelength:04d}_*")
    return path


def test_thickness_is_recovered(raws, tmp_path, capsys, recorded: Record) -> None:
    """Median error below 3 nm and no slipped order, against the map that made the frames; pages as recorded."""
    assert run(["fit", str(raws), "--out", str(tmp_path / "fit")]) == 0
    fitted = ThicknessMap.read_fits(tmp_path / "fit" / "thickness.fits")
    error = fitted.value - e2v_321(SIZE)
    good = fitted.mask == 0
    assert good.mean() > 0.9
    assert np.median(np.abs(error[good])) < 0.003
    assert np.all(np.abs(error[good]) < HALF_ORDER_UM)
    pull = error[good] / fitted.sigma[good]
    assert pull.std() == pytest.approx(1.0, abs=0.1)
    page = (tmp_path / "fit" / "report.html").read_text(encoding="utf-8")
    data = re.search(r'download="flat_residuals.ecsv" href="data:text/plain;base64,([^"]+)"', page)
    residuals = Table.read(base64.b64decode(data.group(1)).decode(), format="ascii.ecsv")
    assert len(residuals) == 12
    assert np.all(np.abs(residuals["ratio"] - 1.0) < 0.1), "what is left is the noise"
    recorded(tmp_path / "fit")


@pytest.mark.slow
def test_the_walk_of_the_paper_agrees_on_the_demo_sensor(raws, tmp_path) -> None:
    out = tmp_path / "fit"
    assert run(["fit", str(raws), "--out", str(out), "--method", "guo2022", "--smoothing", "1"]) == 0
    fitted = ThicknessMap.read_fits(out / "thickness.fits")
    error = fitted.value - e2v_321(SIZE)
    good = fitted.mask == 0
    assert np.median(np.abs(error[good])) < 0.003
    assert np.mean(np.abs(error[good]) > HALF_ORDER_UM) < 1e-3


@pytest.mark.slow
def test_same_seed_same_frames_and_same_map(raws, tmp_path) -> None:
    other = tmp_path / "again"
    assert run(["mock-flats", str(other), "--size", f"{SIZE[1]}x{SIZE[0]}", "--seed", "11"]) == 0
    for path in sorted(raws.iterdir()):
        assert (other / path.name).read_bytes() == path.read_bytes()
    outputs = []
    for name in ("one", "two"):
        assert run(["fit", str(other), "--out", str(tmp_path / name)]) == 0
        outputs.append((tmp_path / name / "thickness.fits").read_bytes())
    assert outputs[0] == outputs[1]


def test_dry_runs_write_nothing(raws, tmp_path, capsys) -> None:
    assert run(["mock-flats", str(tmp_path / "a"), "--seed", "1", "--dry-run"]) == 0
    assert run(["fit", str(raws), "--out", str(tmp_path / "b"), "--dry-run"]) == 0
    assert "would" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("other", [["--method", "guo2022"], ["--silicon", "plane"]])
def test_what_a_fit_cannot_learn_is_refused(raws, tmp_path, capsys, other) -> None:
    out = tmp_path / "fit"
    assert run(["fit", str(raws), "--out", str(out), "--contrast", "common", *other]) != 0
    assert "--contrast" in capsys.readouterr().err
    assert not out.exists()


def test_a_missing_wavelength_is_said(copy, tmp_path, capsys) -> None:
    flat_at(copy, 950).unlink()
    assert run(["fit", str(copy), "--out", str(tmp_path / "fit")]) == 0
    assert "no flats at 950 nm" in capsys.readouterr().err


def test_three_wavelengths_are_too_few(raws, tmp_path, capsys) -> None:
    paths = [str(flat_at(raws, wavelength)) for wavelength in (900, 940, 980)]
    assert run(["fit", *paths, "--out", str(tmp_path / "fit")]) == 1
    assert "4 or more" in capsys.readouterr().err
    assert not (tmp_path / "fit").exists()


def _truncate(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def _not_fits(path: Path) -> None:
    path.write_text("this is not FITS")


def _drop_amplifier(path: Path) -> None:
    with fits.open(path) as hdus:
        fits.HDUList([hdu.copy() for hdu in hdus[:-1]]).writeto(path, overwrite=True)


def _no_wavelength(path: Path) -> None:
    with fits.open(path, mode="update") as hdus:
        del hdus[0].header["MONOWL"]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_truncate, "complete FITS file"),
        (_not_fits, "complete FITS file"),
        (_drop_amplifier, "16"),
        (_no_wavelength, "MONOWL"),
    ],
)
def test_a_damaged_flat_is_one_clear_line(copy, tmp_path, capsys, damage, words) -> None:
    victim = flat_at(copy, 930)
    damage(victim)
    assert run(["fit", str(copy), "--out", str(tmp_path / "fit")]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if victim.name in line]
    assert len(lines) == 1
    assert words in lines[0]
    assert not (tmp_path / "fit").exists()


@pytest.mark.slow
def test_a_damaged_flat_can_be_left_out(copy, tmp_path) -> None:
    _truncate(flat_at(copy, 930))
    assert run(["fit", str(copy), "--out", str(tmp_path / "fit"), "--skip-bad"]) == 0
    assert ThicknessMap.read_fits(tmp_path / "fit" / "thickness.fits").metadata["NFLATS"] == 11


def test_a_saturated_flat_is_refused(copy, tmp_path, capsys) -> None:
    victim = flat_at(copy, 930)
    with fits.open(victim, mode="update") as hdus:
        for hdu in hdus[1:]:
            hdu.data[:] = 250_000
    assert run(["fit", str(copy), "--out", str(tmp_path / "fit")]) == 1
    assert victim.name in capsys.readouterr().err


def test_an_error_in_a_flat_names_its_file(tmp_path) -> None:
    raw = write_raw(tmp_path / "one.fits", {})
    series = find_series([str(raw)])
    with pytest.raises(InputError) as caught:
        series.read(replace(Setup.from_name("ts8_e2v"), f_number=-1.0), FlatPrepOptions(), lambda: None)
    assert caught.value.source == str(raw)


def test_a_sensor_of_another_vendor_is_refused(raws, tmp_path, capsys) -> None:
    """Its films are others; the message names a set-up that has them."""
    assert run(["fit", str(raws), "--setup", "ts8_itl", "--out", str(tmp_path / "fit")]) == 1
    said = capsys.readouterr().err
    assert "of e2v" in said
    assert "ts8_e2v" in said
    assert not (tmp_path / "fit").exists()


def test_two_sensors_are_refused(copy, tmp_path, capsys) -> None:
    with fits.open(flat_at(copy, 930), mode="update") as hdus:
        hdus[0].header["LSST_NUM"] = "E2V-CCD250-357"
    assert run(["fit", str(copy), "--out", str(tmp_path / "fit")]) == 1
    assert "frames of one sensor" in capsys.readouterr().err


def test_an_output_that_is_a_file_is_refused(raws, tmp_path, capsys) -> None:
    (tmp_path / "fit").write_text("mine")
    assert run(["fit", str(raws), "--out", str(tmp_path / "fit")]) == 1
    assert (tmp_path / "fit").read_text() == "mine"
    assert "a folder, not a file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--setup", "ts8_e2w"], "did you mean"),
        (["--setup", "lsst_e2v"], "laboratory"),
        (["--detector", "R11_S09"], "R11_S0"),
        (["--effect", "bandwith.fwhm=2"], "did you mean bandwidth"),
        (["--effect", "bandwidth.fwhm=-2"], "bandwidth.fwhm"),
        (["--wavelengths", "880:3000:200"], "nm"),
        (["--size", "510x500"], "multiples"),
        (["--thickness", "nowhere.fits"], "nowhere.fits"),
    ],
)
def test_bad_requests_for_mock_flats(tmp_path, capsys, arguments, words) -> None:
    assert run(["mock-flats", str(tmp_path / "a"), "--seed", "1", "--size", "256x200", *arguments]) == 1
    assert words in capsys.readouterr().err
    assert not list(tmp_path.glob("a/*"))


@pytest.mark.slow
def test_a_cube_can_be_fitted(raws, tmp_path) -> None:
    from lsst.fringe_sim.algorithms.flat_prep_options import FlatPrepOptions
    from lsst.fringe_sim.cli.lab_frames import find_series
    from lsst.fringe_sim.model import Setup

    cube = find_series([str(raws)]).read(
        Setup.from_name("ts8_e2v"), FlatPrepOptions(smoothing_sigma_px=0.0), int
    )
    assert isinstance(cube, FringeCube)
    cube.write_fits(tmp_path / "cube.fits")
    assert run(["fit", str(tmp_path / "cube.fits"), "--out", str(tmp_path / "fit")]) == 0
    fitted = ThicknessMap.read_fits(tmp_path / "fit" / "thickness.fits")
    good = fitted.mask == 0
    assert np.median(np.abs(fitted.value - e2v_321(SIZE))[good]) < 0.003
