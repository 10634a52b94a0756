"""The data of a search: flats averaged over square cells, each over its own mean."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, FloatArray
from ...blocks import block_sums, in_blocks
from ...effects import ImageGeometry
from ...errors import InputError
from ...products.fringe_cube import FringeCube
from ...products.mask import mask_bits
from ..flat_prep_options import GAUSSIAN_MAD

LEAST_FILLED = 0.75  # Smallest part of good pixels with which a cell is used
UNSTATED_UM = 0.01  # Error of a thickness map that states none [µm]

BAD_PLANES = mask_bits("BAD", "SAT", "INTRP", "CR", "EDGE", "SUSPECT", "NO_DATA")

FEWEST_TO_HOLD_OUT = 12  # Rows and columns of cells from which on a part of them is held out


@dataclass(frozen=True, eq=False)
class CellData:
    """Fringe amplitudes on a grid of cells."""

    # (W, ny, nx): mean counts of a cell over the mean of its plane, or the relative counts of a relative
    # cube; 1 where there are no data
    value: FloatArray
    weight: FloatArray  # (W, ny, nx): inverse variance; 0 where there are no data
    geometry: ImageGeometry  # centres of the cells, wavelengths, levels
    cell_px: int  # side of a cell [px]
    # Rms of the response of the cells, common to all wavelengths (pixel response non-uniformity)
    response_scatter: float = 0.0
    # thickness_um, thickness_sigma_um (ny, nx): known thickness and its uncertainty
    thickness_um: FloatArray | None = None
    thickness_sigma_um: FloatArray | None = None
    # (2, W, ny, nx): where the good pixels of a cell have their mean, along rows and columns, from its
    # centre [cells]
    centroid: FloatArray | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Wavelengths, rows and columns of cells."""
        return (self.value.shape[0], self.value.shape[1], self.value.shape[2])

    @property
    def wavelength_nm(self) -> FloatArray:
        """Wavelength of each plane [nm]."""
        return self.geometry.wavelength_nm

    @property
    def seen(self) -> BoolArray:
        """Cells with data at some wavelength, shape ``(ny, nx)``."""
        return np.asarray((self.weight > 0).any(axis=0))

    @property
    def noise_rms(self) -> float:
        """Rms of the noise of the cells, response scatter included; NaN if no cell has data."""
        used = self.weight > 0
        if not used.any():
            return math.nan
        return float(np.sqrt((1.0 / self.weight[used]).mean() + self.response_scatter**2))

    def restricted(self, keep: BoolArray) -> CellData:
        """Same data with weight 0 where ``keep`` (broadcast to the values) is false."""
        return replace(self, weight=np.where(keep, self.weight, 0.0))

    def window(self, rows: slice, columns: slice) -> CellData:
        """The data of a part of the sensor; levels and positions stay those of the whole."""
        parts = {
            name: values[..., rows, columns]
            for name in ("value", "weight", "thickness_um", "thickness_sigma_um", "centroid")
            if (values := getattr(self, name)) is not None
        }
        geometry = replace(self.geometry, y_px=self.geometry.y_px[rows], x_px=self.geometry.x_px[columns])
        return replace(self, geometry=geometry, **parts)

    def with_noise_of(self, expected: FloatArray) -> CellData:
        """Same data with the variance that goes with what is expected of a cell, not with what it happened to get.

        A variance taken from the counts themselves gives cells that got too few the larger weight, and draws every
        fit towards them. How far the variance follows the counts is measured, wavelength by wavelength; whatever
        else it depends on stays.

        ``expected`` (W, ny, nx).
        """
        used = self.weight > 0.0
        variance = np.divide(1.0, self.weight, out=np.zeros(self.shape), where=used)
        miss = np.where(used, self.value - expected, 0.0)
        for plane in range(self.shape[0]):
            inside = used[plane]
            own = miss[plane][inside] - miss[plane][inside].mean()
            square = float((own**2).sum())
            if square == 0.0:
                continue
            rate = float((own * variance[plane][inside]).sum()) / square
            level = variance[plane][inside]
            variance[plane][inside] = np.clip(level - rate * miss[plane][inside], 0.5 * level, 2.0 * level)
        return replace(self, weight=np.divide(1.0, variance, out=np.zeros(self.shape), where=used))

    def scaled_noise(self, factor: FloatArray | float, response_scatter: float) -> CellData:
        """Same data with the noise (standard deviation) of each wavelength times a factor."""
        square = np.broadcast_to(np.asarray(factor, dtype=float) ** 2, self.shape[:1])
        return replace(self, weight=self.weight / square[:, None, None], response_scatter=response_scatter)


