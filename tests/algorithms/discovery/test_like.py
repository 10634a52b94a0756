"""What a cause outside the catalogue is like: effects that no correction replaces."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.fit import Fit
from lsst.fringe_sim.algorithms.discovery.selection import Hypothesis

from lsst.fringe_sim.algorithms.discovery import SearchOptions, search

BEST = ("black_coating", "amplifier_gain", "dark_current")


def like(
    monkeypatch: pytest.MonkeyPatch, evidence: dict[str, float], corrected: dict[str, float]
) -> tuple[str, ...]:
    """Effects that the best set is said to be like.

    ``evidence``, ``corrected``: log evidence of sets by the first letters of their effects, and of corrections
    beside them.
    """

    def key(names: tuple[str, ...]) -> str:
        return "".join(name[0] for name in names)

    def fitted(names: tuple[str, ...], *_: object) -> Hypothesis:
        one = np.ones(1)
        fit = Fit({}, (), one, one, one, 0.0, np.eye(1), len(names), True)
        told[id(fit)] = corrected[key(names)]
        kept.append(fit)
        return Hypothesis(names, fit, evidence[key(names)])

    told: dict[int, float] = {}
    kept: list[Fit] = []
    monkeypatch.setattr(search, "evidence_of_correction", lambda problem, fit: told[id(fit)])
    own = search._Search.__new__(search._Search)
    own.options, own.until = SearchOptions(), math.inf
    forward = SimpleNamespace(exposures=None)
    own.prepared = SimpleNamespace(rich=True, problem=SimpleNamespace(forward=forward))  # type: ignore[assignment]
    whole = SimpleNamespace(problem=None, hypothesis=fitted, null=fitted(()))
    return own._alike(whole, fitted(BEST)).names  # type: ignore[arg-type]


def test_what_does_the_most_alone_stays_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of three explain what a correction explains as well."""
    evidence = {
        "bad": 1000.0,
        "ad": 300.0,
        "bd": 980.0,
        "ba": 970.0,
        "b": 950.0,
        "d": 100.0,
        "a": 50.0,
        "": 0.0,
    }
    beside = {"bad": 10.0, "ad": 200.0, "bd": 40.0, "ba": 60.0, "b": 90.0, "d": 300.0, "a": 300.0, "": 400.0}
    assert like(monkeypatch, evidence, beside) == ("black_coating",)


def test_members_that_nothing_replaces_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence = {"bad": 1000.0, "ad": 300.0, "bd": 980.0, "ba": 970.0, "": 0.0}
    assert like(monkeypatch, evidence, {"bad": 10.0, "ad": 200.0, "bd": 20.0, "ba": 30.0, "": 0.0}) == BEST


def test_effects_that_do_less_than_a_correction_are_not_told(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence = {"bad": 30.0, "ad": 25.0, "bd": 20.0, "ba": 25.0, "d": 15.0, "a": 20.0, "b": 5.0, "": 0.0}
    beside = {"bad": 10.0, "ad": 30.0, "bd": 30.0, "ba": 30.0, "a": 50.0, "b": 40.0, "d": 40.0, "": 100.0}
    assert like(monkeypatch, evidence, beside) == ()
