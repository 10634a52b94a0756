"""The data of a search: flats averaged over square cells, each over its own mean."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...effects import ImageGeometry
from ...errors import InputError
from ...products.fringe_cube import FringeCube
from ...products.mask import mask_bits

__all__ = ["CellData", "bin_cube", "finest_useful_cell", "spectral_order"]

FloatArray = NDArray[np.float64]

LEAST_FILLED = 0.75
"""Smallest part of good pixels with which a cell is used."""

BAD_PLANES = mask_bits("BAD", "SAT", "INTRP", "CR", "EDGE", "SUSPECT", "NO_DATA")


@dataclass(frozen=True, eq=False)
class CellData:
    """Fringe amplitudes on a grid of cells.

    Attributes
    ----------
    value : `numpy.ndarray`, shape ``(W, ny, nx)``
        Mean counts of a cell over the mean of its plane, or the relative counts of a relative cube; 1 where there are
        no data.
    weight : `numpy.ndarray`, shape ``(W, ny, nx)``
        Inverse variance; 0 where there are no data.
    geometry : `ImageGeometry`
        Centres of the cells, wavelengths, levels.
    cell_px : `int`
        Side of a cell [px].
    response_scatter : `float`
        Rms of the response of the cells, common to all wavelengths (pixel response non-uniformity).
    thickness_um, thickness_sigma_um : `numpy.ndarray`, shape ``(ny, nx)``, optional
        Known thickness and its uncertainty [µm].
    centroid : `numpy.ndarray`, shape ``(2, W, ny, nx)``, optional
        Where the good pixels of a cell have their mean, along rows and columns, from its centre [cells].
    """

    value: FloatArray
    weight: FloatArray
    geometry: ImageGeometry
    cell_px: int
    response_scatter: float = 0.0
    thickness_um: FloatArray | None = None
    thickness_sigma_um: FloatArray | None = None
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
    def n_values(self) -> int:
        """Number of measured values."""
        return int(np.count_nonzero(self.weight))

    @property
    def noise_rms(self) -> float:
        """Rms of the noise of the cells, response scatter included; NaN if no cell has data."""
        used = self.weight > 0
        if not used.any():
            return math.nan
        return float(np.sqrt((1.0 / self.weight[used]).mean() + self.response_scatter**2))

    def restricted(self, keep: NDArray[np.bool_]) -> CellData:
        """Same data with weight 0 where ``keep`` (broadcast to the values) is false."""
        return replace(self, weight=np.where(keep, self.weight, 0.0))

    def with_noise_of(self, expected: FloatArray) -> CellData:
        """Same data with the variance that goes with what is expected of a cell, not with what it happened to get.

        A variance taken from the counts themselves gives cells that got too few the larger weight, and draws every
        fit towards them. How far the variance follows the counts is measured, wavelength by wavelength; whatever
        else it depends on stays.

        Parameters
        ----------
        expected : `numpy.ndarray`, shape ``(W, ny, nx)``
            Values of the cells by a fit.
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

    Parameters
    ----------
    cube : `FringeCube`
        The flats.
    cell_px : `int`
        Side of a cell [px]; rows and columns that fill no cell are left out.
    level_e : mapping, optional
        Mean level of single planes [electrons], where the cube does not know it.
    y_edges, x_edges : `tuple` [`int`, ...], optional
        Borders of the amplifiers [px].

    Raises
    ------
    InputError
        A plane without a good pixel, or with a mean that is not positive.
    """
    rows, columns = cube.shape[1] // cell_px, cube.shape[2] // cell_px
    if rows == 0 or columns == 0:
        raise InputError("cell size [px]", cell_px, f"at most {min(cube.shape[1:])}")
    shape = (cube.shape[0], rows, columns)
    value, weight = np.ones(shape), np.zeros(shape)
    centroid = np.zeros((2, *shape))
    level = np.array(cube.exposures.level_e, dtype=float)
    for plane, source in enumerate(spectral_order(cube)):
        image = np.asarray(cube.image[source], dtype=np.float64)
        variance = np.asarray(cube.variance[source], dtype=np.float64)
        good = (np.asarray(cube.mask[source]) & BAD_PLANES) == 0
        good &= np.isfinite(image) & np.isfinite(variance)
        if not good.any():
            raise InputError(f"good pixels at {cube.wavelength_nm[source]:g} nm", 0, "one or more")
        # A relative plane is over the mean of its whole sensor, of which there may be only a few pixels here.
        mean = float(image[good].mean()) if cube.unit == "electron" else 1.0
        if not mean > 0.0:
            raise InputError(f"mean level at {cube.wavelength_nm[source]:g} nm", mean, "above 0")
        count = _block_sum(good.astype(np.float64), cell_px)
        total = _block_sum(np.where(good, image, 0.0), cell_px)
        spread = _block_sum(np.where(good, variance, 0.0), cell_px)
        used = count >= max(1.0, LEAST_FILLED * cell_px**2)
        np.divide(total, count * mean, out=value[plane], where=used)
        centroid[:, plane] = _centroid(good, count, used, cell_px)
        floor = 1e-14 * mean**2 * count  # noiseless data are fitted as if they were good to 1e-7
        np.divide((count * mean) ** 2, np.maximum(spread, floor), out=weight[plane], where=used)
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
    )
    known = sigma = None
    if cube.thickness is not None:
        known = _block_mean(np.asarray(cube.thickness, dtype=float), cell_px)
        weight = np.where(np.isfinite(known), weight, 0.0)
        if cube.thickness_sigma is not None:
            sigma = _block_mean(np.asarray(cube.thickness_sigma, dtype=float), cell_px)
    moved = centroid if centroid.any() else None
    return CellData(value, weight, geometry, cell_px, 0.0, known, sigma, moved)


def _centroid(
    good: NDArray[np.bool_], count: FloatArray, used: NDArray[np.bool_], cell_px: int
) -> FloatArray:
    """Mean place of the good pixels of each cell from its centre, ``(2, ny, nx)`` [cells]."""
    result = np.zeros((2, *count.shape))
    partial = used & (count < cell_px**2)
    if not partial.any():
        return result
    within = (np.arange(cell_px) + 0.5) / cell_px - 0.5
    rows, columns = count.shape
    blocks = good[: rows * cell_px, : columns * cell_px].reshape(rows, cell_px, columns, cell_px)
    for axis, sums in enumerate((blocks.sum(axis=3, dtype=float), blocks.sum(axis=1, dtype=float))):
        first = np.einsum("ypx,p->yx" if axis == 0 else "yxp,p->yx", sums, within)
        np.divide(first, count, out=result[axis], where=partial)
    return result


KEPT_PATTERN = 0.88
"""Part of the pattern's variance that cells must keep: a quarter of a fringe in a cell, which the model follows."""


