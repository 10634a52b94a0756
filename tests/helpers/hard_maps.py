"""Maps of thickness [µm] that a fit must master."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FRINGE_ORDER_UM = 0.300  # Thickness of one fringe order at 960 nm in an adhesive of index 1.6 [µm]
Shape = tuple[int, int]
Map = NDArray[np.float64]


def saddle(shape: Shape) -> Map:
    """Hyperbolic paraboloid: fringes that meet in a cross."""
    v, u = _unit_grid(shape)
    return _stretch(u * u - v * v + 0.2 * u * v, 4.0)


def closed_islands(shape: Shape) -> Map:
    """Hills and pits several fringe orders high, surrounded by closed fringes."""
    v, u = _unit_grid(shape)
    hills = (
        (-0.5, -0.45, 0.22, 1.0),
        (0.45, 0.5, 0.18, 0.9),
        (-0.4, 0.55, 0.2, -1.0),
        (0.5, -0.4, 0.25, -0.8),
    )
    height = sum(
        sign * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / width**2) for x, y, width, sign in hills
    )
    return _stretch(np.asarray(height), 5.0)


def steep_gradient(shape: Shape) -> Map:
    """Wedge with 45 fringes from corner to corner."""
    v, u = _unit_grid(shape)
    return _stretch(u * np.cos(0.4) + v * np.sin(0.4), 45.0 * FRINGE_ORDER_UM)


def two_halves(shape: Shape) -> Map:
    """Two halves that do not know of each other: another slope, and a step of 1.37 µm at the middle row.

    The step is not a whole number of fringe orders, so neither half can borrow its order from the other.
    """
    v, u = _unit_grid(shape)
    lower = _stretch(u + 0.5 * (v + 0.5), 4.0)
    upper = _stretch(0.6 * v - u + 0.3 * u * v, 4.0)
    middle, seam = shape[0] // 2, shape[1] // 2
    upper += lower[middle, seam] + 1.37 - upper[middle, seam]
    return np.where(np.arange(shape[0])[:, np.newaxis] < middle, lower, upper)


HARD_MAPS: dict[str, Callable[[Shape], Map]] = {
    each.__name__: each for each in (saddle, closed_islands, steep_gradient, two_halves)
}


def _unit_grid(shape: Shape) -> tuple[Map, Map]:
    """Coordinates from -1 to 1 along y and x, broadcastable."""
    return np.linspace(-1.0, 1.0, shape[0])[:, np.newaxis], np.linspace(-1.0, 1.0, shape[1])[np.newaxis, :]


def _stretch(field: Map, span: float) -> Map:
    """The range of ``field`` mapped linearly onto 17 µm ± ``span / 2``."""
    low, high = float(field.min()), float(field.max())
    return 17.0 + span * ((field - low) / (high - low) - 0.5)
