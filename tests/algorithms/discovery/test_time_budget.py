"""A search that is given a time says what it knows when the time is over, and that it did not end."""

import math

import numpy as np
import pytest

from lsst.fringe_sim.algorithms import evaluations
from lsst.fringe_sim.algorithms.discovery import SearchOptions, Verdict, discover
from lsst.fringe_sim.algorithms.evaluations import count_evaluations
from lsst.fringe_sim.algorithms.inference import CellShape, Data, Forward, Problem, fit
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import ImageGeometry
from lsst.fringe_sim.errors import OutOfRangeError
from lsst.fringe_sim.model import FringeModel

BUDGET_S = 100.0
CASE = draw_case("one", np.random.default_rng(31), size=(48, 64), only=["ghost_pedestal"])


def stopped(monkeypatch: pytest.MonkeyPatch, line: str, at_s: float, evaluation_s: float = 0.0) -> Verdict:
    """Verdict of a search whose clock goes on by so much at every evaluation, and jumps once a line is said."""
    clock = {"now": 0.0}

    def monotonic() -> float:
        clock["now"] += evaluation_s
        return clock["now"]

    monkeypatch.setattr(evaluations.time, "monotonic", monotonic)

    def report(said: str) -> None:
        if said.startswith(line):
            clock["now"] = max(clock["now"], at_s)

    options = SearchOptions(time_budget_s=BUDGET_S)
    return discover(CASE.cube, CASE.setup, rng=np.random.default_rng(0), options=options, report=report)


@pytest.mark.parametrize("line", ["fitting the thickness", "chance that noise"])
def test_time_for_nothing(monkeypatch: pytest.MonkeyPatch, line: str) -> None:
    verdict = stopped(monkeypatch, line, 2 * BUDGET_S)
    assert (verdict.verdict, verdict.complete) == ("unexplained", False)
    assert verdict.effects == ()
    assert "stopped" in verdict.summary()


@pytest.mark.slow
def test_the_best_so_far_is_judged_on_data_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the evaluations that a budget allows suffices for the judgement, whatever the machine takes for one.

    The whole search takes about seven thousand, of which the judgement takes seven hundred.
    """
    line, of_many = "  ghost_pedestal", BUDGET_S / 20_000
    verdict = stopped(monkeypatch, line, 0.9 * BUDGET_S, of_many)
    assert not verdict.complete
    assert verdict.gap.heldout_after < verdict.gap.heldout_before
    (found,) = verdict.effects
    assert "ghost_pedestal" in {found.name, *found.ambiguous_with}
    again = Verdict.from_json(verdict.to_json())
    assert not again.complete
    assert again.size == pytest.approx(verdict.size)
    for late in (
        stopped(monkeypatch, line, 2 * BUDGET_S),
        stopped(monkeypatch, line, 0.9 * BUDGET_S, BUDGET_S / 4_000),
    ):
        assert (late.verdict, late.complete, late.effects) == ("unexplained", False, ())
        assert any("not judged" in note for note in late.notes)
        assert late.size["of_counts"] > 0.0


def test_a_budget_is_positive() -> None:
    with pytest.raises(OutOfRangeError, match="time budget"):
        SearchOptions(time_budget_s=-1.0)
    assert math.isinf(SearchOptions().time_budget_s)


def test_evaluations_are_counted() -> None:
    place, waves = np.arange(6.0), np.array([900.0, 930.0, 960.0])
    thickness = 14.0 + 0.01 * place + 0.02 * place[:, np.newaxis]
    geometry = ImageGeometry((6, 6), place, place, waves, np.full(3, 20_000.0))
    forward = Forward(
        FringeModel.from_setup("ts8_e2v"), (), geometry, CellShape.of_field(thickness, 1), (13.5, 14.7)
    )
    value, _ = forward.predict({}, thickness.ravel())
    problem = Problem(Data(1.01 * value, 1e4 * np.ones(value.shape)), forward, thickness.ravel(), 1e-3)
    point = problem.at({}, np.ones(3), thickness.ravel())
    fit((), (), point)  # what is kept of the start is made
    with count_evaluations() as count:
        fit((), (), point)
    with count_evaluations() as again:
        for _ in range(2):
            fit((), (), point)
    assert count.number >= 1
    assert again.number == 2 * count.number
