"""A thickness map held against observed frames of its sensor: frames made comparable, and the map that follows."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from ..array_types import Float32Array, FloatArray
from ..blocks import block_sums
from ..errors import InputError, named_units
from ..notebook import do_nothing
from ..products import ObservedFrame, ThicknessMap, mask_bits
from .correction.background import BackgroundTerms
from .correction.objects import fit_frame
from .fringe_correction import CorrectionOptions
from .observed_frames import frame_weight
from .sky_response import FrameTable, Response
from .sky_shift import MAP_SIGMA_ORDERS, SkyShift, fit_sky_shift

LARGEST_STEP_RAD = 0.5
"""Change of phase from one end of a cell of pixels to the other in all but a twentieth of the cells: the mean of the
fringes over such a cell is that of its middle to 1 %."""

SMALLEST_SIDE = 64  # Cells along a side below which no more pixels are put together


class MapOnSky(NamedTuple):
    """What a night says of a map."""

    shift: SkyShift
    cell_px: int  # side of the cells of `shift` [px]
    moved: ThicknessMap


@named_units
def reach_um(order_um: float, map_sigma_um: float | None = None) -> float:
    """How far from the map a response has to be known [µm]."""
    return order_um + 4.0 * (map_sigma_um or MAP_SIGMA_ORDERS * order_um)


@named_units
def map_on_sky(
    frames: Sequence[Callable[[], ObservedFrame]],
    thickness: ThicknessMap,
    response: Response,
    order_um: float,
    options: CorrectionOptions | None = None,
    *,
    map_sigma_um: float | None = None,
    advance: Callable[[], None] = do_nothing,
) -> MapOnSky:
    """Say where sky and map disagree, and move the map there; ``frames`` are loaders, asked one at a time."""
    chosen = options or CorrectionOptions()
    known = thickness.known_um().astype(float)
    good = np.isfinite(known)
    reach = reach_um(order_um, map_sigma_um)
    low, high = np.nanmin(known) - reach, np.nanmax(known) + reach
    dark, cell = response.sky(), _cell_px(known, order_um)
    level = float(dark.frame(np.where(good, known, np.nanmean(known))).mean(dtype=float))
    patterns = [_pattern(dark, known + part * order_um) for part in (0.0, 0.25)]
    values, weights = [], []
    for frame in frames:
        value, weight = fringes_alone(frame(), patterns, chosen, known.shape)
        weight[~good] = 0.0
        values.append(_cell_means(value, weight, cell))
        weights.append(block_sums(weight, cell))
        advance()
    seen = good.astype(float)
    layer = np.where(block_sums(seen, cell) > 0.0, _cell_means(known, seen, cell), np.nan)
    tables = [
        response.sky({name: float(name == band) for name in response.component}) for band in response.bands
    ]

    def predict(thickness_um: FloatArray) -> FloatArray:
        inside = np.clip(thickness_um, low, high)
        return np.stack([table.frame(inside) for table in tables]).astype(float) / level

    shift = fit_sky_shift(values, weights, layer, predict, order_um, map_sigma_um=map_sigma_um)
    return MapOnSky(shift, cell, _moved(thickness, shift, cell))


def _cell_px(known: FloatArray, order_um: float) -> int:
    """Pixels along a side of a cell: a power of two, as many as the fringes allow."""
    gradient = np.hypot(*np.gradient(known))
    step = 2.0 * math.pi / order_um * float(np.nanpercentile(gradient, 95.0))
    largest = min(known.shape) // SMALLEST_SIDE
    cell = 1
    while 2 * cell <= largest and 2 * cell * step <= LARGEST_STEP_RAD:
        cell *= 2
    return cell


def _pattern(dark: FrameTable, thickness_um: FloatArray) -> Float32Array:
    """The sky of a map, of mean 0: two that are a quarter of an order apart add up to that of any common shift."""
    good = np.isfinite(thickness_um)
    frame = dark.frame(thickness_um).astype(float)
    return np.where(good, frame / frame[good].mean() - 1.0, 0.0).astype(np.float32)


def fringes_alone(
    frame: ObservedFrame, patterns: list[Float32Array], options: CorrectionOptions, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """A frame over its background, minus one, and its inverse variance, 0 in objects.

    ``patterns``: fringes, which are not taken for objects. ``shape``: a frame of another one is refused.
    """
    if frame.shape != shape:
        raise InputError("shape of a frame", frame.shape, f"{shape}, that of the thickness map")
    weight = frame_weight(frame)
    background = BackgroundTerms(frame.shape, options.spacing_px, options.amplifiers)
    image = np.where(np.isfinite(frame.image), frame.image, 0.0)
    found = fit_frame(image, weight, patterns, background)
    surface = found.background.astype(float)
    used = (weight > 0.0) & (~found.objects if options.find_objects else True) & (surface > 0.0)
    value = np.divide(image, surface, out=np.ones(image.shape), where=used) - 1.0
    return value, np.where(used, weight * surface**2, 0.0)


def _cell_means(image: FloatArray, weight: FloatArray, cell: int) -> FloatArray:
    total = block_sums(weight, cell)
    share = block_sums(np.where(weight > 0.0, image, 0.0) * weight, cell)
    return np.divide(share, total, out=np.zeros(total.shape), where=total > 0.0)


def _moved(thickness: ThicknessMap, shift: SkyShift, cell: int) -> ThicknessMap:
    """The map with its shift; its uncertainty is that of both."""
    rows, columns = (
        np.clip((np.arange(side) + 0.5) / cell - 0.5, 0.0, cells - 1.0)
        for side, cells in zip(thickness.shape, shift.shift_um.shape, strict=True)
    )
    places = np.meshgrid(rows, columns, indexing="ij")
    added, sigma = (map_coordinates(values, places, order=1) for values in (shift.shift_um, shift.sigma_um))
    value = thickness.value + added
    below = (thickness.mask == 0) & ~(value > 0.0)
    return dataclasses.replace(
        thickness,
        value=value.astype(np.float32),
        sigma=np.hypot(thickness.sigma, sigma).astype(np.float32),
        mask=thickness.mask | np.where(below, mask_bits("NO_DATA"), 0).astype(np.int32),
        slip_probability=np.maximum(thickness.slip_probability, shift.chance_other_order).astype(np.float32),
        metadata={
            **thickness.metadata,
            "SKYMEAN": float(np.mean(shift.shift_um)),
            "SKYSIGMA": float(np.median(shift.sigma_um)),
            "SKYKEPT": shift.chance_unmoved,
        },
    )
