"""What is not known of a sky because its map was measured at another temperature: the phase of the adhesive.

The optical thickness of the adhesive changes by a factor that is common to all pixels and of which only the size is
known. Sky frames at both ends of the uncertainty differ by a pattern: its rms is the uncertainty of the forecast, and
a correction may fit it as a template beside the sky itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import Float32Array, FloatArray
from ..effects.at_telescope import ADHESIVE_PHASE_SIGMA, adhesive_change
from ..errors import OutOfRangeError
from ..model import FringeModel
from ..products import FringeFrame, mask_bits
from .sky_response import FrameTable, Response

__all__ = ["ADHESIVE_PHASE_SIGMA", "phase_change", "template_pair", "widened_um"]

LARGEST_SIGMA = 2.0  # Bound of the effect `epoxy_temperature` [rad per 10 K]


def _factor(model: FringeModel, sigma: float) -> float:
    """Relative change of the adhesive for one standard uncertainty; 0 where it is not what the map shows."""
    if not 0.0 <= sigma <= LARGEST_SIGMA:
        raise OutOfRangeError("uncertainty of the phase [rad per 10 K]", sigma, f"0 to {LARGEST_SIGMA:g}")
    return abs(adhesive_change(model.system, sigma)) if model.system.varying == "adhesive" else 0.0


def widened_um(model: FringeModel, span_um: tuple[float, float], sigma: float) -> tuple[float, float]:
    """Range of thickness that a response has to cover for `phase_change`."""
    factor = _factor(model, sigma)
    return span_um[0] * (1.0 - factor), span_um[1] * (1.0 + factor)


def phase_change(
    table: FrameTable, thickness_um: ArrayLike, model: FringeModel, sigma: float
) -> Float32Array | None:
    """Half the difference of the skies, each over its mean, with the adhesive at both ends of its uncertainty.

    ``sigma``: standard uncertainty of the phase [rad per 10 K]. Returns ``(ny, nx)``, NaN where the thickness is not
    known; `None` if the map was measured at the temperature of the sky, or shows another layer.
    """
    factor = _factor(model, sigma)
    if factor == 0.0:
        return None
    thickness = np.asarray(thickness_um)
    longer, shorter = (_over_mean(table.frame(thickness * (1.0 + sign * factor))) for sign in (1.0, -1.0))
    return np.asarray(0.5 * (longer - shorter), dtype=np.float32)


def _over_mean(frame: Float32Array) -> FloatArray:
    """Frame in units of the mean of its known pixels."""
    return frame / frame.mean(dtype=np.float64, where=np.isfinite(frame))


def template_pair(
    thickness_um: ArrayLike,
    model: FringeModel,
    response: Response,
    sigma: float,
    creation_datetime: str,
    *,
    detector: str = "",
) -> list[FringeFrame]:
    """Templates for fringe correction: the sky of a map, and how the phase of the adhesive changes it.

    The scale of the second over that of the first is the phase in units of ``sigma``. There is one template alone
    where `phase_change` is `None`.
    """
    thickness = np.asarray(thickness_um)
    table = response.sky()
    frame = table.frame(thickness)
    change = phase_change(table, thickness, model, sigma)
    patterns: list[NDArray[Any]] = [_over_mean(frame), *([] if change is None else [change])]
    mask = np.where(np.isfinite(frame), np.int32(0), np.int32(mask_bits("NO_DATA")))
    return [
        FringeFrame(
            image=np.where(mask, 0.0, pattern - pattern.mean(dtype=np.float64, where=mask == 0)).astype(
                np.float32
            ),
            mask=mask,
            variance=np.zeros(mask.shape, np.float32),
            physical_filter=model.setup.filter_name,
            creation_datetime=creation_datetime,
            metadata={"PHASESIG": sigma, "TEMPLATE": number, "TEMPKIND": kind},
            detector=detector,
        )
        for number, (kind, pattern) in enumerate(zip(("sky", "phase"), patterns, strict=False))
    ]
