"""A correction learned from what the best fit leaves: no name, but the gap becomes smaller, and a shape is seen.

Corrections are Gaussian processes of low rank (as cosines: Solin & Särkkä 2020, doi 10.1007/s11222-019-09886-w). A
few numbers say how smooth and how large they are. Those that maximise the marginal likelihood are taken, and of all
families the one with the largest. Cells that took no part in learning then tell whether the correction predicts
anything. How often noise alone would do as well is counted on noise that is drawn on the fitted model and goes the
same way.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .channels import State
from .fit import Design, Fit, Problem, Projected, fit_model, linearise_at
from .learned_columns import Family, families, with_learned
from .validation import FEWEST_ROWS, misfit_rms, thickness_starts

__all__ = ["FALSE_ALARMS", "Learned", "Prior", "evidence_of_correction", "judging_cells", "learn"]

FloatArray = NDArray[np.float64]

FALSE_ALARMS = 0.01
"""Chance with which noise alone may seem to teach something."""

DRAWS = 199
"""Draws of noise. The rank of the data among them is an exact chance for any number (Phipson & Smyth 2010, doi
10.2202/1544-6115.1585); with this many, one draw that is as good is still an alarm of one in a hundred."""

ROUNDS = 1
"""Rounds in which a correction is learned again about itself."""

AT_ONCE = 20
"""Draws that are in memory together."""

TILE = 2
"""Side of the tiles of cells of which every other is judged by."""

SIZES = np.geomspace(1e-5, 0.1, 17)
"""Rms of a parameter that are tried: from what averages over all cells hide to what is as large as fringes."""


@dataclass(frozen=True, eq=False)
class Learned:
    """A correction, and what data say of it that took no part."""

    name: str  # its effect, ``learned_...``
    words: str  # how smooth it is
    size: float  # rms of a parameter before the data are seen
    beside: dict[str, float]  # settings of the effects beside which it was learned
    own: dict[str, float]  # its own
    log_evidence: float  # over none, in the data that it was learned from
    heldout_gain: float  # fall of χ² on the cells that judge
    unseen_gain: float  # the part of it in blocks that no choice of effects has seen
    chance: float  # that noise alone gives as much
    before_rms: float  # rms of data minus model in the cells that judge, without and with the correction
    after_rms: float
    noise_floor: float

    @property
    def believed(self) -> bool:
        """Whether noise alone would hardly do as much."""
        return self.heldout_gain > 0.0 and self.chance <= FALSE_ALARMS

    def as_mapping(self, names: Sequence[str]) -> dict[str, Any]:
        """What a verdict holds of it; ``names``: the effects beside which it was learned."""
        return {
            **asdict(self),
            "believed": self.believed,
            "effects": list(names),
            "false_alarms": FALSE_ALARMS,
        }


@dataclass(frozen=True, eq=False)
class Prior:
    """One covariance of a family, turned to where its parameters are independent in the data and before them."""

    words: str
    turn: FloatArray  # (K, R): from those to parameters
    known: FloatArray  # (R,): information of each at unit size

    @classmethod
    def of(cls, words: str, root: FloatArray, information: FloatArray) -> Prior:
        """Turn a root of the covariance to where the information is diagonal."""
        values, vectors = np.linalg.eigh(root.T @ information @ root)
        return cls(words, root @ vectors, np.maximum(values, 0.0))

    def best(self, score: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Largest log evidence over all sizes, and that size, for scores ``(S, K)``."""
        square = (score @ self.turn) ** 2
        size = SIZES[:, np.newaxis] ** 2
        gain = 0.5 * square @ (size / (1.0 + size * self.known)).T
        evidence = gain - 0.5 * np.log1p(size * self.known).sum(axis=1)
        best = evidence.argmax(axis=1)
        return evidence[np.arange(len(best)), best], SIZES[best]

    def parameters(self, score: FloatArray, size: FloatArray) -> FloatArray:
        """Expected parameters ``(S, K)``."""
        square = size[:, np.newaxis] ** 2
        return np.asarray((score @ self.turn * (square / (1.0 + square * self.known))) @ self.turn.T)


