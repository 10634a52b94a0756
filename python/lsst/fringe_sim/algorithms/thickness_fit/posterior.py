"""Pixels whose likelihood is no parabola: what their neighbours say enters as a prior.

The two sides of a crest look alike. Where the wavelengths are spaced so that all have their crests together, a pixel
with weak fringes may be taken for its mirror image on the other side, which the slopes at its own place do not tell.
Nor does the likelihood of a pixel whose noise is as large as its fringes. The cells around it know the surface far
better. How far pixels lie from that surface is not assumed but learned from the pixels themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...array_types import Float32Array, FloatArray
from ...compiled import kernel
from .newton import score
from .templates import FlatTemplates

_CHANGE = 0.25
"""Relative change of the information within three standard deviations up to which the likelihood is a parabola: its
uncertainty is then good to a tenth."""
REACH = 0.5  # Orders on both sides over which a pixel may lie: the cells decide between orders
NODES = 65
_CROWD = 4.0
"""Nodes lie as the hyperbolic sine of equal steps, the last of which is this: for an adhesive 0.7 nm apart at the
surface, 19 nm at the ends, where nothing is narrower than the uncertainty of a pixel."""
_STEPS = np.linspace(-_CROWD, _CROWD, NODES)
AWAY = np.sinh(_STEPS) / np.sinh(_CROWD)  # Places of the nodes in units of the reach
SHARE = np.cosh(_STEPS) / np.cosh(_STEPS).sum()
_ROUNDS = 30
"""Steps of expectation and maximisation for the share of pixels that lie apart, then good to a few per cent."""


def nodes_about(order: float) -> FloatArray:
    """Distances of the nodes from the surface, in the unit of ``order``, which is one fringe order."""
    return AWAY * REACH * order


def widest_parabola(templates: FlatTemplates, weight: NDArray[np.floating], order_um: float) -> Float32Array:
    """Largest uncertainty at each thickness, in steps of the table, for which the likelihood is a parabola.

    It has to be one over three standard deviations, and these must not reach into the next order. The weights are
    typical inverse variances of the wavelengths.
    """
    reach = int(REACH * order_um / templates.step_um)
    information = np.gradient(templates.amplitude(), axis=0) ** 2 @ np.asarray(weight, dtype=float)
    limit = np.full(information.shape, reach / 3.0, np.float32)
    for move in range(1, reach + 1):
        for here, there in ((slice(move, None), slice(None, -move)), (slice(None, -move), slice(move, None))):
            changed = np.abs(information[there] - information[here]) > _CHANGE * information[here]
            limit[here][changed] = np.minimum(limit[here][changed], np.float32(move / 3.0))
    return limit


def share_apart(chi2: NDArray[np.floating], spread_um: NDArray[np.floating], order_um: float) -> float:
    """Share of pixels that lie anywhere within half an order of the surface instead of on it.

    That some lie apart is believed if it makes the flats more likely than a free parameter does by itself (Schwarz
    1978, Ann. Stat. 6, 461).

    ``chi2``: of each pixel, at the nodes about the surface, ``(n_pixels, NODES)``; ``spread_um``: standard deviation
    of the pixels that follow the surface [µm], ``(n_pixels,)``.
    """
    if len(chi2) == 0:
        return 1.0
    likelihood = np.exp(-0.5 * (chi2 - chi2.min(axis=1, keepdims=True)))
    anywhere, away = likelihood @ SHARE, nodes_about(order_um)
    follow = SHARE * np.exp(-0.5 * (away / np.maximum(spread_um, away[NODES // 2 + 1])[:, np.newaxis]) ** 2)
    follow = (likelihood * follow).sum(axis=1) / follow.sum(axis=1)
    nobody, apart = 1.0 / (len(chi2) + 1.0), 0.5
    for _ in range(_ROUNDS):
        mixed = apart * anywhere + (1.0 - apart) * follow
        apart = max(float(np.mean(apart * anywhere / mixed)), nobody)
    gain = np.log(apart * anywhere + (1.0 - apart) * follow) - np.log(
        nobody * anywhere + (1.0 - nobody) * follow
    )
    return apart if float(gain.sum()) > 0.5 * np.log(len(chi2)) else nobody


@kernel(relaxed=True)
def chi2_about(value, weight, table, place, away, chi2):  # type: ignore[no-untyped-def]
    """Chi-square of pixels ``away`` steps of the table from ``place``."""
    top = table.shape[0] - 1.0
    for item in range(chi2.shape[0]):
        for k in range(away.shape[0]):
            at = place[item] + away[k]
            _, _, chi2[item, k] = score(table, min(max(at, 0.0), top), value, weight, item)


@kernel(relaxed=True)
def settle_band(amplitude, weight, grid, asked, surface, width, away, share, apart, pixels):  # type: ignore[no-untyped-def]
    """Mean and rms of the posterior of the pixels that are ``asked``, in place.

    Pixels have a prior of a finite ``width`` about the surface, or lie anywhere within half an order of their own
    value. ``away`` are the nodes in steps of the table, ``share`` what each stands for.
    """
    (table, start, step), (value, sigma, chi2_out, used) = grid, pixels
    bands, nodes = amplitude.shape[0], away.shape[0]
    y, w = np.zeros((1, table.shape[1]), np.float32), np.zeros((1, table.shape[1]), np.float32)
    chi2, follow = np.empty(nodes, np.float64), np.empty(nodes, np.float64)
    top = table.shape[0] - 1.0
    for r in range(value.shape[0]):
        for x in range(value.shape[1]):
            if not asked[r, x]:
                continue
            for band in range(bands):
                y[0, band], w[0, band] = amplitude[band, r, x], weight[band, r, x]
            follows = width[r, x] < np.inf
            middle = ((surface[r, x] if follows else value[r, x]) - start) / step
            alone = apart if follows else 1.0
            square = max((width[r, x] / step) ** 2, away[nodes // 2 + 1] ** 2)
            least, norm = np.inf, 0.0
            for k in range(nodes):
                _, _, chi2[k] = score(table, min(max(middle + away[k], 0.0), top), y, w, np.int64(0))
                least = min(least, chi2[k])
                follow[k] = share[k] * np.exp(-0.5 * away[k] * away[k] / square)
                norm += follow[k]
            total, first, second = 0.0, 0.0, 0.0
            for k in range(nodes):
                prior = alone * share[k] + (1.0 - alone) * follow[k] / norm
                probable = np.exp(0.5 * (least - chi2[k])) * prior
                total += probable
                first += probable * away[k]
                second += probable * away[k] * away[k]
            first /= total
            place = min(max(middle + first, 0.0), top)
            variance = max(second / total - first * first, 0.0)
            value[r, x], sigma[r, x] = start + step * place, step * np.sqrt(variance)
            _, information, misfit = score(table, place, y, w, np.int64(0))
            # What the prior holds takes no degree of freedom from the amplitudes.
            chi2_out[r, x] = misfit / max(used[r, x] - min(variance * information, 1.0), 1.0)
