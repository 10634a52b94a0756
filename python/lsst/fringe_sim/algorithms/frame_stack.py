"""Many frames of one sensor, read a few rows of all of them at a time: their Gram matrix and weighted sums of them.

Every frame is taken relative to the first, which removes what they have in common before anything is rounded. The
Gram matrix about the mean frame follows by projection, as a constant vector in each pixel has no part in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from threadpoolctl import threadpool_limits

from ..array_types import BoolArray, Float32Array, FloatArray
from ..errors import InputError
from ..products import SkyFringe

TILE_BYTES = 8 * 2**20  # Memory of one tile of all frames

_FEW_FRAMES = 64
"""Up to so many frames tiles are in double precision, beyond in single precision, which is twice as fast; sums over
tiles are always in double precision."""


@dataclass(frozen=True, eq=False)
class FrameStack:
    """Frames as ``(frame - offset) / unit``."""

    frames: tuple[Any, ...]  # images of one shape, N of them, that can be sliced by rows
    # (ny, nx): pixels that are used. Those without a value in some frame are taken out as the frames are
    # read.
    good: BoolArray
    offset: FloatArray  # (N,): what is subtracted from every frame
    unit: float  # what they are divided by
    # Variance of the noise of a pixel of a frame, in that unit; 0 where it is not known
    noise_variance: float
    rows: int  # rows of a tile

    @classmethod
    def of(cls, frames: Sequence[Any], mask: ArrayLike | None, tile_bytes: int = TILE_BYTES) -> FrameStack:
        """Frames of one sensor: arrays as they are, exposures in electrons in units of their common mean sky."""
        if len(frames) < 2:
            raise InputError("number of frames", len(frames), "two or more")
        images = tuple(each.image if isinstance(each, SkyFringe) else each for each in frames)
        shape = tuple(np.shape(images[0]))
        for number, image in enumerate(images):
            if tuple(np.shape(image)) != shape or len(shape) != 2:
                raise InputError(f"shape of frame {number}", np.shape(image), f"{shape}, two axes")
        good = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask) == 0
        if good.shape != shape:
            raise InputError("shape of the mask", good.shape, f"{shape}")
        item = 8 if len(images) <= _FEW_FRAMES else 4
        rows = max(1, min(shape[0], tile_bytes // (item * len(images) * shape[1])))
        stack = cls(images, good, np.zeros(len(images)), 1.0, 0.0, rows)
        skies = [each for each in frames if isinstance(each, SkyFringe)]
        if len(skies) < len(frames):
            return stack
        for sky in skies:
            good &= sky.mask == 0
        if any(sky.unit != "electron" for sky in skies):
            return stack
        offset = stack._means()
        unit = float(offset.mean())
        noise = float(np.mean([_noise_of(sky) for sky in skies])) / unit**2
        return cls(images, good, offset, unit, noise, rows)

    @property
    def rounding(self) -> float:
        """Share of the variance that an eigenvalue of the Gram matrix may be off by."""
        return 1e-13 if len(self.frames) <= _FEW_FRAMES else 1e-7

    @property
    def pixels(self) -> int:
        """Good pixels."""
        return int(np.count_nonzero(self.good))

    def gram_and_mean(self) -> tuple[FloatArray, Float32Array]:
        """Gram matrix of the frames less their mean over frames, and that mean frame; 0 where there is none."""
        count = len(self.frames)
        whole = np.zeros((count, count))
        mean = np.zeros(self.good.shape, dtype=np.float32)
        # Tiles are small: more than one thread of a matrix product would mostly wait.
        with threadpool_limits(limits=1, user_api="blas"):
            for part, tile in self._tiles(np.float64 if count <= _FEW_FRAMES else np.float32):
                good = self.good[part]
                beside_first = tile.sum(axis=0, dtype=np.float64) / count
                first = np.asarray(self.frames[0][part], dtype=np.float64) - self.offset[0]
                np.copyto(mean[part], (beside_first.reshape(good.shape) + first) / self.unit, "unsafe", good)
                # Without this the first frame would be in all rows, and its rounding in the result.
                tile -= beside_first.astype(tile.dtype)
                whole += tile @ tile.T  # of which BLAS makes one half
        if not self.good.any():
            raise _no_pixels()
        whole -= whole.mean(axis=0)
        whole -= whole.mean(axis=1)[:, None]
        return 0.5 * (whole + whole.T) / self.unit**2, mean

    def components(self, combination: FloatArray) -> tuple[Float32Array, FloatArray]:
        """Components ``combination.T @ (frames - mean)`` and the signs that were given to them.

        The largest entry of every component is made positive. Sums are made in the precision of the frames, after
        the first frame was subtracted. Pixels without a value in some frame must have been found before.
        """
        number = combination.shape[1]
        precise = any(np.asarray(image[:1]).dtype != np.float32 for image in self.frames)
        work = np.dtype(np.float64 if precise else np.float32)
        # Weights of zero sum need no frames less their mean.
        weights = ((combination - combination.mean(axis=0)).T / self.unit).astype(work)
        images = np.empty((number, self.good.size), dtype=np.float32)
        extremes = np.zeros((2, number))
        with threadpool_limits(limits=1, user_api="blas"):
            for part, tile in self._tiles(work):
                begin = part.start * self.good.shape[1]
                chosen = images[:, begin : begin + tile.shape[1]]
                np.matmul(weights, tile, out=chosen, casting="same_kind")
                np.minimum(extremes[0], chosen.min(axis=1), out=extremes[0])
                np.maximum(extremes[1], chosen.max(axis=1), out=extremes[1])
        sign = np.where(extremes[1] < -extremes[0], -1.0, 1.0)
        for index in np.flatnonzero(sign < 0.0):
            np.negative(images[index], out=images[index])
        return images.reshape(number, *self.good.shape), sign

    def _means(self) -> FloatArray:
        """Mean of every frame over the good pixels."""
        beside_first, first = np.zeros(len(self.frames)), 0.0
        for part, tile in self._tiles(np.float64):
            beside_first += tile.sum(axis=1)
            first += float(np.asarray(self.frames[0][part]).sum(dtype=np.float64, where=self.good[part]))
        if not self.good.any():
            raise _no_pixels()
        return (first + beside_first) / self.pixels

    def _tiles(self, precision: DTypeLike) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Rows, and ``frame - offset`` less that of the first there, ``[N, pixels]``; 0 in pixels that are not good.

        The array is overwritten by the next tile. Pixels without a value in some frame are taken out of `good`.
        """
        width = self.good.shape[1]
        whole = np.empty((len(self.frames), self.rows * width), dtype=precision)
        relative = self.offset - self.offset[0]
        for start in range(0, self.good.shape[0], self.rows):
            part = slice(start, start + self.rows)
            first = np.asarray(self.frames[0][part]).ravel()
            tile = whole[:, : first.size]
            for row, image, offset in zip(tile, self.frames, relative, strict=True):
                values = np.asarray(image[part]).ravel()
                exact = precision if values.dtype == first.dtype == np.float32 else np.float64
                with np.errstate(invalid="ignore"):  # of infinities
                    np.subtract(values, first, out=row, dtype=exact, casting="same_kind")
                if offset != 0.0:
                    row -= offset
            good = self.good[part].reshape(-1)
            # What is no number in some frame spoils the sum over frames.
            with np.errstate(invalid="ignore"):
                usable = np.isfinite(tile.sum(axis=0))
            usable &= good
            if not usable.all():
                good[:] = usable
                tile[:, ~usable] = 0.0
            yield part, tile


def _noise_of(frame: SkyFringe) -> float:
    """Variance of the noise of a simulated exposure [e⁻²]; 0 without noise."""
    if frame.seed is None:
        return 0.0
    return frame.mean_electrons + float(frame.metadata.get("RDNOISE", 0.0)) ** 2


def _no_pixels() -> InputError:
    return InputError("good pixels", 0, "at least one in which all frames have a value")
