"""Sealed cases and how answers to them are judged."""

import secrets
from dataclasses import replace

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.discovery import Verdict
from lsst.fringe_sim.algorithms.discovery.verdict import Gap, NamedEffect, Where
from lsst.fringe_sim.challenge.oracle import Oracle, Visibility
from lsst.fringe_sim.challenge.result import CASE_KINDS, VISIBLE, CaseResult
from lsst.fringe_sim.challenge.run import judge, run_challenge
from lsst.fringe_sim.challenge.sealed_cases import SealedCase, draw_case
from lsst.fringe_sim.errors import InputError, UnknownNameError


def _verdict(*effects: NamedEffect) -> Verdict:
    gap = Gap("rms", 2.0, 1.0, 2.0, 1.0, 1.0)
    return Verdict("named" if effects else "unexplained", effects, Where(), gap, (), {}, "ts8_e2v", 0.0)


def _effect(name: str, *others: str) -> NamedEffect:
    return NamedEffect(name, {}, 0.99, others, "", 1.0, 50.0)


def _oracle(**each: float) -> Oracle:
    return Oracle(Visibility(max(each.values()), each), _verdict())


@pytest.fixture(scope="module")
def pair() -> SealedCase:
    case = draw_case("one", np.random.default_rng(4), size=(16, 16), only=["vignetting"])
    return replace(case, kind="two", names=("vignetting", "roughness"))


def test_a_pair_is_right_in_any_order_and_within_classes(pair: SealedCase) -> None:
    oracle = _oracle(vignetting=50.0, roughness=50.0)
    for named in (
        (_effect("roughness"), _effect("vignetting")),
        (_effect("epoxy_absorption", "roughness"), _effect("vignetting")),
    ):
        assert judge(pair, _verdict(*named), 0, 1.0, oracle).right_class
    wrong = (_effect("bandwidth"), _effect("vignetting")), (_effect("vignetting"),), ()
    for named in wrong:
        assert not judge(pair, _verdict(*named), 0, 1.0, oracle).right_class
    more = _effect("roughness"), _effect("vignetting"), _effect("tilt")
    assert not judge(pair, _verdict(*more), 0, 1.0, oracle).right_class


def test_a_faint_second_effect_need_not_be_named_but_no_other_may(pair: SealedCase) -> None:
    oracle = _oracle(vignetting=50.0, roughness=0.5 * VISIBLE)
    result = judge(pair, _verdict(_effect("vignetting")), 0, 1.0, oracle)
    assert result.right_class
    assert not result.exact
    assert result.weakest == 0.5 * VISIBLE
    assert not judge(pair, _verdict(_effect("roughness")), 0, 1.0, oracle).right_class
    assert not judge(pair, _verdict(_effect("vignetting"), _effect("tilt")), 0, 1.0, oracle).right_class


def test_unknown_kind_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="kind of case"):
        draw_case("three", np.random.default_rng(1))


@pytest.mark.parametrize(
    ("setup", "limits_um", "fwhm_nm"),
    [("ts8_e2v", (5.0, 30.0), 2.0), ("bnl_ts8_e2v", (5.0, 30.0), 1.0), ("ts8_itl", (95.0, 105.0), 1.0)],
)
def test_cases_are_of_the_set_up(setup: str, limits_um: tuple[float, float], fwhm_nm: float) -> None:
    case = draw_case("one", np.random.default_rng(5), size=(16, 16), only=["bandwidth"], setup=setup)
    assert case.setup == setup
    assert limits_um[0] < case.thickness_um.min() < case.thickness_um.max() < limits_um[1]
    np.testing.assert_array_equal(case.cube.exposures.bandwidth_fwhm_nm, fwhm_nm)
    assert 0.0 < abs(case.values["bandwidth.fwhm"] - fwhm_nm) < 1.0


@pytest.mark.slow
def test_a_thickness_is_not_hidden_where_it_varies() -> None:
    only = ["silicon_thickness", "silicon_gradient", "vignetting"]
    cases = [
        draw_case("one", np.random.default_rng(n), size=(8, 8), only=only, setup="ts8_itl") for n in range(9)
    ]
    assert {case.names for case in cases} == {("vignetting",)}


@pytest.mark.parametrize("setup", ["lsst_e2v", "nosuch"])
def test_set_ups_without_a_monochromator_are_refused(setup: str) -> None:
    with pytest.raises(InputError, match=r"monochromator|nosuch"):
        draw_case("none", np.random.default_rng(1), setup=setup)


def test_probability_of_a_name_is_that_of_its_class_and_its_share(pair: SealedCase) -> None:
    first = replace(_effect("roughness", "bandwidth"), probability=0.9, share=0.6)
    second = replace(_effect("vignetting"), probability=0.8)
    assert judge(pair, _verdict(first, second), 0, 1.0, None).name_probability == pytest.approx(
        0.9 * 0.6 * 0.8
    )
    assert judge(pair, _verdict(), 0, 1.0, None).name_probability == 0.0


@pytest.mark.slow
def test_cases_do_not_depend_on_what_else_runs() -> None:
    """Number of cases, processes and what is known already change nothing."""
    told: list[tuple[str, int]] = []

    def tell(result: CaseResult) -> None:
        told.append((result.kind, result.number))

    few = run_challenge({"none": 1}, 5, size=(32, 32), progress=tell)
    more = run_challenge({"none": 3, "one": 0}, 5, size=(32, 32), known=few.cases, jobs=2, progress=tell)
    assert told[0] == ("none", 0)
    assert sorted(told[1:]) == [("none", 1), ("none", 2)]
    assert more.cases[0] == few.cases[0]
    assert [case.number for case in more.cases] == [0, 1, 2]
    alone = run_challenge({"none": 3}, 5, size=(32, 32), known=few.cases + more.cases[1:2])
    assert _comparable(alone.cases[2]) == _comparable(more.cases[2])


@pytest.mark.slow
def test_the_oracle_holds_out_what_the_search_does() -> None:
    """One effect, named alone, is what the oracle fits; elsewhere on the sensor its gap would be another."""
    (case,) = run_challenge({"one": 1}, 4, size=(48, 48), only=["vignetting"]).cases
    assert case.exact
    assert case.shrinkage == pytest.approx(1.0, abs=1e-6)


def _comparable(result: CaseResult) -> str:
    return replace(result, seconds=0.0).to_json()


@pytest.mark.slow
def test_a_challenge_of_this_very_moment() -> None:
    """Fresh seed: nothing is named where nothing is hidden, and names are right where something is."""
    seed = secrets.randbelow(2**32)
    clean = ("illumination", "midline_step", "contrast_loss", "amplifier_gain", "epoxy_absorption")
    hidden = run_challenge({"one": 4}, seed, size=(64, 64), only=clean)
    sealed = run_challenge({"none": 4}, seed, size=(64, 64))
    summary = {**hidden.summary(), "false_discoveries": sealed.summary()["false_discoveries"]}
    told = f"seed {seed}: {hidden.confusion()}"
    assert summary["false_discoveries"][0] == 0, f"seed {seed}"
    right, visible = summary["one_right_class"]
    assert right >= visible - 1, told
    named_right, named = summary["named_right"]
    assert named_right >= named - 1, told


@pytest.mark.parametrize("kind", CASE_KINDS)
def test_drawn_cases_are_as_recorded(kind: str, recorded: Record) -> None:
    """A record: the cases of published challenges stay what they were."""
    case = draw_case(kind, np.random.default_rng(8), size=(16, 16))
    recorded({"names": case.names, "values": case.values, "map": case.thickness_um, "flats": case.cube})
