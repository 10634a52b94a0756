"""Pixels whose fringes are too weak for them to tell their thickness by themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled import run_threaded
from .amplitudes import Amplitudes
from .bands import BAND_ROWS, gather_pixels, load_band
from .cells import effective_number
from .pixels import CellSurface, PixelFit, bracket
from .posterior import (
    NODES,
    SHARE,
    SurfacePrior,
    chi2_about,
    learn_prior,
    local_width,
    nodes_about,
    settle_band,
    widest_parabola,
)
from .templates import FringeTemplates

__all__ = ["settle_weak_pixels"]

_MOST_ASKED = 32768
"""Pixels that show how far all lie from their surface: a width of a tenth of the noise of a pixel is then seen."""


def settle_weak_pixels(
    data: Amplitudes,
    templates: FringeTemplates,
    surface: CellSurface,
    pixels: PixelFit,
    order_um: float,
    *,
    typical_weight: NDArray[np.floating],
    threads: int = 2,
) -> PixelFit:
    """Give pixels that do not tell their thickness by themselves the surface of the cells as a prior.

    Parameters
    ----------
    data : `Amplitudes`
        The flats.
    templates : `FringeTemplates`
        The model, normalised to the sensor.
    surface : `CellSurface`
        The cells.
    pixels : `PixelFit`
        What the pixels found by themselves; its arrays are revised in place.
    order_um : `float`
        Thickness of one fringe order [µm].
    typical_weight : `numpy.ndarray`, shape ``(n_wavelengths,)``
        Typical inverse variance of each wavelength.
    threads : `int`, optional
        Number of threads; has no influence on the result.
    """
    limit = widest_parabola(templates, typical_weight, order_um)
    _, ny, nx = data.shape
    place = (pixels.value - templates.start_um) / templates.step_um
    inside = (place >= 0.0) & (place <= len(limit) - 1.0)
    weak = inside & (pixels.sigma / templates.step_um > limit[np.where(inside, place, 0.0).astype(np.intp)])
    if not weak.any():
        return pixels
    nearest = np.ix_(*(_nearest(*sides) for sides in ((surface.y_centre, ny), (surface.x_centre, nx))))
    spread = surface.sigma_um[nearest]
    follows = (surface.smooth & surface.known)[nearest] & np.isfinite(spread)
    begin = surface.at(np.arange(ny), np.arange(nx))
    prior = _learned(data, templates, begin, spread, weak & follows, order_um)
    width = np.where(follows, np.hypot(spread, np.float32(prior.width_um)), np.float32(np.inf))
    _settle_asked(data, templates, pixels, weak, begin, width, prior.apart, order_um, threads)
    shift, sigma = (
        np.where(weak & follows, each, np.float32(np.nan)) for each in (pixels.value - begin, pixels.sigma)
    )
    window = 2 * (int(np.diff(surface.y_centre).max(initial=2)) // 2) + 1
    independence = effective_number(window, window, data.noise_correlation_px) / window**2
    wider = local_width(shift, sigma, width, window, independence)
    again = weak & follows & (wider > width)
    _settle_asked(data, templates, pixels, again, begin, wider, prior.apart, order_um, threads)
    return pixels


def _settle_asked(
    data: Amplitudes,
    templates: FringeTemplates,
    pixels: PixelFit,
    asked: NDArray[np.bool_],
    surface: NDArray[np.float32],
    width: NDArray[np.float32],
    apart: float,
    order_um: float,
    threads: int,
) -> None:
    """Posterior of some pixels, in place."""
    table, start, step = templates.table(), templates.start_um, templates.step_um
    away = nodes_about(order_um / step)

    def work(band: int) -> None:
        part = slice(band * BAND_ROWS, min((band + 1) * BAND_ROWS, len(asked)))
        if asked[part].any():
            amplitude, weight = load_band(data, part.start, part.stop)
            settle_band(
                amplitude, weight, table, start, step, asked[part], surface[part], width[part], away, SHARE, apart,
                pixels.value[part], pixels.sigma[part], pixels.chi2[part], pixels.n_wavelengths[part],
            )  # fmt: skip

    run_threaded(work, -(-len(asked) // BAND_ROWS), threads)


def _learned(
    data: Amplitudes,
    templates: FringeTemplates,
    surface: NDArray[np.float32],
    spread: NDArray[np.float32],
    asked: NDArray[np.bool_],
    order_um: float,
) -> SurfacePrior:
    """Prior that some of the pixels in question show."""
    found = np.flatnonzero(asked)
    rows, columns = np.unravel_index(found[:: -(-found.size // _MOST_ASKED) or 1], asked.shape)
    value, weight = gather_pixels(data, rows, columns)
    place = (surface[rows, columns].astype(float) - templates.start_um) / templates.step_um
    chi2 = np.empty((rows.size, NODES))
    chi2_about(value, weight, templates.table(), place, nodes_about(order_um / templates.step_um), chi2)
    return learn_prior(chi2, spread[rows, columns].astype(float), order_um)


def _nearest(centre: NDArray[np.float64], length: int) -> NDArray[np.int64]:
    """Cell to which each pixel is nearest."""
    below, share = bracket(centre, length)
    return np.minimum(below + (share >= 0.5), len(centre) - 1)
