"""Many frames of one sensor, read a few rows of all of them at a time: their Gram matrix and weighted sums of them.

Every frame is taken relative to the first, which removes what they have in common before anything is rounded. The
Gram matrix about the mean frame follows by projection, as a constant vector in each pixel has no part in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from threadpoolctl import threadpool_limits

from ..errors import InputError
from ..products import SkyFringe

__all__ = ["TILE_BYTES", "FrameStack"]

FloatArray = NDArray[np.float64]

TILE_BYTES = 8 * 2**20
"""Memory of one tile of all frames."""

_FEW_FRAMES = 64
"""Up to so many frames products are made in double precision by the compiled kernel, beyond in single precision by
a matrix product of each tile, which is four times as fast there; sums over tiles are always in double precision."""

_SKEW = 40
"""Columns by which the rows of a tile are longer than needed, so that they do not share cache lines of one set."""

_CHUNK = 256
"""Pixels whose products are summed at a time: those of a dozen frames stay in the nearest cache."""


@dataclass(frozen=True, eq=False)
class FrameStack:
    """Frames as ``(frame - offset) / unit``.

    Attributes
    ----------
    frames : `tuple`
        Images of one shape, N of them, that can be sliced by rows.
    good : `numpy.ndarray`, bool, shape ``(ny, nx)``
        Pixels that are used. Those without a value in some frame are taken out as the frames are read.
    offset : `numpy.ndarray`, shape ``(N,)``
        What is subtracted from every frame.
    unit : `float`
        What they are divided by.
    noise_variance : `float`
        Variance of the noise of a pixel of a frame, in that unit; 0 where it is not known.
    rows : `int`
        Rows of a tile.
    """

    frames: tuple[Any, ...]
    good: NDArray[np.bool_]
    offset: FloatArray
    unit: float
    noise_variance: float
    rows: int

    @classmethod
    def of(cls, frames: Sequence[Any], mask: ArrayLike | None, tile_bytes: int = TILE_BYTES) -> FrameStack:
        """Frames of one sensor: arrays as they are, exposures in electrons in units of their common mean sky.

        Raises
        ------
        InputError
            Fewer than two frames, shapes that differ, or no good pixel.
        """
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

    def gram_and_mean(self) -> tuple[FloatArray, NDArray[np.float32]]:
        """Gram matrix of the frames less their mean over frames, and that mean frame; 0 where there is none.

        Raises
        ------
        InputError
            No pixel has a value in all frames.
        """
        count = len(self.frames)
        few = count <= _FEW_FRAMES
        total = np.zeros((count + -count % 4,) * 2)
        mean = np.empty(self.good.shape, dtype=np.float32)
        # Tiles are small: more than one thread of a matrix product would mostly wait.
        with threadpool_limits(limits=1, user_api="blas"):
            for part, used, tile, sums in self._tiles(np.float64 if few else np.float32):
                first, good = _native(self.frames[0][part]), self.good[part].reshape(-1)
                _add_first(sums, count, first, self.offset[0], self.unit, good, mean[part].reshape(-1))
                if few:
                    _add_products(tile, used, total)
                else:
                    # Without this the first frame would be in all rows, and its rounding in the result.
                    tile[:count, :used] -= (sums / count).astype(np.float32)
                    own = tile[:count, :used]
                    # BLAS makes one half of a product with its own transpose.
                    total[:count, :count] += own @ own.T
        if not self.good.any():
            raise _no_pixels()
        upper = np.triu(total[:count, :count])
        whole = upper + np.triu(upper, 1).T
        whole -= whole.mean(axis=0)
        whole -= whole.mean(axis=1)[:, None]
        return 0.5 * (whole + whole.T) / self.unit**2, mean

    def components(self, combination: FloatArray) -> tuple[NDArray[np.float32], FloatArray]:
        """Components ``combination.T @ (frames - mean)`` and the signs that were given to them.

        The largest entry of every component is made positive. Sums are made in the precision of the frames, after
        the first frame was subtracted. Pixels without a value in some frame must have been found before.
        """
        count, number = combination.shape
        precise = any(np.asarray(image[:1]).dtype != np.float32 for image in self.frames)
        work = np.dtype(np.float64 if precise else np.float32)
        weights = np.zeros((number, count + -count % 4), dtype=work)
        # Weights of zero sum need no frames less their mean.
        weights[:, :count] = (combination - combination.mean(axis=0)).T / self.unit
        images = np.empty((number, self.good.size), dtype=np.float32)
        extremes = np.zeros((2, number))
        with threadpool_limits(limits=1, user_api="blas"):
            for part, used, tile, _ in self._tiles(work, sums=False):
                begin = part.start * self.good.shape[1]
                chosen = images[:, begin : begin + used]
                if precise:
                    chosen[:] = weights @ tile[:, :used]
                else:
                    np.matmul(weights, tile[:, :used], out=chosen)
                np.minimum(extremes[0], chosen.min(axis=1), out=extremes[0])
                np.maximum(extremes[1], chosen.max(axis=1), out=extremes[1])
        sign = np.where(extremes[1] < -extremes[0], -1.0, 1.0)
        for index in np.flatnonzero(sign < 0.0):
            np.negative(images[index], out=images[index])
        return images.reshape(number, *self.good.shape), sign

    def _means(self) -> FloatArray:
        """Mean of every frame over the good pixels."""
        beside_first, first = np.zeros(len(self.frames)), 0.0
        for part, used, tile, _ in self._tiles(np.float64):
            beside_first += tile[: len(self.frames), :used].sum(axis=1)
            first += float(np.asarray(self.frames[0][part]).sum(dtype=np.float64, where=self.good[part]))
        if not self.good.any():
            raise _no_pixels()
        return (first + beside_first) / self.pixels

    def _tiles(
        self, precision: DTypeLike, *, sums: bool = True
    ) -> Iterator[tuple[slice, int, NDArray[Any], FloatArray]]:
        """Rows, their number of pixels, ``frame - offset`` less that of the first, and its sum over the frames.

        The arrays ``[N + padding, pixels + padding]`` and ``[pixels]`` are overwritten by the next tile. Rows of
        padding make N a multiple of four. Pixels that are not good are 0, those beyond the number of pixels are not
        to be used. Without ``sums`` these are not made, and pixels without a value in some frame not looked for.
        """
        count, width = len(self.frames), self.good.shape[1]
        tile = np.zeros((count + -count % 4, self.rows * width + _SKEW), dtype=precision)
        total = np.empty(self.rows * width)
        relative = self.offset - self.offset[0]
        flats = [_flat(image) for image in self.frames]
        for start in range(0, self.good.shape[0], self.rows):
            part = slice(start, start + self.rows)
            pixels = slice(start * width, (start + self.rows) * width)
            values = [
                _native(image[part]) if flat is None else flat[pixels]
                for image, flat in zip(self.frames, flats, strict=True)
            ]
            used = values[0].size
            total[:used] = 0.0
            for number, each in enumerate(values):
                if sums:
                    _load_and_add(each, values[0], relative[number], tile[number], total)
                else:
                    _load(each, values[0], relative[number], tile[number])
            _drop(total[:used], self.good[part].reshape(-1), tile)
            yield part, used, tile, total[:used]


def _flat(image: Any) -> NDArray[Any] | None:
    """Pixels of an image that compiled code reads as it is, in one dimension; nothing for any other."""
    if isinstance(image, np.ndarray) and image.flags.c_contiguous and image.dtype.isnative:
        return image.reshape(-1) if image.dtype in (np.float32, np.float64) else None
    return None


def _native(rows: Any) -> NDArray[Any]:
    """Pixels in a number format that compiled code reads, in one dimension."""
    values = np.asarray(rows)
    if values.dtype not in (np.float32, np.float64) or not values.dtype.isnative:
        values = values.astype(np.float32 if values.dtype.kind == "f" and values.itemsize <= 4 else float)
    return np.ascontiguousarray(values).ravel()


def _noise_of(frame: SkyFringe) -> float:
    """Variance of the noise of a simulated exposure [e⁻²]; 0 without noise."""
    if frame.seed is None:
        return 0.0
    return frame.mean_electrons + float(frame.metadata.get("RDNOISE", 0.0)) ** 2


def _no_pixels() -> InputError:
    return InputError("good pixels", 0, "at least one in which all frames have a value")


@numba.njit(cache=True, fastmath={"contract"})
def _load(
    values: NDArray, first: NDArray, offset: float, row: NDArray
) -> None:  # pragma: no cover - compiled
    """One frame less the first and less an offset."""
    for k in range(values.size):
        row[k] = np.float64(values[k]) - np.float64(first[k]) - offset


@numba.njit(cache=True, fastmath={"contract"})
def _load_and_add(
    values: NDArray, first: NDArray, offset: float, row: NDArray, total: NDArray
) -> None:  # pragma: no cover - compiled
    """One frame less the first and less an offset; what is no number spoils the sum over frames."""
    for k in range(values.size):
        value = np.float64(values[k]) - np.float64(first[k]) - offset
        row[k] = value
        total[k] += value


@numba.njit(cache=True, fastmath={"contract"})
def _add_first(
    total: NDArray, count: int, first: NDArray, offset: float, unit: float, good: NDArray, mean: NDArray
) -> None:  # pragma: no cover - compiled
    """Mean frame from the sum of the differences from the first frame."""
    of_total, of_first = 1.0 / (count * unit), 1.0 / unit
    for k in range(good.size):
        value = total[k] * of_total + (np.float64(first[k]) - offset) * of_first
        mean[k] = value if good[k] else 0.0


@numba.njit(cache=True)
def _drop(total: NDArray, good: NDArray, tile: NDArray) -> None:  # pragma: no cover - compiled
    """Take out pixels that are masked or without a value in some frame."""
    # Nearly always there are none, which is quickly seen.
    usable = 0
    for k in range(good.size):
        usable += good[k] & (abs(total[k]) < np.inf)
    if usable == good.size:
        return
    for k in range(good.size):
        if not (good[k] and np.isfinite(total[k])):
            good[k] = False
            total[k] = 0.0
            for number in range(tile.shape[0]):
                tile[number, k] = 0.0


@numba.njit(cache=True, fastmath={"contract", "reassoc", "nsz"})
def _add_products(tile: NDArray, used: int, total: NDArray) -> None:  # pragma: no cover - compiled
    """Add the products of all frames to the upper half of a Gram matrix, four by four frames at a time.

    Sixteen sums stay in registers while eight rows pass, so that every number that is read enters four products.
    """
    for begin in range(0, used, _CHUNK):
        end = min(begin + _CHUNK, used)
        for i in range(0, tile.shape[0], 4):
            a, b, c, d = (
                tile[i, begin:end],
                tile[i + 1, begin:end],
                tile[i + 2, begin:end],
                tile[i + 3, begin:end],
            )
            for j in range(i, tile.shape[0], 4):
                e, f, g, h = (
                    tile[j, begin:end],
                    tile[j + 1, begin:end],
                    tile[j + 2, begin:end],
                    tile[j + 3, begin:end],
                )
                ae = af = ag = ah = be = bf = bg = bh = 0.0
                ce = cf = cg = ch = de = df = dg = dh = 0.0
                for k in range(end - begin):
                    ae += a[k] * e[k]
                    af += a[k] * f[k]
                    ag += a[k] * g[k]
                    ah += a[k] * h[k]
                    be += b[k] * e[k]
                    bf += b[k] * f[k]
                    bg += b[k] * g[k]
                    bh += b[k] * h[k]
                    ce += c[k] * e[k]
                    cf += c[k] * f[k]
                    cg += c[k] * g[k]
                    ch += c[k] * h[k]
                    de += d[k] * e[k]
                    df += d[k] * f[k]
                    dg += d[k] * g[k]
                    dh += d[k] * h[k]
                total[i, j] += ae
                total[i, j + 1] += af
                total[i, j + 2] += ag
                total[i, j + 3] += ah
                total[i + 1, j] += be
                total[i + 1, j + 1] += bf
                total[i + 1, j + 2] += bg
                total[i + 1, j + 3] += bh
                total[i + 2, j] += ce
                total[i + 2, j + 1] += cf
                total[i + 2, j + 2] += cg
                total[i + 2, j + 3] += ch
                total[i + 3, j] += de
                total[i + 3, j + 1] += df
                total[i + 3, j + 2] += dg
                total[i + 3, j + 3] += dh
