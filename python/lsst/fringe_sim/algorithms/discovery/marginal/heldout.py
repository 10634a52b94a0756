"""The part held out, used once: whether effects that were fitted elsewhere predict it better."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...inference import Data, Hypothesis, Point, in_best_orders, relaxed
from ..continuation import continued
from .preparation import Prepared

__all__ = ["Unseen", "judge_unseen"]


@dataclass(frozen=True)
class Unseen:
    """Unchanged model against effects."""

    gain: float  # of the log likelihood, with thickness and response of the cells free in both
    before_rms: float
    after_rms: float

    @property
    def better(self) -> bool:
        """Whether the data are predicted better."""
        return self.gain > 0.0


def judge_unseen(prepared: Prepared, found: Hypothesis) -> Unseen | None:
    """Compare a set with the unchanged model on the part held out; nothing where there is none."""
    if not prepared.unseen.seen.any():
        return None
    before, after = (_fitted(prepared, one) for one in (prepared.null, found))
    noise = prepared.unseen.noise_rms
    number = max(float(before.noise_share[:, before.problem.data.seen].sum()), 1.0)
    rms = [noise * float(np.sqrt(2.0 * point.cell_energy.sum() / number)) for point in (before, after)]
    return Unseen(before.cost - after.cost, *rms)


def _fitted(prepared: Prepared, found: Hypothesis) -> Point:
    """The held out cells with the effects of a hypothesis as they are; levels and cells are their own."""
    cells = prepared.unseen
    shape = cells.shape
    data = Data(cells.value.reshape(shape[0], -1), cells.weight.reshape(shape[0], -1))
    start = continued(found.point.thickness_um.reshape(shape[1:]), prepared.cells.seen).ravel()
    problem = replace(found.point.problem, data=data, thickness_um=start)
    first = problem.at(found.point.settings, found.point.levels, start)
    return relaxed(in_best_orders(relaxed(first, rounds=4)), rounds=6)
