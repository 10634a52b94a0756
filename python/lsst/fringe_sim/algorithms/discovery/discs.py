"""Discs anywhere on a sensor in which something promises most."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

__all__ = ["Disc", "Discs"]

FloatArray = NDArray[np.float64]

SMALLEST_RADIUS, LARGEST_PART, RADIUS_RATIO = 2.0, 0.35, 1.2
"""Radii that are tried: the smallest [cells], the largest over the shorter side, and one over the one before."""

LEAST_SEEN = 0.3
"""Part of a disc that must lie on cells with data."""

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
    def of(cls, seen: NDArray[np.bool_]) -> Discs:
        """Discs about the cells with and without data."""
        shape = (seen.shape[0], seen.shape[1])
        largest = LARGEST_PART * min(shape)
        number = math.floor(math.log(max(largest / SMALLEST_RADIUS, 0.5)) / math.log(RADIUS_RATIO)) + 1
        radii = [SMALLEST_RADIUS * RADIUS_RATIO**step for step in range(max(number, 0))]
        rows, columns = (next_fast_len(side + math.ceil(largest), real=True) for side in shape)
        from_row, from_column = (
            np.minimum(np.arange(side), side - np.arange(side)) for side in (rows, columns)
        )
        away = np.hypot(from_row[:, np.newaxis], from_column[np.newaxis, :])
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

    def best(self, score: FloatArray, information: FloatArray) -> Disc:
        """The disc that promises most, from derivative and curvature of the likelihood in every cell."""
        best = (0.0, 0.0, 0.0, SMALLEST_RADIUS)
        least = 1e-6 * float(information.sum())
        each = zip(self.radii, self.usable, self.sums(score), self.sums(information), strict=True)
        for radius, usable, amount, variance in each:
            strength = np.divide(
                amount, variance, out=np.zeros(self.shape), where=usable & (variance > least)
            )
            # A finite signature may be scaled only a little.
            fall = np.where((strength > 0.2) & (strength < 3.0), amount * strength, 0.0)
            row, column = np.unravel_index(int(np.argmax(fall)), fall.shape)
            if fall[row, column] > best[0]:
                best = (float(fall[row, column]), float(row), float(column), radius)
        return best
