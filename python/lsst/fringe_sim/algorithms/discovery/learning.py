"""A correction learned from what the best fit leaves: no name, but the gap becomes smaller, and a shape is seen.

Corrections are Gaussian processes of low rank (as cosines: Solin & Särkkä 2020, doi 10.1007/s11222-019-09886-w). A
few numbers say how smooth and how large they are. Those that maximise the marginal likelihood are taken, and of all
families the one with the largest. Cells that took no part in learning then tell whether the correction predicts
anything. How often noise alone would do as well is counted on noise that is drawn on the fitted model and goes the
same way.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, FloatArray
from ...effects import ImageGeometry
from .cells import FEWEST_TO_HOLD_OUT
from .channels import State
from .columns import Columns, Projected
from .learned_columns import Family, families

FALSE_ALARMS = 0.01  # Chance with which noise alone may seem to teach something

DRAWS = 199
"""Draws of noise. The rank of the data among them is an exact chance for any number (Phipson & Smyth 2010, doi
10.2202/1544-6115.1585); with this many, one draw that is as good is still an alarm of one in a hundred."""

ROUNDS = 1  # Rounds in which a correction is learned again about itself
AT_ONCE = 20  # Draws that are in memory together
TILE = 2  # Side of the tiles of cells of which every other is judged by

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


class Part(ABC):
    """Cells with the model fitted to them: effects are held, and all else is projected out of what is asked.

    ``only``: the one family that is asked; all of them by default.
    """

    only: str = ""

    @property
    @abstractmethod
    def settings(self) -> dict[str, float]:
        """Effects by ``name.parameter``."""

    @property
    @abstractmethod
    def state(self) -> State:
        """Residual, model and noise."""

    @property
    @abstractmethod
    def geometry(self) -> ImageGeometry:
        """Centres of the cells, wavelengths."""

    @property
    @abstractmethod
    def chi2(self) -> float:
        """χ² of all its cells."""

    @property
    @abstractmethod
    def rms(self) -> float:
        """Rms of data minus model, corrected for the freedom of the nuisances."""

    @property
    @abstractmethod
    def planes(self) -> int:
        """Random numbers that a cell needs for a draw of its noise."""

    @abstractmethod
    def chi2_of(self, cells: BoolArray) -> float:
        """χ² of some of the cells ``(ny, nx)``."""

    @abstractmethod
    def change(self, settings: dict[str, float]) -> FloatArray:
        """What other settings change in the data, at the same thickness and levels, ``(W, ny, nx)``."""

    @abstractmethod
    def of_noise(self, numbers: FloatArray) -> FloatArray:
        """Whitened residual of nothing but noise, from random numbers ``(planes, ny, nx)``."""

    @abstractmethod
    def own_scores(self, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scores of all that is free, for a whitened residual."""

    def own_scores_of_data(self) -> tuple[FloatArray, FloatArray]:
        """Those for the residual of the data."""
        return self.own_scores(self.state.residual)

    @abstractmethod
    def projection(self, columns: Columns) -> tuple[Projected, FloatArray]:
        """Score of columns, from a residual and its `own_scores`, and their information."""

    @functools.cached_property
    def families(self) -> list[Family]:
        """Kinds of corrections."""
        return families(self, self.only)

    @functools.cached_property
    def _projected(self) -> list[tuple[Projected, FloatArray]]:
        return [self.projection(family.columns) for family in self.families]

    @property
    def information(self) -> list[FloatArray]:
        """Of the parameters of every family, ``(K, K)``."""
        return [information for _, information in self._projected]

    @functools.cached_property
    def priors(self) -> list[list[Prior]]:
        """Covariances that are tried, of every family."""
        return [
            [Prior.of(words, root, information) for words, root in family.priors]
            for family, information in zip(self.families, self.information, strict=True)
        ]

    def scores(self, residuals: Sequence[FloatArray] | None = None) -> list[FloatArray]:
        """Scores ``(S, K)`` of all families for whitened residuals; for that of the data by default."""
        if residuals is None:
            asked: Sequence[FloatArray] = [self.state.residual]
            own = [self.own_scores_of_data()]
        else:
            asked, own = residuals, [self.own_scores(residual) for residual in residuals]
        return [
            np.stack([project(*pair) for pair in zip(asked, own, strict=True)])
            for project, _ in self._projected
        ]


