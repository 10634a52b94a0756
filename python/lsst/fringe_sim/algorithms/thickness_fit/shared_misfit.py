"""Misfit that neighbouring pixels share: no noise, so that pixels do not add up to certainty.

Noise differs from pixel to pixel. What a wrong relief, a wrong mean response or a wrong model leaves over is the same
in neighbouring pixels, however small it is beside the noise. If it is as large as what another order would
leave over, then the sum over many pixels says nothing about which of the two is true.
"""

from __future__ import annotations

import numpy as np

from ...array_types import Float32Array, FloatArray
from .amplitudes import Amplitudes
from .bands import gather_pixels
from .cells import Cells
from .evidence import refine_row
from .pixels import CellSurface
from .templates import FlatTemplates

_MOST_PIXELS = 4000
_MOST_PAIRS = 40_000
_SHIFTS = (-3, -2, -1, 1, 2, 3)  # Orders from the solution with which the shared misfit is compared
_NOISE_SIGMA = 3.0
"""Standard deviations of its own uncertainty by which the shared misfit is believed to be smaller."""
_APART = 4.0
"""Distance at which the noise of two pixels is their own, in standard deviations of the kernel that smoothed them."""


def doubt_from_shared_misfit(
    data: Amplitudes, templates: FlatTemplates, thickness_um: Float32Array, order_um: float
) -> float:
    """Probability that a solution is wrong, if all of its shared misfit has one cause.

    The misfit of one pixel in the direction of another order is then as good as that of all: an excess of ``d`` in
    the chi-square of a pixel at another order counts as ``d`` over the shared misfit per degree of freedom.

    ``thickness_um``: thickness of every pixel [µm], float32, ``(ny, nx)``.
    """
    apart = 1 + int(np.ceil(_APART * data.noise_correlation_px))
    ny, nx = thickness_um.shape
    if nx <= apart:
        return 0.0
    stride = max(int(np.sqrt(ny * nx / _MOST_PIXELS)), 1)
    rows, columns = (index.ravel() for index in np.mgrid[0:ny:stride, 0 : nx - apart : stride])
    usable = np.isfinite(thickness_um[rows, columns]) & np.isfinite(thickness_um[rows, columns + apart])
    rows, columns = rows[usable], columns[usable]
    value, weight = gather_pixels(data, rows, columns)
    value_beside, weight_beside = gather_pixels(data, rows, columns + apart)
    own = thickness_um[rows, columns]
    miss = _pull(templates, value, weight, own)
    product = miss * _pull(templates, value_beside, weight_beside, thickness_um[rows, columns + apart])
    freedom = float(np.maximum(((weight > 0.0) & (weight_beside > 0.0)).sum(axis=1) - 1, 0).sum())
    if freedom == 0.0:
        return 0.0
    each = product.sum(axis=1)
    shared = float(each.sum() - _NOISE_SIGMA * each.std() * np.sqrt(each.size)) / freedom
    if shared <= 0.0:
        return 0.0
    odds, chi2 = 0.0, (miss**2).sum(axis=1)
    for shift in _SHIFTS:
        start = (own + shift * order_um).astype(np.float32)
        inside = (start > templates.start_um) & (start < templates.stop_um)
        if inside.any():
            found = np.full_like(start, np.nan)
            refine_row(value, weight, *templates.grid(), start, found)
            excess = (_pull(templates, value, weight, found) ** 2).sum(axis=1) - chi2
            odds += float(np.exp(-0.5 * max(float(excess[inside].mean()), 0.0) / shared))
    return odds / (1.0 + odds)


def leaves_only_noise(data: Amplitudes, templates: FlatTemplates, surface: CellSurface) -> bool:
    """Whether what a model leaves over in neighbouring pixels has nothing in common.

    The median over pairs of pixels is not moved by some that have a wrong order.
    """
    apart = 1 + int(np.ceil(_APART * data.noise_correlation_px))
    _, ny, nx = data.shape
    if nx <= apart:
        return False
    stride = max(int(np.sqrt(ny * nx / _MOST_PAIRS)), 1)
    rows, columns = np.arange(0, ny, stride), np.arange(0, nx - apart, stride)
    pulls = []
    for shift in (0, apart):
        start = np.ascontiguousarray(surface.at(rows, columns + shift)).ravel()
        y, x = (index.ravel() for index in np.meshgrid(rows, columns + shift, indexing="ij"))
        value, weight = gather_pixels(data, y, x)
        found = np.full_like(start, np.nan)
        refine_row(value, weight, *templates.grid(), start, found)
        pulls.append(_pull(templates, value, weight, np.nan_to_num(found, nan=templates.start_um)))
        pulls[-1][~np.isfinite(found)] = np.nan
    return _is_noise((pulls[0] * pulls[1]).sum(axis=1))


def cells_leave_only_noise(cells: Cells, templates: FlatTemplates, thickness_um: Float32Array) -> bool:
    """Whether what a model leaves over in neighbouring cells has nothing in common.

    A cell has less noise than its pixels: fringes so weak that no pixel shows them are seen in cells. Taken for the
    whole fringes of a sensor that is nearly flat, they leave over what no thickness explains.
    """
    value, weight = (part.reshape(-1, part.shape[-1]) for part in (cells.value, cells.weight))
    pulls = _pull(templates, value, weight, np.nan_to_num(thickness_um.ravel(), nan=templates.start_um))
    pulls[~np.isfinite(thickness_um.ravel())] = np.nan
    pulls = pulls.reshape(*thickness_um.shape, -1)
    return _is_noise((pulls[:, 1:] * pulls[:, :-1]).sum(axis=-1).ravel())


def _is_noise(product: FloatArray) -> bool:
    """Whether products of neighbours scatter about zero."""
    product = product[np.isfinite(product)]
    if product.size == 0:
        return False
    middle = float(np.median(product))
    scatter = 1.4826 * float(np.median(np.abs(product - middle)))
    return middle <= _NOISE_SIGMA * 1.2533 * scatter / np.sqrt(product.size)


def _pull(
    templates: FlatTemplates, value: Float32Array, weight: Float32Array, thickness_um: Float32Array
) -> FloatArray:
    """What a thickness leaves over, in standard deviations, shape ``(n, n_wavelengths)``; 0 without data."""
    wavelengths = templates.n_wavelengths
    miss = value[:, :wavelengths] - templates.amplitude_at(thickness_um).T
    return np.asarray(np.sqrt(weight[:, :wavelengths].astype(float)) * miss)
