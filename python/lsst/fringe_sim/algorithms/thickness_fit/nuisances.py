"""What flats hold besides fringes: free levels, steps between zones, slow illumination, another contrast.

The flats over their mean are modelled as ``(1 + c f(d)) (1 + g(x, y))`` for each wavelength, with the fringe
amplitude ``f`` of the templates, a contrast ``c`` and a light ``g`` of known patterns: ones over each zone of the
sensor, and low polynomials over the whole of it. Light and gain multiply the fringes; at a light of 4 % and fringes
of 13 % their product is larger than the noise of a flat. With the orders known this is a linear problem, step by
step, once the thickness of every cell is eliminated: a small change of it moves the amplitudes along their slope, so
that direction is projected out (variable projection, Golub & Pereyra 1973, Inverse Problems 19, R1 (2003) for a
review).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, OutOfRangeError, UnknownNameError
from ..thickness_fit_options import CONTRASTS, ZONES
from .cells import Cells
from .evidence import refine_cells
from .templates import FringeTemplates

__all__ = [
    "CONTRASTS",
    "ZONES",
    "NuisanceFit",
    "Nuisances",
    "add_offset",
    "first_nuisances",
    "fit_nuisances",
    "subtract_offset",
]

FloatArray = NDArray[np.float64]

_MOST_CELLS = 8_000
_ROUNDS = 8
_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Nuisances:
    """Which of them a fit leaves free.

    Parameters
    ----------
    level : `bool`, optional
        A free level at each wavelength in each zone.
    zones : {"sensor", "halves", "amplifiers"}, optional
        Zones with a level of their own; other than ``sensor`` implies ``level``.
    illumination_degree : `int`, optional
        Degree of a polynomial in x and y, free at each wavelength, and the level with it; 0 for none.
    contrast : {"fixed", "common", "wavelength"}, optional
        Factor on the fringe amplitude of the model.

    Raises
    ------
    UnknownNameError, OutOfRangeError
        A choice that does not exist, or a degree outside 0 to 8.
    """

    level: bool = False
    zones: str = "sensor"
    illumination_degree: int = 0
    contrast: str = "fixed"

    def __post_init__(self) -> None:
        if self.zones not in ZONES:
            raise UnknownNameError("zones", self.zones, ZONES)
        if self.contrast not in CONTRASTS:
            raise UnknownNameError("contrast", self.contrast, CONTRASTS)
        if not 0 <= self.illumination_degree <= 8:
            raise OutOfRangeError("illumination degree", self.illumination_degree, "0 to 8")

    @property
    def any(self) -> bool:
        """Whether anything is left free."""
        return self.patterned or self.contrast != "fixed"

    @property
    def patterned(self) -> bool:
        """Whether light or level are free."""
        return self.level or self.zones != "sensor" or self.illumination_degree > 0

    def breaks(self, ny: int, nx: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Rows and columns at which a zone begins.

        Raises
        ------
        InputError
            A sensor too small for its zones.
        """
        if self.zones == "sensor":
            return (), ()
        if ny < 2 or (self.zones == "amplifiers" and nx < 8):
            raise InputError("zones", self.zones, f"zones that a sensor of {ny} rows and {nx} columns has")
        rows = (ny // 2,)
        return rows, (tuple(nx * k // 8 for k in range(1, 8)) if self.zones == "amplifiers" else ())


@dataclass(frozen=True, eq=False)
class NuisanceFit:
    """Patterns and contrast that a fit found.

    Attributes
    ----------
    offset : `numpy.ndarray`, float32, shape ``(n_wavelengths, ncy, ncx)``
        Light of each cell, less one; no wavelengths if it is even.
    contrast : `numpy.ndarray`, shape ``(n_wavelengths,)``
        Factor on the fringe amplitude.
    """

    offset: NDArray[np.float32]
    contrast: FloatArray


def first_nuisances(cells: Cells, templates: FringeTemplates, free: Nuisances) -> NuisanceFit:
    """Patterns and contrast before any thickness is known: fringes average out over a sensor.

    Parameters
    ----------
    cells : `Cells`
        Mean amplitudes.
    templates : `FringeTemplates`
        The model.
    free : `Nuisances`
        What is free.
    """
    wavelengths = templates.n_wavelengths
    pattern = _patterns(cells, free)
    offset = np.zeros((wavelengths, *cells.shape)) if pattern.shape[-1] else np.zeros((0, *cells.shape))
    contrast = np.ones(wavelengths)
    for band in range(wavelengths if free.any else 0):
        weight, value = cells.weight[..., band].astype(float), cells.value[..., band].astype(float)
        seen = weight > 0
        if not seen.any():
            continue
        rest = value[seen]
        if pattern.shape[-1]:
            coefficients = np.linalg.lstsq(pattern[seen], rest, rcond=1e-10)[0]
            offset[band] = pattern @ coefficients
            rest = rest - pattern[seen] @ coefficients
        power = _robust_variance(rest) - np.median(1.0 / weight[seen])
        contrast[band] = np.sqrt(max(power, 0.0)) / templates.amplitude()[:, band].std()
    if free.contrast == "fixed":
        contrast[:] = 1.0
    elif free.contrast == "common":
        strength = templates.amplitude().std(axis=0)
        contrast[:] = np.sum(contrast * strength**2) / np.sum(strength**2)
    return NuisanceFit(offset.astype(np.float32), np.maximum(contrast, 1e-3) * templates.contrast)


def _robust_variance(values: FloatArray) -> float:
    """Variance of a fringe and its noise without its outliers: values beyond four times the median are cut."""
    size = np.abs(values - np.median(values))
    return float(np.mean(np.minimum(size, 4.0 * np.median(size)) ** 2))


def fit_nuisances(
    cells: Cells,
    templates: FringeTemplates,
    thickness_um: NDArray[np.float32],
    free: Nuisances,
    start: NuisanceFit,
    threads: int = 2,
) -> tuple[NDArray[np.float32], NuisanceFit]:
    """Fit patterns, contrast and the thickness of the cells together, the orders being known.

    Parameters
    ----------
    cells : `Cells`
        Mean amplitudes, with nothing subtracted.
    templates : `FringeTemplates`
        The model.
    thickness_um : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
        Thickness of the cells to within a fraction of an order [µm]; NaN where there is none.
    free : `Nuisances`
        What is free.
    start : `NuisanceFit`
        Where to begin.
    threads : `int`, optional
        Number of threads; has no influence on the result.

    Returns
    -------
    thickness_um : `numpy.ndarray`, float32, shape ``(ncy, ncx)``
    fit : `NuisanceFit`
    """
    pattern = _patterns(cells, free)
    offset, contrast = start.offset.astype(float), start.contrast.copy()
    thickness = thickness_um
    for _ in range(_ROUNDS):
        now = NuisanceFit(offset.astype(np.float32), contrast)
        fitted = templates.with_contrast(contrast)
        rest = subtract_offset(cells, now)
        thickness = refine_cells(rest, fitted, thickness, threads)
        added, factor = _one_round(rest, fitted, thickness, pattern, free)
        change = np.abs(factor - 1.0).max()
        contrast = contrast * factor
        if pattern.shape[-1]:
            step = np.moveaxis(pattern @ added.T, -1, 0)
            offset = offset + step * (1.0 + offset)
            change = max(change, float(np.abs(step).max()))
        if change < _TOLERANCE:
            break
    final = NuisanceFit(offset.astype(np.float32), contrast)
    thickness = refine_cells(
        subtract_offset(cells, final), templates.with_contrast(contrast), thickness, threads
    )
    return thickness, final


def subtract_offset(cells: Cells, fit: NuisanceFit) -> Cells:
    """Cells under even light."""
    return _under_light(cells, 1.0 / (1.0 + fit.offset))


def add_offset(cells: Cells, fit: NuisanceFit) -> Cells:
    """Cells under the light that was taken from them."""
    return _under_light(cells, 1.0 + fit.offset)


def _under_light(cells: Cells, light: NDArray[np.float32]) -> Cells:
    """Cells whose counts are multiplied by a light of shape ``(n_wavelengths, ncy, ncx)``."""
    if light.size == 0:
        return cells
    value = cells.value.copy()
    seen = value[..., : len(light)]
    seen += (1.0 + seen) * (np.moveaxis(light, 0, -1) - np.float32(1))
    return replace(cells, value=value)


def _patterns(cells: Cells, free: Nuisances) -> FloatArray:
    """Known patterns at the centres of the cells, shape ``(ncy, ncx, n_patterns)``."""
    ny, nx = int(cells.y_edges[-1]), int(cells.x_edges[-1])
    columns = []
    if free.patterned:
        # The mean of a flat is that of light times fringe: where the light is free, so is the level.
        rows_at, columns_at = free.breaks(ny, nx)
        zone_y = np.searchsorted(rows_at, cells.y_edges[:-1], side="right")
        zone_x = np.searchsorted(columns_at, cells.x_edges[:-1], side="right")
        for a in range(len(rows_at) + 1):
            for b in range(len(columns_at) + 1):
                columns.append(np.outer(zone_y == a, zone_x == b).astype(float))
    if free.illumination_degree:
        y = 2.0 * cells.y_centre / max(ny - 1, 1) - 1.0
        x = 2.0 * cells.x_centre / max(nx - 1, 1) - 1.0
        along = np.polynomial.legendre.legvander(y, free.illumination_degree)
        across = np.polynomial.legendre.legvander(x, free.illumination_degree)
        for total in range(1, free.illumination_degree + 1):
            for k in range(total + 1):
                columns.append(np.outer(along[:, k], across[:, total - k]))
    return np.stack(columns, axis=-1) if columns else np.zeros((*cells.shape, 0))


def _one_round(
    cells: Cells,
    templates: FringeTemplates,
    thickness_um: NDArray[np.float32],
    pattern: FloatArray,
    free: Nuisances,
) -> tuple[FloatArray, FloatArray]:
    """Change of the coefficients ``(n_wavelengths, n_patterns)`` and factor on the contrast."""
    wavelengths, count = templates.n_wavelengths, pattern.shape[-1]
    good = np.flatnonzero(np.isfinite(thickness_um))
    good = good[:: max(1, good.size // _MOST_CELLS)]
    weight = cells.weight.reshape(-1, cells.weight.shape[-1])[good, :wavelengths].astype(float)
    value = cells.value.reshape(-1, cells.value.shape[-1])[good, :wavelengths].astype(float)
    thickness = thickness_um.ravel()[good].astype(float)
    model = templates.amplitude_at(thickness).T
    margin = 2.0 * templates.step_um
    inside = np.clip(thickness, templates.start_um + margin, templates.stop_um - margin)
    slope = (
        (templates.amplitude_at(inside + margin) - templates.amplitude_at(inside - margin)) / (2 * margin)
    ).T
    rest = value - model
    sound = _sound(rest, weight)
    weight, slope, rest, model = weight[sound], slope[sound], rest[sound], model[sound]
    known = pattern.reshape(thickness_um.size, count)[good][sound]
    information = np.maximum((weight * slope**2).sum(axis=1), 1e-30)
    lean = weight * slope / np.sqrt(information)[:, None]
    weighted = weight * rest - lean * (lean * rest).sum(axis=1)[:, None]
    extra = 0 if free.contrast == "fixed" else 1
    size = count + extra
    design = [
        np.concatenate([known, model[:, [band]]], axis=1) if extra else known for band in range(wavelengths)
    ]
    normal = np.zeros((wavelengths, size, wavelengths, size))
    right = np.zeros((wavelengths, size))
    for a in range(wavelengths):
        right[a] = design[a].T @ weighted[:, a]
        for b in range(a, wavelengths):
            share = -lean[:, a] * lean[:, b] + (weight[:, a] if a == b else 0.0)
            normal[a, :, b] = design[a].T @ (share[:, None] * design[b])
            normal[b, :, a] = normal[a, :, b].T
    matrix, vector = normal.reshape(wavelengths * size, -1), right.ravel()
    spread = np.eye(wavelengths * size)
    if free.contrast == "common":
        keep = [k for k in range(wavelengths * size) if k % size != count]
        shared = (np.arange(wavelengths * size) % size == count).astype(float)
        spread = np.concatenate([spread[:, keep], shared[:, None]], axis=1)
    solved = spread @ np.linalg.lstsq(spread.T @ matrix @ spread, spread.T @ vector, rcond=1e-12)[0]
    table = solved.reshape(wavelengths, size)
    factor = np.clip(1.0 + table[:, count], 0.3, 3.0) if extra else np.ones(wavelengths)
    return table[:, :count], factor


def _sound(rest: FloatArray, weight: FloatArray) -> NDArray[np.bool_]:
    """Cells that fit no worse than most."""
    misfit = (weight * rest**2).sum(axis=1)
    return misfit <= 9.0 * np.median(misfit)
