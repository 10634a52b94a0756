"""Uncertainty of pixels whose likelihood is no parabola.

The two sides of a crest look alike. Where the wavelengths are spaced so that all have their crests together, a pixel
with weak fringes may be taken for its mirror image on the other side, which the slopes at its own place do not tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled import kernel, run_threaded
from .amplitudes import Amplitudes
from .bands import BAND_ROWS, load_band
from .newton import score
from .pixels import PixelFit
from .templates import FringeTemplates

__all__ = ["widen_uncertainties"]

_CHANGE = 0.25
"""Relative change of the information within three standard deviations up to which the likelihood is a parabola: its
uncertainty is then good to a tenth."""
_STEPS = 8
"""Steps of one standard deviation to both sides; the sum over a normal distribution is then exact to 1e-8."""
_REACH = 0.5
"""Orders on both sides over which a pixel may lie: its neighbours decide between orders."""


def widen_uncertainties(
    data: Amplitudes,
    templates: FringeTemplates,
    pixels: PixelFit,
    order_um: float,
    weight: NDArray[np.floating],
    threads: int = 2,
) -> None:
    """Replace uncertainties by the rms of the likelihood about the value, in place, where it is no parabola.

    Parameters
    ----------
    data : `Amplitudes`
        The flats.
    templates : `FringeTemplates`
        The model, normalised to the sensor.
    pixels : `PixelFit`
        The fit.
    order_um : `float`
        Thickness of one fringe order [µm].
    weight : `numpy.ndarray`, shape ``(n_wavelengths,)``
        Typical inverse variance of each wavelength.
    threads : `int`, optional
        Number of threads; has no influence on the result.
    """
    table = templates.table()
    limit = _widest(templates, np.asarray(weight, dtype=float), int(_REACH * order_um / templates.step_um))

    def work(band: int) -> None:
        rows = slice(band * BAND_ROWS, (band + 1) * BAND_ROWS)
        value, sigma = pixels.value[rows], pixels.sigma[rows]
        chosen = np.zeros(value.shape, np.bool_)
        if _choose(limit, templates.start_um, templates.step_um, value, sigma, chosen):
            _widen(
                *load_band(data, rows.start, rows.stop), table, templates.start_um, templates.step_um, order_um,
                chosen, pixels.n_wavelengths[rows], value, sigma,
            )  # fmt: skip

    run_threaded(work, -(-len(pixels.value) // BAND_ROWS), threads)


def _widest(templates: FringeTemplates, weight: NDArray[np.float64], reach: int) -> NDArray[np.float32]:
    """Largest uncertainty at each thickness, in steps of the table, for which the likelihood is a parabola."""
    information = np.gradient(templates.amplitude(), axis=0) ** 2 @ weight
    limit = np.full(information.shape, np.inf, np.float32)
    for move in range(1, reach + 1):
        for here, there in (
            (slice(move, None), slice(None, -move)),
            (slice(None, -move), slice(move, None)),
        ):
            changed = np.abs(information[there] - information[here]) > _CHANGE * information[here]
            limit[here][changed] = np.minimum(limit[here][changed], np.float32(move / 3.0))
    return limit


@kernel
def _choose(limit, start, step, value, sigma, chosen):  # type: ignore[no-untyped-def]
    """Pixels whose uncertainty is above its limit; returns how many there are."""
    top = limit.shape[0] - 1.0
    number = 0
    for r in range(value.shape[0]):
        for x in range(value.shape[1]):
            place, width = (value[r, x] - start) / step, sigma[r, x] / step
            if 0.0 <= place <= top and limit[int(place)] < width < np.inf:
                chosen[r, x] = True
                number += 1
    return number


@kernel(relaxed=True)
def _widen(  # type: ignore[no-untyped-def]
    amplitude, weight, table, start, step, order, chosen, used, value, sigma
):
    bands = amplitude.shape[0]
    y, w = np.zeros((1, table.shape[1]), np.float32), np.zeros((1, table.shape[1]), np.float32)
    top = table.shape[0] - 1.0
    for r in range(value.shape[0]):
        for x in range(value.shape[1]):
            if not chosen[r, x]:
                continue
            count = 0
            for band in range(bands):
                y[0, band], w[0, band] = amplitude[band, r, x], weight[band, r, x]
                count += weight[band, r, x] > np.float32(0.0)
            if count != used[r, x]:
                continue  # a wavelength was left out, and it is not known which
            middle = (value[r, x] - start) / step
            move = min(sigma[r, x] / step, _REACH * order / step / _STEPS)
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
