"""The part held out, used once: effects that were fitted elsewhere must predict it, and better than a stand-in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ...array_types import BoolArray, FloatArray
from ...errors import OutOfRangeError
from ..inference import CellShape, Data, Hypothesis, Point, fit, relaxed
from .learning import SIZES, Prior
from .lesson import (
    CellPart,
    in_all_cells,
    in_own_cells,
    together,
    unseen_too,
    with_corrections,
)
from .preparation import Prepared, data_of
from .telling import rms_left
from .verdict_words import LEARNED_WORDS

FEWEST_WAVELENGTHS = 8  # Wavelengths from which on every fourth is left out at once

ROUNDS = 3
"""How often a stand-in is fitted again about itself, as long as that helps: what it does is hardly linear."""

FAINT = 1e-9  # Weight of wavelengths that are left out: a level is all that follows them
STRIDES = (1.0, 0.3, 0.1)  # Parts of the way to a fit that are tried


@dataclass(frozen=True)
class Unseen:
    """Unchanged model against effects, and against a stand-in of equal size."""

    # of the log likelihood, with thickness and response of the cells free in both; nothing without blocks
    gain: float | None
    before_rms: float
    after_rms: float
    stand_in: str = ""  # what it is; empty where none explains anything
    stand_in_gain: float = 0.0
    # the same as ``gain`` of wavelengths that were left out of a fit, whose cells have its thickness; 0 without any
    waves_gain: float = 0.0

    def why_not(self, outsider_prior: float) -> str:
        """Why effects are not believed, or nothing.

        A stand-in is a cause outside the catalogue that was written down. It is believed in their place where its
        likelihood and its prior odds together are the larger.

        ``outsider_prior``: prior probability of such a cause.
        """
        if self.gain is not None and self.gain <= 0.0:
            return "data held out are not predicted better"
        gain = self.gain or 0.0
        if self.gain is None and self.waves_gain == 0.0:
            return "there are too few pixels and wavelengths to hold any out"
        if gain + self.waves_gain <= 0.0:
            return "wavelengths that are left out are not predicted better than by the unchanged model"
        ahead = self.stand_in_gain - gain
        if self.stand_in and ahead > math.log((1.0 - outsider_prior) / outsider_prior):
            return (
                f"{self.stand_in} with as many parameters predicts data held out better, by a log likelihood of "
                f"{ahead:.1f}"
            )
        return ""

    @property
    def text(self) -> str:
        """One line for the notes."""
        other = f", with {self.stand_in} of equal size by {self.stand_in_gain:.1f}" if self.stand_in else ""
        blocks = "" if self.gain is None else f"of blocks rises by {self.gain:.1f}{other}; that "
        return (
            f"held out: the log likelihood {blocks}of wavelengths that are left out of the fit rises by "
            f"{self.waves_gain:.1f}"
        )


def rms_unseen(prepared: Prepared) -> float | None:
    """Rms of the part held out minus the unchanged model, of which a choice is not asked; nothing without one."""
    if not prepared.unseen.seen.any():
        return None
    whole = _whole(prepared, prepared.point)
    own = relaxed(whole.problem_with(data_of(prepared.unseen)))
    return CellPart(own, prepared.unseen.noise_rms).rms


def judge_unseen(prepared: Prepared, found: Hypothesis) -> Unseen:
    """Compare a set with the unchanged model on the part held out, and on wavelengths that are left out."""
    if not prepared.unseen.seen.any():
        of_waves = _gain_of_single_waves if prepared.few else _gain_of_waves
        before_rms, after_rms = rms_left(prepared, prepared.null), rms_left(prepared, found)
        return Unseen(None, before_rms, after_rms, waves_gain=of_waves(prepared, found))
    noise, cells = prepared.unseen.noise_rms, together(prepared)
    whole = _whole(prepared, found.point)
    shape = whole.problem.forward.shape  # all are judged with cells as the best thickness shapes them
    after = CellPart(_fitted(prepared, whole, shape), noise)
    before = CellPart(_fitted(prepared, unseen_too(prepared, prepared.point, cells), shape), noise)
    gain = before.point.cost - after.point.cost
    told = Unseen(gain, before.rms, after.rms, waves_gain=_gain_of_waves(prepared, found))
    rival = stand_in(CellPart(with_corrections(prepared.point), noise), len(found.items))
    if rival is None:
        return told
    other = _fitted(prepared, unseen_too(prepared, rival.point, cells), shape)
    return replace(told, stand_in=rival.words, stand_in_gain=before.point.cost - other.cost)


def _whole(prepared: Prepared, found: Point) -> Point:
    """A fit to the part searched, at all cells, which have the shape of their thickness there."""
    return in_all_cells(prepared, unseen_too(prepared, found, together(prepared)))


def _fitted(prepared: Prepared, point: Point, shape: CellShape) -> Point:
    """The held out cells with the effects of a point as they are; levels and cells are their own.

    ``point``: at all cells. ``shape``: that of the cells.
    """
    forward, start = replace(point.problem.forward, shape=shape), point.thickness_um
    problem = replace(point.problem.about(start), data=data_of(prepared.unseen), forward=forward)
    return in_own_cells(problem.at(point.settings, point.levels, start))


def _gain_of_waves(prepared: Prepared, found: Hypothesis) -> float:
    """Log likelihood of every fourth wavelength over the unchanged model, after fits that have not seen it.

    0 where there are few wavelengths, or others say nothing of those left out.
    """
    waves = len(found.point.levels)
    forward = found.point.problem.forward
    alone = any(forward.effect_of(i.key).parameter(i.parameter).wavelength_nm > 0.0 for i in found.items)
    if waves < FEWEST_WAVELENGTHS or alone:
        return 0.0
    out = (np.arange(waves) % 4 == 2)[:, np.newaxis]
    before, after = (_cost_of_waves(one, out) for one in (prepared.null, found))
    return before - after


def _gain_of_single_waves(prepared: Prepared, found: Hypothesis) -> float:
    """The same of every wavelength in turn, predicted by all others: levels, cells and effects are integrated."""
    waves = range(len(found.point.levels))
    after, before = (
        np.array([one.log_evidence - _without_wave(one, wave).log_evidence for wave in waves])
        for one in (found, prepared.null)
    )
    return float((after - before).sum())


def _without_wave(found: Hypothesis, wave: int) -> Hypothesis:
    """A set fitted to all exposures but one."""
    point, data = found.point, found.point.problem.data
    out = (np.arange(len(data.weight)) == wave)[:, np.newaxis]
    return fit(found.effects, found.items, point.problem_with(_faint(data, out)))


def _faint(data: Data, out: BoolArray) -> Data:
    """Data with hardly any weight at some wavelengths ``(W, 1)``."""
    return Data(data.value, np.where(out, FAINT, 1.0) * data.weight)


def _cost_of_waves(found: Hypothesis, out: BoolArray) -> float:
    """Minus the log likelihood of some wavelengths ``(W, 1)``, predicted by a fit to the others."""
    problem, data = found.point.problem, found.point.problem.data
    seen = replace(problem, data=_faint(data, out))
    start = seen.at(found.point.settings, found.point.levels, found.point.thickness_um)
    point = fit(found.effects, found.items, start).point
    rest = replace(
        problem,
        data=_faint(data, ~out),
        thickness_um=point.thickness_um,
        thickness_sigma_um=point.thickness_sigma_um,
    )
    return relaxed(rest.at(point.settings, point.levels, point.thickness_um)).cost


# Stand-in -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StandIn:
    """A correction with a given number of parameters, fitted to the part searched."""

    words: str
    point: Point


def stand_in(part: CellPart, number: int) -> StandIn | None:
    """The correction of so many parameters that explains the most, nothing where none explains anything.

    The kinds of corrections are those that may be learned. Within a kind and a smoothness, the parameters are those
    shapes that are independent in the data and before them, and the best of them are taken.

    ``part``: the unchanged model. ``number``: parameters.
    """
    tried = [
        (_best_shapes(prior, score[0], number), family, place)
        for family, priors, score in zip(part.families, part.priors, part.scores(), strict=True)
        for place, prior in enumerate(priors)
    ]
    (evidence, parameters), family, place = max(tried, key=lambda one: one[0][0])
    known = np.zeros(len(parameters))
    if evidence <= 0.0:
        return None
    for number_done in range(1, ROUNDS + 1):
        new = _walked(part, family.keys, known, parameters)
        if new is None:
            break
        known, part = new[0], CellPart(new[1], part.noise_rms, family.name)
        if number_done < ROUNDS:
            score = part.scores()[0][0] + part.information[0] @ known
            _, parameters = _best_shapes(part.priors[0][place], score, number)
    words = f"{LEARNED_WORDS[family.name]} ({family.priors[place][0]})"
    return StandIn(words, part.point) if known.any() else None


def _best_shapes(prior: Prior, score: FloatArray, number: int) -> tuple[float, FloatArray]:
    """Log evidence of the best shapes of one prior, at its best size, and the parameters that they have."""
    along, square = score @ prior.turn, SIZES[:, np.newaxis] ** 2
    share = square / (1.0 + square * prior.known)
    each = 0.5 * along**2 * share - 0.5 * np.log1p(square * prior.known)
    best = np.sort(each, axis=1)[:, ::-1][:, :number].sum(axis=1)
    size = int(best.argmax())
    chosen = np.argsort(-each[size])[:number]
    return float(best[size]), np.asarray(prior.turn[:, chosen] @ (along * share[size])[chosen])


def _walked(
    part: CellPart, keys: tuple[str, ...], known: FloatArray, wanted: FloatArray
) -> tuple[FloatArray, Point] | None:
    """Parameters on the way to others that describe the cells better, and the point there."""
    point = part.point
    for stride in STRIDES:
        own = known + stride * (wanted - known)
        settings = {**point.settings, **dict(zip(keys, own.tolist(), strict=True))}
        try:
            new = relaxed(point.moved(point.levels, point.thickness_um, settings), rounds=4)
        except OutOfRangeError:
            continue
        if new.cost < point.cost:
            return own, new
    return None