def spectral_order(cube: FringeCube) -> NDArray[np.int64]:
    """Positions of the planes in the order of wavelength."""
    order: NDArray[np.int64] = np.argsort(cube.wavelength_nm, kind="stable")
    return order


def bin_cube(
    cube: FringeCube,
    cell_px: int,
    *,
    level_e: Mapping[int, float] | None = None,
    y_edges: tuple[int, ...] = (),
    x_edges: tuple[int, ...] = (),
) -> CellData:
    """Average a cube over cells.

    ``cell_px``: side of a cell [px]; rows and columns that fill no cell are left out. ``level_e``: mean level
    of single planes, where the cube does not know it. ``y_edges``, ``x_edges``: borders of the amplifiers [px].
    """
    rows, columns = cube.shape[1] // cell_px, cube.shape[2] // cell_px
    if rows == 0 or columns == 0:
        raise InputError("cell size [px]", cell_px, f"at most {min(cube.shape[1:])}")
    shape = (cube.shape[0], rows, columns)
    value, weight = np.ones(shape), np.zeros(shape)
    centroid = np.zeros((2, *shape))
    level = np.array(cube.exposures.level_e, dtype=float)
    for plane, source in enumerate(spectral_order(cube)):
        pixels, good, mean = _pixels_of(cube, int(source))
        sums = pixels.summed(cell_px)
        value[plane], weight[plane] = sums.cells(mean, cell_px)
        centroid[:, plane] = _centroid(good, sums.number, cell_px)
        if cube.unit == "electron":
            level[source] = mean
    if level_e:
        for plane_number, number in level_e.items():
            level[plane_number] = number
    order = spectral_order(cube)
    geometry = ImageGeometry(
        cube.shape[1:],
        cell_px * np.arange(rows, dtype=np.float64) + 0.5 * (cell_px - 1),
        cell_px * np.arange(columns, dtype=np.float64) + 0.5 * (cell_px - 1),
        np.asarray(cube.wavelength_nm, dtype=float)[order],
        level[order],
        y_edges,
        x_edges,
        np.asarray(cube.exposures.dark_time_s, dtype=float)[order],
    )
    known = sigma = None
    if cube.thickness is not None:
        known = block_sums(np.asarray(cube.thickness, dtype=float), cell_px) / cell_px**2
        weight = np.where(np.isfinite(known), weight, 0.0)
        if cube.thickness_sigma is not None:
            sigma = block_sums(np.asarray(cube.thickness_sigma, dtype=float), cell_px) / cell_px**2
    moved = centroid if centroid.any() else None
    return CellData(value, weight, geometry, cell_px, 0.0, known, sigma, moved)


def _centroid(good: BoolArray, count: FloatArray, cell_px: int) -> FloatArray:
    """Mean place of the good pixels of each cell from its centre, ``(2, ny, nx)`` [cells]."""
    result = np.zeros((2, *count.shape))
    partial = (count > 0) & (count < cell_px**2)
    if not partial.any():
        return result
    within = (np.arange(cell_px) + 0.5) / cell_px - 0.5
    blocks = in_blocks(good, cell_px)
    for axis, sums in enumerate((blocks.sum(axis=3, dtype=float), blocks.sum(axis=1, dtype=float))):
        first = np.einsum("ypx,p->yx" if axis == 0 else "yxp,p->yx", sums, within)
        np.divide(first, count, out=result[axis], where=partial)
    return result


KEPT_PATTERN = 0.88
"""Part of the pattern's variance that cells must keep: a quarter of a fringe in a cell, which the model follows."""

FEWEST_CELLS = 400  # Cells that coarser ones must leave


