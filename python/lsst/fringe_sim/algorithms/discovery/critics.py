"""Critics: what a hypothesis leaves, and the chance of that under noise. The list of them is an argument."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ...array_types import FloatArray
from ...effects import ImageGeometry
from ..inference import Columns, Hypothesis, Point, free_columns, joined, solved
from .channels import (
    BANDS,
    Channel,
    State,
    amplifier_features,
    chance_beyond,
    echo_channel,
    in_looks,
    phase_features,
    spatial_features,
    texture_channels,
)
from .columns import PlaneColumns
from .options import SearchOptions
from .spots import SpotScores
from .trends import FEWEST_DRAWS, trend_channel

RANK = 1e-7  # Relative eigenvalue of what nothing else has left

FEWEST_ROWS = {"phase": 1, "place": 8, "texture": BANDS * 3}
"""Rows and columns of cells from which on a critic says something."""


class Judged:
    """A hypothesis with what all critics need: the state, and the dense columns that are free.

    ``block``: columns that are known within a unit of theirs.
    """

    def __init__(
        self, found: Hypothesis, index: FloatArray, noncentral: float, block: Columns | None = None
    ) -> None:
        point = found.point
        self.found, self.index, self.noncentral = found, index, noncentral
        self.geometry: ImageGeometry = point.problem.forward.geometry
        columns = free_columns(point, found.items)
        free = len(columns)
        if block is not None:
            columns = joined(columns, block)
        self.columns: Columns = columns
        self.known = np.diag((np.arange(len(columns)) >= free).astype(float))  # precision of priors
        self.state = state_of(point, columns, self.known)

    @property
    def rows(self) -> int:
        """Fewest cells along a side."""
        return min(self.geometry.sample_shape)

    def family(self, values: FloatArray) -> tuple[float, int]:
        """Score statistic of further columns ``(L, W, N)``, all else free, and its degrees of freedom."""
        point = self.found.point
        own = point.bare_columns(values)
        base = point.information(self.columns, self.columns) + self.known
        across = solved(base, point.information(self.columns, own))
        matrix = point.information(own, own) - point.information(own, self.columns) @ across
        score = point.unbiased_score(own) - across.T @ point.unbiased_score(self.columns)
        scale = np.sqrt(np.maximum((values**2).sum(axis=(1, 2)), 1e-300))
        size, axes = np.linalg.eigh(matrix / np.outer(scale, scale))
        keep = size > RANK
        along = axes[:, keep].T @ (score / scale)
        return float((along**2 / size[keep]).sum()), int(keep.sum())


def state_of(point: Point, columns: Columns, known: FloatArray | float = 0.0) -> State:
    """A point in the layout in which residuals are described and drawn.

    ``known`` (K, K): precision with which the dense parameters are known beforehand.
    """
    shape = (len(point.levels), *point.problem.forward.geometry.sample_shape)
    base = point.information(columns, columns) + known
    step = solved(base, point.score(columns))
    left = point.projected(point.first_residual - columns.combined(step))
    left = left / np.sqrt(np.maximum(point.noise_share, 0.05))
    root = point.root.reshape(shape)
    value = (point.value * point.levels[:, np.newaxis]).reshape(shape)
    raw = np.where(root > 0.0, point.problem.data.value.reshape(shape) - value, 0.0)
    steep, thickness = point.steep.reshape(shape), point.thickness_um.reshape(shape[1:])
    return State(steep, left.reshape(shape), raw, value, thickness, root)


PROJECTED = ("thickness phase", "large scales", "amplifiers")
"""Channels whose statistic is the fall of χ² with columns that are free."""

Critic = Callable[[Judged], Sequence[Channel]]


def _phase(judged: Judged) -> list[Channel]:
    """Harmonics of the fringes at every wavelength."""
    features: PlaneColumns = phase_features(judged.state, judged.geometry, judged.index)
    values = np.zeros((len(features.plane), len(judged.index), judged.state.thickness_um.size))
    values[np.arange(len(values)), features.plane] = features.amplitude.reshape(len(values), -1)
    statistic, degrees = judged.family(values)
    chance = chance_beyond(statistic, max(degrees, 1), judged.noncentral)
    return [Channel("thickness phase", statistic, degrees, chance)]


def _place(judged: Judged) -> list[Channel]:
    """Patterns over the sensor, and amplifiers."""
    if judged.rows < FEWEST_ROWS["place"]:
        return []
    found = []
    for name, features in (("large scales", spatial_features), ("amplifiers", amplifier_features)):
        columns = features(judged.state, judged.geometry)
        statistic, degrees = judged.family(columns.reshape(*columns.shape[:2], -1))
        found.append(Channel(name, statistic, degrees, chance_beyond(statistic, max(degrees, 1))))
    return found


def _texture(judged: Judged) -> list[Channel]:
    """Power at all scales against that at the finest, single waves, and copies of the image."""
    if judged.rows < FEWEST_ROWS["texture"]:
        return []
    return [*texture_channels(judged.state, correlation_of(judged.found)), echo_channel(judged.state)]


def _spots(judged: Judged) -> list[Channel]:
    """The strongest round spot of all exposures."""
    return [] if judged.rows < FEWEST_ROWS["texture"] else [spot_scores(judged.found).channel()]


def _trends(judged: Judged) -> list[Channel]:
    """Whether errors of single exposures are draws."""
    found, forward = judged.found, judged.found.point.problem.forward
    channels = []
    for name in dict.fromkeys(item.effect for item in found.items if item.exchangeable):
        effect = forward.effect_of(name)
        place = np.array([
            effect.parameter(item.parameter).wavelength_nm if item.effect == name else np.nan for item in found.items
        ])  # fmt: skip
        own = np.flatnonzero(np.isfinite(place))
        if len(own) >= FEWEST_DRAWS:
            covariance = found.covariance[np.ix_(own, own)]
            channels.append(trend_channel(effect.title, place[own], found.values[own], covariance))
    return channels


def spot_scores(found: Hypothesis) -> SpotScores:
    """Score and information of what all exposures have in common in a cell, beside its thickness and its response."""
    point, shape = found.point, found.point.problem.forward.geometry.sample_shape
    own = point._forward_solved(point._along(point.response))
    score = (point.response * point.unbiased_residual).sum(axis=0) - (own * point.residual_cells).sum(axis=0)
    information = (point.response**2).sum(axis=0) - (own**2).sum(axis=0)
    return SpotScores.beside_level(score.reshape(shape), information.reshape(shape), correlation_of(found))


def spots_instead(found: Hypothesis, without: Mapping[str, Hypothesis]) -> float:
    """Log evidence of a few spots in the place of an effect of image or island, over that of the effect.

    Gains of two amplifiers under a stain are most of the stain. ``without``: the set without each of its effects.
    """
    gains = [-math.inf]
    for name, rest in without.items():
        effect = found.point.problem.forward.effect_of(name)
        if effect.acts_on == "image" or effect.local:
            gains.append(spot_scores(rest).evidence() - (found.log_evidence - rest.log_evidence))
    return max(gains)


def correlation_of(found: Hypothesis) -> float:
    """Correlation of the noise of neighbouring cells that the effects of a set account for."""
    forward = found.point.problem.forward
    effects = [forward.effect_of(name) for name in found.effects]
    nulls = [effect.null_values(forward.model.base_system) for effect in effects]
    return sum(
        effect.noise_correlation({**null, **_own(found.point.settings, effect.name)}, forward.geometry)
        for effect, null in zip(effects, nulls, strict=True)
    )


def _own(settings: dict[str, float], name: str) -> dict[str, float]:
    return {key.partition(".")[2]: value for key, value in settings.items() if key.partition(".")[0] == name}


CRITICS: tuple[Critic, ...] = (_phase, _place, _texture, _spots, _trends)


def judge(
    found: Hypothesis,
    null: Hypothesis,
    index: FloatArray,
    options: SearchOptions,
    critics: Sequence[Critic] = CRITICS,
    block: Columns | None = None,
) -> tuple[Channel, ...]:
    """What all critics say of a hypothesis; fringes are described only so well, and effects in their form.

    ``block``: see `Judged`.
    """
    judged = Judged(found, index, _undescribed(found, null, options), block)
    return tuple(channel for critic in critics for channel in critic(judged))


def _undescribed(found: Hypothesis, null: Hypothesis, options: SearchOptions, fall: float = 0.0) -> float:
    """χ² by which the fringes may be described wrongly; ``fall``: what further effects explain."""
    response = found.point.response
    fringes = response - response.mean(axis=1, keepdims=True)
    explained = max(null.chi2 - found.chi2, 0.0) + fall
    return options.precision**2 * float((fringes**2).sum()) + options.imprecision**2 * explained


def is_out_of_reach(
    channels: Sequence[Channel], found: Hypothesis, null: Hypothesis, fall: float, options: SearchOptions
) -> bool:
    """Whether something is left that is no noise, even if further effects take so much off χ².

    What columns explain beside an effect is what they explain without it, less what the effect explains, or more.
    """
    noncentral = _undescribed(found, null, options, fall)
    return any(
        chance_beyond(one.statistic - fall, max(one.degrees, 1.0), noncentral) < options.significance
        for one in channels
        if one.name in PROJECTED
    )


def total_chance(channels: Sequence[Channel]) -> float:
    """Chance that noise alone gives so small a smallest chance."""
    return in_looks(min((channel.probability for channel in channels), default=1.0), len(channels))
