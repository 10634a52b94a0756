"""``fringe-sim demo``: the whole chain with the real programs, once, and what it leaves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from browser import check_page
from lsst.daf.butler import Butler

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.mock.thickness import e2v_321

SIZE = (500, 512)
PROGRAM = Path(sys.executable).parent / "fringe-sim"

pytestmark = [pytest.mark.slow, pytest.mark.middleware]


def demo(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(PROGRAM), "demo", "--out", str(folder), "--size", f"{SIZE[1]}x{SIZE[0]}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> tuple[Path, str]:
    """A finished demo and what it printed."""
    folder = tmp_path_factory.mktemp("demo") / "out"
    result = demo(folder)
    assert result.returncode == 0, result.stdout + result.stderr
    return folder, result.stdout


@pytest.fixture
def butler(done) -> Butler:
    with Butler.from_config(str(done[0] / "repo"), collections=["demo/sky", "demo/lab"]) as opened:
        yield opened


def test_it_ends_with_the_paths_of_what_it_made(done) -> None:
    folder, text = done
    lines = dict(
        line.rsplit(maxsplit=1) for line in text.splitlines() if line.startswith(("report", "fringe "))
    )
    assert lines["report"] == str(folder / "report.html")
    for path in lines.values():
        assert Path(path).exists(), path


def test_thickness_is_right(butler) -> None:
    """Median error below 3 nm, no slipped order, against the map that made the frames."""
    fitted = butler.get("epoxyThickness", instrument="LSST-TS8", detector=145)
    error = fitted.value - e2v_321(SIZE)
    good = fitted.mask == 0
    assert good.mean() > 0.9
    assert np.median(np.abs(error[good])) < 0.003
    assert np.all(np.abs(error[good]) < 0.15)


def test_sky_frames_and_components(butler) -> None:
    refs = butler.query_datasets("skyFringe")
    assert len(refs) == 11
    components = butler.get("fringeComponents", instrument="LSSTCam", detector=37, physical_filter="y_10")
    assert components.explained_variance_ratio[0] > 0.9
    template = butler.get("fringe", instrument="LSSTCam", detector=37, physical_filter="y_10")
    assert abs(float(template.image[template.mask == 0].mean())) < 1e-6
    assert np.all(np.isfinite(template.image))


def test_the_template_is_certified(done) -> None:
    with Butler.from_config(str(done[0] / "repo"), collections="demo/calib") as opened:
        associations = list(opened.registry.queryDatasetAssociations("fringe", "demo/calib"))
    assert len(associations) == 1
    assert associations[0].timespan is not None


def test_report_shows_every_section(done) -> None:
    text = (done[0] / "report.html").read_text(encoding="utf-8")
    for title in (
        "Laboratory flats",
        "Thickness of the adhesive",
        "Night sky",
        "Templates",
        "One measured pixel",
        "Search for a missing effect",
    ):
        assert title in text
    evidence = (done[0] / "discovery" / "report.html").read_text(encoding="utf-8")
    assert "Data minus model" in evidence
    assert len(list((done[0] / "figures").glob("*.png"))) >= 7


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", ["report.html", "discovery/report.html"])
def test_reports_open_in_a_browser(done, name, width, tmp_path) -> None:
    check_page(
        done[0] / name, tmp_path, width, f"demo_{name.removesuffix('.html').replace('/', '_')}_{width}"
    )


def test_running_it_again_does_nothing_twice(done) -> None:
    folder, _ = done
    before = {path: path.stat().st_mtime_ns for path in (folder / "repo").rglob("*.fits")}
    result = demo(folder)
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.count("done before") >= 8
    assert {path: path.stat().st_mtime_ns for path in (folder / "repo").rglob("*.fits")} == before


def test_other_settings_do_not_mix_with_it(done) -> None:
    folder, _ = done
    result = demo(folder, "--seed", "2")
    assert result.returncode == 1
    assert "same settings" in result.stderr
    assert json.loads((folder / "demo.json").read_text(encoding="utf-8"))["settings"]["seed"] == 1


def test_a_folder_with_other_things_is_left_alone(tmp_path, capsys) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    assert run(["demo", "--out", str(tmp_path)]) == 1
    assert "an empty folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert run(["demo", "--out", str(tmp_path), "--fresh"]) == 1
    assert (tmp_path / "thesis.tex").read_text() == "mine"


def test_dry_run(tmp_path, capsys) -> None:
    assert run(["demo", "--out", str(tmp_path / "demo"), "--dry-run"]) == 0
    assert not (tmp_path / "demo").exists()
