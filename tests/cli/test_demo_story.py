"""The demo step by step, with its programs replaced by results made by hand; `test_demo` runs the real ones."""

import json
import re
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from product_makers import components, frame, sky
from recorded_numbers import Record
from small_pages import WAVELENGTHS_NM, smooth_map

from lsst.fringe_sim.algorithms.discovery import Verdict
from lsst.fringe_sim.algorithms.discovery.verdict import Gap, NamedEffect, ParameterValue, Where
from lsst.fringe_sim.challenge.demo_case import DemoCase
from lsst.fringe_sim.cli import demo, demo_report, demo_truth
from lsst.fringe_sim.cli.demo_outcome import Outcome
from lsst.fringe_sim.cli.demo_report import DemoDatasets
from lsst.fringe_sim.cli.demo_truth import DemoTruth
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.mock.visits import MockVisit
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube
from lsst.fringe_sim.report.page import Report

pytestmark = pytest.mark.middleware

SIDE = 24
VISITS = [f"visit_{number + 1:03d}_R11_S01" for number in range(4)]


def waves(strength: float, number: int = 0) -> np.ndarray:
    """Fringes over the light of the sky, on a slope that a background would take."""
    y, x = np.indices((SIDE, SIDE)) / SIDE
    return (strength * np.cos(20.0 * x + 9.0 * y + number) + 0.02 * x - 0.01 * y * y).astype(np.float32)


def verdict(**changes: Any) -> Verdict:
    amplifiers = {
        f"C{row}{column}": ParameterValue(1e-3 * (row - column), 2e-4, "")
        for row in (0, 1)
        for column in range(8)
    }
    named = (
        NamedEffect("contrast_loss", {"factor": ParameterValue(0.134, 0.002, "")}, 0.99, ("ghost_pedestal",)),
        NamedEffect("amplifier_gain", amplifiers, 0.98),
    )
    tests = ({"name": "thickness phase", "statistic": 14872.2, "degrees": 120, "probability": 0.0},)
    colour = tuple({"wavelength_nm": w, "chi2": 70.0, "degrees": 7.0, "rms": 6e-3} for w in WAVELENGTHS_NM)
    values: dict[str, Any] = {
        "verdict": "named", "effects": named, "gap": Gap("rms", 0.02, 0.0071, 0.02, 0.0072, 0.007),
        "candidates": ({"name": "contrast_loss", "score": 63.8, "degrees": 1},),
        "where": Where(colour, (), 28.1, (), tests),
    }  # fmt: skip
    values |= changes
    return Verdict(steps=(), unexplained={}, setup="ts8_e2v", global_probability=0.0, **values)


def datasets(folder: Path) -> DemoDatasets:
    fitted, model = smooth_map(), FringeModel.from_setup("ts8_e2v", {"contrast_loss.factor": 0.13})
    response = model.response(fitted.value.ravel().astype(float), WAVELENGTHS_NM).reshape(-1, SIDE, SIDE)
    counts = 1e5 * response / response.mean(axis=(1, 2), keepdims=True)
    good, pattern = np.zeros((SIDE, SIDE), np.int32), waves(0.004).astype(float)
    return DemoDatasets(
        cube=FringeCube.from_arrays(counts, WAVELENGTHS_NM, variance=counts),
        first_thickness=replace(fitted, value=fitted.value + np.float32(3.0)),
        thickness=fitted,
        sky=tuple(sky((SIDE, SIDE), number, mask=good, hour=20.0 + number) for number in (1, 2)),
        template=frame((SIDE, SIDE), mask=good, image=pattern - pattern.mean()),
        components=components((SIDE, SIDE), mask=good),
        thickness_path=folder / "thickness.fits",
        sky_folder=folder / "sky",
        template_path=folder / "template.fits",
    )