def finest_useful_cell(cube: FringeCube, *, most_cells: int, largest: int = 64) -> int:
    """Side of the largest cell that does not blur the pattern, or of the smallest that keeps ``most_cells``.

    The variance of an image falls with the cell size by its noise; what it falls beyond that is pattern. A size
    is taken while the part `KEPT_PATTERN` of the pattern's variance is left at every wavelength.

    Parameters
    ----------
    cube : `FringeCube`
        The flats.
    most_cells : `int`
        Number of cells wanted at most; pattern is not sacrificed for it.
    largest : `int`, optional
        Largest side [px].
    """
    size = 1
    reference: FloatArray | None = None
    while True:
        cells = bin_cube(cube, size)
        signal, error = _pattern_variance(cells)
        reference = signal if reference is None else reference
        enough = np.count_nonzero(cells.weight[0]) if size > 1 else np.inf
        blurred = bool(np.any(signal + 3.0 * error < KEPT_PATTERN * reference))
        if size > 1 and (blurred or enough < 400):
            return size // 2
        few = cells.shape[1] * cells.shape[2] <= most_cells // 4
        if few or size >= largest or min(cells.shape[1:]) < 32:
            return size
        size *= 2


def _pattern_variance(cells: CellData) -> tuple[FloatArray, FloatArray]:
    """Variance of the amplitudes minus that of the noise, which second differences show, and its error."""
    waves = cells.shape[0]
    result, error = np.zeros(waves), np.zeros(waves)
    for plane in range(waves):
        good = cells.weight[plane] > 0
        if good.sum() < 2:
            continue
        value = cells.value[plane]
        near = good[2:, 2:] & good[2:, 1:-1] & good[2:, :-2] & good[1:-1, 2:] & good[1:-1, 1:-1]
        near &= good[1:-1, :-2] & good[:-2, 2:] & good[:-2, 1:-1] & good[:-2, :-2]
        if near.any():
            rows = value[2:] - 2.0 * value[1:-1] + value[:-2]
            both = (rows[:, 2:] - 2.0 * rows[:, 1:-1] + rows[:, :-2]) / 6.0
            noise = (1.4826 * float(np.median(np.abs(both[near])))) ** 2
        else:
            noise = float(np.median(1.0 / cells.weight[plane][good]))
        result[plane] = max(float(value[good].var()) - noise, 0.0)
        error[plane] = noise * np.sqrt(2.0 / good.sum())
    return result, error


def _block_sum(image: FloatArray, size: int) -> FloatArray:
    rows, columns = image.shape[0] // size, image.shape[1] // size
    if size == 1:
        return image
    trimmed = image[: rows * size, : columns * size]
    total: FloatArray = trimmed.reshape(rows, size, columns, size).sum(axis=(1, 3))
    return total


def _block_mean(image: FloatArray, size: int) -> FloatArray:
    return _block_sum(image, size) / size**2
