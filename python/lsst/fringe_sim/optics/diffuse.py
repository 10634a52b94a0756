"""Light that the gate side of a sensor sends back into the silicon in all directions."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import ComplexArray, FloatArray
from ..errors import named_units
from .stack import LayerStack
from .transfer_matrix import layer_absorption

__all__ = ["DiffuseReturn"]

NODES = 16  # Nodes of Gauss's rule between two critical angles, where the integrand is smooth

STEP_NM = 1.0
"""Spacing of the wavelengths between which the absorbed part is interpolated; tables of silicon have 5 nm."""


@dataclass(frozen=True)
class DiffuseReturn:
    """A gate side of which a part returns light evenly in cos θ dΩ (Lambert), and lets none pass.

    The plane wave loses that part whenever it passes: on the way down into diffuse light, on the way up into what
    lies below. The two are told apart by sharing the loss between two layers without thickness: with q² = 1 − R these
    take (1 − q)(D + q U) and (1 − q)(q D + U) of the light that comes down, D, and up, U.

    Attributes
    ----------
    upper, lower : `str`
        The two layers, below the detection layer and of its medium.
    reflectance : `float`
        Part of the gate side that returns light, R.
    total_reflection : `float`
        Part of the rest that is flat, and reflects diffuse light beyond the critical angle.
    """

    upper: str
    lower: str
    reflectance: float
    total_reflection: float = 0.0

    def attenuation(self, stack: LayerStack) -> FloatArray:
        """Logarithm of the power that a passage of every layer takes from the plane wave, shape ``(L,)``."""
        taken = np.zeros(len(stack.layers))
        taken[[stack.position(name) for name in (self.upper, self.lower)]] = -0.5 * np.log1p(
            -self.reflectance
        )
        return taken

    def returned(self) -> tuple[float, float]:
        """Factors on what the two layers take, whose sum is the light that comes down and is returned."""
        passed = np.sqrt(1.0 - self.reflectance)
        return float(1.0 / (1.0 - passed)), float(-passed / (1.0 - passed))

    @named_units
    def fate(
        self, stack: LayerStack, detection: str, wavelength_nm: ArrayLike, temperature_k: float
    ) -> tuple[FloatArray, FloatArray]:
        """Parts of the returned light that end in the detection layer, and that leave through the front.

        The rest is lost below the gate side. Each has the shape of the wavelengths.
        """
        from scipy.interpolate import CubicSpline

        wavelength = np.asarray(wavelength_nm, dtype=float)
        known = [layer.medium.wavelength_range_nm for layer in stack.layers]
        low = max(float(wavelength.min()) - STEP_NM, *(ends[0] for ends in known))
        high = min(float(wavelength.max()) + STEP_NM, *(ends[1] for ends in known))
        grid = np.linspace(low, high, max(4, int(np.ceil((high - low) / STEP_NM)) + 1))
        parts = self._fate_at(stack, stack.position(detection), grid, temperature_k)
        absorbed, escaped = (CubicSpline(grid, part)(wavelength) for part in parts)
        return absorbed, escaped

    def _fate_at(
        self, stack: LayerStack, detection: int, wavelength_nm: FloatArray, temperature_k: float
    ) -> tuple[FloatArray, FloatArray]:
        index = stack.indices(wavelength_nm, temperature_k)
        silicon, below = index[detection], stack.position(self.lower) + 1
        # Critical angles, at which the integrand has kinks: of the world outside, and of what lies below.
        # What is denser than silicon has none: the interval that is left to it has no weight.
        ratios = [np.minimum(index[end].real / silicon.real, 1.0 - 1e-9) for end in (below, 0)]
        kinks = [np.sqrt(1.0 - ratio**2) for ratio in ratios]
        cosine, share = _rule(np.sort(np.stack(kinks), axis=0))
        absorption = 4.0 * np.pi * silicon.imag / (1e-3 * wavelength_nm)
        once = np.exp(-absorption[:, np.newaxis] * stack.layers[detection].thickness_um / cosine)
        front = _front(stack, detection, index, wavelength_nm, cosine)
        flat = self.total_reflection * (cosine < kinks[0][:, np.newaxis])
        # Ways up and down that follow one another without being scattered again.
        ways = 1.0 / (1.0 - once**2 * front * (1.0 - self.reflectance) ** 2 * flat)
        taken, left, again = (
            (share * part * ways).sum(axis=1)
            for part in (
                (1.0 - once) * (1.0 + once * front),
                once * (1.0 - front),
                self.reflectance * once**2 * front,
            )
        )
        return taken / (1.0 - again), left / (1.0 - again)


def _rule(kinks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosines and weights, ``(W, nodes)``, of the mean over a Lambertian source; kinks ``(2, W)`` ascending."""
    x, w = np.polynomial.legendre.leggauss(NODES)
    zero, one = np.zeros(kinks.shape[1]), np.ones(kinks.shape[1])
    ends = [zero, *kinks, one]
    cosines, shares = [], []
    for low, high in itertools.pairwise(ends):
        half = 0.5 * (high - low)[:, np.newaxis]
        cosine = low[:, np.newaxis] + half * (1.0 + x)
        cosines.append(cosine)
        shares.append(2.0 * cosine * half * w)
    return np.concatenate(cosines, axis=1), np.concatenate(shares, axis=1)


def _front(
    stack: LayerStack,
    detection: int,
    index: ComplexArray,
    wavelength_nm: FloatArray,
    cosine: FloatArray,
) -> FloatArray:
    """Reflectance of all that lies before the detection layer, seen from within, ``(W, nodes)``."""
    order = list(range(detection, -1, -1))
    media = np.repeat(index[order][:, :, np.newaxis], cosine.shape[1], axis=2)
    media[0] = media[0].real  # a wave that comes from afar has not been absorbed
    depth = np.array([stack.layers[place].thickness_um for place in order])
    depth[0] = depth[-1] = np.inf
    wide = depth[:, np.newaxis, np.newaxis] * np.ones(cosine.shape)
    return layer_absorption(media, wide, 1e-3 * wavelength_nm[:, np.newaxis], np.arccos(cosine))[0]