class Programs:
    """What the demo asks for, and what its programs would leave."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.said, self.asked = folder, [], []
        self.status: dict[str, int] = {}

    def run(self, command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        assert options["check"] is False
        words = [str(word).replace(str(self.folder), "DEMO") for word in command]
        name = Path(words[0]).name
        self.said.append(" ".join([name, *words[1:]]))
        log = Path(options["stdout"].name).stem
        if log in self.status:
            options["stdout"].write("".join(f"line {number}\n" for number in range(20)))
        if log == "discover":
            (self.folder / "discovery").mkdir(exist_ok=True)
            (self.folder / "discovery" / "discovery.json").write_text(verdict().to_json())
        if log.startswith("sky_"):
            (self.folder / log).mkdir(exist_ok=True)
            strength = 0.03 if log == "sky_without" else 0.004
            image = (1.0 + waves(strength)) * 2000.0
            made = sky((SIDE, SIDE), image=image.astype(np.float32), mask=np.zeros((SIDE, SIDE), np.int32))
            made.write_fits(self.folder / log / "sky_R11_S01_00.fits")
        if log == "correct":
            self.correct()
        return subprocess.CompletedProcess(command, self.status.get(log, 0))

    def correct(self) -> None:
        """Of three visits half, none and most of the fringes are taken; the fourth is not there."""
        corrected = self.folder / "corrected"
        corrected.mkdir()
        rows = []
        for number, (name, part) in enumerate(zip(VISITS[:3], (0.5, 0.0, 0.9), strict=True)):
            level = 1000.0 + 100.0 * number
            image = level * (1.0 + waves(0.005, number).astype(float))
            taken = part * level * waves(0.005, number)
            if number == 2:
                taken[0, 0] = np.nan
            for path, pixels in (
                (self.folder / "visits" / f"{name}.fits", image),
                (corrected / f"{name}_corrected.fits", image - taken),
            ):
                fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(pixels, name="IMAGE")]).writeto(path)
            rows.append((name, level * (0.8 + 0.2 * number), level * 0.1 * (1 + number)))
        Table(rows=rows, names=("name", "scale 0", "sigma 0")).write(corrected / "frames.ecsv")
        (corrected / "report.html").write_text("page")

    def flats(self, raws: Path, **settings: Any) -> None:
        raws.mkdir()
        self.asked.append({"raws": raws.name, **settings, "rng": settings["rng"].random()})

    def visits(self, folder: Path, **settings: Any) -> Any:
        folder.mkdir()
        self.asked.append({"night": folder.name, **settings, "rng": settings["rng"].random()})
        for number, name in enumerate(VISITS):
            level = 1000.0 + 100.0 * number
            yield MockVisit(folder / f"{name}.fits", (level * waves(0.005, number)).astype(np.float32), level)


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Programs:
    made = Programs(tmp_path / "demo")
    monkeypatch.setattr(demo.subprocess, "run", made.run)
    monkeypatch.setattr(demo_truth, "write_mock_flats", made.flats)
    monkeypatch.setattr(demo_truth, "write_mock_visits", made.visits)
    monkeypatch.setattr(demo_report, "dataset_path", lambda repo, name, run: Path(f"{name}@{run}"))
    monkeypatch.setattr(DemoDatasets, "read", lambda *names: datasets(made.folder))
    return made


def told(capsys: pytest.CaptureFixture[str], folder: Path) -> list[str]:
    text = re.sub(
        r"\d+\.\d s$", "T s", capsys.readouterr().out.replace(str(folder), "DEMO"), flags=re.MULTILINE
    )
    return text.splitlines()


def test_the_whole_story(
    programs: Programs, tmp_path: Path, capsys: pytest.CaptureFixture[str], recorded: Record
) -> None:
    """Every program with its words, every line, and the page; again, nothing is done twice."""
    words = ["demo", "--out", str(programs.folder), "--size", "24x24", "--seed", "4"]
    assert run([*words, "--dry-run"]) == 0
    assert told(capsys, programs.folder) == [
        "would simulate 24x24 pixels of E2V-CCD250-321 with a hidden effect and process them in DEMO/repo"
    ]
    assert run(words) == 0
    lines = told(capsys, programs.folder)
    assert lines[0] == "Demo in DEMO: 24x24 pixels of E2V-CCD250-321, seed 4"
    steps = [line for line in lines if line.endswith("T s")]
    assert len(steps) == len(json.loads((programs.folder / "demo.json").read_text())["done"]) == 17
    assert any(line == "  search for a missing effect: begun" for line in lines)
    assert [line for line in lines if line.startswith("report   ")] == ["report            DEMO/report.html"]
    (tmp_path / "told.txt").write_text("\n".join(lines))
    (tmp_path / "programs.txt").write_text("\n".join(sorted(programs.said)))
    page = programs.folder / "report.html"
    recorded(
        {
            "told": [line.split(": ")[0] for line in lines],
            "numbers": tmp_path / "told.txt",
            "programs": [re.sub(r"[^A-Za-z_ +.-]+", " ", line) for line in sorted(programs.said)],
            "words": tmp_path / "programs.txt",
            "asked": programs.asked,
            "page": page,
            "figures": programs.folder / "figures",
            "model": (programs.folder / "model.py").read_text().splitlines()[1:-1],
        }
    )
    for wanted in (
        "butler create DEMO/repo --seed-config resource://lsst.fringe_sim/configs/butler.yaml",
        "butler certify-calibrations DEMO/repo demo/sky demo/calib fringe --begin-date 2025-01-01 --end-date "
        "2035-01-01",
        "fringe-sim discover DEMO/raws --setup ts8_e2v --out DEMO/discovery --overwrite --seed 4 --cells 4096",
        "fringe-sim sky --thickness epoxyThickness@demo/found --detector E2V-CCD250-321 --noiseless --effects-file "
        "DEMO/model.py --out DEMO/sky_with --overwrite",
        "pipetask run -b DEMO/repo -i demo/lab -o demo/found -p "
        "resource://lsst.fringe_sim/pipelines/ts8/labFlats.yaml#epoxyFit -d instrument='LSST-TS8' AND detector=145 "
        "-C epoxyFit:DEMO/model.py --register-dataset-types -j 1",
    ):
        assert wanted in programs.said
    number = len(programs.said)
    assert run(words) == 0
    again = told(capsys, programs.folder)
    assert len(programs.said) == number
    assert sum(line.endswith(": done before") for line in again) == 17
    assert again[-15:] == lines[-15:]
    assert run([*words[:-1], "5"]) == 1
    assert run([*words[:-1], "5", "--dry-run"]) == 1
    (programs.folder / "thesis.tex").write_text("mine")
    assert run([*words, "--fresh"]) == 1
    (programs.folder / "thesis.tex").unlink()
    assert run([*words[:-1], "5", "--fresh", "--dry-run"]) == 0


@pytest.mark.parametrize(("log", "status"), [("create", 1), ("correct", 2), ("discover", 1)])
def test_a_program_that_fails(
    log: str, status: int, programs: Programs, capsys: pytest.CaptureFixture[str]
) -> None:
    """The end of what it said is shown, and the steps before are not done again."""
    programs.status[log] = status
    assert run(["demo", "--out", str(programs.folder), "--size", "24x24"]) == 1
    captured = capsys.readouterr()
    assert "failed; see" in captured.err
    assert "line 19" in captured.err
    assert "line 5" in captured.err.replace("line 15", "")
    assert "line 4" not in captured.err.replace("line 14", "")
    assert "failed" in captured.out
    done = json.loads((programs.folder / "demo.json").read_text())["done"]
    assert ("raws" in done, log in done) == (True, False)
    for _ in range(1000):  # the search runs beside the others, and must not run into the next test
        if (programs.folder / "discovery" / "discovery.json").exists():
            return
        time.sleep(0.01)
    pytest.fail("nothing was searched")


def test_visits_that_are_refused_do_not_end_it(
    programs: Programs, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    programs.status["correct"] = 1
    monkeypatch.setattr(demo_report, "write_demo_report", lambda *parts: None)
    assert run(["demo", "--out", str(programs.folder), "--size", "24x24"]) == 0
    assert "T s" in "\n".join(told(capsys, programs.folder))


class NoFigures(Report):
    """A page of which the names of figures are kept."""

    def __init__(self) -> None:
        super().__init__("t", "s")
        self.names: list[str] = []

    def add(self, name: str, made: Any, caption: str) -> None:
        self.names.append(name)


def outcome(**changes: Any) -> Outcome:
    frames = tuple(
        sky(
            (SIDE, SIDE),
            image=(2000.0 * (1.0 + waves(part))).astype(np.float32),
            mask=np.zeros((SIDE, SIDE), np.int32),
        )
        for part in (0.03, 0.004)
    )
    fringe = SimpleNamespace(
        name="v",
        before=waves(0.01),
        after=waves(0.002),
        corrected=True,
        strength=(0.9, 0.1),
        rms=(0.01, 0.002),
    )
    other = SimpleNamespace(
        **{**vars(fringe), "corrected": False, "strength": (0.5, 0.2), "rms": (0.02, 0.02)}
    )
    case = DemoCase(
        4,
        (SIDE, SIDE),
        {"contrast_loss.factor": 0.13, "illumination.gradient_x": 0.003, "illumination.gradient_y": -0.002},
    )
    values: dict[str, Any] = {
        "case": case,
        "verdict": verdict(),
        "map_errors_nm": (12.3, 1.23),
        "forecast": frames,
        "visits": (fringe, other),
    }
    return Outcome(**(values | changes))


def test_numbers_of_the_story() -> None:
    """Means over visits are of squares, or weighted; percent are of the sky."""
    made = outcome()
    assert made.rms_of_fringes == pytest.approx((np.sqrt(2.5e-4), np.sqrt(2.02e-4)))
    assert made.measured == pytest.approx(((0.9 * 100 + 0.5 * 25) / 125, 125**-0.5))
    lines = dict(made.lines())
    assert lines["judgement"].startswith("wrong")
    assert lines["hidden"] == (
        "contrast_loss (factor = 0.13); illumination (gradient_x = 0.003, gradient_y = -0.002)"
    )
    gains = np.std([1e-3 * (row - column) for row in (0, 1) for column in range(8)])
    assert lines["found"] == (
        f"contrast_loss (factor = 0.134 ± 0.002), or ghost_pedestal; amplifier_gain (rms {gains:.2g})"
    )
    assert lines["data minus model"] == "2.86 times the noise before, 1.01 times after"
    assert lines["error of the thickness map"].startswith("12 nm with the unchanged model, 1.2 nm with what")
    assert lines["forecast of the sky"] == (
        "fringes of 1.6 % rms with the unchanged model, 0.21 % with what was found; 1.6 % in the visits"
    )
    assert lines["fringes in the visits"] == (
        "1.6 % of the sky (rms) before the correction, 1.4 % after; seen and subtracted in 1 of 2 visits, which "
        "together measure 0.17 ± 0.02 %"
    )
    assert lines["seed"] == "4"
    silent = outcome(verdict=verdict(verdict="unexplained", effects=()))
    assert dict(silent.lines())["found"] == "unexplained"


@pytest.mark.parametrize("bare", [False, True])
def test_figures_of_the_story(bare: bool) -> None:
    """Those of which there is something to be shown."""
    page = NoFigures()
    changes: dict[str, Any] = (
        {"where": Where(), "candidates": (), "gap": Gap("rms", *[np.nan] * 5)} if bare else {}
    )
    outcome(verdict=verdict(**changes)).tell(page, page.add)
    seen = [] if bare else ["discovery_where", "discovery_candidates", "discovery_gap"]
    assert page.names == [*seen, "forecast", "visit"]
    text = page.to_html()
    assert "Not taken to the sky, as flat fields or the laboratory keep it: amplifier_gain." in text
    assert text.count("<tr") > 18
    for word in (
        "contrast_loss.factor",
        "0.13",
        "0.134",
        "illumination.gradient_x",
        "amplifier_gain.C00",
        "–",
        "yes",
        "no",
    ):
        assert word in text


def test_what_is_sealed_is_read_back(tmp_path: Path, programs: Programs) -> None:
    truth = DemoTruth(tmp_path / "sealed", 7, (96, 128))
    truth.write_flats(tmp_path / "raws")
    truth.write_visits(tmp_path / "visits", 4)
    assert truth.case().seed == 7
    found = truth.fringes()
    assert [name for name, _, _ in found] == VISITS
    assert [level for _, _, level in found] == [1000.0, 1100.0, 1200.0, 1300.0]
    np.testing.assert_array_equal(found[1][1], 1100.0 * waves(0.005, 1))
    assert truth.thickness_um().shape == (96, 128)
    flats, night = programs.asked
    assert (flats["setup"], flats["detector"], flats["size"]) == ("ts8_e2v", "E2V-CCD250-321", "128x96")
    assert (night["setup"], night["thickness_um"].shape) == ("lsst_e2v", (96, 128))
    assert night["conditions"].visits == 4
    assert flats["effects"] == truth.case().values
    assert night["effects"] == truth.case().on_sky
