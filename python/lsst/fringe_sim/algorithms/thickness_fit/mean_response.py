"""The mean response over a sensor, which its thicknesses tell, and they depend on it."""

from __future__ import annotations

import numpy as np

from ...array_types import Float32Array
from .amplitudes import Amplitudes
from .cells import Cells, sample_pixels
from .evidence import refine_cells
from .pixels import CellSurface
from .templates import FlatTemplates

_MEAN_TOLERANCE = 2e-6
"""Relative change of the mean response that is left alone: far below the noise of a smoothed flat."""
_MOST_ROUNDS = 20
SENSOR_ORDERS = 3.0
"""Orders of thickness that a sensor must span before its mean is near that of the range, whatever its order."""


def spans_orders(thickness_um: Float32Array, order_um: float, orders: float = SENSOR_ORDERS) -> bool:
    """Whether a sensor holds enough orders for the mean response over it to be known from its map."""
    values = thickness_um[np.isfinite(thickness_um)]
    return values.size > 0 and float(np.ptp(np.percentile(values, (2.0, 98.0)))) > orders * order_um


def normalise_to_cells(
    cells: Cells, templates: FlatTemplates, thickness_um: Float32Array, threads: int = 2
) -> tuple[Float32Array, FlatTemplates]:
    """Refit the cells and renormalise the templates in turn until neither changes.

    A wrong mean response shifts each thickness by a little that depends on its phase, and so bends the very
    distribution from which the mean response is taken; a few rounds straighten it.

    ``thickness_um``: thickness of the cells to within a fraction of an order [µm]; NaN where there is none,
    ``(ncy, ncx)``. Returns the thickness, float32, and the templates.
    """
    thickness, fitted = thickness_um, templates.normalised_to(thickness_um)
    for _ in range(_MOST_ROUNDS):
        thickness = refine_cells(cells, fitted, thickness, threads)
        before, fitted = fitted, fitted.normalised_to(thickness)
        if np.abs(fitted.mean_response / before.mean_response - 1.0).max() < _MEAN_TOLERANCE:
            break
    return thickness, fitted


def normalise_to_pixels(
    data: Amplitudes, templates: FlatTemplates, surface: CellSurface, threads: int
) -> FlatTemplates:
    """Renormalise to single pixels: a steep cell spreads over a part of a fringe that its mean does not show."""
    return normalise_to_cells(*_sample_on(data, surface, templates, threads))[1]


def _sample_on(
    data: Amplitudes, surface: CellSurface, templates: FlatTemplates, threads: int
) -> tuple[Cells, FlatTemplates, Float32Array, int]:
    """Some single pixels, and where they begin, as `normalise_to_cells` takes them."""
    sample = sample_pixels(data)
    start = surface.at(sample.y_edges[:-1], sample.x_edges[:-1])
    start[sample.n_wavelengths == 0] = np.nan
    return sample, templates, start, threads