class Lesson(Protocol):
    """What a search gives to learn from: cells that teach and cells that judge."""

    @property
    def judged(self) -> BoolArray:
        """Cells that judge, ``(ny, nx)``."""

    @property
    def held_out(self) -> BoolArray:
        """Cells that no choice of effects has seen, ``(ny, nx)``."""

    @property
    def noise_floor(self) -> float:
        """Rms of what a perfect model leaves."""

    def teaching(self) -> Part:
        """The cells that teach, with the effects fitted to them; `Part.settings` are those of the effects."""

    def again(self, taught: Part, settings: dict[str, float], only: str) -> Part:
        """The same cells with other settings, which thickness and levels follow."""

    def judging(self, taught: Part, settings: dict[str, float]) -> Part:
        """The cells that judge, with thickness and levels of their own."""


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
    seen: Part, unseen: Part, scores: list[FloatArray], wanted: list[FloatArray], least: float
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


def judging_cells(shape: tuple[int, ...]) -> BoolArray:
    """Cells that are judged by: every other tile along both sides, ``(ny, nx)``; the others lie all around them.

    A pattern over the sensor can be told where it is seen near by, not in the middle of a block without data.
    """
    if min(shape) < FEWEST_TO_HOLD_OUT:
        return np.zeros(shape, dtype=bool)
    rows, columns = (np.arange(size) // TILE % 2 == 1 for size in shape)
    return np.asarray(rows[:, np.newaxis] & columns)


def learn(lesson: Lesson, rng: np.random.Generator, least: float) -> Learned | None:
    """Learn a correction beside the best fit; `None` where there are few cells, or nothing speaks for one.

    The choice of effects has seen all cells in the end. So the data are split anew: tiles all over the sensor judge,
    the cells around them teach. What the tiles in blocks say that no choice has seen stands beside.

    ``rng``: draws the noise. ``least``: log evidence that a correction must bring.
    """
    if not lesson.judged.any():
        return None
    seen = lesson.teaching()
    unseen = lesson.judging(seen, seen.settings)
    taught = _taught(seen, unseen, seen.scores(), unseen.scores(), least)
    if taught.evidence[0] <= least:
        return None
    family = seen.families[taught.family[0]]
    fitted, own = _again(lesson, seen, family, taught)
    after = lesson.judging(fitted, {**fitted.settings, **own})
    gain, drawn = unseen.chi2 - after.chi2, _of_noise(seen, unseen, rng, least)
    strict = lesson.judged & lesson.held_out
    return Learned(
        name=family.name,
        words=family.priors[taught.prior[0]][0],
        size=float(taught.size[0]),
        beside={key: x for key, x in fitted.settings.items() if key not in own},
        own=own,
        log_evidence=float(taught.evidence[0]),
        heldout_gain=gain,
        unseen_gain=unseen.chi2_of(strict) - after.chi2_of(strict),
        chance=(1 + int((drawn >= gain).sum())) / (1 + len(drawn)),
        before_rms=unseen.rms,
        after_rms=after.rms,
        noise_floor=lesson.noise_floor,
    )


def best_evidence(part: Part) -> float:
    """Largest log evidence of a correction, over none; 0 where nothing speaks for one."""
    best = [
        prior.best(score)[0][0]
        for score, priors in zip(part.scores(), part.priors, strict=True)
        for prior in priors
    ]
    return max(0.0, *(float(evidence) for evidence in best))


def _again(lesson: Lesson, seen: Part, family: Family, taught: _Taught) -> tuple[Part, dict[str, float]]:
    """The correction once more about itself, with thickness and levels that follow it.

    Where it is large, what it does is not in proportion to it.
    """
    known = taught.parameters[0]
    for _ in range(ROUNDS):
        own = dict(zip(family.keys, known.tolist(), strict=True))
        seen = lesson.again(seen, {**seen.settings, **own}, family.name)
        score = seen.scores()[0] + seen.information[0] @ known
        known = seen.priors[0][taught.prior[0]].parameters(score, taught.size)[0]
    return seen, dict(zip(family.keys, known.tolist(), strict=True))


def _of_noise(seen: Part, unseen: Part, rng: np.random.Generator, least: float) -> FloatArray:
    """Gains of what is learned from noise alone, ``(DRAWS,)``."""
    gains = []
    shape = (seen.planes, *seen.state.residual.shape[1:])
    for first in range(0, DRAWS, AT_ONCE):
        noise = rng.standard_normal((min(AT_ONCE, DRAWS - first), *shape))
        parts = [[side.of_noise(one) for one in noise] for side in (seen, unseen)]
        gains.append(_taught(seen, unseen, seen.scores(parts[0]), unseen.scores(parts[1]), least).gain)
    return np.concatenate(gains)
