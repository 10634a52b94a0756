"""How sets of effects grow, with fits that are made up."""

from types import SimpleNamespace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import SearchOptions
from lsst.fringe_sim.algorithms.discovery import set_search as module
from lsst.fringe_sim.algorithms.discovery.channels import Channel
from lsst.fringe_sim.algorithms.discovery.classes import EffectClass
from lsst.fringe_sim.algorithms.discovery.fit import Coordinate, Fit
from lsst.fringe_sim.algorithms.discovery.selection import Candidate, Hypothesis
from lsst.fringe_sim.algorithms.discovery.set_search import SetSearch

OPTIONS = SearchOptions()
NULL_CHI2 = 10_000.0
NOISE = (Channel("all values", 100.0, 100.0, 0.5),)
MUCH = (Channel("all values", 400.0, 100.0, 1e-12),)
SINGLES = tuple(f"single{number}" for number in range(OPTIONS.refits))
"""Effects of which each explains a little less by itself than the one before."""


def fitted(names: tuple[str, ...], chi2: float, channels: tuple[Channel, ...]) -> Hypothesis:
    items = tuple(Coordinate(name, "size", 0.0, -1.0, 1.0, 0.1, False, "") for name in names)
    size, settings = np.full(len(names), 0.2), {f"{name}.size": 0.2 for name in names}
    fit = Fit(settings, items, size, np.ones(1), np.zeros(1), chi2, np.eye(len(names)), 5, True)
    return Hypothesis(names, fit, 0.5 * (NULL_CHI2 - chi2), channels)


class MadeUpFits:
    """Fits of which those of two effects bring what their scores promise, and leave noise below some χ²."""

    def __init__(self, promises: dict[tuple[str, str], float], noise_below: float) -> None:
        self.promises, self.noise_below = promises, noise_below
        self.singles = [fitted((name,), 3000.0 + 100.0 * place, MUCH) for place, name in enumerate(SINGLES)]
        self.pairs: list[tuple[str, ...]] = []

    def known(self, size: int) -> list[Hypothesis]:
        return self.singles if size == 1 else []

    def others(self, hypothesis: Hypothesis) -> list[str]:
        return ["partner", *(name for name in SINGLES if name not in hypothesis.names)]

    def score_alike(self, like: Fit, bases: list[Hypothesis]) -> list[list[Candidate]]:
        return [self.score(base.fit, self.others(base), scan=False) for base in bases]

    def score(self, fit: Fit, names: list[str], *, scan: bool) -> list[Candidate]:
        (parent,) = (item.effect for item in fit.coordinates)
        promised = ((name, self.promises.get((parent, name), 0.0)) for name in names)
        return [Candidate(name, promise, 1, np.zeros(1), promise) for name, promise in promised]

    def with_candidate(self, base: Hypothesis, candidate: Candidate) -> Hypothesis:
        self.pairs.append((*base.names, candidate.name))
        chi2 = base.fit.chi2 - candidate.promise
        return fitted(self.pairs[-1], chi2, NOISE if chi2 < self.noise_below else MUCH)

    def with_channels(self, hypothesis: Hypothesis) -> Hypothesis:
        return hypothesis

    def shifts_phase(self, hypothesis: Hypothesis) -> bool:
        return False


def grown(fits: MadeUpFits) -> Hypothesis | None:
    sets = SetSearch(fits, OPTIONS, lambda text: None, lambda found: found)  # type: ignore[arg-type]
    return sets.one_more(fits.singles[0])


def test_the_right_single_effect_may_come_last() -> None:
    fits = MadeUpFits({(SINGLES[0], "partner"): 1500.0, (SINGLES[-1], "partner"): 2900.0}, 1100.0)
    best = grown(fits)
    assert best is not None
    assert best.names == (SINGLES[-1], "partner")


def test_what_promises_far_too_little_is_not_fitted_once_a_set_leaves_noise() -> None:
    right, near, far = (SINGLES[2], "partner"), (SINGLES[0], SINGLES[1]), (SINGLES[3], SINGLES[4])
    promises = {right: 2200.0, near: 1500.0, far: 20.0}
    fits = MadeUpFits(promises, 1100.0)
    best = grown(fits)
    assert best is not None
    assert best.names == right
    assert fits.pairs == [right, near]


def test_it_is_fitted_while_none_does() -> None:
    promises = {(SINGLES[2], "partner"): 2200.0, (SINGLES[3], SINGLES[4]): 20.0}
    fits = MadeUpFits(promises, 0.0)
    found = SetSearch(fits, OPTIONS, lambda text: None, lambda found: found)._larger_sets(fits.singles[0])  # type: ignore[arg-type]
    assert [item.names for item in found] == list(promises)


@pytest.mark.parametrize(
    ("brought", "left"), [(0.1, ("coat", "light")), (40.0, ("coat", "bystander", "light"))]
)
def test_a_member_that_brings_nothing_where_a_rival_has_led_is_left_out(
    monkeypatch: pytest.MonkeyPatch, brought: float, left: tuple[str, ...]
) -> None:
    """Another effect in the place of one may find a minimum in which a third is not needed."""

    def improved(names: tuple[str, ...], base: Fit) -> Hypothesis:
        needed = {"coat", "light"} <= set(names)
        chi2 = 1000.0 + (brought if needed and "bystander" not in names else 0.0)
        return fitted(names, chi2, NOISE) if needed else fitted(names, 5000.0, MUCH)

    def classes_of(selector: object, chosen: Hypothesis, width: float) -> dict[str, EffectClass]:
        taken = {name: brought if name == "bystander" else 4000.0 for name in chosen.names}
        return {n: EffectClass({n: 1.0}, 1.0, {}, fall**0.5, chosen, {}) for n, fall in taken.items()}

    selector = SimpleNamespace(improved=improved, with_channels=lambda found: found)
    monkeypatch.setattr(module, "classes_of", classes_of)
    sets = SetSearch(selector, OPTIONS, lambda text: None, lambda found: found)  # type: ignore[arg-type]
    monkeypatch.setattr(sets, "step", lambda before, after: after.names)
    steps: list[object] = []
    chosen, classes = sets.classified(improved(("coat", "bystander", "light"), Fit), steps)  # type: ignore[arg-type]
    assert chosen.names == tuple(classes) == left
    assert steps == ([left] if len(left) == 2 else [])


@pytest.mark.parametrize(("behind", "name"), [(19.0, "leaves noise"), (21.0, "likelier")])
def test_a_single_effect_that_leaves_noise_may_be_less_likely_by_a_credit(
    monkeypatch: pytest.MonkeyPatch, behind: float, name: str
) -> None:
    assert OPTIONS.credit == 20.0
    singles = [fitted(("likelier",), 3000.0, MUCH), fitted(("leaves noise",), 3000.0 + 2.0 * behind, NOISE)]
    known = {one.names: one for one in singles}
    selector = SimpleNamespace(
        null=fitted((), NULL_CHI2, MUCH), with_channels=lambda found: found, shifts_phase=lambda found: False,
        improved=lambda names, base, scan: known[names],
        problem=SimpleNamespace(cells=SimpleNamespace(n_values=3000)),
    )  # fmt: skip
    sets = SetSearch(selector, OPTIONS, lambda text: None, lambda found: found)  # type: ignore[arg-type]
    monkeypatch.setattr(sets, "step", lambda before, after: after.names)
    chosen, steps = sets.first(singles)
    assert chosen.names == steps[0] == (name,)
