"""Uncertainty of pixels whose likelihood is no parabola.

The two sides of a crest look alike. Where the wavelengths are spaced so that all have their crests together, a pixel
with weak fringes may be taken for its mirror image on the other side, which the slopes at its own place do not tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled import kernel
from .newton import score
from .templates import FringeTemplates

__all__ = ["widen_band", "widest_parabola"]

_CHANGE = 0.25
"""Relative change of the information within three standard deviations up to which the likelihood is a parabola: its
uncertainty is then good to a tenth."""
_STEPS = 8
"""Steps of one standard deviation to both sides; the sum over a normal distribution is then exact to 1e-8."""
_REACH = 0.5
"""Orders on both sides over which a pixel may lie: its neighbours decide between orders."""


def widest_parabola(
    templates: FringeTemplates, weight: NDArray[np.floating], order_um: float
) -> NDArray[np.float32]:
    """Largest uncertainty at each thickness, in steps of the table, for which the likelihood is a parabola.

    The weights are typical inverse variances of the wavelengths.
    """
    reach = int(_REACH * order_um / templates.step_um)
    information = np.gradient(templates.amplitude(), axis=0) ** 2 @ np.asarray(weight, dtype=float)
    limit = np.full(information.shape, np.inf, np.float32)
    for move in range(1, reach + 1):
        for here, there in (
            (slice(move, None), slice(None, -move)),
            (slice(None, -move), slice(move, None)),
        ):
            changed = np.abs(information[there] - information[here]) > _CHANGE * information[here]
            limit[here][changed] = np.minimum(limit[here][changed], np.float32(move / 3.0))
    return limit


@kernel(relaxed=True)
def widen_band(amplitude, weight, table, start, step, order, limit, value, sigma):  # type: ignore[no-untyped-def]
    """Replace uncertainties above their limit by the rms of the likelihood about the value, in place."""
    bands = amplitude.shape[0]
    y, w = np.zeros((1, table.shape[1]), np.float32), np.zeros((1, table.shape[1]), np.float32)
    top = table.shape[0] - 1.0
    for r in range(value.shape[0]):
        for x in range(value.shape[1]):
            middle, width = (value[r, x] - start) / step, sigma[r, x] / step
            if not (0.0 <= middle <= top and limit[int(middle)] < width < np.inf):
                continue
            for band in range(bands):
                y[0, band], w[0, band] = amplitude[band, r, x], weight[band, r, x]
            move = min(width, _REACH * order / step / _STEPS)
            _, _, least = score(table, middle, y, w, np.int64(0))
            total, square = 0.0, 0.0
            for k in range(-_STEPS, _STEPS + 1):
                place = middle + k * move
                if 0.0 <= place <= top:
                    _, _, chi2 = score(table, place, y, w, np.int64(0))
                    share = np.exp(min(0.5 * (least - chi2), 50.0))
                    total += share
                    square += share * k * k
            if square > 0.0:
                sigma[r, x] = step * move * np.sqrt(square / total)
