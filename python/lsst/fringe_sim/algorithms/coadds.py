"""What is left of fringes in coadds of visits that lie differently on a sensor, before and after a correction."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, spline_filter

from ..array_types import Float32Array, FloatArray
from ..errors import InputError, OutOfRangeError, named_units
from ..products import SkyFringe
from ..resources import read_user_table

COUNTS = (1, 10, 100, 1000)  # Exposures in coadds that are looked at, besides the deepest

VISITS = 100
"""Exposures in the deepest coadd where no visits are given; the y band of LSST has some more in ten years."""

LARGEST_REGION_PX = 400  # Side of the region that is coadded [px]; a quarter of it is 20 arcsec of LSST

SMALLEST_REGION_PX = 16

CELLS = 100
"""Cells in a side of the region, or somewhat more, where it has more pixels: 4 px of LSST, 0.8 arcsec."""

LARGEST_PART = 4
"""The largest square in which pixels are averaged is at most this part of a region: there must be several of them."""


@named_units
@dataclass(frozen=True, eq=False)
class VisitPlaces:
    """Where one region of the sky lies on a sensor, visit by visit."""

    x_px: FloatArray  # (V,): centre of the region [px, from 0]
    y_px: FloatArray
    rotation_deg: FloatArray  # (V,): angle between the axes of the sky and of the sensor [deg]
    frame: NDArray[np.int64]  # (V,): which of the frames has the fringes of the visit

    def __len__(self) -> int:
        return int(self.x_px.size)

    @classmethod
    def random(
        cls, shape: tuple[int, int], region_px: int, visits: int, frames: int, rng: np.random.Generator
    ) -> VisitPlaces:
        """Uniform over the places at which a region fits under every angle, over angles, and over frames."""
        reach = 0.5 * math.sqrt(2.0) * (region_px - 1) + 1.0
        y, x = (rng.uniform(reach, size - 1.0 - reach, visits) for size in shape)
        return cls(x, y, rng.uniform(0.0, 360.0, visits), rng.integers(frames, size=visits))

    @classmethod
    def read(cls, path: str | os.PathLike[str], frames: int) -> VisitPlaces:
        """Read an ECSV table with columns ``x``, ``y`` [px], ``rotation`` [deg], and perhaps ``frame``.

        Without the last the visits go through the frames in turn.
        """
        table, source = read_user_table(path, "visits"), str(path)
        missing = [name for name in ("x", "y", "rotation") if name not in table.colnames]
        if missing:
            raise InputError("columns of the visits", table.colnames, "x, y, rotation", source=source)
        x, y, rotation = (_numbers(table, name, source) for name in ("x", "y", "rotation"))
        if x.size < 2:
            raise InputError("visits", x.size, "two or more", source=source)
        frame = _numbers(table, "frame", source) if "frame" in table.colnames else np.arange(x.size) % frames
        if not np.all(np.isin(frame, np.arange(frames))):
            raise InputError("frame of a visit", float(frame.max()), f"0 to {frames - 1}", source=source)
        return cls(x, y, rotation, frame.astype(int))

    def region_px(self, shape: tuple[int, ...]) -> int:
        """Side of the largest region that lies on the sensor in every visit, but at most `LARGEST_REGION_PX`."""
        angle = np.radians(self.rotation_deg)
        inside = [
            np.minimum(at, size - 1.0 - at) for at, size in zip((self.y_px, self.x_px), shape, strict=True)
        ]
        side = 1.0 + 2.0 * (np.min(inside, axis=0) - 1.0) / (np.abs(np.cos(angle)) + np.abs(np.sin(angle)))
        worst = int(np.argmin(side))
        if side[worst] < SMALLEST_REGION_PX:
            raise OutOfRangeError(
                f"place of visit {worst} [px]",
                (float(self.x_px[worst]), float(self.y_px[worst])),
                f"far enough inside {shape[1]} x {shape[0]} for a region of {SMALLEST_REGION_PX} px",
            )
        return min(LARGEST_REGION_PX, int(side[worst]))


def _numbers(table: Any, name: str, source: str) -> FloatArray:
    try:
        values: FloatArray = np.asarray(table[name], dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(name, "not numbers", "numbers", source=source) from None
    if not np.all(np.isfinite(values)):
        raise InputError(name, "not finite", "finite numbers", source=source)
    return values


@dataclass(frozen=True, eq=False)
class Coadds:
    """Standard deviation of means over squares in coadds of more and more visits, as fractions of the sky."""

    counts: NDArray[np.int64]  # (N,): visits in the coadds
    square_px: NDArray[np.int64]  # (S,): sides of the squares [px]
    # (N, S): of the fringes: the mean over as many coadds as the visits give, one after the other
    fringes: FloatArray
    corrected: FloatArray | None  # (N, S): of what a correction leaves of them
    noise: FloatArray  # (N, S): of white noise, as expected


def coadds_of_frames(
    frames: Sequence[SkyFringe], rng: np.random.Generator, places: VisitPlaces | None = None
) -> Coadds | None:
    """Fringes left in coadds of pieces of the frames, before a correction and after one with one template.

    The template is the one pattern that takes most of the frames, so that a single frame has no correction.
    Visits are at random places and angles by default; `None` for frames that are too small to be rotated.
    """
    placed = placed_visits(frames, rng, places)
    if placed is None:
        return None
    patterns = [filled_pattern(frame) for frame in frames]
    noise = np.sqrt(np.mean([1.0 / frame.mean_electrons for frame in frames]))
    return coadd_visits(patterns, placed[0], float(noise), placed[1], 1 if len(frames) > 1 else 0)


def placed_visits(
    frames: Sequence[SkyFringe], rng: np.random.Generator, places: VisitPlaces | None = None
) -> tuple[VisitPlaces, int] | None:
    """Visits, and the side of the region that is coadded [px]; see `coadds_of_frames`."""
    shape = frames[0].shape
    if places is not None:
        return places, places.region_px(shape)
    # A region that is rotated by any angle needs its diagonal, and the spline a few pixels more.
    region = min(LARGEST_REGION_PX, int((min(shape) - 8) / np.sqrt(2.0)) - 1)
    if region < SMALLEST_REGION_PX:
        return None
    return VisitPlaces.random(shape, region, VISITS, len(frames), rng), region


def coadd_visits(
    patterns: Sequence[NDArray[np.floating]],
    places: VisitPlaces,
    noise_rms: float,
    region_px: int,
    templates: int = 0,
) -> Coadds:
    """Fringes left in coadds of a region of the sky.

    Patterns are averaged over cells, `CELLS` in a side of the region, and interpolated with cubic splines. The mean
    of the region is subtracted from every visit.
    """
    step = max(1, region_px // CELLS)
    cells = region_px // step
    means = np.array([_cell_means(pattern, step) for pattern in patterns])
    kinds = [means]
    if templates:
        kinds.append(np.tensordot(_projection(means, templates), means, axes=1))
    splines = [[spline_filter(image, order=3) for image in images] for images in kinds]
    counts = np.array([*(count for count in COUNTS if count < len(places)), len(places)])
    sides = np.unique(np.geomspace(1, max(1, cells // LARGEST_PART), 12).astype(int))
    sums = np.zeros((len(counts), len(kinds), cells, cells))
    variance = np.zeros((len(counts), len(kinds), sides.size))
    for number in range(len(places)):
        frame = places.frame[number]
        sums += [_piece(images[frame], places, number, cells, step) for images in splines]
        for k in np.flatnonzero((number + 1) % counts == 0):
            variance[k] += [_square_variance(each / counts[k], sides) for each in sums[k]]
            sums[k] = 0.0
    rms = np.sqrt(variance / (len(places) // counts)[:, None, None])
    noise = noise_rms / (np.sqrt(counts)[:, None] * step * sides)
    return Coadds(counts, step * sides, rms[:, 0], rms[:, 1] if templates else None, noise)


def _cell_means(pattern: NDArray[np.floating], step: int) -> FloatArray:
    ny, nx = (size // step for size in pattern.shape)
    cells = pattern[: ny * step, : nx * step].reshape(ny, step, nx, step)
    return np.asarray(cells.mean(axis=(1, 3), dtype=float))


def patterns_left(patterns: Sequence[NDArray[np.floating]], templates: int) -> FloatArray:
    """What a correction leaves of patterns, as sums of all of them: a matrix of shape ``(P, P)``.

    Subtracted are the patterns that take most of the given ones, without errors.
    """
    step = max(1, LARGEST_REGION_PX // CELLS)
    step = step if min(patterns[0].shape) > CELLS * step else 1
    return _projection(np.array([_cell_means(pattern, step) for pattern in patterns]), templates)


def _projection(patterns: FloatArray, templates: int) -> FloatArray:
    """What is left of each pattern after the subtraction of those that take most of all."""
    flat = patterns.reshape(len(patterns), -1)
    _, vectors = np.linalg.eigh(flat @ flat.T)
    taken = vectors[:, vectors.shape[1] - templates :]
    return np.asarray(np.eye(len(flat)) - taken @ taken.T)


def _piece(spline: FloatArray, places: VisitPlaces, number: int, cells: int, step: int) -> FloatArray:
    """The region in one visit, less its mean."""
    angle = math.radians(places.rotation_deg[number])
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    centre = (np.array([places.y_px[number], places.x_px[number]]) + 0.5) / step - 0.5
    start = centre - turn @ np.full(2, 0.5 * (cells - 1))
    piece = affine_transform(spline, turn, start, (cells, cells), order=3, prefilter=False, mode="nearest")
    return np.asarray(piece - piece.mean())


def _square_variance(image: FloatArray, sides: NDArray[np.int64]) -> FloatArray:
    """Variance of the means over all squares of each side."""
    total = np.pad(image.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = (
        total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
        for side in sides
    )
    return np.array([(each / side**2).var() for each, side in zip(sums, sides, strict=True)])


def filled_pattern(frame: SkyFringe) -> Float32Array:
    """Pattern with the mean sky where it is not known."""
    values = frame.fraction()
    return np.where((frame.mask == 0) & np.isfinite(values), values, np.float32(0))
