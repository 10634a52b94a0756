"""Pixels whose fringes are too weak for them to tell their thickness by themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, Float32Array
from ...compiled import run_threaded
from .amplitudes import Amplitudes
from .bands import BAND_ROWS, gather_pixels, load_band
from .cells import Cells, cell_independence, effective_number
from .leaning import Leanings, lean_strip, local_variance
from .local_surface import LocalSurface, local_surface
from .pixels import CellSurface, PixelFit
from .posterior import NODES, SHARE, chi2_about, nodes_about, settle_band, share_apart, widest_parabola
from .templates import FlatTemplates

_MOST_ASKED = 8192  # Pixels that show how many lie apart from their surface


def settle_weak_pixels(
    data: Amplitudes,
    templates: FlatTemplates,
    surface: CellSurface,
    cells: Cells,
    pixels: PixelFit,
    order_um: float,
    *,
    threads: int = 2,
) -> tuple[PixelFit, BoolArray]:
    """Give pixels that do not tell their thickness by themselves the surface of the cells as a prior.

    ``pixels``: what the pixels found by themselves; its arrays are revised in place. Returns ``pixels``: the revised
    fit; ``leaning``: pixels that have a surface as their prior, bool, ``(ny, nx)``.
    """
    typical = cells.weight[..., : templates.n_wavelengths].mean(axis=(0, 1))
    weak = _weak(templates, pixels, widest_parabola(templates, typical, order_um))
    if not weak.any():
        return pixels, weak
    cell_of = [
        np.repeat(np.arange(len(edges) - 1), np.diff(edges)) for edges in (cells.y_edges, cells.x_edges)
    ]
    asked = np.zeros(cells.shape, bool)
    asked[tuple(of[index] for of, index in zip(cell_of, np.nonzero(weak), strict=True))] = True
    local = local_surface(surface, cells, templates, asked & surface.known, order_um)
    begin, seen = _leanings(data, templates, cells, local, cell_of[1], threads)
    rows, columns = (int(np.diff(edges).max()) for edges in (cells.y_edges, cells.x_edges))
    independence = effective_number(rows, columns, data.noise_correlation_px) / (rows * columns)
    variance = local.sigma_um.astype(float) ** 2 / cell_independence(rows, data.noise_correlation_px)
    away, step = nodes_about(order_um), templates.step_um
    widths = (away[NODES // 2 + 1] / step, away[-1] / step)
    moved = local_variance(seen, np.where(local.holds, variance, 0.0) / step**2, widths, independence)
    width = np.sqrt(np.where(local.holds, variance + step**2 * moved, np.inf)).astype(np.float32)
    width = width[np.ix_(*cell_of)]
    _settle_asked(data, templates, pixels, weak, begin, width, order_um, threads)
    return pixels, weak & np.isfinite(width)


def _weak(templates: FlatTemplates, pixels: PixelFit, limit: Float32Array) -> BoolArray:
    """Pixels whose likelihood is no parabola over their uncertainty."""
    place = (pixels.value - templates.start_um) / templates.step_um
    inside = (place >= 0.0) & (place <= len(limit) - 1.0)
    own = limit[np.where(inside, place, 0.0).astype(np.intp)]
    return np.asarray(inside & (pixels.sigma / templates.step_um > own))


def _leanings(
    data: Amplitudes,
    templates: FlatTemplates,
    cells: Cells,
    local: LocalSurface,
    cell_of_column: NDArray[np.int64],
    threads: int,
) -> tuple[Float32Array, Leanings]:
    """The surface at each pixel [µm], and what the pixels of each cell show about it."""
    begin, sums = np.zeros(data.shape[1:], np.float32), np.zeros((4, *cells.shape))
    grid = templates.grid()
    away_x = np.arange(data.shape[2]) - cells.x_centre[cell_of_column]

    def work(strip: int) -> None:
        if local.holds[strip].any():
            low, high = int(cells.y_edges[strip]), int(cells.y_edges[strip + 1])
            amplitude, weight = load_band(data, low, high)
            lean_strip(
                amplitude, weight, grid, local.holds[strip], local.terms[strip], cell_of_column,
                np.arange(low, high) - cells.y_centre[strip], away_x, begin[low:high], Leanings(*sums[:, strip]),
            )  # fmt: skip

    run_threaded(work, cells.shape[0], threads)
    return begin, Leanings(*sums)


def _settle_asked(
    data: Amplitudes,
    templates: FlatTemplates,
    pixels: PixelFit,
    asked: BoolArray,
    surface: Float32Array,
    width: Float32Array,
    order_um: float,
    threads: int,
) -> None:
    """Posterior of some pixels, in place."""
    apart = _share_apart(data, templates, surface, width, order_um)
    grid, away = templates.grid(), nodes_about(order_um / templates.step_um)

    def work(band: int) -> None:
        part = slice(band * BAND_ROWS, min((band + 1) * BAND_ROWS, len(asked)))
        if asked[part].any():
            amplitude, weight = load_band(data, part.start, part.stop)
            settle_band(
                amplitude, weight, grid, asked[part], surface[part], width[part], away, SHARE, apart,
                pixels.rows(part),
            )  # fmt: skip

    run_threaded(work, -(-len(asked) // BAND_ROWS), threads)


def _share_apart(
    data: Amplitudes, templates: FlatTemplates, surface: Float32Array, width: Float32Array, order_um: float
) -> float:
    """Share of pixels apart from their surface that some of those with a surface show."""
    found = np.flatnonzero(np.isfinite(width))
    rows, columns = np.unravel_index(found[:: -(-found.size // _MOST_ASKED) or 1], width.shape)
    value, weight = gather_pixels(data, rows, columns)
    place = (surface[rows, columns].astype(float) - templates.start_um) / templates.step_um
    chi2 = np.empty((rows.size, NODES))
    chi2_about(value, weight, templates.table(), place, nodes_about(order_um / templates.step_um), chi2)
    return share_apart(chi2, width[rows, columns].astype(float), order_um)
