"""How much of the fringes a correction leaves, by the power of the residual at the waves of the template."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2

from ...array_types import BoolArray, Float32Array, FloatArray
from .objects import square_sums
from .scales import ScaleFit

__all__ = ["PartLeft", "part_left"]

Window = Float32Array
Sums = tuple[FloatArray, FloatArray]

WINDOW_PX, WINDOWS_A_SIDE = 128, 6
"""Side of the windows in which fringes are waves of few directions and lengths; in small frames it is a sixth of the
shorter side, so that the scatter between windows tells the error."""


BINNED_PX = 2
"""Side of the squares that are added first where windows are as large as that: fringes are longer than 4 px."""


@dataclass(frozen=True)
class PartLeft:
    """Square of the part of the fringes that is left; noise may make it negative.

    Attributes
    ----------
    square, variance : `float`
        Variance of the fringes that are left over that of the fringes that were subtracted, and the variance of this
        number.
    """

    square: float
    variance: float

    @property
    def value(self) -> float:
        """The part that is left."""
        return math.sqrt(max(self.square, 0.0))

    @property
    def sigma(self) -> float:
        """How much larger the part is if its square is larger by one standard deviation."""
        return math.sqrt(max(self.square, 0.0) + math.sqrt(self.variance)) - self.value


def part_left(
    residual: Float32Array,
    fringes: Float32Array,
    used: BoolArray,
    fit: ScaleFit,
    information: FloatArray,
    noise: Sequence[NDArray[Any]] = (),
) -> PartLeft:
    """Compare the residual with the fringes that were subtracted.

    Parameters
    ----------
    residual, fringes : `numpy.ndarray`, shape ``(ny, nx)``
        What is left, and what was subtracted.
    used : `numpy.ndarray` of `bool`
        Pixels without objects and defects.
    fit : `ScaleFit`
        Scales and their covariance.
    information : `numpy.ndarray`, shape ``(K, K)``
        Sums of products of the templates beside the background.
    noise : sequence of `numpy.ndarray`, optional
        Variance of the noise that the templates print into the frame, one of them each.

    Notes
    -----
    In each window the power of the residual is added over waves with the power of the fringes as weight, and that of
    the same waves turned by 90 degrees is subtracted: noise, and the round images of faint objects, have as much of
    one as of the other. A map that is wrong moves fringes, and leaves waves of their length and direction. What
    the errors of the scales leave is no part of this power, because the fit has made the residual orthogonal to the
    templates; it is added from the covariance of the scales. The noise of the templates has no direction either,
    and is added from their variance. Where noise was taken out of templates (`shrink_noise`), fringes of about the
    same power went with it, of which nobody knows how much: the error of this term is as large as the term.
    """
    of_residual, of_fringes = _oriented_power(residual, fringes, used)
    total = float(of_fringes.sum())
    if not total > 0.0:
        return PartLeft(math.nan, math.nan)
    square = float(of_residual.sum()) / total
    number = of_fringes.size
    scatter = float(np.square(of_residual - square * of_fringes).sum()) * number / (number - 1)
    spread = fit.covariance @ information / float(fit.scale @ information @ fit.scale)
    from_scales = float(np.trace(spread)), 2.0 * float(np.trace(spread @ spread))
    printed = sum(float(each.mean(where=used, dtype=np.float64)) for each in noise)
    printed /= float(fringes.var(where=used, dtype=np.float64))
    variance = scatter / total**2 + from_scales[1] + printed**2
    return PartLeft(square + from_scales[0] + printed, variance)


def _oriented_power(residual: Window, fringes: Window, used: BoolArray) -> Sums:
    """Power of residual and of fringes, in each window, at the waves of the fringes less that across them."""
    side = 2 * (min(WINDOW_PX, min(used.shape) // WINDOWS_A_SIDE) // 2)
    residual, fringes = (np.where(used, each, np.float32(0.0)) for each in (residual, fringes))
    if side == WINDOW_PX:
        residual, fringes = (square_sums(each, BINNED_PX) for each in (residual, fringes))
        side //= BINNED_PX
    bell = np.sin(np.pi * (np.arange(side) + 0.5) / side).astype(np.float32)
    window = np.outer(bell, bell)
    found: list[tuple[float, float]] = []
    for y in range(0, residual.shape[0] - side + 1, side):
        for x in range(0, residual.shape[1] - side + 1, side):
            place = np.s_[y : y + side, x : x + side]
            both = np.empty((side, side), dtype=np.complex64)
            both.real, both.imag = residual[place], fringes[place]
            both *= window
            found.append(_of_window(both))
    of_residual, of_fringes = np.array(found).T
    return of_residual, of_fringes


def _of_window(both: NDArray[np.complex64]) -> tuple[float, float]:
    """The same of one window, which has the residual as real and the fringes as imaginary part."""
    wave = fft2(both)
    # Minus the place of every wave, for the transforms of real images are conjugate there.
    opposite = np.roll(wave[::-1, ::-1], 1, axis=(0, 1)).conj()
    power = [np.square(np.abs(each)) / np.float32(4.0) for each in (wave + opposite, wave - opposite)]
    across = np.roll(power[1][::-1], 1, axis=0).T
    oriented = power[1] - across
    return tuple(float(np.vdot(oriented, each)) for each in power)  # type: ignore[return-value]
