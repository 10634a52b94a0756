"""What commands say and write around their long work, which is replaced by results made by hand."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from recorded_numbers import Record
from small_pages import smooth_map

from lsst.fringe_sim.algorithms import warm_up
from lsst.fringe_sim.algorithms.public_evidence import verdict as evidence_verdict
from lsst.fringe_sim.challenge import run as challenge_run
from lsst.fringe_sim.challenge.result import CaseResult, ChallengeResult
from lsst.fringe_sim.cli import amplitudes, compile, focal_plane
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.cli.mock_flats import thickness_map
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.report import evidence_text

Say = Callable[..., tuple[int, list[str], list[str]]]


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Say:
    """Status and both streams of a command, in lines, without the folder of the test."""

    def said(*words: object) -> tuple[int, list[str], list[str]]:
        capsys.readouterr()
        status = run([str(word) for word in words])
        out, err = (text.replace(str(tmp_path), "…").splitlines() for text in capsys.readouterr())
        return status, out, err

    return said


def case(number: int, **changes: Any) -> CaseResult:
    values: dict[str, Any] = {
        "number": number, "kind": "one", "truth": ("tilt", "roughness"), "values": {}, "verdict": "named",
        "found": ("tilt",), "ambiguous": ((),), "right_class": False, "exact": False, "signal_to_noise": 20.0,
        "weakest": 20.0, "probability": 0.9, "name_probability": 0.9, "pulls": {}, "shrinkage": 0.9, "seconds": 11.6,
    }  # fmt: skip
    return CaseResult(**(values | changes))


def test_a_challenge_goes_on_and_says_so(say: Say, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def cases(counts: Any, seed: int, *, size: Any, setup: str, known: Any, jobs: int, progress: Any) -> Any:
        asked.append((dict(counts), seed, size, setup, [each.number for each in known], jobs))
        silent = {"kind": "none", "truth": (), "found": (), "verdict": "no_discrepancy", "seconds": 0.4}
        made = [case(0), case(1, **silent), case(5)]
        for each in made[len(known) :]:
            progress(each)
        return ChallengeResult(seed, tuple(made[:2]))

    monkeypatch.setattr(challenge_run, "run_challenge", cases)
    words = [
        "challenge",
        "--seed",
        3,
        "--none",
        2,
        "--one",
        2,
        "--two",
        0,
        "--outsider",
        0,
        "--size",
        "40x30",
    ]
    words += ["--jobs", 2, "--out", tmp_path / "out"]
    identity = {"seed": 3, "setup": "ts8_e2v", "columns": 40, "rows": 30}
    status, out, err = say(*words)
    assert status == 0
    assert err == ["1 of 4: tilt+roughness -> tilt (12 s)", "2 of 4: none -> no_discrepancy (0 s)",
                   "3 of 4: tilt+roughness -> tilt (12 s)"]  # fmt: skip
    assert out[-1] == "…/out/challenge.ecsv"
    assert json.loads("\n".join(out[:-1]))["false_discoveries"] == [0, 1]
    record = tmp_path / "out" / "cases.jsonl"
    assert [json.loads(line).get("number") for line in record.read_text().splitlines()] == [None, 0, 1, 5]
    assert json.loads(record.read_text().splitlines()[0]) == identity
    record.write_text(record.read_text()[:-10])
    status, out, err = say(*words)
    assert err == ["2 of 4 cases are there from before", "3 of 4: tilt+roughness -> tilt (12 s)"]
    assert (status, len(record.read_text().splitlines())) == (0, 4)
    status, _, err = say(*words)
    assert err == ["2 of 4 cases are there from before"]  # of the third, five were asked for once
    counts = {"none": 2, "one": 2, "two": 0, "outsider": 0}
    assert asked == [(counts, 3, (30, 40), "ts8_e2v", known, 2) for known in ([], [0, 1], [0, 1, 5])]
    assert say(*words[:-2], "--out", tmp_path / "new", "--dry-run")[1] == [
        f"would run 4 cases of 40 x 30 pixels of ts8_e2v: {counts}"
    ]


def test_evidence_compares_the_sets_that_are_asked_for(say: Say, tmp_path: Path, monkeypatch) -> None:
    asked: list[Any] = []

    def compare(sets: Any, advance: Any) -> Any:
        asked.append([tuple(names) for names in sets])
        for _ in range(len(sets) + 1):
            advance()
        return SimpleNamespace(content=lambda: {"sets": len(sets)})

    monkeypatch.setattr(evidence_verdict, "compare", compare)
    monkeypatch.setattr(
        evidence_text, "evidence_text", lambda found: f"verdict: of {found.content()['sets']}"
    )
    two, out = ["--effect", "bandwidth", "--effect", "contrast_loss"], tmp_path / "out"
    assert say("evidence", *two, "--out", out)[:2] == (
        0, ["verdict: of 3", "…/out/evidence.json", "…/out/evidence.txt"]
    )  # fmt: skip
    assert (out / "evidence.json").read_text() == '{\n  "sets": 3\n}\n'
    assert (out / "evidence.txt").read_text() == "verdict: of 3\n"
    assert say("evidence", *two[:2])[1] == ["verdict: of 1"]
    assert say("evidence")[0] == 0
    assert asked[0] == [("bandwidth",), ("contrast_loss",), ("bandwidth", "contrast_loss")]
    assert asked[1] == [("bandwidth",)]
    assert asked[2] == [tuple(names) for names in evidence_verdict.RIVALS]
    assert say("evidence", *two, "--dry-run")[1] == [
        "would compare bandwidth, contrast_loss, bandwidth + contrast_loss and no effect at all"
    ]


def test_amplitudes_shows_a_table_and_writes_it(say: Say, tmp_path: Path, monkeypatch) -> None:
    asked: list[Any] = []

    def compared(adhesive: Any, skies: Any, settings: Any, rows: Any) -> Table:
        asked.append((adhesive.shape, [sky.name for sky in skies], settings, [row.name for row in rows]))
        table = Table(
            {
                "case": ["a", "b"],
                "setup": ["x", "y"],
                "temperature": [1, 2],
                "layer": ["u", "v"],
                "rms": [0.5, 1.5],
            }
        )
        table.meta["contradiction"] = ["One sentence.", "Another."]
        return table

    monkeypatch.setattr(amplitudes, "compare_amplitudes", compared)
    status, out, _ = say(
        "amplitudes", "--case", "MonoCam", "--effect", "bandwidth.fwhm=2.5", "--out", tmp_path / "out"
    )
    assert status == 0
    assert [line.split() for line in out[:4]] == [
        ["case", "rms"],
        ["----", "---"],
        ["a", "0.5"],
        ["b", "1.5"],
    ]
    assert out[4:] == ["One sentence.", "Another.", "…/out/amplitudes.ecsv"]
    assert Table.read(tmp_path / "out" / "amplitudes.ecsv").colnames == [
        "case",
        "setup",
        "temperature",
        "layer",
        "rms",
    ]
    assert say("amplitudes")[1][-1] == "Another."
    assert asked[0][2:] == ({"bandwidth.fwhm": 2.5}, ["MonoCam"])
    assert asked[0][0] == (251, 256)
    assert asked[0][1] == asked[1][1]
    assert asked[1][3] == [each.name for each in amplitudes.CASES]


def test_compiling_does_every_piece_of_work(say: Say, monkeypatch) -> None:
    done: list[str] = []

    class Pool:
        def __init__(self, processes: int, context: Any) -> None:
            assert (processes, context.get_start_method()) == (2, "spawn")

        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: Any) -> None:
            pass

        def submit(self, work: Any, name: str) -> Any:
            return SimpleNamespace(result=lambda: done.append(name))

    monkeypatch.setattr(compile, "ProcessPoolExecutor", Pool)
    monkeypatch.setenv("NUMBA_CPU_NAME", "")
    status, out, _ = say("compile")
    assert (status, len(out)) == (0, 1)
    assert re.fullmatch(r"compiled in \d s", out[0])
    assert os.environ["NUMBA_CPU_NAME"] == ""
    assert done == [*warm_up.FIRST, "simulated flats", *warm_up.THEN]
    assert say("compile", "--cpu", "generic")[0] == 0
    assert os.environ["NUMBA_CPU_NAME"] == "generic"


def test_flats_are_simulated_while_compiling(monkeypatch) -> None:
    """A bias frame and a flat of a few pixels."""
    from lsst.fringe_sim.mock import raw_frames

    made: list[Any] = []
    write = raw_frames.write_mock_flats
    monkeypatch.setattr(
        raw_frames, "write_mock_flats", lambda *parts, **more: made.append(write(*parts, **more))
    )
    compile._simulated()
    assert [len(run.paths) for run in made] == [2]


FINDING = {"place": "Fig. 1", "quantity": "order", "unit": "nm", "stated": "3", "tolerance": 0.5}


@pytest.mark.parametrize("folder", [True, False])
def test_the_paper_is_told_number_by_number(folder: bool, say: Say, tmp_path: Path, monkeypatch) -> None:
    import lsst.fringe_sim.paper as paper
    from lsst.fringe_sim.report import paper_page

    def finding(status: str, value: float, cold: float) -> Any:
        return SimpleNamespace(number=SimpleNamespace(**FINDING), status=status, value=value, cold=cold)

    asked: list[Any] = []

    def reproduce(context: Any, advance: Any) -> Any:
        asked.append((context.thickness_um.shape if hasattr(context, "thickness_um") else None, context))
        findings = [finding("differs", 4.0, np.nan), finding("agrees", 3.0, 3.2), finding("agrees", 3.0, 3.1)]
        return SimpleNamespace(
            table=lambda: Table({"item": [1]}), all_findings=findings, summary=lambda: "2 agree"
        )

    pages: list[Any] = []
    monkeypatch.setattr(paper, "reproduce", reproduce)
    monkeypatch.setattr(
        paper_page, "write_paper_page", lambda made, path, notices, origin: pages.append(notices)
    )
    monkeypatch.setenv("FRINGE_SIM_SHARED", str(tmp_path / "curves"))
    monkeypatch.chdir(tmp_path)
    if folder:
        (tmp_path / "curves" / "measured").mkdir(parents=True)
    status, out, err = say(
        "reproduce-paper", "--out", tmp_path / "out", "--size", "80x64", "--coadds", 7, "--seed", 9
    )
    assert status == 0
    assert out == [
        "differs: Fig. 1: order: 4 nm (paper 3 ± 0.5)",
        "silicon: Fig. 1: order: 3 nm with the constants of the paper, 3.2 with those measured in the cold",
        "2 agree",
        "…/out/paper.html",
        "…/out/paper.ecsv",
    ]
    assert err[0] == (
        "published curves: …/curves" if folder
        else "skipping comparisons with published curves; --published FOLDER or $FRINGE_SIM_SHARED"
    )  # fmt: skip
    assert [len(each) for each in pages] == [0 if folder else 1]
    maps = [value for value in vars(asked[0][1]).values() if isinstance(value, np.ndarray)]
    assert [each.shape for each in maps] == [(64, 80), (1000, 1000)]
    assert {7, 9} <= {value for value in vars(asked[0][1]).values() if isinstance(value, int)}
    for size, status in (
        ("64x64", 0),
        ("63x64", 1),
        ("64x63", 1),
        ("4096x4004", 0),
        ("4097x100", 1),
        ("100x4005", 1),
    ):
        assert say("reproduce-paper", "--out", tmp_path / "no", "--size", size, "--dry-run")[0] == status


def test_thicknesses_that_are_drawn(recorded: Record) -> None:
    """For either layer, for a small part of a sensor, and from what is built in."""
    rng = np.random.default_rng(51)
    e2v, itl = Setup.from_name("ts8_e2v"), Setup.from_name("ts8_itl")
    recorded(
        {
            "adhesive": thickness_map("random", e2v, (2000, 8), rng),
            "small": [thickness_map("random", e2v, (20, 30), rng) for _ in range(3)],
            "large": [np.ptp(thickness_map("random", e2v, (4000, 4000 // 1000), rng)) for _ in range(2)],
            "silicon": thickness_map("random", itl, (20, 30), rng),
            "built": thickness_map("e2v_321", e2v, (20, 30), rng),
        }
    )
    with pytest.raises(InputError, match="layer detection"):
        thickness_map("e2v_321", itl, (20, 30), rng)


def test_a_map_of_another_size_is_resampled(tmp_path: Path) -> None:
    smooth_map().write_fits(tmp_path / "map.fits")
    rng = np.random.default_rng(1)
    setup = Setup.from_name("ts8_e2v")
    same = thickness_map(str(tmp_path / "map.fits"), setup, (24, 24), rng)
    other = thickness_map(str(tmp_path / "map.fits"), setup, (12, 48), rng)
    assert (same.shape, other.shape) == ((24, 24), (12, 48))
    np.testing.assert_allclose(np.nanmedian(same), np.nanmedian(other), atol=0.02)


def test_mocks_tell_what_they_write(say: Say, tmp_path: Path, monkeypatch) -> None:
    from lsst.fringe_sim.mock import raw_frames, visits

    asked: list[dict[str, Any]] = []

    def flats(folder: Path, **settings: Any) -> Any:
        asked.append(settings)
        settings["progress"](folder / "a")
        return SimpleNamespace(paths=("a", "b"))

    def of_visits(folder: Path, **settings: Any) -> Any:
        asked.append(settings)
        picture = np.zeros((8, 8), np.float32)
        for number in range(settings["conditions"].visits):
            yield visits.MockVisit(folder / f"visit_{number}.fits", picture + 2.0, 1234.0 + number)

    monkeypatch.setattr(raw_frames, "write_mock_flats", flats)
    monkeypatch.setattr(visits, "write_mock_visits", of_visits)
    made = ["mock-flats", tmp_path / "raws", "--seed", 1, "--size", "128x64", "--effect", "tilt.angle=2"]
    assert say(*made, "--dry-run")[1] == ["would write 17 frames of RTM-020_S01, 128 x 64 pixels, to …/raws"]
    assert say(*made, "--temperature", "-100degC", "--bias-frames", 3)[:2] == (0, ["2 raw frames in …/raws"])
    assert asked[0]["effects"] == {"tilt.angle": 2.0, "temperature.kelvin": pytest.approx(173.15)}
    assert (asked[0]["size"], asked[0]["n_bias"], asked[0]["silicon"]) == ("128x64", 3, None)
    assert asked[0]["thickness_um"].shape == (64, 128)
    assert asked[0]["defects"] is None
    night = ["mock-visits", tmp_path / "night", "--seed", 1, "--size", "128x64", "--visits", 2, "--stars", 1]
    assert say(*night, "--dry-run")[1] == ["would write 2 visits of R22_S11, 128 x 64 pixels, to …/night"]
    status, out, err = say(*night, "--truth", tmp_path / "truth", "--moon", 0.25)
    assert status == 0
    assert out
    assert any("then 2 visits of about" in line for line in err)
    assert (asked[1]["conditions"].stars_per_arcmin2, asked[1]["conditions"].moon) == (1.0, 0.25)
    assert len(list((tmp_path / "truth").glob("*.fits"))) == 2


# The focal plane


def test_sensors_that_are_chosen() -> None:
    assert len(focal_plane._chosen(())) == 189
    names = [each.name for each in focal_plane._chosen(("R22", "R22_S11", "R01_S00"))]
    assert names == [f"R22_S{y}{x}" for y in range(3) for x in range(3)] + ["R01_S00"]
    with pytest.raises(InputError, match="a science sensor or a raft"):
        focal_plane._chosen(("R44_SG0",))


@pytest.mark.parametrize(
    ("maps", "said"),
    [
        ([("R01_S00", True)], "that --sensor chooses"),
        ([("R22_S11", True), ("R22_S11", True)], "one map of a sensor"),
        ([("R22_S11", False)], "an existing FITS file"),
    ],
)
def test_maps_that_cannot_be_used(maps: list[tuple[str, bool]], said: str, tmp_path: Path) -> None:
    (tmp_path / "a.fits").write_text("")
    given = [
        SimpleNamespace(name=name, path=tmp_path / ("a.fits" if there else "b.fits")) for name, there in maps
    ]
    chosen = focal_plane._chosen(("R22",))
    with pytest.raises(InputError, match=said):
        focal_plane._measured(given, chosen)
    good = [SimpleNamespace(name="R22_S11", path=tmp_path / "a.fits")]
    assert focal_plane._measured(good, chosen) == {"R22_S11": tmp_path / "a.fits"}


def test_a_small_focal_plane(say: Say, tmp_path: Path, monkeypatch, recorded: Record) -> None:
    """Sensors of either vendor, one of them measured: what is asked of each step, and the tables of them all."""
    asked: list[Any] = []

    class Field:
        def on(self, placement: Any) -> str:
            asked.append(["place", placement])
            return "response"

        def relative_illumination(self, radius_deg: float) -> float:
            return 1.0 - 0.1 * radius_deg

    def forecast(
        thickness: Any, response: Any, detector: Any, level: Any, night: Any, observed: Any, **more: Any
    ) -> Any:
        asked.append(
            [
                "forecast",
                thickness,
                response,
                detector.name,
                level,
                len(night),
                len(observed),
                more["stand_in"],
            ]
        )
        row = {"detector": detector.name, "vendor": detector.vendor, "rms": 0.1}
        return SimpleNamespace(to_table=lambda: Table({"x": [1.0, 2.0], "rms": [0.1, 0.2]}, meta=row))

    def angular(model: Any, sky: Any, limits: Any, thickness_range_um: Any) -> str:
        asked.append(["angular", model.effect_settings, sky.airmass, limits, thickness_range_um])
        return "angular"

    def field(*arguments: Any) -> Field:
        asked.append(["field", list(arguments[2])])
        return Field()

    def page(folder: Path, cells: Table, summary: Table, *words: Any) -> list[str]:
        asked.append(["page", cells, summary, list(words[:3])])
        return ["e2v: 2 sensors"]

    monkeypatch.setattr(focal_plane, "forecast_sensor", forecast)
    monkeypatch.setattr(focal_plane, "angular_response", angular)
    monkeypatch.setattr(focal_plane, "field_response", field)
    monkeypatch.setattr(focal_plane, "beam_field", lambda telescope: SimpleNamespace(largest_deg=2.1))
    monkeypatch.setattr(focal_plane, "beam_limits", lambda beams: beams.largest_deg)
    monkeypatch.setattr(focal_plane, "summary_table", lambda rows: Table(rows=rows))
    monkeypatch.setattr(focal_plane, "write_focal_plane_page", page)
    monkeypatch.setattr(focal_plane, "SAMPLE_PX", 250)
    effects, measured = tmp_path / "effects.yaml", tmp_path / "map.fits"
    effects.write_text("epoxy_index.offset: 0.01\nsilicon_absorption.scale: 1.1\n")
    value = np.linspace(8.0, 24.0, 256).reshape(16, 16)
    fits.PrimaryHDU(value).writeto(measured)
    words = [
        "--sensor",
        "R22_S11",
        "--sensor",
        "R22_S12",
        "--sensor",
        "R01_S00",
        "--nights",
        2,
        "--airmass",
        1.3,
    ]
    words += ["--thickness", f"R22_S11={measured}", "--effects-file", effects]
    status, out, err = say("focal-plane", *words, "--out", tmp_path / "out")
    assert (status, out) == (0, ["e2v: 2 sensors", "…/out", "…/out/report.html"])
    cells = Table.read(tmp_path / "out" / "cells.ecsv")
    assert list(cells["detector"]) == ["R22_S11"] * 2 + ["R22_S12"] * 2 + ["R01_S00"] * 2
    assert len(Table.read(tmp_path / "out" / "focal_plane.ecsv")) == 3
    stand_ins = [each[-1] for each in asked if each[0] == "forecast"]
    assert stand_ins == [False, True, True]
    recorded(asked)
    monkeypatch.setattr(focal_plane, "beam_field", lambda telescope: None)
    status, _, err = say("focal-plane", *words, "--out", tmp_path / "two")
    assert status == 1
    assert "field radius alone" in err[-1]
