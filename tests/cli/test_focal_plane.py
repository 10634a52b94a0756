"""``fringe-sim focal-plane`` and ``fringe-sim amplitudes``."""

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from browser import check_page

from lsst.fringe_sim.algorithms.cost_model import FocalPlaneCost
from lsst.fringe_sim.cli import focal_plane
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.mock.thickness import e2v_321


@pytest.fixture(scope="module")
def two_sensors(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of a forecast of two sensors, one of them measured, and what was said."""
    folder = tmp_path_factory.mktemp("focal_plane")
    path, out = folder / "thickness.fits", folder / "out"
    fits.PrimaryHDU(e2v_321((800, 819)).astype(np.float32)).writeto(path)
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        status = run(
            [
                *("focal-plane", "--sensor", "R22_S11", "--sensor", "R22_S12"),
                *("--thickness", f"R22_S11={path}"),
                *("--nights", "2", "--airmass", "1.0", "--out", str(out)),
            ]
        )
    assert status == 0
    return out, said.getvalue()


@pytest.mark.slow
def test_two_sensors_of_a_focal_plane(two_sensors) -> None:
    out, said = two_sensors
    sensors = Table.read(out / "focal_plane.ecsv")
    assert list(sensors["detector"]) == ["R22_S11", "R22_S12"]
    assert list(sensors["stand_in"]) == [False, True]
    # OH lines alone have 0.099 % with this map (physics.md), of which continua leave four fifths.
    assert sensors["rms"][0] == pytest.approx(0.08, abs=0.01)
    assert np.all(sensors["residual_2"] < 0.1)
    assert len(Table.read(out / "cells.ecsv")) == 128
    assert (out / "focal_plane.png").read_bytes().startswith(b"\x89PNG")
    assert "focal_plane.ecsv" in (out / "report.html").read_text(encoding="utf-8")
    assert "e2v: 2 sensors" in said
    assert "2 templates" in said


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 390])
def test_page_of_the_focal_plane_in_a_browser(two_sensors, width, tmp_path) -> None:
    check_page(two_sensors[0] / "report.html", tmp_path, width, f"focal_plane_{width}")


def test_cost_is_stated_and_nothing_is_written(tmp_path, capsys) -> None:
    assert run(["focal-plane", "--out", str(tmp_path / "out"), "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "189 sensors" in said
    assert "2458 quanta" in said
    assert not (tmp_path / "out").exists()


def test_cost_grows_with_sensors_and_exposures() -> None:
    one, all_of_them = FocalPlaneCost(1, 11), FocalPlaneCost(189, 11)
    assert all_of_them.disk_bytes == 189 * one.disk_bytes
    assert one.sensor_night_s < 20.0
    assert one.frame_bytes == 4004 * 4096 * 8
    assert FocalPlaneCost(1, 22).disk_bytes - one.disk_bytes == 11 * one.frame_bytes


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sensor", "R44_SG0"], "a science sensor"),
        (["--sensor", "R99_S00"], "R99_S00"),
        (["--thickness", "R22_S11=missing.fits"], "an existing FITS file"),
        (
            ["--sensor", "R22_S11", "--thickness", f"R22_S12={__file__}"],
            "a science sensor that --sensor chooses",
        ),
        (["--thickness", f"R22_S11={__file__}", "--thickness", f"R22_S11={__file__}"], "one map of a sensor"),
    ],
)
def test_bad_input_is_named(arguments, message, tmp_path, capsys) -> None:
    assert run(["focal-plane", *arguments, "--out", str(tmp_path / "out")]) == 1
    assert message in capsys.readouterr().err


def test_effects_that_a_set_up_cannot_have_are_left_out(capsys) -> None:
    settings = {"bandwidth.fwhm": 3.0, "silicon_absorption.scale": 1.1}
    assert focal_plane._of_stack(settings, "lsst_itl") == {"silicon_absorption.scale": 1.1}
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)
    assert err.startswith("lsst_itl: without bandwidth.fwhm (")


@pytest.mark.parametrize("text", ["thickness.fits", "=thickness.fits", "R22_S11="])
def test_a_map_without_its_sensor_is_a_usage_error(text, tmp_path, capsys) -> None:
    assert run(["focal-plane", "--thickness", text, "--out", str(tmp_path / "out")]) == 2
    assert f"'{text}' is not SENSOR=FILE" in capsys.readouterr().err


def test_amplitudes_names_what_it_would_compute(tmp_path, capsys) -> None:
    lines = tmp_path / "mine.ecsv"
    Table({"wavelength": [960.0], "intensity": [1.0]}).write(lines, format="ascii.ecsv")
    assert run(["amplitudes", "--lines", str(lines), "--dry-run"]) == 0
    assert "mine, PALACE lines" in capsys.readouterr().out
    lines.write_text("no table")
    assert run(["amplitudes", "--lines", str(lines), "--dry-run"]) == 1


@pytest.mark.slow
def test_amplitudes_of_a_given_map(tmp_path, capsys) -> None:
    path = tmp_path / "thickness.fits"
    fits.PrimaryHDU(e2v_321((60, 60)).astype(np.float32)).writeto(path)
    cases = ("--case", "MonoCam", "--case", "SLAC-TS8, flat")
    effect = ("--effect", "contrast_loss.factor=0.13")
    assert run(["amplitudes", "--thickness", str(path), *cases, *effect, "--out", str(tmp_path / "out")]) == 0
    table = Table.read(tmp_path / "out" / "amplitudes.ecsv")
    assert list(table["model"]) == ["undamped"] * 3 + ["with effects"] * 3
    for sentence in table.meta["contradiction"]:
        assert "no contrast that is common to both" in sentence
    assert "PALACE and continuum" in capsys.readouterr().out
