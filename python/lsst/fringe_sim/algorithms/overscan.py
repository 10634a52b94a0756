"""The electronic level of an amplifier, measured in its overscan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_lsq_spline
from scipy.ndimage import median_filter

from ..array_types import Float32Array, FloatArray
from ..errors import FrameFormatError
from ..instrument.raw_frame import RawAmplifier
from .flat_prep_options import DEFAULT_OPTIONS, GAUSSIAN_MAD, FlatPrepOptions

Image = Float32Array

NEARBY_ROWS = 25  # Rows on either side among which the overscan of a row is judged; fewer may hold charge


@dataclass(frozen=True, eq=False)
class OverscanCorrected:
    """One amplifier without its electronic level."""

    image: Image  # Imaging section, read-out order [ADU]
    level_adu: float  # Median level that was taken off [ADU]
    # Standard deviation of the overscan pixels about their rows, without outliers: the read noise [ADU]
    noise_adu: float


def correct_overscan(
    amp: RawAmplifier, options: FlatPrepOptions = DEFAULT_OPTIONS
) -> OverscanCorrected | None:
    """Take the electronic level off one amplifier.

    Row by row with the serial overscan, which follows the drift of the electronics; then what columns differ from
    each other in the parallel overscan. Outliers (cosmic rays, bleeding, deferred charge) are rejected, and rows
    whose whole overscan holds charge get the level of the rows around.
    `None` for an amplifier that is switched off: one value in all pixels.
    """
    if amp.data.min() == amp.data.max():
        return None
    first_column = amp.serial_overscan[1].start + options.overscan_skip
    if first_column + 3 > amp.data.shape[1]:
        width = amp.data.shape[1] - amp.serial_overscan[1].start
        raise FrameFormatError(
            f"{amp.name} serial overscan", width, f"{options.overscan_skip + 3} columns or more"
        )
    rows, columns = amp.imaging
    serial = amp.data[:, first_column:].astype(np.float32)
    level, noise = _row_level(serial, amp.data[:, : columns.start].astype(np.float32), options)
    image = amp.data[rows, columns].astype(np.float32)
    image -= level[rows, np.newaxis]
    first_row = amp.parallel_overscan[0].start + options.overscan_skip
    if options.parallel_overscan and first_row + 3 <= amp.data.shape[0]:
        parallel = amp.data[first_row:, columns].astype(np.float32)
        parallel -= level[first_row:, np.newaxis]
        image -= _column_level(parallel, noise, options)
    return OverscanCorrected(image, float(np.median(level)), noise)


def _row_level(serial: Image, prescan: Image, options: FlatPrepOptions) -> tuple[Image, float]:
    """Level of every row, and the noise of one pixel about it [ADU]."""
    median = np.median(serial, axis=1)
    departure = serial - median[:, np.newaxis]
    # The median deviation of integers is coarse, so it only decides what is an outlier.
    rough = max(GAUSSIAN_MAD * float(np.median(np.abs(departure))), 1.0)
    inside = np.abs(departure) <= options.clip_sigma * rough
    noise = math.sqrt(float(np.mean(departure * departure, where=inside, dtype=np.float64)))
    noise = max(noise, 1.0 / math.sqrt(12.0))  # an integer is never known better than this
    median = _without_charge(median, prescan, noise, options.clip_sigma)
    if options.overscan_method == "median":
        return median, noise
    clipped = np.clip(departure, -options.clip_sigma * noise, options.clip_sigma * noise)
    mean = median + clipped.mean(axis=1)
    return _robust_spline(mean.astype(float), options).astype(np.float32), noise


def _without_charge(level: Image, prescan: Image, noise: float, clip_sigma: float) -> Image:
    """Levels of rows, those that charge in the overscan has raised replaced by that of the rows around.

    A level that the electronics have moved has moved the prescan alike, which is read before any charge.
    """
    around = _running_median(level)
    departure = np.abs(level - around)
    # Steps of integers have a spread of their own, which the deviation of most rows may not show.
    scatter = max(GAUSSIAN_MAD * float(np.median(departure)), noise / math.sqrt(NEARBY_ROWS))
    clean = departure <= clip_sigma * scatter
    if clean.all() or prescan.shape[1] < 3:
        return np.where(clean, level, around).astype(np.float32)
    row = np.arange(len(level))
    before = np.median(prescan, axis=1)
    moved = before - np.interp(row, row[clean], before[clean])
    expected = np.interp(row, row[clean], level[clean])
    raised = level - expected
    charged = (np.abs(raised) > clip_sigma * scatter) & (np.abs(moved - raised) > np.abs(moved)) & ~clean
    return np.where(charged, expected, level).astype(np.float32)


def _running_median(level: Image) -> Image:
    """Median of the rows around each; at the ends the drift is taken to go on as it was."""
    reach = min(NEARBY_ROWS, len(level) // 4)
    if reach < 3:
        return np.full_like(level, np.median(level))
    # Point reflection about the median of the outermost five rows.
    below = 2.0 * np.median(level[:5]) - level[5 : 5 + reach][::-1]
    above = 2.0 * np.median(level[-5:]) - level[-5 - reach : -5][::-1]
    padded = np.concatenate([below, level, above])
    return median_filter(padded, 2 * reach + 1)[reach : reach + len(level)]


def _robust_spline(values: FloatArray, options: FlatPrepOptions) -> FloatArray:
    """Cubic least-squares spline through equidistant values, refitted without outliers."""
    position = np.arange(len(values), dtype=float)
    intervals = min(options.overscan_knots, max(1, len(values) // 8))
    inner = np.linspace(0.0, position[-1], intervals + 1)
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    weight = np.ones(len(values))
    for _ in range(5):
        curve = make_lsq_spline(position, values, knots, 3, w=weight)(position)
        residual = values - curve
        scale = GAUSSIAN_MAD * np.median(np.abs(residual))
        # Outliers keep a trace of weight, so that no interval of the spline is ever left without data.
        updated = np.where(np.abs(residual) <= options.clip_sigma * max(scale, 1e-6), 1.0, 1e-3)
        if np.array_equal(updated, weight):
            break
        weight = updated
    return curve


def _column_level(parallel: Image, noise: float, options: FlatPrepOptions) -> Image:
    """Level of every column in the parallel overscan over that of all [ADU]; 0 where charge bled into it.

    What columns have in common is left to the serial overscan: here it is the noise of a few dozen row levels, and
    would give every amplifier an offset of its own in every exposure. A lasting one is in the bias frames.
    """
    median = np.median(parallel, axis=0)
    common = float(np.median(median))
    # The standard error of a median of n Gaussian values is 1.2533 sigma / sqrt(n).
    error = 1.2533 * noise / math.sqrt(parallel.shape[0])
    scatter = max(GAUSSIAN_MAD * float(np.median(np.abs(median - common))), error)
    outlier = np.abs(median - common) > options.clip_sigma * scatter
    # Medians of integers are halves of integers; only their mean has no step.
    departure = median - median[~outlier].mean(dtype=np.float64)
    return np.where(outlier, 0.0, departure).astype(np.float32)
