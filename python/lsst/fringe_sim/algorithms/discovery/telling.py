"""Numbers of a verdict from the cells of a search: sizes, gaps, steps, data."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import chdtri

from ...array_types import FloatArray
from ..inference import Hypothesis
from .preparation import Prepared
from .verdict import CONFIDENCE, Step


def rms_left(prepared: Prepared, found: Hypothesis) -> float:
    """Rms of data minus model of the part searched, corrected for the freedom of all that is fitted."""
    point = found.point
    return prepared.cells.noise_rms * point.misfit(point.problem.free_levels + len(found.items))


def size_of(prepared: Prepared) -> dict[str, float]:
    """Size of what the unchanged model leaves beyond noise, as `Verdict.size` states it."""
    point = prepared.null.point
    seen = point.problem.data.seen
    return size_beyond(_noise_and_misfit(prepared), point.value[:, seen])


def _noise_and_misfit(prepared: Prepared) -> list[tuple[float, float, float]]:
    """Variance of a value by noise, χ² and degrees of freedom: of single exposures, and of what all of them share.

    The thickness of every cell is taken out of both, as far as it may be off.
    """
    point, cells = prepared.null.point, prepared.cells
    seen = point.problem.data.seen
    left = point.beside_thickness(point.first_residual)[:, seen]
    response, residual = point.response[:, seen], point.first_residual[:, seen]
    length2 = (response * point.beside_thickness(point.response)[:, seen]).sum(axis=0)
    along2 = (response * left).sum(axis=0) ** 2 / length2
    scatter2 = cells.response_scatter**2
    shared = float((along2 / (1.0 + length2 * scatter2)).sum())
    single = float((residual * left).sum() - along2.sum())
    of_shared = float((1.0 / length2).mean())
    return [
        (cells.noise_rms**2 - scatter2 - of_shared, single, max(float(point.problem.freedom), 1.0)),
        (of_shared + scatter2, shared, float(response.shape[1])),
    ]


def steps_of(
    prepared: Prepared, rounds: Sequence[Hypothesis], leaves_noise: Callable[[Hypothesis], bool]
) -> tuple[Step, ...]:
    """What every round of a search brought over the one before.

    ``rounds``: the best set of every size, the last one chosen.
    """
    steps, before = [], prepared.null
    for after in rounds:
        added = tuple(name for name in after.effects if name not in before.effects)
        steps.append(
            Step(
                added, after.log_evidence - before.log_evidence, before.chi2 - after.chi2,
                rms_left(prepared, before), rms_left(prepared, after), leaves_noise(after),
            )
        )  # fmt: skip
        before = after
    return tuple(steps)


def data_of(prepared: Prepared, found: Hypothesis) -> dict[str, Any]:
    """The part searched, as `Verdict.data` holds it."""
    cells, thickness = prepared.cells, found.point.thickness_um
    return {
        "shape": list(cells.shape),
        "cell_px": cells.cell_px,
        "wavelength_nm": cells.wavelength_nm.tolist(),
        "noise_factor": prepared.noise_factor.tolist(),
        "response_scatter": cells.response_scatter,
        "thickness_um": [float(thickness.min()), float(thickness.max())],
    }


def size_beyond(parts: Sequence[tuple[float, float, float]], pattern: FloatArray) -> dict[str, float]:
    """Size of what is left beyond noise, as `Verdict.size` states it.

    Noise of single exposures and noise that all of them share, the scatter of the response of the cells, are compared
    with what is left of each: what all exposures share is lost in χ² where the response scatters. The limit takes
    the sum for a multiple of one chi-square (Satterthwaite 1946, doi 10.2307/3002019). Noise that happens to be small
    gives no limit below that of mean noise: power-constrained limits of Cowan et al. 2011.

    ``parts``: variance of a value by noise, χ² and degrees of freedom, of each kind of noise. ``pattern`` (W, N): the
    model over its level, of cells with data.
    """
    variance, chi2, freedom = np.array(parts).T
    noise, left = float(variance.sum()), float((variance * chi2 / freedom).sum())
    degrees = noise**2 / float((variance**2 / freedom).sum())
    counts = math.sqrt(max(left - noise, 0.0))
    most = math.sqrt(max(max(left, noise) * degrees / float(chdtri(degrees, CONFIDENCE)) - noise, 0.0))
    fringes = math.sqrt(float(pattern.var(axis=1).mean())) if pattern.size else 0.0
    return {
        "of_counts": counts,
        "of_fringes": counts / fringes if fringes > 0.0 else math.nan,
        "of_fringes_at_most": most / fringes if fringes > 0.0 else math.nan,
    }
