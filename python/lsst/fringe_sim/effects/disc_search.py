"""The disc of a sensor in which a model leaves most."""

from __future__ import annotations

import math

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from .base import Residuals

__all__ = ["find_disc"]

SMALLEST_RADIUS, LARGEST_PART, RADIUS_RATIO = 2.0, 0.35, 1.05
"""Radii that are tried: the smallest [cells], the largest over the shorter side, and one over the one before."""

LEAST_SEEN = 0.3
"""Part of a disc that must lie on samples with data."""

MOST_EXCESS = 4.0
"""Excess over the noise that counts in one sample: it matters where something is left, not how much."""


def find_disc(residuals: Residuals) -> tuple[float, float, float] | None:
    """Row and column of its middle, and its radius [px]; nothing if noise leaves as much somewhere.

    The sum of the excess of chi square in a disc is compared with its own scatter.
    """
    weight, geometry = residuals.weight, residuals.geometry
    number = (weight > 0.0).sum(axis=0)
    used = number > 0
    shape = geometry.sample_shape
    if min(shape) * LARGEST_PART < SMALLEST_RADIUS or not used.any():
        return None
    power = np.where(used, (weight * residuals.value**2).sum(axis=0) / np.maximum(number, 1), 0.0)
    # The median of chi square is below its mean (Wilson & Hilferty 1931); discs do not matter to the former.
    mean = float(np.median(power[used])) / (1.0 - 2.0 / (9.0 * float(number.max()))) ** 3
    excess = np.where(used, np.clip(power / mean - 1.0, -1.0, MOST_EXCESS), 0.0)
    largest = LARGEST_PART * min(shape)
    radii = SMALLEST_RADIUS * RADIUS_RATIO ** np.arange(
        int(math.log(largest / SMALLEST_RADIUS) / math.log(RADIUS_RATIO)) + 1
    )
    padded = [next_fast_len(side + math.ceil(largest), real=True) for side in shape]
    away = np.hypot(*np.meshgrid(*(np.fft.fftfreq(side, 1.0 / side) for side in padded), indexing="ij"))
    both = [rfft2(values, padded) for values in (excess, used.astype(float))]
    scatter = math.sqrt(2.0 / float(number.max()))
    best, place = 2.0 * math.log(used.sum() * len(radii)), None
    for radius in radii:
        disc = rfft2((away <= radius).astype(float))
        amount, seen = (irfft2(own * disc, padded)[: shape[0], : shape[1]] for own in both)
        enough = seen > LEAST_SEEN * math.pi * radius**2
        strength = np.where(enough & (amount > 0.0), (amount / scatter) ** 2 / np.maximum(seen, 1.0), 0.0)
        row, column = np.unravel_index(int(np.argmax(strength)), strength.shape)
        if strength[row, column] > best:
            best, place = float(strength[row, column]), (int(row), int(column), float(radius))
    if place is None:
        return None
    return (
        float(geometry.y_px[place[0]]), float(geometry.x_px[place[1]]),
        place[2] * math.sqrt(math.prod(geometry.cell_px)),
    )  # fmt: skip
