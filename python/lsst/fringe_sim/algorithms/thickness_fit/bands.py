"""Bands of rows of a sensor, or some of its pixels, as compiled loops want them: amplitudes and weights."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import Float32Array
from ...compiled import kernel
from .amplitudes import Amplitudes, core
from .templates import LANES

BAND_ROWS = 8
"""Rows that are loaded at once: all wavelengths of a full sensor then stay in the cache of a processor."""
_KEEP_APART = 80  # Columns more: rows of 2^n numbers would share the lines of the processor's cache
_HUGE = np.float32(1e30)

_EVERY = slice(None)


def load_band(
    data: Amplitudes, low: int, high: int, wavelengths: slice = _EVERY
) -> tuple[Float32Array, Float32Array]:
    """Amplitudes and inverse variances of the rows from ``low`` to ``high``, light divided out.

    ``low, high``: first row, and the one after the last; rows beyond the sensor are left out; ``wavelengths``:
    which of them; all by default. Both are 0 where a pixel cannot be used; the columns beyond those of the
    sensor hold nothing, float32, ``(n_wavelengths, rows, columns and some more)``.
    """
    image, variance, bad = data.rows(low, high, wavelengths)
    variance, bad = core(variance), core(bad)
    bands, rows, columns = image.shape
    amplitude, weight = (np.empty((bands, rows, columns + _KEEP_APART), np.float32) for _ in range(2))
    scale = data.scale[wavelengths].astype(np.float32)
    light = data.offset[wavelengths] if len(data.offset) else np.zeros((bands, 0, 1), np.float32)
    cell_of_row = data.cell_of_row()[low:high]
    for band in range(bands):
        _load(
            _to_read(image[band]), _to_read(variance[min(band, len(variance) - 1)]),
            _to_read(bad[min(band, len(bad) - 1)]), scale[band], _to_read(light[band]), cell_of_row, data.x_edges,
            amplitude[band], weight[band],
        )  # fmt: skip
    return amplitude, weight


def gather_pixels(
    data: Amplitudes, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> tuple[Float32Array, Float32Array]:
    """Amplitudes and weights of some pixels, shape ``(n, padded wavelengths)``."""
    wavelengths = data.shape[0]
    padded = -(-wavelengths // LANES) * LANES
    value, weight = np.zeros((rows.size, padded), np.float32), np.zeros((rows.size, padded), np.float32)
    scale = data.scale.astype(np.float32)
    cell_of_row = data.cell_of_row()
    for band in range(wavelengths):
        image = data.image[band][rows, columns].astype(np.float32)
        variance = data.variance[band][rows, columns].astype(np.float32) * scale[band] ** 2
        good = (
            (data.bad[band][rows, columns] == 0) & np.isfinite(image) & np.isfinite(variance) & (variance > 0)
        )
        amplitude = image * scale[band] - 1
        if len(data.offset):
            light = data.offset[band][cell_of_row[rows], np.searchsorted(data.x_edges, columns, "right") - 1]
            amplitude = (amplitude - light) / (1 + light)
        value[:, band] = np.where(good, amplitude, 0)
        weight[:, band] = np.where(good, 1 / np.where(good, variance, 1), 0)
    return value, weight


def _to_read(array: NDArray[Any]) -> NDArray[Any]:
    """Contiguous array that is not to be written, whatever it was: one version of the kernel, and no copies."""
    part = np.ascontiguousarray(array).view()
    part.flags.writeable = False
    return part


@kernel(relaxed=True)
def _load(image, variance, bad, factor, light, cell_of_row, x_edges, amplitude, weight):  # type: ignore[no-untyped-def]
    """One wavelength; axes of ``variance`` and ``bad`` have one element where all along them is the same."""
    rows, columns = image.shape
    same_variance, same_bad = np.empty(columns, np.float32), np.empty(columns, np.int16)
    same_light = np.empty(columns, np.float32)
    square = factor * factor
    for row in range(rows):
        own = variance[min(row, variance.shape[0] - 1)]
        if own.shape[0] < columns:
            same_variance[:] = own[0]
            own = same_variance
        flag = bad[min(row, bad.shape[0] - 1)]
        if flag.shape[0] < columns:
            same_bad[:] = flag[0]
            flag = same_bad
        line, value, inverse = image[row], amplitude[row], weight[row]
        for x in range(columns):
            level = line[x] * factor - np.float32(1.0)
            spread = own[x] * square
            # NaN fails every comparison.
            good = (abs(level) < _HUGE) & (spread > np.float32(0.0)) & (spread < _HUGE) & (flag[x] == 0)
            value[x] = level if good else np.float32(0.0)
            inverse[x] = np.float32(1.0) / spread if good else np.float32(0.0)
        if light.shape[0] > 0:
            # Amplitudes are flats less one, and so is the light.
            if row == 0 or cell_of_row[row] != cell_of_row[row - 1]:
                own_light = light[cell_of_row[row]]
                for cell in range(own_light.shape[0]):
                    for x in range(x_edges[cell], x_edges[cell + 1]):
                        same_light[x] = np.float32(1.0) / (np.float32(1.0) + own_light[cell])
            for x in range(columns):
                value[x] = (value[x] + np.float32(1.0)) * same_light[x] - np.float32(1.0)
