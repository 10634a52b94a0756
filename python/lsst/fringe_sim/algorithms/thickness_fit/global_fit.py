"""Thickness of a whole sensor at once: orders on cells, then every pixel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import Float32Array
from .amplitudes import Amplitudes
from .borders import settle_borders
from .cell_size import choose_cell_size
from .cells import Cells, average_cells, cell_edges, cell_independence, effective_number
from .conclusion import contrast_map, model_error
from .learned_error import learned_sigma
from .mean_response import normalise_to_pixels
from .nuisances import NuisanceFit, Nuisances
from .pixels import PixelFit, calm_surface, fit_pixels
from .relaxation import SettledCells, settle_orders
from .rescue import rescue_pixels
from .shared_misfit import doubt_from_shared_misfit
from .solver import Solver, surface_of
from .templates import FlatTemplates
from .weak_pixels import settle_weak_pixels


@dataclass(frozen=True, eq=False)
class GlobalFit:
    """What the global fit found."""

    pixels: PixelFit  # value, uncertainty, chi-square of every pixel
    cells: Cells  # averages that the orders were solved on
    settled: SettledCells  # order of every cell, and how sure it is
    # probability that a pixel near a step lies on the other side of it, or that one which was fitted by itself has
    # another order, float32, ``(ny, nx)``
    border_slip: Float32Array
    templates: FlatTemplates  # the model as it was normalised in the end
    nuisance: NuisanceFit  # patterns and contrast beside the fringes
    order_um: float  # thickness of one fringe order [µm]
    # ``sensor``, ``narrow`` or ``range``: over which thicknesses the mean response was taken. ``narrow`` is a
    # sensor of few orders, whose mean response was found together with its order
    normalisation: str
    common_slip: float = 0.0  # probability that the sensor as a whole has another order
    # chi-square by which the next best order of the whole sensor is worse, where nuisances are free
    margin: float = np.inf
    # contrast in blocks of the sensor, over that of the sensor, float32
    contrast_map: Float32Array = field(default_factory=lambda: np.ones((1, 1), np.float32))


def global_fit(
    data: Amplitudes,
    templates: FlatTemplates,
    *,
    range_um: tuple[float, float],
    cell_px: int | None = None,
    nuisances: Nuisances | None = None,
    threads: int = 2,
) -> GlobalFit:
    """Fit a sensor.

    ``templates``: the model; its grid must contain the range and half an order on both sides; ``range_um``:
    thicknesses that are possible [µm]; ``cell_px``: size of the cells [px]; chosen from the steepness of the
    fringes if not given.
    """
    _, ny, nx = data.shape
    nuisances = (nuisances or Nuisances()).fitting(ny, nx)
    order = templates.order_um()
    size = choose_cell_size(data) if cell_px is None else cell_px
    y_breaks, x_breaks = nuisances.breaks(ny, nx)
    cells = average_cells(
        data,
        cell_edges(ny, size, y_breaks),
        cell_edges(nx, size, x_breaks),
        largest_amplitude=np.abs(templates.amplitude()).max(axis=0),
        threads=threads,
    )
    independence = cell_independence(size, data.noise_correlation_px)
    solver = Solver(order, range_um, independence, nuisances, threads, data, templates)
    state = solver.solve(cells, templates)
    settled = settle_orders(
        state.cells, state.templates, state.thickness_um, state.slope_y, state.slope_x, order, state.found,
        range_um=state.range_um, temper=solver.temper, correlation_px=data.noise_correlation_px, threads=threads,
    )  # fmt: skip
    state = solver.adjust(replace(state, thickness_um=settled.thickness_um))
    surface = surface_of(state, order)
    calmed = calm_surface(surface, threads)
    if state.free.any:
        state = solver.relearn(state, data, calmed)
    light = state.nuisance.light(cells, state.free)
    fringes = replace(data, offset=light, y_edges=cells.y_edges, x_edges=cells.x_edges)
    if state.normalisation == "sensor" and not state.free.any:
        state = replace(state, templates=normalise_to_pixels(data, state.templates, calmed, threads))
    pixels = fit_pixels(fringes, state.templates, calmed, order, threads=threads)
    pixels, leaning = settle_weak_pixels(
        fringes, state.templates, surface, state.cells, pixels, order, threads=threads
    )
    rough = spread_to_pixels(cells, ~surface.smooth) & ~leaning
    independent = effective_number(64, 64, data.noise_correlation_px) / 64**2
    pixels, border_slip = settle_borders(fringes, state.templates, pixels, rough, order, independent)
    pixels = rescue_pixels(
        fringes, state.templates, pixels, border_slip, order, range_um=state.range_um, threads=threads
    )
    seen = calmed._replace(sigma_um=surface.sigma_um)
    learned = learned_sigma(cells, seen, leaning, templates, state.free, state.nuisance, order)
    pixels = model_error(pixels, state.nuisance.scale_sigma, learned)
    if state.common_sigma_um > 0.0:
        whole = np.hypot(pixels.sigma, np.float32(state.common_sigma_um))
        pixels = pixels._replace(sigma=np.asarray(whole, np.float32))
    common_slip = state.common_slip
    if state.searched and not state.free.any:
        doubt = doubt_from_shared_misfit(fringes, state.templates, pixels.value, order)
        common_slip = 1.0 - (1.0 - common_slip) * (1.0 - doubt)
    # Near a step the pixels have been asked one by one, which is worth more than the answer of their cell.
    settled = replace(settled, cell_slip=np.where(surface.smooth, settled.cell_slip, np.float32(0)))
    return GlobalFit(
        pixels, state.cells, settled, border_slip, state.templates, state.nuisance, order, state.normalisation,
        common_slip, state.margin, contrast_map(state.cells, state.templates, state.thickness_um),
    )  # fmt: skip


def spread_to_pixels(cells: Cells, values: NDArray[Any]) -> NDArray[Any]:
    """Image in which every pixel holds the value of its cell."""
    rows = np.repeat(values, np.diff(cells.y_edges), axis=0)
    return np.repeat(rows, np.diff(cells.x_edges), axis=1)
