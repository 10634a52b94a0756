"""Records of what a challenge draws and writes, for edits that are not meant to change it; how it judges."""

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from product_makers import cube
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.discovery import Verdict
from lsst.fringe_sim.algorithms.discovery.verdict import Gap, NamedEffect, ParameterValue, Where
from lsst.fringe_sim.challenge import oracle, run
from lsst.fringe_sim.challenge.demo_case import SECOND_EFFECTS, draw_demo_case, thickness_of_demo
from lsst.fringe_sim.challenge.oracle import Oracle, Visibility, visibility
from lsst.fringe_sim.challenge.page import write_challenge_report
from lsst.fringe_sim.challenge.result import CaseResult, ChallengeResult
from lsst.fringe_sim.challenge.sealed_cases import OUTSIDERS, SIZES, SealedCase, draw_case, expose
from lsst.fringe_sim.errors import UnknownNameError


def test_sizes_of_all_effects(recorded: Record) -> None:
    """Two draws of each, in the catalogue of the challenge and in that of the demo."""
    rng = np.random.default_rng(21)
    sizes = {name: [draw(rng), draw(rng)] for name, draw in SIZES.items()}
    second = {name: [draw(rng, (48, 64)), draw(rng, (64, 48))] for name, draw in SECOND_EFFECTS.items()}
    drawn = [draw_demo_case(seed, (32, 40)) for seed in range(4)]
    recorded(
        {
            "sizes": [list(each.values()) for pair in sizes.values() for each in pair],
            "second": [list(each.values()) for pair in second.values() for each in pair],
            "demo": [[case.values, case.names, case.on_sky] for case in drawn],
            "noise": [[case.frames_rng.random(), case.visits_rng.random()] for case in drawn],
            "thickness": thickness_of_demo((12, 16)),
        }
    )


@pytest.mark.parametrize("outsider", OUTSIDERS)
def test_cases_of_outsiders(outsider: str, recorded: Record) -> None:
    """With masks and without, with all flats and with some lost; and what each outsider does to even light."""
    case = draw_case("outsider", np.random.default_rng(len(outsider)), size=(9, 10), only=[outsider])
    scene = {
        "size": 0.1,
        "film": np.linspace(7.9, 8.1, 20).reshape(4, 5),
        "period": 3.0,
        "turn": 0.4,
        "stains": [(1.0, 2.0, 4.0), (3.0, 1.0, 2.0)],
        "columns": np.arange(5.0),
    }
    light = 1.0 + 0.01 * np.arange(20.0).reshape(4, 5)
    changed = OUTSIDERS[outsider][0](light, 910.0, scene)
    recorded({"names": case.names, "values": case.values, "cube": case.cube, "changed": changed})


def test_flats_with_electronics(recorded: Record) -> None:
    """Every amplifier with its own gain and offset, dark charge, and charge that moves."""
    values = {
        "amplifier_gain.rms": 0.02,
        "amplifier_offset.rms": 50.0,
        "dark_current.rate": 100.0,
        "non_linearity.quadratic": 0.05,
        "vignetting.corner": 0.1,
    }
    thickness = np.linspace(15.0, 15.05, 16 * 24).reshape(16, 24)
    cube, sizes = expose(thickness, values, np.random.default_rng(22), noise_factor=1.2, setup="bnl_ts8_e2v")
    assert sizes == {}
    recorded(cube)
    with pytest.raises(UnknownNameError, match="outsider"):
        expose(thickness, values, np.random.default_rng(22), outsider="stain")


def result_of(number: int, kind: str = "one", **changes: object) -> CaseResult:
    usual = CaseResult(
        number, kind, ("roughness",), {"roughness.sigma": 40.0}, "named", ("roughness",), ((),), True, True, 50.0,
        50.0, 0.99, 0.98, {"roughness.sigma": 0.3 * number - 1.0}, 0.9 + 0.02 * number, 12.0 + number,
    )  # fmt: skip
    return replace(usual, **changes)


