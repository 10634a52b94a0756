"""The panel: its list, its judgement, its comparison, and twelve of its cases beside the frozen baseline."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks._panel_cases import KINDS, checksum, read_cases
from slow_cases import first_is_quick

from benchmarks import panel
from lsst.fringe_sim.effects import EFFECTS

ROOT = Path(__file__).resolve().parents[2]

CASES = {case.case: case for case in read_cases()}
NAMES = {effect.name for effect in EFFECTS}


def result(case: str, outcome: str, checksum: str = "0") -> panel.PanelResult:
    return panel.PanelResult(case, "single", "tilt", "named", "tilt", outcome, 7, 1.5, checksum, "v")


def test_the_list_is_what_it_is_meant_to_be() -> None:
    cases = read_cases()
    assert len(cases) >= 60
    assert len(CASES) == len(cases) == len({case.seed for case in cases})
    assert {case.kind for case in cases} == set(KINDS)
    assert set(panel.QUICK) <= set(CASES)
    assert len(panel.QUICK) == 12
    assert {CASES[name].kind for name in panel.QUICK} == set(KINDS)
    for case in cases:
        wanted = {"null": 0, "single": 1, "pair": 2}.get(case.kind, 1)
        assert len(case.truth) == wanted, case.case
        assert (set(case.truth) <= NAMES) == (case.kind in ("null", "single", "pair")), case.case
        assert set(case.like) <= NAMES
    assert sorted(case.case for case in panel.mixed(cases)) == sorted(CASES)


@pytest.mark.parametrize(
    "name",
    first_is_quick(
        ["null-foreign-contrast-0.13", "one-mock-jitter", "outsider-mock-columns", "near-foreign-window"]
    ),
)
def test_a_case_is_the_same_every_time_and_another_when_fresh(name: str) -> None:
    case = CASES[name]

    def drawn(fresh: int | None) -> str:
        data, _, factor = case.streams(fresh)
        return checksum(case.cube(data, factor))

    assert drawn(None) == drawn(None)
    assert len({drawn(None), drawn(1), drawn(2)}) == 3


@pytest.mark.slow
def test_foreign_cases_hide_what_they_say() -> None:
    """Without noise that differs, a case with its sensor is not the one without."""
    for case in CASES.values():
        if case.source == "foreign" and case.sensor and case.px == 64 and "aperture" not in case.sensor:
            images = [
                own.cube(np.random.default_rng(3), 1.0).image
                for own in (case, replace(case, sensor={}, contrast_known=1.0))
            ]
            assert np.abs(images[0] - images[1]).max() > 0.0, case.case


@pytest.mark.parametrize(
    ("kind", "truth", "verdict", "classes", "outcome"),
    [
        ("null", (), "no_discrepancy", [], "right"),
        ("null", (), "unexplained", [], "unexplained"),
        ("null", (), "named", [["tilt"]], "wrong"),
        ("single", ("tilt",), "named", [["tilt", "roughness"]], "right"),
        ("single", ("tilt",), "named", [["roughness", "tilt"]], "class"),
        ("single", ("tilt",), "named", [["roughness"]], "wrong"),
        ("single", ("tilt",), "named", [["tilt"], ["roughness"]], "wrong"),
        ("single", ("tilt",), "no_discrepancy", [], "missed"),
        ("single", ("tilt",), "unexplained", [], "unexplained"),
        ("single", ("tilt",), "timed out", [], "timed out"),
        ("single", ("tilt",), "ended", [], "timed out"),
        ("single", ("tilt",), "failed", [], "failed"),
        ("pair", ("tilt", "void"), "named", [["void"], ["roughness", "tilt"]], "class"),
        ("pair", ("tilt", "void"), "named", [["void", "tilt"]], "wrong"),
        ("pair", ("tilt", "void"), "named", [["void", "tilt"], ["roughness"]], "wrong"),
        ("outsider", ("stains",), "unexplained", [], "right"),
        ("outsider", ("stains",), "named", [["void"]], "wrong"),
        ("outsider", ("stains",), "no_discrepancy", [], "missed"),
        ("neighbour", ("coat",), "unexplained", [], "right"),
        ("neighbour", ("coat",), "like", [], "right"),
        ("neighbour", ("coat",), "named", [["black_coating"]], "wrong"),
    ],
)
def test_outcomes(kind: str, truth: tuple[str, ...], verdict: str, classes: list, outcome: str) -> None:
    assert panel.judge(kind, truth, verdict, classes) == outcome


def test_a_neighbour_may_be_named_as_what_it_is_like() -> None:
    assert panel.judge("neighbour", ("coat",), "named", [["black_coating"]], ["black_coating"]) == "right"
    assert panel.judge("outsider", ("stains",), "named", [["void"]], ["void"]) == "wrong"


def test_every_lost_case_is_listed_and_three_more_than_won_fail() -> None:
    before = {name: result(name, "right") for name in "abcde"}
    now = [result(name, "unexplained") for name in "abcd"] + [result("e", "class"), result("new", "wrong")]
    lines, net = panel.compare(now, before)
    assert net == 4
    assert [line.split()[1] for line in lines] == list("abcd")
    assert panel.verdict_of(now, net)[1]
    before["d"] = result("d", "wrong")
    lines, net = panel.compare(now, before)
    assert net == 2
    assert sum(line.startswith("won: d ") for line in lines) == 1
    assert not panel.verdict_of(now, net)[1]
    assert panel.compare([result("a", "right", "1")], before)[0] == ["drawn differently from v: a"]


def test_more_than_a_tenth_timed_out_fails() -> None:
    results = [result(str(n), "timed out" if n < 2 else "right") for n in range(19)]
    assert panel.verdict_of(results, 0)[1]
    assert not panel.verdict_of([*results, result("last", "right")], 0)[1]


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    results = [
        result("a", "right"),
        panel.PanelResult("b", "null", "", "no_discrepancy", "", "right", -1, 0.25, "", ""),
    ]
    panel.write_results(tmp_path / "file.ecsv", results)
    assert list(panel.read_results(tmp_path / "file.ecsv").values()) == results


def test_a_search_is_stopped_when_its_processor_time_is_used_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(panel, "CAP_S", 0.5)
    (found,) = panel.run_cases([CASES["one-mock-bandwidth"]], version="v")
    assert found.outcome == "timed out"
    assert found.processor_s < 5.0
    assert found.checksum


@pytest.mark.slow
def test_no_case_of_the_quick_panel_is_lost() -> None:
    recorded = panel.read_results(panel.BASELINE) if panel.BASELINE.exists() else {}
    if not set(panel.QUICK) <= set(recorded):
        pytest.skip(
            "the baseline does not hold all cases of the quick panel: record it by `benchmarks panel --record`"
        )
    command = [sys.executable, "-m", "benchmarks", "panel", "--quick", "--jobs", "2"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    assert f"compared with an earlier result: {len(panel.QUICK)}" in found.stdout
