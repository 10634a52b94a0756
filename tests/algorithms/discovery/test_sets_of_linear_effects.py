"""The search among sets of effects, where all effects are straight lines and the evidence of every set is known."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from recorded_numbers import Record
from scipy.special import chdtrc

from lsst.fringe_sim.algorithms.discovery import SearchOptions
from lsst.fringe_sim.algorithms.discovery.channels import Channel
from lsst.fringe_sim.algorithms.discovery.fit import Coordinate, Fit, FullColumns
from lsst.fringe_sim.algorithms.discovery.selection import MANY_PARAMETERS, Candidate, Hypothesis
from lsst.fringe_sim.algorithms.discovery.set_search import SetSearch

SHAPE = (4, 10, 10)
OPTIONS = SearchOptions()


class LinearDesign:
    """Derivatives of the effects of a fit, which are projected out."""

    def __init__(self, columns: np.ndarray) -> None:
        self.columns = columns

    def project(self, columns: FullColumns, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rest = self.without(columns.flat)
        return rest @ residual.ravel(), rest @ rest.T

    def without(self, rows: np.ndarray) -> np.ndarray:
        if not len(self.columns):
            return rows
        return rows - rows @ np.linalg.pinv(self.columns) @ self.columns


class LinearSelector:
    """Sets of effects whose signatures do not depend on their size, in noise of 1, with a normal prior of width 1.

    ``columns``: signature of each effect, ``(L, n)``, in the order of the fringes in which it is found first and, for
    what shifts the phase, in another one that only a scan finds.
    """

    def __init__(
        self, data: np.ndarray, columns: dict[str, list[np.ndarray]], guessed: Sequence[str] = ()
    ) -> None:
        self.data, self.columns = data, columns
        self.coordinates = {
            name: tuple(Coordinate(name, str(k), 0.0, -9.0, 9.0, 1.0, False, "") for k in range(len(own[0])))
            for name, own in columns.items()
        }
        self.effects = {
            name: SimpleNamespace(
                search=SimpleNamespace(exact=name not in guessed, hides_fringes="blur" in name)
            )
            for name in columns
        }
        basis = SimpleNamespace(gather=lambda seen: np.zeros((0, 1)))
        cells = SimpleNamespace(n_values=data.size, noise_rms=0.01, seen=np.ones(SHAPE[1:], bool))
        forward = SimpleNamespace(
            is_image_effect=lambda name: "pixels" in name,
            couples_pixels=lambda name: "blur" in name,
            is_island=lambda name: False,
        )
        self.problem = SimpleNamespace(
            cells=cells, forward=forward, basis=basis, field_prior=False, level_basis=np.zeros((4, 4))
        )
        self.fitted: dict[frozenset[str], Hypothesis] = {}
        self.null = self.with_channels(self._fitted((), {}))
        self.fitted[frozenset()] = self.null

    def _rows(self, names: Iterable[str], orders: dict[str, int]) -> np.ndarray:
        return np.concatenate([np.zeros((0, self.data.size)), *(self.columns[n][orders[n]] for n in names)])

    def _fitted(self, names: tuple[str, ...], orders: dict[str, int]) -> Hypothesis:
        rows = self._rows(names, orders)
        information = rows @ rows.T
        curvature = np.eye(len(rows)) + information
        position = np.linalg.solve(curvature, rows @ self.data)
        chi2 = float(((self.data - position @ rows) ** 2).sum())
        evidence = 0.5 * float(self.data @ self.data - chi2 - position @ position)
        evidence -= 0.5 * float(np.linalg.slogdet(curvature)[1])
        items = tuple(item for name in names for item in self.coordinates[name])
        settings = {item.key: float(value) for item, value in zip(items, position, strict=True)}
        settings |= {f"{name}.order": float(order) for name, order in orders.items()}
        fit = Fit(settings, items, position, np.ones(1), np.zeros(1), chi2, information)
        return Hypothesis(names, fit, evidence)

    def _orders(self, names: Iterable[str], fit: Fit) -> dict[str, int]:
        return {name: int(fit.settings.get(f"{name}.order", 0)) for name in names}

    def hypothesis(
        self, names: Sequence[str], start: np.ndarray | None = None, base: Fit | None = None
    ) -> Hypothesis:
        if frozenset(names) not in self.fitted:
            orders = self._orders(names, self.null.fit if base is None else base)
            self.fitted[frozenset(names)] = self._fitted(tuple(names), orders)
        return self.fitted[frozenset(names)]

    def improved(self, names: Sequence[str], base: Fit, *, scan: bool = False) -> Hypothesis:
        known = self.hypothesis(names, None, base)
        tried = [
            known,
            self._fitted(known.names, {**self._orders(names, known.fit), **self._orders(names, base)}),
        ]
        if scan:
            tried += [
                self._fitted(known.names, dict(zip(known.names, orders, strict=True)))
                for orders in itertools.product(*(range(len(self.columns[name])) for name in known.names))
            ]
        self.fitted[frozenset(names)] = min(tried, key=lambda item: item.fit.chi2)
        return self.fitted[frozenset(names)]

    def with_candidate(self, base: Hypothesis, candidate: Candidate) -> Hypothesis:
        return self.hypothesis((*base.names, candidate.name), candidate.start, base.fit)

    def known(self, size: int) -> list[Hypothesis]:
        found = [item for key, item in self.fitted.items() if len(key) == size]
        return sorted(found, key=lambda item: -item.log_evidence)

    def others(self, hypothesis: Hypothesis) -> list[str]:
        return [name for name in self.columns if name not in hypothesis.names]

    def state(self, fit: Fit) -> SimpleNamespace:
        names = tuple(dict.fromkeys(item.effect for item in fit.coordinates))
        rows = self._rows(names, self._orders(names, fit))
        return SimpleNamespace(design=LinearDesign(rows), residual=(self.data - fit.position @ rows))

    def features(self, state: SimpleNamespace, fit: Fit, name: str) -> np.ndarray:
        return self.columns[name][0].reshape(-1, *SHAPE)

    def score(self, fit: Fit, names: Sequence[str], *, scan: bool = False) -> list[Candidate]:
        state, found = self.state(fit), []
        for name in names:
            rest = state.design.without(self.columns[name][0])
            start = np.linalg.pinv(rest @ rest.T, hermitian=True) @ rest @ state.residual
            gain = float(start @ rest @ state.residual)
            found.append(Candidate(name, gain, len(rest), start, gain))
        return sorted(found, key=lambda item: -item.promise)

    def score_alike(self, like: Fit, bases: Sequence[Hypothesis]) -> list[list[Candidate]]:
        return [self.score(base.fit, self.others(base)) for base in bases]

    def criticise(self, fit: Fit, *, imprecision: float = 0.02) -> tuple[Channel, ...]:
        allowed = imprecision**2 * max(float(self.data @ self.data) - fit.chi2, 0.0)
        degrees = self.data.size - len(fit.coordinates)
        return (Channel("all values", fit.chi2, degrees, float(chdtrc(degrees, fit.chi2 - allowed))),)

    def with_channels(self, hypothesis: Hypothesis) -> Hypothesis:
        return (
            hypothesis
            if hypothesis.channels
            else replace(hypothesis, channels=self.criticise(hypothesis.fit))
        )

    def has_many(self, name: str) -> bool:
        return len(self.coordinates[name]) >= MANY_PARAMETERS

    def is_sought(self, name: str) -> bool:
        return False

    def undescribed(self, name: str) -> float:
        return 2.0 if "blur" in name else 0.0

    def prior_cost(self, hypothesis: Hypothesis, name: str) -> float:
        own = [item.effect == name for item in hypothesis.fit.coordinates]
        return 0.5 * float((hypothesis.fit.position[own] ** 2).sum())

    def shifts_phase(self, hypothesis: Hypothesis) -> bool:
        return len(self.columns[hypothesis.names[-1]]) > 1


def drawn(rng: np.random.Generator, strength: float, kind: str) -> LinearSelector:
    """Effects some of which look like others, and data with up to three of them, or with something else."""

    def lines(number: int = 1) -> np.ndarray:
        rows = rng.standard_normal((number, np.prod(SHAPE)))
        return strength * rows / np.linalg.norm(rows, axis=1, keepdims=True)

    columns = {name: [lines()] for name in ("pixels", "blur", "plain", "pixels blur")}
    columns["film"] = [0.7 * columns["plain"][0] + 0.7 * lines()]
    columns["like plain"] = [columns["plain"][0] + 0.1 * lines()]
    columns["errors"] = [
        np.concatenate([columns["pixels"][0], columns["film"][0], lines(MANY_PARAMETERS - 2)])
    ]
    columns["shift"] = [0.5 * lines() + 0.5 * columns["blur"][0], lines()]
    columns["other shift"] = [0.5 * lines(), 0.3 * columns["shift"][1] + lines()]
    data = rng.standard_normal(np.prod(SHAPE))
    number = {"outsider": 0}.get(kind, rng.integers(1, 4))
    names = sorted(name for name, own in columns.items() if kind != "one order" or len(own) == 1)
    hidden = rng.choice(names, number, replace=False)
    for name in hidden:
        row = columns[name][-1]
        data += rng.uniform(0.5, 2.0, len(row)) * rng.choice([-1.0, 1.0], len(row)) @ row
    if kind in ("outsider", "both"):
        data += rng.uniform(0.5, 2.0) * lines()[0]
    return LinearSelector(data, columns, guessed=("blur", "film"))


def told(found: Hypothesis) -> dict[str, object]:
    return {"names": list(found.names), "chi2": found.fit.chi2, "log_evidence": found.log_evidence}


def searched(
    selector: LinearSelector, options: SearchOptions = OPTIONS
) -> tuple[Hypothesis, dict[str, object]]:
    """What a search finds, and all that it asks of sets on the way."""
    sets = SetSearch(selector, options, lambda text: None, lambda found: found)  # type: ignore[arg-type]
    singles = sets.refits(selector.null)
    said: dict[str, object] = {"singles": [told(one) for one in singles]}
    said["if stopped"] = told(sets.best_so_far()[0])
    chosen, steps = sets.first(singles)
    said["first"] = told(chosen)
    said["hopeless"] = float(sets.is_hopeless(chosen))
    if singles:
        said["may hide fringes"] = [told(one) for one in sets.that_may_hide_fringes(singles)]
        said["to judge with"] = told(sets.to_judge_with(singles))
    chosen = sets.enlarged(chosen, steps, options.most_effects)
    said["enlarged"], said["so far"] = told(chosen), told(sets.best_so_far()[0])
    chosen = sets.finished(chosen, steps)
    said["finished"] = told(chosen)
    if chosen.names:
        chosen, classes = sets.classified(chosen, steps)
        said["exact"] = sets.taken_for_exact(chosen).probability_of_noise
        said["classes"] = {
            name: [group.members, group.probability, group.significance, group.values]
            for name, group in classes.items()
        }
    said["chosen"], said["steps"] = told(chosen), steps
    for number, other in enumerate(selector.known(len(chosen.names))[1:3] if chosen.names else []):
        other, way = selector.with_channels(other), [sets.step(selector.null, other)]
        said[f"finished from {number}"] = [told(sets.finished(other, way)), way]
        way = []
        said[f"classified from {number}"] = [told(sets.classified(other, way)[0]), way]
    return chosen, said


@pytest.mark.parametrize("kind", ["set", "outsider", "both"])
@pytest.mark.parametrize("strength", [5.0, 7.0, 12.0, 30.0])
def test_sets_are_as_recorded(kind: str, strength: float, recorded: Record) -> None:
    rng = np.random.default_rng([int(strength), len(kind)])
    recorded([searched(drawn(rng, strength, kind))[1] for _ in range(8)])


@pytest.mark.rng("no set is clearly likelier")
def test_no_other_set_is_clearly_likelier(rng: np.random.Generator) -> None:
    """All sets of effects that do not shift the phase are fitted; the prior odds of one are those of any other."""
    for _ in range(8):
        some = drawn(rng, 20.0, "one order")
        columns = {name: own for name, own in some.columns.items() if len(own) == 1}
        selector = LinearSelector(some.data, columns)
        chosen, _ = searched(selector)
        every = [
            selector.hypothesis(names)
            for number in range(1, OPTIONS.most_effects + 1)
            for names in itertools.combinations(selector.columns, number)
        ]
        best = max(one.log_evidence for one in every if OPTIONS.is_noise(selector.with_channels(one)))
        assert chosen.log_evidence > best - OPTIONS.class_width


@pytest.mark.rng("a level beside the errors that take it in")
def test_an_effect_is_found_beside_one_of_many_parameters_that_takes_it_in(rng: np.random.Generator) -> None:
    """Errors that all lie far on one side of zero are likelier with what moves all of them."""
    some = drawn(rng, 30.0, "one order")
    errors = some.columns["errors"][0]
    columns = {"plain": some.columns["plain"], "errors": [errors], "level": [errors.sum(axis=0)[np.newaxis]]}
    noise = rng.standard_normal(np.prod(SHAPE))
    for level, names in ((4.0, {"errors", "level"}), (0.0, {"errors"})):
        data = noise + (level + 0.5 * rng.standard_normal(len(errors))) @ errors
        chosen, _ = searched(LinearSelector(data, columns))
        assert set(chosen.names) == names
