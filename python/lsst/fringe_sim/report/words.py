"""Quantities as pages state them: two or three digits, and one unit for each."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..products import SensorSection

PERCENT = 100.0
NM = 1000.0

MOST_DECIMALS, MOST_PLAIN = 100.0, 1e6  # Numbers from which on no decimals are shown, and an exponent is


def amplitude_text(fraction: float) -> str:
    """A fraction of the counts or of the sky."""
    return f"{number_text(PERCENT * fraction)} %"


def masked_text(mask: NDArray[Any]) -> str:
    """Share of the pixels that are masked."""
    return f"{number_text(PERCENT * float(np.mean(np.asarray(mask) != 0)), 2)} % of the pixels"


def sigma_text(sigma_um: NDArray[np.floating]) -> str:
    """Median uncertainty of thicknesses [µm]; empty where there are none."""
    return f"{number_text(NM * float(np.median(sigma_um)), 2)} nm" if np.size(sigma_um) else ""


def of_sensor(shape: tuple[int, ...], section: SensorSection | None) -> str:
    """Pixels of an image, and which part of the sensor they are where that is known."""
    rows, columns = shape
    said = f"{columns} × {rows} px"
    if section is None:
        return said
    if shape == section.detector.shape:
        return f"{said}, the whole sensor"
    part = PERCENT * rows * columns / float(np.prod(section.detector.shape))
    x, y = (sorted(ends) for ends in (section.x, section.y))
    return f"{said}, {number_text(part, 2)} % of the sensor: columns {x[0]} to {x[1]}, rows {y[0]} to {y[1]}"


def number_text(value: float, digits: int = 3) -> str:
    """So many digits of a number, more only before its decimal point; a dash for none."""
    if np.ma.is_masked(value) or math.isnan(value):
        return "–"
    whole = value == round(value) if math.isfinite(value) else False
    plain = abs(value) < MOST_PLAIN and (whole or abs(value) >= MOST_DECIMALS)
    return f"{value:.0f}" if plain else f"{value:#.{digits}g}".rstrip(".")


def measured_text(value: float, sigma: float) -> tuple[str, str]:
    """A value and its standard deviation, both to the second digit of the latter."""
    if not (math.isfinite(sigma) and sigma > 0.0):
        return f"{value:.3g}", number_text(sigma)
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:z.{decimals}f}", f"{sigma:.{decimals}f}"


def span_text(values: ArrayLike) -> str:
    """One number, or the smallest and the largest."""
    low, high = (number_text(float(edge)) for edge in (np.min(values), np.max(values)))
    return low if low == high else f"{low} to {high}"
