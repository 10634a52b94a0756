"""Thickness where an effect is in a part of the sensor only, such as a void in the adhesive."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ...array_types import BoolArray, FloatArray
from ...effects import ImageGeometry
from ...model import FringeModel, ResponseTable
from ...products import FringeCube, ThicknessMap, mask_bits
from ..parabola import parabolic_minimum
from .rescue import chi2_limits

WIDE = 1.6  # Fringe orders on both sides in which pixels are looked for at first; strong voids break the first fit

NEIGHBOURS = 3  # Rows and columns on both sides of a pixel whose median is where it is looked for

STEPS_PER_ORDER = 60
"""Thicknesses in a fringe order at which pixels are compared; a parabola through three of them does the rest."""

RING_PX = 12  # Pixels around an island that tell the thickness with which it begins
SAMPLED = 20_000  # Pixels outside that tell the levels of the flats
_PIXELS = 2048  # Pixels that are compared at a time


def fit_islands(fitted: ThicknessMap, cube: FringeCube, model: FringeModel) -> ThicknessMap:
    """Fit the pixels on islands again, with the optics that they have.

    The first fit takes all pixels to be like the rest of the sensor. On an island its fringes are shifted, by nearly
    as much everywhere: the thickness is moved by what best joins it to the ring around the island, and every pixel
    then looked for near the middle of its neighbours, within a few fringe orders and again within half of one. Pixels
    of the rim see both optics.

    Returns the same map where no effect is local.
    """
    geometry = ImageGeometry.of_pixels((fitted.value.shape[0], fitted.value.shape[1]), cube.wavelength_nm)
    for item, inside in model.islands:
        part = item.coverage(model.base_system, geometry)
        usable = (part > 0.0) & np.isfinite(fitted.value) & (cube.mask == 0).any(axis=0)
        if usable.any():
            fitted = _fit_island(fitted, cube, model, inside, part, usable)
    return fitted


def _fit_island(
    fitted: ThicknessMap,
    cube: FringeCube,
    outside: FringeModel,
    inside: FringeModel,
    part: FloatArray,
    usable: BoolArray,
) -> ThicknessMap:
    order = float(np.mean(outside.fringe_order_um(cube.wavelength_nm)))
    first = np.where(usable | (part == 0.0), fitted.value, np.nan).astype(float)
    first[part > 0.5] += _joining_shift(fitted, outside, inside, cube.wavelength_nm, part, usable, order)
    span = max(float(np.nanmin(first)) - WIDE * order, 0.0), float(np.nanmax(first)) + WIDE * order
    tables = [model.table(span, cube.wavelength_nm) for model in (outside, inside)]
    pixels = _Pixels(cube, tables, _levels(fitted, cube, outside, part), part, *np.nonzero(usable))
    wide = pixels.search(_middle_of_neighbours(first, usable), WIDE * order, order)
    first[usable] = wide.value
    found = pixels.search(_middle_of_neighbours(first, usable), 0.5 * order, order)
    value, sigma, chi2 = (np.array(array) for array in (fitted.value, fitted.sigma, fitted.chi2))
    mask = np.array(fitted.mask)
    value[usable], sigma[usable], chi2[usable] = found.value, found.sigma, found.chi2
    limits = float(fitted.metadata.get("MISFIT", 1.0)) * chi2_limits(len(cube.wavelength_nm))
    suspect, cleared = mask_bits("SUSPECT"), ~mask_bits("SUSPECT")
    mask[usable] = np.where(found.chi2 > limits[found.used], mask[usable] | suspect, mask[usable] & cleared)
    return replace(fitted, value=value, sigma=sigma, chi2=chi2, mask=mask)


@dataclass(frozen=True, eq=False)
class _Found:
    """Thickness of some pixels [µm], its uncertainty, reduced χ², and wavelengths used."""

    value: FloatArray
    sigma: FloatArray
    chi2: FloatArray
    used: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Pixels on an island, with the tables of the optics off and on it."""

    cube: FringeCube
    tables: list[ResponseTable]
    levels: FloatArray
    part: FloatArray
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    def search(self, start: FloatArray, reach_um: float, order_um: float) -> _Found:
        """The best thickness of every pixel within some reach of a first one."""
        number = math.ceil(reach_um / order_um * STEPS_PER_ORDER)
        step = reach_um / number
        shifts = step * np.arange(-number, number + 1)
        low = self.tables[0].start_um
        value, sigma, chi2 = (np.empty(start.size) for _ in range(3))
        used = np.empty(start.size, np.int64)
        for begin in range(0, start.size, _PIXELS):
            own = slice(begin, begin + _PIXELS)
            y, x = self.rows[own], self.columns[own]
            off, on = (table.lookup(np.maximum(start[own] + shifts[:, None], low)) for table in self.tables)
            signal = self.levels[:, None, None] * (off + self.part[y, x] * (on - off))
            good = self.cube.mask[:, y, x] == 0
            weight = np.where(good, 1.0 / np.asarray(self.cube.variance[:, y, x], float), 0.0)
            data = np.where(good, np.asarray(self.cube.image[:, y, x], float), 0.0)
            curve = (weight[:, None] * (data[:, None] - signal) ** 2).sum(axis=0)
            minimum = parabolic_minimum(curve)
            used[own] = good.sum(axis=0)
            value[own] = start[own] + (minimum.place - number) * step
            sigma[own] = step * np.sqrt(2.0 / np.maximum(minimum.bend, 1e-30))
            chi2[own] = minimum.value / np.maximum(used[own] - 1, 1)
        return _Found(value, sigma, chi2, used)


