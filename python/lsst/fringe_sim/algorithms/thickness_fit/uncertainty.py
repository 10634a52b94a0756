"""How sure the fringe order of a pixel is."""

from __future__ import annotations

import numpy as np

from ...array_types import Float32Array
from ...compiled import kernel, run_threaded
from .amplitudes import Amplitudes
from .bands import BAND_ROWS, load_band
from .global_fit import GlobalFit
from .newton import gauss_newton
from .templates import FlatTemplates

_SHIFTS = 4  # Orders on both sides that a lone pixel is compared with


def slip_probability(found: GlobalFit, out: Float32Array | None = None) -> Float32Array:
    """Probability that the order of a pixel is wrong, all evidence of a global fit taken together.

    Either the whole surface is off, on the summed evidence of its cells; or its cell is, against the neighbours;
    or, near a step, the pixel lies on the other side of it.

    ``out``: where to write; may be ``found.border_slip``, which is then lost, float32, ``(ny, nx)``. Returns 1
    where a cell has no data, float32, ``(ny, nx)``.
    """
    settled = found.settled
    by_segment = np.append(settled.segment_slip, 1.0)[settled.segment]
    stays = (1.0 - found.common_slip) * (1.0 - by_segment) * (1.0 - settled.cell_slip)
    lines = np.repeat(stays.astype(np.float32), np.diff(found.cells.x_edges), axis=1)
    slip = np.empty_like(found.border_slip) if out is None else out
    for line, low, high in zip(lines, found.cells.y_edges[:-1], found.cells.y_edges[1:], strict=True):
        # A few rows at a time stay in the cache of the processor.
        part = slip[low:high]
        np.subtract(np.float32(1), found.border_slip[low:high], out=part)
        part *= line
        np.subtract(np.float32(1), part, out=part)
    return slip


def lone_slip_probability(
    data: Amplitudes, templates: FlatTemplates, thickness_um: Float32Array, order_um: float, threads: int = 2
) -> Float32Array:
    """Probability that the order of a pixel is wrong, on its own amplitudes alone.

    ``thickness_um``: fitted thickness [µm], float32, ``(ny, nx)``. Returns it for a flat prior over four orders on
    both sides; 1 where there is no thickness, float32, ``(ny, nx)``.
    """
    out = np.ones(thickness_um.shape, np.float32)
    table = templates.table()

    def work(band: int) -> None:
        rows = slice(band * BAND_ROWS, (band + 1) * BAND_ROWS)
        _lone_band(
            *load_band(data, rows.start, rows.stop), table, templates.start_um, templates.step_um,
            thickness_um[rows], order_um, out[rows],
        )  # fmt: skip

    run_threaded(work, -(-len(out) // BAND_ROWS), threads)
    return out


@kernel(relaxed=True)
def _lone_band(amplitude, weight, table, start, step, thickness, order, out):  # type: ignore[no-untyped-def]
    bands = amplitude.shape[0]
    rows, columns = out.shape
    y, w = np.zeros((1, table.shape[1]), np.float32), np.zeros((1, table.shape[1]), np.float32)
    top = table.shape[0] - 1.0
    for r in range(rows):
        for x in range(columns):
            middle = (thickness[r, x] - start) / step
            if not 0.0 <= middle <= top:
                continue
            for band in range(bands):
                y[0, band], w[0, band] = amplitude[band, r, x], weight[band, r, x]
            _, _, own = gauss_newton(table, middle, y, w, np.int64(0), np.int64(5), 0.03 / step)
            odds = 0.0
            for shift in range(-_SHIFTS, _SHIFTS + 1):
                place = middle + shift * order / step
                if shift != 0 and 0.0 <= place <= top:
                    _, _, chi2 = gauss_newton(table, place, y, w, np.int64(0), np.int64(5), 0.03 / step)
                    odds += np.exp(min(max(0.5 * (own - chi2), -100.0), 100.0))
            out[r, x] = odds / (1.0 + odds)
