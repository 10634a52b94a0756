"""Discs of a sensor in which a model leaves most, something promises most, or the thickness is another one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from .base import FloatArray, Residuals
from .geometry import ImageGeometry

SMALLEST_RADIUS, LARGEST_PART, RADIUS_RATIO = 2.0, 0.35, 1.2
"""Radii that are tried: the smallest [cells], the largest over the shorter side, and one over the one before."""

FINE_RATIO = 1.05  # The last of these where nothing but the power tells the radius
LEAST_SEEN = 0.3  # Part of a disc that must lie on cells with data

MOST_EXCESS = 4.0
"""Excess over the noise that counts in one sample: it matters where something is left, not how much."""

SMALLEST_STEP = 2.8  # Radius of the smallest disc of which no smooth thickness takes up all [cells]

CHANCE = 1e-3
"""Chance that noise has a step of the thickness somewhere, below which there is one; as that of the critics."""

QUIET_QUARTER = 0.3186  # Quarter of the absolute values of a Gaussian of unit width lies below

Disc = tuple[float, float, float, float]
"""Fall of χ² that a disc promises, its row, column and radius [cells]."""


@dataclass(frozen=True, eq=False)
class Discs:
    """Discs of all radii about every cell."""

    shape: tuple[int, int]  # rows and columns of cells
    padded: tuple[int, int]  # the same with room for the largest disc
    radii: list[float]  # radii [cells]
    transforms: list[NDArray[np.complex128]]  # Fourier transform of a disc of each radius
    usable: list[NDArray[np.bool_]]  # cells about which enough of a disc of each radius has data

    @classmethod
    def of(cls, seen: NDArray[np.bool_], ratio: float = RADIUS_RATIO) -> Discs:
        """Discs about the cells with and without data; ``ratio``: of a radius over the one before."""
        shape = (seen.shape[0], seen.shape[1])
        largest = LARGEST_PART * min(shape)
        number = math.floor(math.log(largest / SMALLEST_RADIUS) / math.log(ratio)) + 1
        radii = [SMALLEST_RADIUS * ratio**step for step in range(number)]
        rows, columns = (next_fast_len(side + math.ceil(largest), real=True) for side in shape)
        away = _distance((rows, columns))
        transforms = [rfft2((away <= radius).astype(float)) for radius in radii]
        discs = cls(shape, (rows, columns), radii, transforms, [])
        parts = discs.sums(seen.astype(float))
        discs.usable.extend(
            part > LEAST_SEEN * math.pi * radius**2 for part, radius in zip(parts, radii, strict=True)
        )
        return discs

    def sums(self, values: FloatArray) -> Iterator[FloatArray]:
        """Sums over the discs of every radius."""
        transform = rfft2(values, self.padded)
        for disc in self.transforms:
            yield irfft2(transform * disc, self.padded)[: self.shape[0], : self.shape[1]]


def _better(best: Disc, fall: FloatArray, radius: float) -> Disc:
    """The better of a disc and the best one of a radius about any cell."""
    row, column = np.unravel_index(int(np.argmax(fall)), fall.shape)
    found = float(fall[row, column])
    return (found, float(row), float(column), radius) if found > best[0] else best


def _distance(padded: tuple[int, int]) -> FloatArray:
    """Distance of cells from the first one, around both edges [cells]."""
    away = (np.minimum(np.arange(side), side - np.arange(side)) for side in padded)
    return np.asarray(np.hypot(*np.meshgrid(*away, indexing="ij")))


def _placed(disc: Disc, geometry: ImageGeometry) -> tuple[float, float, float]:
    """Row and column of the middle of a disc, and its radius [px]."""
    _, row, column, radius = disc
    return (
        float(geometry.y_px[int(row)]), float(geometry.x_px[int(column)]),
        radius * math.sqrt(math.prod(geometry.cell_px)),
    )  # fmt: skip


def find_disc(residuals: Residuals) -> tuple[float, float, float] | None:
    """Row and column of its middle, and its radius [px]; nothing if noise leaves as much somewhere.

    The sum of the excess of chi square in a disc is compared with its own scatter.
    """
    weight = residuals.weight
    number = (weight > 0.0).sum(axis=0)
    used = number > 0
    discs = Discs.of(used, FINE_RATIO)
    if not discs.radii or not used.any():
        return None
    power = np.where(used, (weight * residuals.value**2).sum(axis=0) / np.maximum(number, 1), 0.0)
    # The median of chi square is below its mean (Wilson & Hilferty 1931); discs do not matter to the former.
    mean = float(np.median(power[used])) / (1.0 - 2.0 / (9.0 * float(number.max()))) ** 3
    excess = np.where(used, np.clip(power / mean - 1.0, -1.0, MOST_EXCESS), 0.0)
    scatter = math.sqrt(2.0 / float(number.max()))
    by_chance = 2.0 * math.log(used.sum() * len(discs.radii))
    best = (by_chance, 0.0, 0.0, 0.0)
    each = zip(discs.radii, discs.usable, discs.sums(excess), discs.sums(used.astype(float)), strict=True)
    for radius, usable, amount, seen in each:
        strength = (amount / scatter) ** 2 / np.maximum(seen, 1.0)
        best = _better(best, np.where(usable & (amount > 0.0), strength, 0.0), radius)
    return None if best[0] <= by_chance else _placed(best, residuals.geometry)


def find_step(residuals: Residuals) -> tuple[float, float, float] | None:
    """Row, column and radius [px] of the clearest disc at whose rim the thickness steps; nothing if noise has such.

    What discs of one radius promise is compared with the scatter of the quieter quarter of them, which tells how much
    of a step a smooth thickness takes up.
    """
    score, information = residuals.thickness_score, residuals.thickness_information
    if score is None or information is None:
        return None
    used = information > 0.0
    discs = Discs.of(used)
    by_chance = 2.0 * math.log(max(used.sum() * len(discs.radii), 1) / CHANCE)
    best = (by_chance, 0.0, 0.0, 0.0)
    each = zip(discs.radii, discs.usable, discs.sums(score), discs.sums(information), strict=True)
    for radius, usable, amount, alone in each:
        if radius >= SMALLEST_STEP and usable.any():
            size = amount / np.sqrt(np.where(usable, np.maximum(alone, 0.0), np.inf))
            scatter = float(np.quantile(np.abs(size[usable]), 0.25)) / QUIET_QUARTER
            best = _better(best, (size / max(scatter, 1e-300)) ** 2, radius)
    return None if best[0] <= by_chance else _placed(best, residuals.geometry)
