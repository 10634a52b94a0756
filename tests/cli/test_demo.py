"""``fringe-sim demo``: the whole chain with the real programs, once, and what it leaves."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from browser import check_page
from lsst.daf.butler import Butler

from lsst.fringe_sim.challenge.demo_case import DemoCase, found_words, thickness_of_demo
from lsst.fringe_sim.cli.demo_outcome import read_verdict
from lsst.fringe_sim.cli.main import run

SIZE = (256, 256)
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
    with Butler.from_config(str(done[0] / "repo"), collections=["demo/sky", "demo/found"]) as opened:
        yield opened


def test_it_ends_with_the_story_and_the_paths_of_what_it_made(done) -> None:
    folder, text = done
    story = dict(line.split(": ", 1) for line in text.splitlines() if ": " in line)
    case = DemoCase.from_json((folder / "sealed" / "truth.json").read_text(encoding="utf-8"))
    assert story["seed"] == "1"
    assert all(name in story["hidden"] for name in case.names)
    assert story["judgement"].startswith(found_words(case, read_verdict(folder)))
    lines = dict(
        line.rsplit(maxsplit=1)
        for line in text.splitlines()
        if line.startswith(
            ("report  ", "evidence  ", "fringe frames", "fringe template", "corrected visits  ")
        )
    )
    assert lines["report"] == str(folder / "report.html")
    assert len(lines) == 5
    for path in lines.values():
        assert Path(path).exists(), path


def test_what_is_hidden_is_found(done) -> None:
    """Seed 1, by name or class, as `python -m benchmarks demo` counts it; and data and model agree then."""
    case = DemoCase.from_json((done[0] / "sealed" / "truth.json").read_text(encoding="utf-8"))
    verdict = read_verdict(done[0])
    assert found_words(case, verdict) in ("right", "right class")
    assert verdict.gap.before > 10.0 * verdict.gap.noise_floor
    assert verdict.gap.after < 1.2 * verdict.gap.noise_floor
    assert "contrast_loss.factor" in (done[0] / "model.py").read_text(encoding="utf-8")


def test_the_truth_is_sealed(done) -> None:
    """No program that looks at the frames was given it, and the frames do not tell."""
    folder = done[0]
    assert {path.name for path in (folder / "sealed").iterdir()} == {"truth.json", "fringes.npz"}
    for log in (folder / "logs").glob("*.log"):
        assert str(folder / "sealed") not in log.read_text(encoding="utf-8"), log
    case = DemoCase.from_json((folder / "sealed" / "truth.json").read_text(encoding="utf-8"))
    for path in (folder / "raws").iterdir():
        content = path.read_bytes()
        assert not any(name.encode() in content for name in case.names)


def test_thickness_is_right(butler) -> None:
    """Median error below a fifteenth of a fringe, no slipped order, against the map that made the frames."""
    fitted = butler.get("epoxyThickness", instrument="LSST-TS8", detector=145)
    error = fitted.value - thickness_of_demo(SIZE)
    good = fitted.mask == 0
    assert good.mean() > 0.8
    assert np.median(np.abs(error[good])) < 0.02
    assert np.all(np.abs(error[good]) < 0.15)


def test_the_forecast_is_that_of_the_visits(done) -> None:
    """With what was found; without it, fringes are forecast several times too strong."""
    said = next(line for line in done[1].splitlines() if line.startswith("forecast of the sky"))
    without, found, true = map(float, re.findall(r"[\d.]+(?= %)", said))
    assert found == pytest.approx(true, rel=0.3)
    assert without > 4.0 * true


def test_sky_frames_and_components(butler) -> None:
    refs = butler.query_datasets("skyFringe")
    assert len(refs) == 11
    components = butler.get("fringeComponents", instrument="LSSTCam", detector=37, physical_filter="y_10")
    shares = components.explained_variance_ratio
    assert shares[0] > shares[1:].sum()
    template = butler.get("fringe", instrument="LSSTCam", detector=37, physical_filter="y_10")
    assert abs(float(template.image[template.mask == 0].mean())) < 1e-6
    assert np.all(np.isfinite(template.image))


def test_the_template_is_that_of_the_true_fringes(done, butler) -> None:
    """In visits of another simulator, less surfaces of second degree: shape and strength."""
    template = butler.get("fringe", instrument="LSSTCam", detector=37, physical_filter="y_10")
    good = template.mask == 0
    v, u = np.indices(SIZE) / SIZE[0]
    smooth = np.stack([np.ones(SIZE), u, v, u * u, u * v, v * v], axis=-1)[good]
    with np.load(done[0] / "sealed" / "fringes.npz") as stored:
        mean = (stored["fringes"] / stored["level"][:, np.newaxis, np.newaxis]).mean(axis=0)
    true, ours = (
        image[good] - smooth @ np.linalg.lstsq(smooth, image[good], rcond=None)[0]
        for image in (mean.astype(float), template.image.astype(float))
    )
    assert np.corrcoef(true, ours)[0, 1] > 0.85
    assert np.std(ours) == pytest.approx(np.std(true), rel=0.3)


def test_the_template_is_certified(done) -> None:
    with Butler.from_config(str(done[0] / "repo"), collections="demo/calib") as opened:
        associations = list(opened.registry.queryDatasetAssociations("fringe", "demo/calib"))
    assert len(associations) == 1
    assert associations[0].timespan is not None


def test_report_shows_every_section(done) -> None:
    text = (done[0] / "report.html").read_text(encoding="utf-8")
    for title in (
        "Truth beside verdict",
        "The sky with and without it",
        "Visits with stars",
        "Laboratory flats",
        "Thickness of the adhesive",
        "Night sky",
        "Templates",
        "One measured pixel",
    ):
        assert title in text
    evidence = (done[0] / "discovery" / "report.html").read_text(encoding="utf-8")
    assert "Data minus model" in evidence
    assert len(list((done[0] / "figures").glob("*.png"))) >= 7


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", ["report.html", "discovery/report.html", "corrected/report.html"])
def test_reports_open_in_a_browser(done, name, width, tmp_path) -> None:
    check_page(
        done[0] / name, tmp_path, width, f"demo_{name.removesuffix('.html').replace('/', '_')}_{width}"
    )


def test_running_it_again_does_nothing_twice(done) -> None:
    folder, _ = done
    before = {path: path.stat().st_mtime_ns for path in (folder / "repo").rglob("*.fits")}
    result = demo(folder)
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.count("done before") >= 16
    assert "…" not in result.stdout
    assert {path: path.stat().st_mtime_ns for path in (folder / "repo").rglob("*.fits")} == before


def test_other_settings_do_not_mix_with_it(done) -> None:
    folder, _ = done
    result = demo(folder, "--seed", "2")
    assert result.returncode == 1
    assert "same settings" in result.stderr
    assert json.loads((folder / "demo.json").read_text(encoding="utf-8"))["settings"]["seed"] == 1


def test_a_folder_with_other_things_is_left_alone(tmp_path, capsys) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    for dry in ([], ["--dry-run"]):
        assert run(["demo", "--out", str(tmp_path), *dry]) == 1
    assert "an empty folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert run(["demo", "--out", str(tmp_path), "--fresh"]) == 1
    assert (tmp_path / "thesis.tex").read_text() == "mine"


def test_dry_run(tmp_path, capsys) -> None:
    assert run(["demo", "--out", str(tmp_path / "demo"), "--dry-run"]) == 0
    assert not (tmp_path / "demo").exists()