def _middle_of_neighbours(thickness_um: FloatArray, usable: BoolArray) -> FloatArray:
    """Median of the pixels about each usable one [µm]; pixels without a number do not count."""
    reach = np.arange(-NEIGHBOURS, NEIGHBOURS + 1)
    rows, columns = np.nonzero(usable)
    padded = np.pad(thickness_um, NEIGHBOURS, constant_values=np.nan)
    middle = np.empty(rows.size)
    for begin in range(0, rows.size, _PIXELS):
        own = slice(begin, begin + _PIXELS)
        y, x = (place[own, None, None] + NEIGHBOURS for place in (rows, columns))
        middle[own] = np.nanmedian(padded[y + reach[:, None], x + reach], axis=(1, 2))
    return middle


def _joining_shift(
    fitted: ThicknessMap,
    outside: FringeModel,
    inside: FringeModel,
    wavelength_nm: FloatArray,
    part: FloatArray,
    usable: BoolArray,
    order: float,
) -> float:
    """Shift of the thickness on the island: what the phases of both optics differ by, and whole orders [µm]."""
    middle = float(np.median(fitted.value[usable]))
    grid = middle + np.arange(STEPS_PER_ORDER) * (order / STEPS_PER_ORDER)
    shifts = np.linspace(-0.5, 0.5, STEPS_PER_ORDER + 1) * order
    one = outside.response(grid, wavelength_nm)[:, np.newaxis]
    other = inside.response(grid + shifts[:, np.newaxis], wavelength_nm)
    one, other = (light - light.mean(axis=-1, keepdims=True) for light in (one, other))
    shift = float(shifts[int(np.argmax((one * other).sum(axis=(0, 2))))])
    ring = binary_dilation(part > 0.0, iterations=RING_PX) & (part == 0.0) & (fitted.mask == 0)
    rim = binary_dilation(part < 1.0, iterations=RING_PX) & (part == 1.0) & usable
    if not ring.any() or not rim.any():
        return shift
    jump = float(np.median(fitted.value[ring])) - float(np.median(fitted.value[rim])) - shift
    return shift + order * round(jump / order)


def _levels(fitted: ThicknessMap, cube: FringeCube, model: FringeModel, part: FloatArray) -> FloatArray:
    """Counts over response at each wavelength, from pixels outside."""
    good = np.flatnonzero(((fitted.mask == 0) & (part == 0.0)).ravel())
    good = good[:: max(1, good.size // SAMPLED)]
    response = model.response(fitted.value.ravel()[good], cube.wavelength_nm)
    levels = np.empty(len(response))
    for plane, light in enumerate(response):
        own = cube.mask[plane].ravel()[good] == 0
        counts = np.asarray(cube.image[plane].ravel()[good][own], float)
        levels[plane] = counts.sum() / max(light[own].sum(), 1e-300)
    return levels