def all_kinds() -> ChallengeResult:
    """Results by hand: of every kind, right, wrong, ambiguous, faint and silent."""
    silent = {"verdict": "unexplained", "found": (), "ambiguous": (), "right_class": False, "exact": False,
              "pulls": {}, "probability": 0.0, "name_probability": 0.0}  # fmt: skip
    nothing = {**silent, "truth": (), "values": {}, "signal_to_noise": math.nan, "weakest": math.nan}
    pair = {"truth": ("roughness", "tilt"), "pulls": {}, "exact": False}
    strengths = (1.0, 3.0, 4.0, 9.0, 10.0, 20.0, 30.0, 60.0, 200.0)
    said = (0.2, 0.3, 0.4, 0.6, 0.8, 0.95, 0.97, 0.98, 1.0)
    cases = [
        *(
            result_of(k, signal_to_noise=s, name_probability=p)
            for k, (s, p) in enumerate(zip(strengths, said, strict=True))
        ),
        result_of(
            9, found=("tilt",), right_class=False, exact=False, pulls={"a.b": 9.0}, name_probability=0.5
        ),
        result_of(10, found=("bandwidth",), ambiguous=(("roughness", "tilt"),), exact=False, shrinkage=0.5),
        result_of(11, **silent, signal_to_noise=12.0, shrinkage=math.nan),
        result_of(0, "none", **{**nothing, "verdict": "no_discrepancy"}),
        result_of(1, "none", **nothing),
        result_of(2, "none", **{**nothing, "verdict": "named", "found": ("tilt",), "ambiguous": ((),)}),
        result_of(
            0, "two", **pair, weakest=10.0, found=("roughness", "tilt"), ambiguous=((), ("bandwidth",))
        ),
        result_of(1, "two", **pair, weakest=2.0),
        result_of(2, "two", **pair, weakest=math.nan, right_class=False, found=("a", "b", "c")),
        result_of(0, "outsider", **{**silent, "truth": ("stains",)}),
        result_of(1, "outsider", truth=("annealing",), right_class=False, exact=False, pulls={}),
    ]
    return ChallengeResult(7, tuple(cases))


def test_tables_and_page(tmp_path, recorded: Record) -> None:
    """Everything that is written of a challenge, and the same of one without cases."""
    for name, result in (("full", all_kinds()), ("empty", ChallengeResult(3, ()))):
        result.write(tmp_path / name)
        write_challenge_report(tmp_path / name / "page.html", result)
    recorded({"written": tmp_path, "summary": all_kinds().summary(), "weights": all_kinds().pull_weights()})


def verdict_of(effects: tuple[NamedEffect, ...], before: float, after: float) -> Verdict:
    gap = Gap("rms", 9.0, 1.0, before, after, 1.0)
    return Verdict("named" if effects else "unexplained", effects, Where(), gap, (), {}, "ts8_e2v", 0.0)


def test_numbers_of_a_judgement() -> None:
    """Pulls in units of the stated error, and the fall of the variance beside that of the oracle."""
    values = {"vignetting.corner": 0.1, "roughness.sigma": 40.0}
    case = draw_case("none", np.random.default_rng(4), size=(8, 8))
    case = replace(case, kind="two", names=("vignetting", "roughness"), values=values)
    found = (
        NamedEffect("roughness", {"sigma": ParameterValue(43.0, 2.0, "nm")}, 0.9, (), "", 0.5),
        NamedEffect("vignetting", {"corner": ParameterValue(0.1, 0.0, "")}, 0.8),
    )
    seen = Oracle(Visibility(60.0, {"vignetting": 10.0, "roughness": 50.0}), verdict_of(found, 3.0, 1.0))
    judged = run.judge(case, verdict_of(found, 3.0, 2.0), 5, 1.5, seen)
    assert (judged.number, judged.seconds, judged.right_class, judged.exact) == (5, 1.5, True, True)
    assert judged.pulls == {"roughness.sigma": 1.5}
    assert judged.shrinkage == pytest.approx(5.0 / 8.0)
    assert (judged.signal_to_noise, judged.weakest) == (60.0, 10.0)
    assert judged.probability == 0.8
    assert judged.name_probability == pytest.approx(0.9 * 0.5 * 0.8)
    still = replace(seen, verdict=verdict_of(found, 1.0, 1.0))
    alone = run.judge(case, verdict_of(found[:1], 3.0, 2.0), 5, 1.5, still)
    assert math.isnan(alone.shrinkage)
    assert not alone.right_class
    nothing = run.judge(case, verdict_of((), 1.0, 1.0), 5, 1.5, None)
    assert (nothing.probability, nothing.name_probability, nothing.pulls) == (0.0, 0.0, {})
    assert math.isnan(nothing.weakest)
    unnamed = replace(verdict_of(found, 3.0, 2.0), verdict="unexplained")
    assert not run.is_right(case.names, unnamed)
    assert not run.judge(
        replace(case, kind="outsider"), verdict_of(found, 3.0, 2.0), 5, 1.5, seen
    ).right_class


