"""Pixels whose likelihood is no parabola: what their neighbours say enters as a prior.

The two sides of a crest look alike. Where the wavelengths are spaced so that all have their crests together, a pixel
with weak fringes may be taken for its mirror image on the other side, which the slopes at its own place do not tell.
Nor does the likelihood of a pixel whose noise is as large as its fringes. The cells around it know the surface far
better. How far pixels lie from that surface is not assumed but learned from the pixels themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from ...compiled import kernel
from .newton import score
from .templates import FringeTemplates

__all__ = [
    "NODES",
    "WIDEST",
    "SurfacePrior",
    "chi2_about",
    "learn_prior",
    "local_width",
    "nodes_about",
    "settle_band",
    "widest_parabola",
]

_CHANGE = 0.25
"""Relative change of the information within three standard deviations up to which the likelihood is a parabola: its
uncertainty is then good to a tenth."""
_REACH = 0.5
"""Orders on both sides over which a pixel may lie: the cells decide between orders."""
NODES = 65
_CROWD = 3.0
"""Nodes lie as the hyperbolic sine of equal steps, the last of which is this: for an adhesive 1.4 nm apart at the
surface, 14 nm at the ends, where nothing is narrower than the uncertainty of a pixel."""
_STEPS = np.linspace(-_CROWD, _CROWD, NODES)
AWAY = np.sinh(_STEPS) / np.sinh(_CROWD)
"""Places of the nodes in units of the reach."""
SHARE = np.cosh(_STEPS) / np.cosh(_STEPS).sum()
_WIDTHS = 24
"""Widths that are tried, in equal ratios from the least distance of the nodes to the whole reach."""
_ROUNDS = 30
"""Steps of expectation and maximisation for the share of pixels that lie apart, then good to a few per cent."""


@dataclass(frozen=True)
class SurfacePrior:
    """How pixels scatter about the surface of the cells around them, beyond the noise of that surface.

    Attributes
    ----------
    width_um : `float`
        Standard deviation of those that follow the surface [µm].
    apart : `float`
        Share of pixels that lie anywhere within half an order.
    """

    width_um: float
    apart: float


def nodes_about(order: float) -> NDArray[np.float64]:
    """Distances of the nodes from the surface, in the unit of ``order``, which is one fringe order."""
    return AWAY * _REACH * order


WIDEST = SurfacePrior(0.0, 1.0)
"""Nothing is known: anywhere within half an order."""


def widest_parabola(
    templates: FringeTemplates, weight: NDArray[np.floating], order_um: float
) -> NDArray[np.float32]:
    """Largest uncertainty at each thickness, in steps of the table, for which the likelihood is a parabola.

    It has to be one over three standard deviations, and these must not reach into the next order. The weights are
    typical inverse variances of the wavelengths.
    """
    reach = int(_REACH * order_um / templates.step_um)
    information = np.gradient(templates.amplitude(), axis=0) ** 2 @ np.asarray(weight, dtype=float)
    limit = np.full(information.shape, reach / 3.0, np.float32)
    for move in range(1, reach + 1):
        for here, there in (
            (slice(move, None), slice(None, -move)),
            (slice(None, -move), slice(move, None)),
        ):
            changed = np.abs(information[there] - information[here]) > _CHANGE * information[here]
            limit[here][changed] = np.minimum(limit[here][changed], np.float32(move / 3.0))
    return limit


def learn_prior(
    chi2: NDArray[np.floating], surface_sigma_um: NDArray[np.floating], order_um: float
) -> SurfacePrior:
    """The prior under which the flats of some pixels are most likely.

    That some lie apart is believed if it makes the flats more likely than a free parameter does by itself (Schwarz
    1978, Ann. Stat. 6, 461).

    Parameters
    ----------
    chi2 : `numpy.ndarray`, shape ``(n_pixels, NODES)``
        Of each pixel, at the nodes about the surface.
    surface_sigma_um : `numpy.ndarray`, shape ``(n_pixels,)``
        Uncertainty of the surface there [µm].
    order_um : `float`
        Thickness of one fringe order [µm].
    """
    if len(chi2) == 0:
        return WIDEST
    likelihood = np.exp(-0.5 * (chi2 - chi2.min(axis=1, keepdims=True)))
    anywhere, away = likelihood @ SHARE, nodes_about(order_um)
    narrowest = away[NODES // 2 + 1]
    price, nobody = 0.5 * np.log(len(chi2)), 1.0 / (len(chi2) + 1.0)
    best, found = -np.inf, WIDEST
    for width in (0.0, *np.geomspace(narrowest, away[-1], _WIDTHS)):
        spread = np.maximum(np.hypot(surface_sigma_um, width), narrowest)[:, np.newaxis]
        follow = SHARE * np.exp(-0.5 * (away / spread) ** 2)
        follow = (likelihood * follow).sum(axis=1) / follow.sum(axis=1)
        apart = 0.5
        for _ in range(_ROUNDS):
            mixed = apart * anywhere + (1.0 - apart) * follow
            apart = max(float(np.mean(apart * anywhere / mixed)), nobody)
        for share, cost in ((apart, price), (nobody, 0.0)):
            total = float(np.log(share * anywhere + (1.0 - share) * follow).sum()) - cost
            if total > best:
                best, found = total, SurfacePrior(float(width), share)
    return found


@kernel(relaxed=True)
def chi2_about(value, weight, table, place, away, chi2):  # type: ignore[no-untyped-def]
    """Chi-square of pixels ``away`` steps of the table from ``place``."""
    top = table.shape[0] - 1.0
    for item in range(chi2.shape[0]):
        for k in range(away.shape[0]):
            at = place[item] + away[k]
            _, _, chi2[item, k] = score(table, min(max(at, 0.0), top), value, weight, item)


def local_width(
    shift_um: NDArray[np.floating],
    sigma_um: NDArray[np.floating],
    width_um: NDArray[np.floating],
    window_px: int,
    independence: float = 1.0,
) -> NDArray[np.float32]:
    """Width of the prior where pixels that lie together are off the surface together.

    A structure smaller than the cells is not in their surface. The mean of what a prior leaves of it in a window,
    undone for how far the prior draws, has a noise that is known. The width is the most likely one for this mean, but
    no smaller than that of all pixels.

    Parameters
    ----------
    shift_um, sigma_um : `numpy.ndarray`, shape ``(ny, nx)``
        Mean, less the surface, and rms of the posterior under the prior [µm]; NaN where there is none.
    width_um : `numpy.ndarray`, shape ``(ny, nx)``
        Width of that prior [µm].
    window_px : `int`
        Side of the window [px].
    independence : `float`, optional
        Independent pixels per pixel of a window: below 1 where noise is correlated.

    Returns
    -------
    width_um : `numpy.ndarray`, float32, shape ``(ny, nx)``
        That of the prior, or a larger one.
    """
    known = np.isfinite(shift_um)
    square = np.where(known, width_um, 0.0).astype(float) ** 2
    free = np.where(
        known, np.clip(1.0 - sigma_um.astype(float) ** 2 / np.maximum(square, 1e-30), 0.0, 1.0), 0.0
    )
    moved, freedom, spread = (
        uniform_filter(each, window_px, mode="constant") * window_px**2
        for each in (np.where(known, shift_um, 0.0).astype(float), free, free * square)
    )
    freedom = np.maximum(freedom, 1e-30)
    mean, noise = moved / freedom, np.maximum(spread, 0.0) / (independence * freedom**2)
    return np.asarray(np.sqrt(np.maximum(square, mean**2 - noise)), np.float32)


@kernel(relaxed=True)
def settle_band(  # type: ignore[no-untyped-def]
    amplitude, weight, table, start, step, asked, surface, width, away, share, apart,
    value, sigma, chi2_out, used,
):  # fmt: skip
    """Mean and rms of the posterior of the pixels that are ``asked``, in place.

    Pixels have a prior of a finite ``width`` about the surface, or lie anywhere within half an order of their own
    value. ``away`` are the nodes in steps of the table, ``share`` what each stands for.
    """
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
            value[r, x] = start + step * place
            sigma[r, x] = step * np.sqrt(max(second / total - first * first, 0.0))
            _, _, misfit = score(table, place, y, w, np.int64(0))
            chi2_out[r, x] = misfit / max(used[r, x] - 1, 1)
