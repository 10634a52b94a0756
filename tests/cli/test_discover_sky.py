"""``fringe-sim discover`` with the set-up of a telescope."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from recorded_numbers import Record

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.products import SkyFringe, bands_of_header


@pytest.fixture(scope="module")
def sky(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A night of MonoCam and its map."""
    folder = tmp_path_factory.mktemp("sky_frames")
    layer = random_field((64, 72), np.random.default_rng(4), mean=14.0, span=2.5).astype(np.float32)
    thickness = folder / "thickness.fits"
    fits.PrimaryHDU(layer).writeto(thickness)
    out = folder / "night"
    given = ["sky", "--setup", "monocam", "--thickness", str(thickness), "--night", "--out", str(out)]
    assert run(given) == 0
    return out, str(thickness)


def test_frames_of_the_sky_state_their_bands(sky: tuple[Path, str]) -> None:
    frames = [SkyFringe.read_fits(file) for file in sorted(sky[0].glob("sky_*.fits"))]
    assert len(frames) == 11
    strength = [bands_of_header(frame.metadata)["8-4"] for frame in frames]
    assert max(strength) > 2.0 * min(strength)


@pytest.mark.slow
def test_nothing_is_found_in_frames_of_the_model_itself(sky: tuple[Path, str], tmp_path: Path) -> None:
    frames = [str(file) for file in sorted(sky[0].glob("sky_*.fits"))[:3]]
    out = tmp_path / "verdict"
    assert run(["discover", *frames, "--setup", "monocam", "--thickness", sky[1], "--out", str(out)]) == 0
    assert json.loads((out / "discovery.json").read_text())["verdict"] == "no_discrepancy"
    assert "agree" in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--setup", "monocam"], "--thickness"),
        (["--setup", "ts8_e2v", "--thickness", "map"], "set-up of a telescope"),
        (["--setup", "monocam", "--thickness", "nowhere.fits"], "nowhere.fits"),
    ],
)
def test_bad_requests(
    sky: tuple[Path, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    frames = [str(file) for file in sorted(sky[0].glob("sky_*.fits"))[:2]]
    assert run(["discover", *frames, "--out", str(tmp_path / "a"), *arguments]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_a_dry_run_writes_nothing(
    sky: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [
        "discover",
        str(sky[0]),
        "--setup",
        "monocam",
        "--thickness",
        sky[1],
        "--out",
        str(tmp_path / "a"),
    ]
    assert run([*given, "--dry-run"]) == 0
    assert "11 frames of 72 x 64" in capsys.readouterr().out
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("product", ["FringeFrame", "FringeTemplates"])
def test_templates_beside_the_frames_are_passed_over(
    sky: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], product: str
) -> None:
    """`fringe-sim sky --templates` writes them into the folder of its frames."""
    night = tmp_path / "night"
    night.mkdir()
    for file in sorted(sky[0].glob("sky_*.fits"))[:2]:
        shutil.copy(file, night)
    template = fits.PrimaryHDU()
    template.header["PRODUCT"] = product
    template.writeto(night / "fringe_0.fits")
    given = ["discover", str(night), "--setup", "monocam", "--thickness", sky[1], "--dry-run", "--out"]
    assert run([*given, str(tmp_path / "verdict")]) == 0
    assert "2 frames of 72 x 64" in capsys.readouterr().out


def test_a_night_and_its_map_on_the_sky_are_as_recorded(
    sky: tuple[Path, str], tmp_path: Path, recorded: Record
) -> None:
    """A record of what is written today, for edits that are not meant to change it."""
    out = tmp_path / "on_sky"
    assert run(["fit-sky", str(sky[0]), "--setup", "monocam", "--thickness", sky[1], "--out", str(out)]) == 0
    recorded({"night": sky[0], "on_sky": out})