def test_cases_of_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of kinds and numbers, each drawn by its own stream; those that are known are not made again."""
    told: list[tuple[str, int]] = []
    asked: list[tuple[object, ...]] = []

    def search(cube, setup, effects=None, *, rng, options=None):
        asked.append((round(float(cube.image.sum())), setup, effects, rng.random(), options))
        return verdict_of((), 2.0, 1.0)

    monkeypatch.setattr(run, "discover", search)
    monkeypatch.setattr(run, "visibility", lambda case, most_cells: Visibility(9.0, {case.names[0]: 9.0}))

    def made(counts: dict[str, int], **more: object) -> ChallengeResult:
        return run.run_challenge(counts, 5, size=(8, 8), only=["vignetting", "tilt"], **more)

    first = made({"one": 2, "none": 1}, progress=lambda result: told.append((result.kind, result.number)))
    assert told == [("none", 0), ("one", 0), ("one", 1)]
    assert [(case.kind, case.number) for case in first.cases] == told
    assert {case.truth[0] for case in first.cases[1:]} <= {"vignetting", "tilt"}
    assert first.cases[0].truth == ()
    assert math.isnan(first.cases[0].weakest)
    assert [case.shrinkage for case in first.cases[1:]] == [1.0, 1.0]
    searched, of_oracle = asked[1:3]
    assert searched[:2] == of_oracle[:2]
    assert searched[3] == of_oracle[3]  # the same blocks are held out
    assert searched[2] is None
    assert [effect.name for effect in of_oracle[2]] == list(first.cases[1].truth)
    assert (of_oracle[4].significance, of_oracle[4].least_probability) == (1.0, 1e-6)
    assert len({each[0] for each in asked}) == 3
    again = made({"one": 3, "none": 1}, known=first.cases, progress=lambda result: told.append(result.number))
    assert told[3:] == [2]
    assert again.cases[:3] == first.cases
    assert made({}).cases == ()


@pytest.mark.parametrize(
    "values",
    [
        {
            "vignetting.corner": 0.01,
            "void.thickness": 40.0,
            "void.centre_x": 6.0,
            "void.centre_y": 5.0,
            "void.radius": 3.0,
        }
    ],
)
def test_visibility_of_a_case(
    values: dict[str, float], recorded: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A record of how clearly two effects are seen, one of them in a part of a small sensor only."""
    monkeypatch.setattr(oracle, "VALLEYS", 1)
    rng = np.random.default_rng(23)
    case = draw_case("none", rng, size=(8, 8))
    cube, _ = expose(case.thickness_um, values, rng)
    names = tuple(dict.fromkeys(key.partition(".")[0] for key in values))
    recorded(visibility(replace(case, cube=cube, kind="two", names=names, values=values), most_cells=16))


@pytest.mark.parametrize(("processors", "jobs", "threads"), [(7, 3, 2), (2, 2, 1), (1, 3, 1)])
def test_cases_of_several_processes_share_the_processors(
    processors: int, jobs: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They come as they are ready, and are those of one process."""
    limits: list[int] = []
    monkeypatch.setattr(run, "processors", lambda: processors)
    monkeypatch.setattr(run, "limit_threads", limits.append)
    monkeypatch.setattr(
        run, "ProcessPoolExecutor", lambda n, _, start, given: ThreadPoolExecutor(n, "case", start, given)
    )
    monkeypatch.setattr(run, "_run_case", lambda kind, number, **_: result_of(number, kind))
    counts = {"one": 3, "none": 2}
    told: list[CaseResult] = []
    assert run.run_challenge(counts, 5, jobs=jobs, progress=told.append) == run.run_challenge(counts, 5)
    assert sorted(map(str, told)) == sorted(map(str, run.run_challenge(counts, 5).cases))
    assert set(limits) == {threads}


def test_names_in_any_order() -> None:
    found = tuple(NamedEffect(name, {}, 0.9, others) for name, *others in (("a", "x"), ("b",), ("c", "y")))
    for names in itertools.permutations("xby"):
        assert run.is_right(names, verdict_of(found, 1.0, 1.0))
    assert not run.is_right("xbb", verdict_of(found, 1.0, 1.0))


def test_the_fall_of_the_variance_beside_that_of_the_oracle() -> None:
    """Squares of what is left: 25 to 16 of the 25 to 9 that could be reached."""
    case = SealedCase(cube(), "ts8_e2v", "none", (), {}, np.full((3, 4), 14.0), 1.0)
    reached = Oracle(Visibility(9.0, {}), verdict_of((), 5.0, 3.0))
    assert run.judge(case, verdict_of((), 5.0, 4.0), 0, 1.0, reached).shrinkage == pytest.approx(9.0 / 16.0)
