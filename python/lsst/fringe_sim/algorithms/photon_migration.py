"""How far photons walk inside the silicon before they are absorbed (section 4.2 and Figure 11).

A ray that enters under an angle is refracted towards the normal and absorbed at some depth; sideways it has then
moved by depth times refracted slope. Only the first passage counts here: what returns from the back of the sensor is
the fringe itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import convolve

from ..array_types import Float32Array, FloatArray
from ..errors import InputError, OutOfRangeError
from ..instrument.sky import SpectralComponent
from ..instrument.telescope import RayBundle
from ..optics import LayerStack

_DEPTHS = 256  # Equally probable depths that stand for the distribution of depth

_RAYS = 4000
"""Rays that stand for a bundle, taken from its order by the golden ratio: equal steps would meet the same spokes of
the pupil again and again."""

_DEPTH_STEP_UM = 0.02


@dataclass(frozen=True, eq=False)
class PhotonMigration:
    """Depths of absorption and refracted slopes, independent of each other."""

    depth_um: FloatArray  # (D,): equally probable depths of absorption, ascending
    # slope_x, slope_y (R,): slopes dx/dz and dy/dz inside the silicon of equally probable rays
    slope_x: FloatArray
    slope_y: FloatArray

    def fraction_inside(self, half_width_um: float) -> float:
        """Share of the absorbed photons that end within a square around their point of entry."""
        if not half_width_um > 0.0:
            raise OutOfRangeError("half width [um]", half_width_um, "positive")
        steepest = np.maximum(np.abs(self.slope_x), np.abs(self.slope_y))
        with np.errstate(divide="ignore"):
            deepest = half_width_um / steepest
        return float(np.searchsorted(self.depth_um, deepest, side="right").mean() / self.depth_um.size)

    def sample(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Random photons that entered at the origin.

        Returns (count, 3).
        """
        depth = self.depth_um[rng.integers(self.depth_um.size, size=count)]
        ray = rng.integers(self.slope_x.size, size=count)
        return np.stack([self.slope_x[ray] * depth, self.slope_y[ray] * depth, depth], axis=1)

    def pixel_kernel(self, pixel_um: float, reach_px: int = 3) -> FloatArray:
        """Where the photons of a uniformly lit pixel are absorbed.

        Returns (2 reach + 1, 2 reach + 1): shares by pixel ``[y, x]``; they sum to 1.
        """
        if not pixel_um > 0.0 or reach_px < 1:
            raise OutOfRangeError("pixel pitch [um] and reach [px]", (pixel_um, reach_px), "positive")
        kernel = np.zeros((2 * reach_px + 1, 2 * reach_px + 1))
        for depth in self.depth_um:
            kernel += (
                _overlap(self.slope_y * depth / pixel_um, reach_px)
                @ _overlap(self.slope_x * depth / pixel_um, reach_px).T
            )
        kernel /= self.depth_um.size * self.slope_x.size
        if kernel.sum() < 1.0 - 1e-3:
            raise OutOfRangeError("reach of the kernel [px]", reach_px, "more pixels for these slopes")
        return kernel / kernel.sum()


def photon_migration(
    rays: RayBundle, light: Sequence[SpectralComponent], stack: LayerStack, temperature_k: float
) -> PhotonMigration:
    """Walk of the photons of a sky in the detection layer.

    ``rays``: directions at a place of the focal plane.
    """
    if not light or not sum(float(item.photons.sum()) for item in light) > 0.0:
        raise InputError("light", "none", "components with photons")
    wavelength = np.concatenate([item.wavelength_nm for item in light])
    photons = np.concatenate([item.photons for item in light])
    medium = stack.layers[stack.position("detection")]
    index = medium.medium.index(wavelength, temperature_k)
    total = rays.slope_x.size
    golden = 0.5 * (math.sqrt(5.0) - 1.0)
    chosen = (
        np.arange(total) if total <= _RAYS else (np.mod(np.arange(_RAYS) * golden, 1.0) * total).astype(int)
    )
    tangent = np.hypot(rays.slope_x[chosen], rays.slope_y[chosen])
    mean_index = float(photons @ index.real / photons.sum())
    sine = tangent / np.sqrt(1.0 + tangent**2) / mean_index
    refracted = np.divide(
        sine / np.sqrt(1.0 - sine**2), tangent, out=np.zeros_like(tangent), where=tangent > 0.0
    )
    slant = float(np.mean(1.0 / np.sqrt(1.0 - sine**2)))
    absorption = 4.0 * np.pi * index.imag / (1e-3 * wavelength) * slant
    return PhotonMigration(
        _depth_quantiles(absorption, photons, medium.thickness_um),
        rays.slope_x[chosen] * refracted,
        rays.slope_y[chosen] * refracted,
    )


def spread_charge(image: ArrayLike, kernel: ArrayLike) -> Float32Array:
    """Frame after photons have walked to neighbouring pixels; edges repeat the outermost pixels.

    ``image`` (ny, nx).
    """
    values = np.asarray(image, dtype=np.float32)
    if values.ndim != 2:
        raise InputError("shape of the image", values.shape, "two axes (y, x)")
    return np.asarray(convolve(values, np.asarray(kernel, dtype=np.float32), mode="nearest"))


def _depth_quantiles(absorption_um: FloatArray, photons: FloatArray, thickness_um: float) -> FloatArray:
    """Depths of equal probability of photons absorbed above ``thickness_um``."""
    depth = np.linspace(0.0, thickness_um, math.ceil(thickness_um / _DEPTH_STEP_UM) + 1)
    # Absorption coefficients vary smoothly with wavelength: bins of their logarithm keep the sum small.
    edges = np.linspace(np.log(absorption_um.min()), np.log(absorption_um.max()) + 1e-12, 257)
    place = np.clip(np.digitize(np.log(absorption_um), edges) - 1, 0, 255)
    share = np.bincount(place, photons, 256)
    mean = np.bincount(place, photons * absorption_um, 256)
    filled = share > 0.0
    absorbed = share[filled] @ -np.expm1(-np.outer(mean[filled] / share[filled], depth))
    return np.interp((np.arange(_DEPTHS) + 0.5) / _DEPTHS * absorbed[-1], absorbed, depth)


def _overlap(shift_px: FloatArray, reach: int) -> FloatArray:
    """Share of a unit pixel that a shift moves onto each pixel of a row, shape ``(2 reach + 1, N)``."""
    pixel = np.arange(-reach, reach + 1)[:, np.newaxis]
    return np.clip(1.0 - np.abs(shift_px[np.newaxis, :] - pixel), 0.0, 1.0)
