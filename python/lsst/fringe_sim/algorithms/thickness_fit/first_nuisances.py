"""Light and contrast before any thickness is known.

The mean over the wavelengths shows the light that all flats share: fringes of a layer of tens of orders turn several
times over the wavelengths and average out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...array_types import FloatArray
from .cells import Cells
from .learning_cells import some_of
from .nuisances import NuisanceFit, Nuisances, light_widths, patterns_of_cells
from .templates import FlatTemplates

_FIRST_CELLS = 20_000
_INDEPENDENT = 100
"""Independent places of a sensor at most, before the fringes are known: they hide light of their own scale."""


def first_nuisances(cells: Cells, templates: FlatTemplates, free: Nuisances, own: bool = True) -> NuisanceFit:
    """Light and contrast before any thickness is known: fringes average out over wavelengths and over the sensor.

    ``own``: whether each wavelength has light of its own, which fringes of few orders are taken for.
    """
    wavelengths, width = templates.n_wavelengths, cells.value.shape[-1]
    seen = some_of(np.flatnonzero((cells.weight[..., :wavelengths] > 0).all(axis=-1)), _FIRST_CELLS)
    pattern, zones = patterns_of_cells(cells, free, *np.unravel_index(seen, cells.shape))
    known = replace(NuisanceFit.none(wavelengths, pattern.shape[-1]), contrast=templates.contrast)
    if not free.any or seen.size == 0:
        return known
    weight, value = (
        part.reshape(-1, width)[seen, :wavelengths].astype(float) for part in (cells.weight, cells.value)
    )
    coefficients = known.coefficients.copy()
    if pattern.shape[-1]:
        level = np.log1p(np.clip(value, -0.9, 10.0))
        shared = _ridge(pattern, level.mean(axis=1), light_widths(free, zones, pattern.shape[-1], True))
        coefficients[:] = shared
        if own:
            rest = level - (pattern @ shared)[:, None]
            alone = light_widths(free, zones, pattern.shape[-1], False)
            coefficients += np.stack([_ridge(pattern, part, alone) for part in rest.T])
    rest = (1.0 + value) * np.exp(-pattern @ coefficients.T) - 1.0
    strength = templates.amplitude().std(axis=0)
    power = np.array(
        [_robust_variance(rest[:, k]) - float(np.median(1.0 / weight[:, k])) for k in range(wavelengths)]
    )
    contrast = np.sqrt(np.maximum(power, 0.0)) / strength
    mean = float(np.sum(contrast * strength**2) / np.sum(strength**2))
    if free.contrast == "fixed":
        contrast = np.ones(wavelengths)
    elif free.contrast == "common":
        contrast = np.full(wavelengths, mean)
    else:
        contrast = np.clip(contrast, 0.3 * mean, 3.0 * mean)
    return replace(known, coefficients=coefficients, contrast=np.maximum(contrast, 1e-3) * templates.contrast)


def _robust_variance(values: FloatArray) -> float:
    """Variance of a fringe and its noise without its outliers: values beyond four times the median are cut."""
    size = np.abs(values - np.median(values))
    return float(np.mean(np.minimum(size, 4.0 * np.median(size)) ** 2))


def _ridge(pattern: FloatArray, value: FloatArray, width: FloatArray) -> FloatArray:
    """Least squares with a prior; what is left over is counted as noise of few independent places."""
    centred = value - value.mean()
    noise = max(float(np.mean(centred**2)), 1e-12)
    for _ in range(2):
        share = min(_INDEPENDENT / len(value), 1.0) / noise
        normal = share * pattern.T @ pattern + np.diag(width**-2.0)
        found = np.linalg.solve(normal, share * pattern.T @ value)
        noise = max(float(np.mean((value - pattern @ found) ** 2)), 1e-12)
    return np.asarray(found)
