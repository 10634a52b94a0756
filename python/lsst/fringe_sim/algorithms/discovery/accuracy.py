"""How well the model is known: a disagreement that its tables may be wrong by is none that an effect must explain."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...array_types import FloatArray
from ..inference import Columns, Hypothesis, Point, free_columns, solved
from .critics import CRITICS, judge, total_chance
from .learned_columns import over_wavelength
from .options import MODEL_ACCURACY, SearchOptions

ACCURACY_SOURCE = "absorption of silicon at 1 um, Schinke et al. 2015, doi 10.1063/1.4923419"

TABLE_STEP_NM = 10.0
"""Wavelength over which the errors of a table are alike [nm]: the step at which constants of silicon are stated
(Green 2008, doi 10.1016/j.solmat.2008.06.009); between its entries a table is as wrong as its neighbours are."""


def told_accuracy(
    null: Hypothesis,
    best: Hypothesis,
    index: FloatArray,
    options: SearchOptions,
    accuracy: float,
    chance: float,
) -> dict[str, Any]:
    """What the model may be wrong by, and what is left to explain then, as `Verdict.accuracy` holds it.

    ``null``, ``best``: the unchanged model and the best set. ``accuracy``: see `MODEL_ACCURACY`. ``chance``: that
    noise alone disagrees as much.
    """
    block = model_block(null.point, accuracy)
    channels = judge(null, null, index, options, CRITICS, block)
    told: dict[str, Any] = {
        "assumed": accuracy,
        "source": ACCURACY_SOURCE if accuracy == MODEL_ACCURACY else "as asked for",
        "chance": max(chance, total_chance(channels)),
    }
    if best.effects:
        exact = best.log_evidence - null.log_evidence
        told["log_evidence"] = exact
        told["log_evidence_within"] = (
            exact + evidence_within(best, accuracy) - evidence_within(null, accuracy)
        )
    return told


def model_block(point: Point, accuracy: float) -> Columns:
    """Errors of amplitude and phase of the fringes at all wavelengths, as columns of unit variance."""
    forward = point.problem.forward
    wavelength = forward.geometry.wavelength_nm
    root = accuracy * over_wavelength(wavelength, TABLE_STEP_NM)  # (W, R)
    radian_um = forward.model.fringe_order_um(wavelength)[:, np.newaxis] / (2.0 * math.pi)
    shapes = [point.whitened(point.value - 1.0), point.steep * radian_um]
    values = np.concatenate([root.T[:, :, np.newaxis] * shape for shape in shapes])
    return point.bare_columns(values)


def evidence_within(found: Hypothesis, accuracy: float) -> float:
    """What the log evidence of a set gains where the model may be wrong by so much."""
    point, columns = found.point, free_columns(found.point, found.items)
    block = model_block(point, accuracy)
    across = solved(point.information(columns, columns), point.information(columns, block))
    known = point.information(block, block) - point.information(block, columns) @ across
    score = point.unbiased_score(block) - across.T @ point.unbiased_score(columns)
    total = np.eye(len(score)) + 0.5 * (known + known.T)
    return 0.5 * float(score @ np.linalg.solve(total, score)) - 0.5 * float(np.linalg.slogdet(total)[1])
