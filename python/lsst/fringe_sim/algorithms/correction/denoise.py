"""Noise taken out of a template: waves that stand above it are kept, window by window."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.ndimage import uniform_filter

from ...array_types import BoolArray, Float32Array

__all__ = ["shrink_noise"]

WINDOW_PX = 128
"""Side of the windows in which fringes are sought as waves; within one they change little in direction and length."""

THRESHOLD = 3.0
"""Power over that of the noise, averaged over 3 x 3 waves, below which all is noise. Of pure noise 1.8 % of
the standard deviation pass; what is left of noise and of fringes together is the same from 2.5 to 3.5."""

FILLINGS = 4  # Times that pixels without a value get the one that the others let expect


def shrink_noise(
    pattern: NDArray[Any], variance: NDArray[Any], known: BoolArray
) -> tuple[Float32Array, float]:
    """What is expected of a pattern of fringes, given a noisy measurement of it.

    Parameters
    ----------
    pattern : `numpy.ndarray`, shape ``(ny, nx)``
        Measured pattern.
    variance : `numpy.ndarray`, shape ``(ny, nx)``
        Variance of its white noise.
    known : `numpy.ndarray` of `bool`
        Pixels that have a value; the others get what the known ones let expect.

    Returns
    -------
    pattern : `numpy.ndarray`, float32, shape ``(ny, nx)``
        The pattern without most of its noise.
    kept : `float`
        Part of the variance of the noise that is left in it.

    Notes
    -----
    In windows that overlap by half, a wave of power P (the mean of it and its eight neighbours) where noise has N is
    multiplied by ``1 - 3 N / P``, or by 0 if that is negative: James and Stein's rule for blocks, with the threshold
    that Cai (1999, Annals of Statistics 27, 898) puts into it.
    """
    if not known.any():
        return np.zeros(pattern.shape, dtype=np.float32), 0.0
    noise = float(variance[known].mean(dtype=np.float64))
    windows = _Windows(known, noise)
    filled = np.where(known, pattern, np.float32(0.0)).astype(np.float32)
    expected = windows.shrink(filled)
    if not known.all():
        for _ in range(FILLINGS - 1):
            expected = windows.shrink(np.where(known, filled, expected), again=True)
    return expected, windows.kept


class _Windows:
    """Windows over an image that is reflected at its edges, so that every pixel lies in four, whose squares sum to 1.

    When the pixels without a value are filled once more, only windows in which there are such are worked out again.
    """

    def __init__(self, known: BoolArray, noise: float) -> None:
        self.size = min(WINDOW_PX, 2 * (min(known.shape) // 2))
        bell = np.sin(np.pi * (np.arange(self.size) + 0.5) / self.size)
        self.window = np.outer(bell, bell).astype(np.float32)
        self.floor = np.float32(THRESHOLD * float((bell**2).sum() ** 2) * noise)
        self.inside = tuple(slice(self.size // 2, self.size // 2 + side) for side in known.shape)
        half = self.size // 2
        self.padding = [(half, self.size + (-side) % half) for side in known.shape]
        gaps = np.pad(~known, self.padding, mode="symmetric")
        self.places = [range(0, side - self.size + 1, half) for side in gaps.shape]
        self.gaps = [
            [x for x in self.places[1] if gaps[y : y + self.size, x : x + self.size].any()]
            for y in self.places[0]
        ]
        self.total = np.zeros(gaps.shape, dtype=np.float32)
        self.last: dict[tuple[int, int], Float32Array] = {}
        self.gains: list[float] = []

    @property
    def kept(self) -> float:
        """Part of the variance of the noise that is left."""
        return float(np.mean(self.gains))

    def shrink(self, image: Float32Array, *, again: bool = False) -> Float32Array:
        """The image without most of its noise."""
        padded = np.pad(image, self.padding, mode="symmetric")
        for y, gaps in zip(self.places[0], self.gaps, strict=True):
            columns = gaps if again else list(self.places[1])
            if columns:
                for x, made in zip(columns, self._row(padded, y, columns), strict=True):
                    place = np.s_[y : y + self.size, x : x + self.size]
                    self.total[place] += made - self.last.get((y, x), np.float32(0.0))
                    if x in gaps:
                        self.last[y, x] = made
        return self.total[self.inside]

    def _row(self, padded: Float32Array, y: int, columns: list[int]) -> Float32Array:
        pieces = np.stack([padded[y : y + self.size, x : x + self.size] for x in columns])
        wave = rfft2(pieces * self.window)
        power = uniform_filter(wave.real**2 + wave.imag**2, (1, 3, 3), mode=("nearest", "wrap", "nearest"))
        gain = np.maximum(np.float32(0.0), 1.0 - self.floor / np.maximum(power, np.float32(1e-30)))
        self.gains.append(float(np.mean(np.square(gain), dtype=np.float64)))
        return np.asarray(irfft2(gain * wave, s=(self.size, self.size)) * self.window)