@dataclass(frozen=True, eq=False)
class _Side:
    """One part of the cells, with all nuisances of a fit to it."""

    state: State
    families: list[Family]
    projected: list[Projected]
    information: list[FloatArray]

    @classmethod
    def of(cls, problem: Problem, fit: Fit, only: str = "") -> _Side:
        design, residual, prediction, thickness, whiten = linearise_at(problem, fit)
        value = problem.expected(fit.levels, prediction.value)
        raw = np.where(problem.cells.weight > 0, problem.cells.value - value, 0.0)
        state = State(design, residual, raw, value, thickness, whiten)
        kinds = families(problem, fit, state, only)
        both = [design.projection(family.columns) for family in kinds]
        return cls(state, kinds, [each[0] for each in both], [each[1] for each in both])

    @functools.cached_property
    def priors(self) -> list[list[Prior]]:
        """Covariances that are tried, of every family."""
        return [
            [Prior.of(words, root, information) for words, root in family.priors]
            for family, information in zip(self.families, self.information, strict=True)
        ]

    def scores(self, residuals: Sequence[FloatArray]) -> list[FloatArray]:
        """Scores ``(S, K)`` of all families for whitened residuals."""
        design: Design = self.state.design
        own = [design.own_scores(residual) for residual in residuals]
        return [
            np.stack([project(*pair) for pair in zip(residuals, own, strict=True)])
            for project in self.projected
        ]


@dataclass(frozen=True, eq=False)
class _Taught:
    """What is learned from each of some residuals: the family and prior of the largest evidence."""

    evidence: FloatArray  # (S,)
    family: NDArray[np.int64]
    prior: NDArray[np.int64]
    size: FloatArray
    gain: FloatArray  # (S,): fall of χ² held out, linearised; 0 where nothing is learned
    parameters: list[FloatArray]


def _taught(
    seen: _Side, unseen: _Side, scores: list[FloatArray], wanted: list[FloatArray], least: float
) -> _Taught:
    """Learn from scores of the part that is seen, and predict those of the other part.

    ``least``: log evidence without which nothing is learned.
    """
    tried = [
        (number, place, *prior.best(scores[number]), prior)
        for number, priors in enumerate(seen.priors)
        for place, prior in enumerate(priors)
    ]
    evidence = np.stack([each[2] for each in tried])
    best = evidence.argmax(axis=0)
    gain, parameters = np.zeros(len(best)), []
    size = np.array([tried[which][3][number] for number, which in enumerate(best)])
    for number, which in enumerate(best):
        family, prior = tried[which][0], tried[which][4]
        own = prior.parameters(scores[family][number : number + 1], size[number : number + 1])[0]
        parameters.append(own)
        if evidence[which, number] > least:
            told = unseen.information[family] @ own
            gain[number] = own @ (2.0 * wanted[family][number] - told)
    return _Taught(
        evidence.max(axis=0), np.array([tried[which][0] for which in best]),
        np.array([tried[which][1] for which in best]), size, gain, parameters,
    )  # fmt: skip