def finest_useful_cell(cube: FringeCube, *, most_cells: int, largest: int = 64) -> int:
    """Side of the largest cell that does not blur the pattern, or of the smallest that keeps ``most_cells``.

    The variance of an image falls with the cell size by its noise; what it falls beyond that is pattern. A size
    is taken while the part `KEPT_PATTERN` of the pattern's variance is left at every wavelength.

    ``most_cells``: number of cells wanted at most; pattern is not sacrificed for it. ``largest``: largest side
    [px].
    """
    sizes = [1]
    while not _is_coarse(
        (cube.shape[1] // sizes[-1], cube.shape[2] // sizes[-1]), sizes[-1], most_cells, largest
    ):
        sizes.append(2 * sizes[-1])
    signal, error = np.zeros((2, len(sizes), cube.shape[0]))
    filled = np.zeros(len(sizes))
    for plane, source in enumerate(spectral_order(cube)):
        sums, _, mean = _pixels_of(cube, int(source))
        for step, size in enumerate(sizes):
            if step:
                sums = sums.summed(2)
            value, weight = sums.cells(mean, size)
            signal[step, plane], error[step, plane] = _pattern_variance(value, weight)
            if plane == 0:
                filled[step] = np.count_nonzero(weight)
    for step, size in enumerate(sizes[1:], start=1):
        blurred = np.any(signal[step] + 3.0 * error[step] < KEPT_PATTERN * signal[0])
        if blurred or filled[step] < FEWEST_CELLS:
            return size // 2
    return sizes[-1]


def _is_coarse(shape: tuple[int, int], size: int, most_cells: int, largest: int) -> bool:
    """Whether cells of twice the size are out of the question."""
    return shape[0] * shape[1] <= most_cells // 4 or size >= largest or min(shape) < 32


def _pattern_variance(value: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Variance of the amplitudes minus that of the noise, which second differences show, and its error."""
    good = weight > 0
    number = int(good.sum())
    if number < 2:
        return 0.0, 0.0
    near = good[2:] & good[1:-1] & good[:-2]
    near = near[:, 2:] & near[:, 1:-1] & near[:, :-2]
    if near.any():
        rows = value[2:] - 2.0 * value[1:-1] + value[:-2]
        both = (rows[:, 2:] - 2.0 * rows[:, 1:-1] + rows[:, :-2]) / 6.0
        noise = (GAUSSIAN_MAD * float(np.median(np.abs(both[near])))) ** 2
    else:
        noise = float(np.median(1.0 / weight[good]))
    return max(float(value[good].var()) - noise, 0.0), noise * math.sqrt(2.0 / number)


class _Sums(NamedTuple):
    """Good pixels, their sum and that of their variances, in every cell of one plane."""

    number: FloatArray
    total: FloatArray
    spread: FloatArray

    def summed(self, size: int) -> _Sums:
        """Sums over blocks of cells."""
        return _Sums(*(block_sums(part, size) for part in self))

    def cells(self, mean: float, cell_px: int) -> tuple[FloatArray, FloatArray]:
        """Values over the mean of the plane, 1 where there are too few pixels, and their weights."""
        value, weight = np.ones(self.number.shape), np.zeros(self.number.shape)
        used = self.number >= max(1.0, LEAST_FILLED * cell_px**2)
        np.divide(self.total, self.number * mean, out=value, where=used)
        floor = 1e-14 * mean**2 * self.number  # noiseless data are fitted as if they were good to 1e-7
        np.divide((self.number * mean) ** 2, np.maximum(self.spread, floor), out=weight, where=used)
        return value, weight


def _pixels_of(cube: FringeCube, source: int) -> tuple[_Sums, BoolArray, float]:
    """Pixels of one plane as cells, which of them are good, and their mean."""
    image = np.array(cube.image[source], dtype=np.float64)
    variance = np.array(cube.variance[source], dtype=np.float64)
    good = (np.asarray(cube.mask[source]) & BAD_PLANES) == 0
    good &= np.isfinite(image) & np.isfinite(variance)
    if not good.any():
        raise InputError(f"good pixels at {cube.wavelength_nm[source]:g} nm", 0, "one or more")
    # A relative plane is over the mean of its whole sensor, of which there may be only a few pixels here.
    mean = float(image[good].mean()) if cube.unit == "electron" else 1.0
    if not mean > 0.0:
        raise InputError(f"mean level at {cube.wavelength_nm[source]:g} nm", mean, "above 0")
    image[~good], variance[~good] = 0.0, 0.0
    return _Sums(good.astype(np.float64), image, variance), good, mean
