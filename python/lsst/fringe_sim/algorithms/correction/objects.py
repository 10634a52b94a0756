"""Objects in a frame, found where background and fringes are subtracted, so that no fringe is taken for one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, label

from .background import BackgroundTerms
from .scales import ScaleFit, fit_scales, rounding_of

__all__ = ["FrameFit", "find_objects", "fit_frame"]

BoolArray = NDArray[np.bool_]

SCALES_PX = (0.0, 1.5, 5.0)
"""Widths of the kernels with which objects are looked for [px]: single pixels, stars, halos and galaxies."""

THRESHOLDS = (5.0, 4.0, 4.0)
"""Standard deviations above which they are; 4096² pixels of noise have about one above 5."""

LEAST_GROWTH_PX, GROWTH = 3.0, 0.5
"""An object is masked as far as 3 px and half the square root of its area around what is above the threshold."""

UNCHANGED = 1e-3
"""Part of the pixels of which no fit takes notice, below which objects count as the same."""

SAMPLE = 200_000
"""Pixels that tell a scatter to 0.2 %."""

BINNED_PX = 4
"""Pixels on a side that are averaged before the widest kernel."""

ROUNDS = 4
"""Rounds of fit and detection; fringes and background are those of pixels without the objects found so far."""


@dataclass(frozen=True, eq=False)
class FrameFit:
    """A frame taken apart.

    Attributes
    ----------
    fit : `ScaleFit`
        Scales and background.
    objects : `numpy.ndarray` of `bool`, shape ``(ny, nx)``
        Pixels of objects.
    background : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Background.
    residual : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Frame less background and fringes; 0 where the frame has no number.
    """

    fit: ScaleFit
    objects: BoolArray
    background: NDArray[np.float32]
    residual: NDArray[np.float32]


def fit_frame(
    image: NDArray[Any],
    weight: NDArray[np.float32],
    patterns: Sequence[NDArray[np.float32]],
    background: BackgroundTerms,
    *,
    known: BoolArray | None = None,
    rounds: int = ROUNDS,
) -> FrameFit:
    """Fit background and fringes, find the objects in what is left, and repeat without them.

    Parameters
    ----------
    image, weight, patterns, background
        See `fit_scales`.
    known : `numpy.ndarray` of `bool`, optional
        Pixels of objects that are known before.
    rounds : `int`, optional
        Most rounds; ends when the objects stay the same.

    Raises
    ------
    UndeterminedError
        Too few pixels are left, or the templates are not independent.
    """
    objects = np.zeros(weight.shape, dtype=bool) if known is None else known
    for _ in range(rounds):
        fit = fit_scales(image, np.where(objects, 0, weight), patterns, background)
        surface = background.surface(fit.coefficient)
        residual = np.where(weight > 0, image - surface, 0).astype(np.float32)
        for scale, pattern in zip(fit.scale, patterns, strict=True):
            residual -= np.float32(scale) * np.where(weight > 0, pattern, 0)
        found = find_objects(residual, weight, rounding_of(surface))
        if known is not None:
            found |= known
        changed = np.count_nonzero(found != objects)
        objects = found
        if changed <= UNCHANGED * objects.size:
            break
    return FrameFit(fit, objects, surface, residual)


def find_objects(
    residual: NDArray[np.float32], weight: NDArray[np.float32], rounding: float = 0.0
) -> BoolArray:
    """Pixels of objects, with what surrounds them.

    Parameters
    ----------
    residual : `numpy.ndarray`, shape ``(ny, nx)``
        Frame less background and fringes.
    weight : `numpy.ndarray`
        0 where a pixel says nothing.
    rounding : `float`, optional
        Scatter that is rounding: a frame without noise has no objects that could be told from it.
    """
    good = weight > 0
    objects = np.zeros(good.shape, dtype=bool)
    if not good.any() or _scatter(residual[good]) <= rounding:
        return objects
    for width, threshold in zip(SCALES_PX, THRESHOLDS, strict=True):
        # What is found already does not reach into the wider kernels.
        objects |= _grown(_above(residual, good & ~objects, width, threshold))
    return objects


def _above(residual: NDArray[np.float32], good: BoolArray, width: float, threshold: float) -> BoolArray:
    """Pixels in which the smoothed residual stands above its own scatter; below it where width is 0 as well."""
    values = np.where(good, residual, 0).astype(np.float32)
    if width == 0.0:
        return good & (np.abs(values) > threshold * _scatter(values[good]))
    binned = BINNED_PX if width > BINNED_PX else 1
    share, smooth = (_smooth(each, width, binned) for each in (good.astype(np.float32), values))
    seen = share > 0.25
    smooth /= np.maximum(share, 0.25)
    # White noise is the least there is: few independent places do not tell less.
    least = _scatter(values[good]) / (2.0 * math.sqrt(math.pi) * width)
    scatter = max(_scatter(smooth[seen]), least) / np.sqrt(np.maximum(share, 0.25))
    above = seen & (smooth > threshold * scatter)
    if binned > 1:
        above = above.repeat(binned, axis=0).repeat(binned, axis=1)
        above = above[: good.shape[0], : good.shape[1]]
    return above


def _smooth(image: NDArray[np.float32], width: float, binned: int) -> NDArray[np.float32]:
    """Gaussian average, of means over squares if ``binned`` is more than 1."""
    if binned > 1:
        padded = np.pad(image, [(0, -side % binned) for side in image.shape], mode="edge")
        blocks = padded.reshape(padded.shape[0] // binned, binned, -1, binned)
        image = blocks.mean(axis=(1, 3), dtype=np.float32)
    return np.asarray(gaussian_filter(image, width / binned, truncate=3.0))


def _scatter(values: NDArray[Any]) -> float:
    """Standard deviation from the quartile below the median: objects only add light."""
    sample = values[:: max(1, values.size // SAMPLE)]
    low, middle = np.percentile(sample, [25.0, 50.0]) if sample.size else (0.0, 0.0)
    return float(middle - low) / 0.6745


def _grown(above: BoolArray) -> BoolArray:
    """The same with what surrounds each object, further around large ones."""
    if not above.any():
        return above
    number, count = label(above, structure=np.ones((3, 3)))
    reach = LEAST_GROWTH_PX + GROWTH * np.sqrt(np.bincount(number.ravel(), minlength=count + 1))
    distance, nearest = distance_transform_edt(~above, return_indices=True)
    return np.asarray(distance <= reach[number[tuple(nearest)]])