def judging_cells(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Cells that are judged by: every other tile along both sides, ``(ny, nx)``; the others lie all around them.

    A pattern over the sensor can be told where it is seen near by, not in the middle of a block without data.
    """
    if min(shape) < FEWEST_ROWS:
        return np.zeros(shape, dtype=bool)
    rows, columns = (np.arange(size) // TILE % 2 == 1 for size in shape)
    return np.asarray(rows[:, np.newaxis] & columns)


def learn(
    problem: Problem,
    null: Fit,
    best: Fit,
    held_out: NDArray[np.bool_],
    rng: np.random.Generator,
    least: float,
) -> Learned | None:
    """Learn a correction beside the best fit; `None` where there are few cells, or nothing speaks for one.

    The choice of effects has seen all cells in the end. So the data are split anew: tiles all over the sensor judge,
    the cells around them teach. What the tiles in blocks say that no choice has seen stands beside.

    ``null``, ``best``: fits of the unchanged model and of the best effects to all data. ``held_out`` (ny, nx): cells
    that the choice of effects has not seen. ``rng``: draws the noise. ``least``: log evidence that a correction must
    bring.
    """
    judged = judging_cells(held_out.shape)
    if not (judged & problem.cells.seen).any():
        return None
    problem = with_learned(problem)
    inside = problem.without_cells(judged)
    outside = problem.with_cells(problem.cells.restricted(judged))
    free = fit_model(inside, best.coordinates, best.position, best.field, best.levels, best.settings)
    fitted = free.held()  # beside the effects as they are: free ones would take a part of the correction back
    before = _beyond(problem, outside, null, fitted, judged, fitted.settings)
    seen, unseen = _Side.of(inside, fitted), _Side.of(outside, before)
    scores = [side.scores([side.state.residual]) for side in (seen, unseen)]
    taught = _taught(seen, unseen, scores[0], scores[1], least)
    if taught.evidence[0] <= least:
        return None
    family = seen.families[taught.family[0]]
    fitted, own = _again(inside, fitted, family, taught)
    after = _beyond(problem, outside, null, fitted, judged, {**fitted.settings, **own})
    gain, drawn = before.chi2 - after.chi2, _of_noise(seen, unseen, rng, least)
    strict = judged & held_out
    return Learned(
        name=family.name,
        words=family.priors[taught.prior[0]][0],
        size=float(taught.size[0]),
        beside={key: x for key, x in fitted.settings.items() if key not in own},
        own=own,
        log_evidence=float(taught.evidence[0]),
        heldout_gain=gain,
        unseen_gain=_chi2_of(outside, before, strict) - _chi2_of(outside, after, strict),
        chance=(1 + int((drawn >= gain).sum())) / (1 + len(drawn)),
        before_rms=misfit_rms(outside, before),
        after_rms=misfit_rms(outside, after),
        noise_floor=problem.cells.noise_rms,
    )


def evidence_of_correction(problem: Problem, fit: Fit) -> float:
    """Largest log evidence of a correction beside a fit, in all cells, over none; 0 where nothing speaks for one."""
    side = _Side.of(with_learned(problem), fit.held())
    best = [
        prior.best(score)[0][0]
        for score, priors in zip(side.scores([side.state.residual]), side.priors, strict=True)
        for prior in priors
    ]
    return max(0.0, *(float(evidence) for evidence in best))


def _again(inside: Problem, fitted: Fit, family: Family, taught: _Taught) -> tuple[Fit, dict[str, float]]:
    """The correction once more about itself, with thickness and levels that follow it.

    Where it is large, what it does is not in proportion to it.
    """
    known = taught.parameters[0]
    for _ in range(ROUNDS):
        own = dict(zip(family.keys, known.tolist(), strict=True))
        fixed = {**fitted.settings, **own}
        fitted = fit_model(inside, (), np.zeros(0), fitted.field, fitted.levels, fixed)
        side = _Side.of(inside, fitted, family.name)
        score = side.scores([side.state.residual])[0] + side.information[0] @ known
        known = side.priors[0][taught.prior[0]].parameters(score, taught.size)[0]
    return fitted, dict(zip(family.keys, known.tolist(), strict=True))


def _chi2_of(problem: Problem, fit: Fit, cells: NDArray[np.bool_]) -> float:
    """χ² of some of the cells ``(ny, nx)``."""
    expected = problem.expected_of(fit)
    residual = problem.whitener(expected)(problem.cells.value - expected)
    return float((residual[:, cells] ** 2).sum())


def _beyond(
    problem: Problem,
    outside: Problem,
    null: Fit,
    fitted: Fit,
    judged: NDArray[np.bool_],
    settings: dict[str, float],
) -> Fit:
    """Thickness and levels fitted to the cells held out, effects and correction as they were learned."""
    fields = [
        problem.basis.fit(thickness, np.ones(judged.shape))
        for thickness in thickness_starts(problem, null, fitted, judged)
    ]
    ends = [fit_model(outside, (), np.zeros(0), field, fitted.levels, settings) for field in fields]
    return min(ends, key=lambda fit: fit.chi2)


def _of_noise(seen: _Side, unseen: _Side, rng: np.random.Generator, least: float) -> FloatArray:
    """Gains of what is learned from noise alone, ``(DRAWS,)``."""
    gains = []
    for first in range(0, DRAWS, AT_ONCE):
        number = min(AT_ONCE, DRAWS - first)
        noise = rng.standard_normal((number, *seen.state.residual.shape))
        parts = [[np.where(side.state.residual != 0.0, one, 0.0) for one in noise] for side in (seen, unseen)]
        gains.append(_taught(seen, unseen, seen.scores(parts[0]), unseen.scores(parts[1]), least).gain)
    return np.concatenate(gains)
