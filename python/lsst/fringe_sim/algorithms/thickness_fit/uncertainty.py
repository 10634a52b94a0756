"""How sure the fringe order of a pixel is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .global_fit import GlobalFit, spread_to_pixels

__all__ = ["region_slip_probability"]


def region_slip_probability(found: GlobalFit) -> NDArray[np.float32]:
    """Probability that the whole region in which a pixel lies has the wrong order.

    Parameters
    ----------
    found : `GlobalFit`
        Result of the global fit.

    Returns
    -------
    probability : `numpy.ndarray`, float32, shape ``(ny, nx)``
    """
    settled = found.settled
    by_segment = np.append(settled.segment_slip, 1.0)[settled.segment]
    by_cell = 1.0 - (1.0 - by_segment) * (1.0 - settled.cell_slip)
    by_pixel = spread_to_pixels(found.cells, by_cell.astype(np.float32))
    return np.asarray(1.0 - (1.0 - by_pixel) * (1.0 - found.border_slip), dtype=np.float32)
