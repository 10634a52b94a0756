"""What a model of the sky's fringes may have wrong in all frames alike: another envelope of the fringes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import named_units

__all__ = ["Envelope", "ModelError"]

FloatArray = NDArray[np.float64]

SPACING_ORDERS = 3.0
"""Distance of the thicknesses between which an error of the envelope changes [orders]: lines of a y band differ in
wavelength by up to a seventh, so that their fringes go once through all phases relative to each other in seven."""

SIZES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Errors of the envelope that compete, over the fringes of the dark sky."""


@named_units
@dataclass(frozen=True, eq=False)
class Envelope:
    """Errors of the fringes: cosine and sine of their phase times tents over the thickness.

    Attributes
    ----------
    size : `float`
        Standard deviation of each coefficient, over the amplitude of the fringes of the dark sky; 0 for none.
    order_um : `float`
        Thickness of one fringe order [µm].
    nodes_um : `numpy.ndarray`
        Thicknesses at the tops of the tents [µm].
    """

    size: float
    order_um: float
    nodes_um: FloatArray

    @classmethod
    @named_units
    def of(cls, size: float, layer_um: FloatArray, order_um: float) -> Envelope:
        """For the thicknesses of a map."""
        low, high = float(layer_um.min()), float(layer_um.max())
        number = 2 + math.ceil((high - low) / (SPACING_ORDERS * order_um))
        return cls(size, order_um, np.linspace(low, high, number))

    @named_units
    def terms(self, thickness_um: FloatArray, bands: FloatArray) -> FloatArray:
        """Functions of the thickness of every pixel, shape ``(J, pixels)``, of the amplitude of the fringes."""
        phase = 2.0 * math.pi / self.order_um * thickness_um.ravel()
        step = self.nodes_um[1] - self.nodes_um[0]
        place = np.clip((thickness_um.ravel() - self.nodes_um[0]) / step, 0.0, self.nodes_um.size - 1.0)
        tents = np.maximum(0.0, 1.0 - np.abs(place - np.arange(self.nodes_um.size)[:, None]))
        amplitude = math.sqrt(2.0) * float(bands.sum(axis=0).std())
        return np.asarray(amplitude * np.concatenate([tents * np.cos(phase), tents * np.sin(phase)]))


@dataclass(eq=False)
class ModelError:
    """Sums over frames, from which the coefficients of an envelope follow, the levels of each frame being free."""

    envelope: Envelope
    terms: FloatArray
    _weighted: list[FloatArray] = field(default_factory=list)
    _beside: list[FloatArray] = field(default_factory=list)
    strength: list[float] = field(default_factory=list)
    coefficient: FloatArray = field(default_factory=lambda: np.zeros(0))
    inverse: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def add(self, weight: FloatArray, design: FloatArray, strength: float) -> None:
        """Take a frame in: weight of its pixels, its own terms, its fringes over those of the dark sky."""
        weighted = self.terms * weight.ravel()
        self._weighted.append(weighted)
        self._beside.append(weighted @ design.T)
        self.strength.append(strength)

    def solve(self, residuals: Sequence[FloatArray], inverses: Sequence[FloatArray]) -> tuple[float, float]:
        """Find the coefficients; returned is by how much half the χ² falls, and the log of the volume they take."""
        size = self.envelope.size
        normal, side = np.eye(len(self.terms)) / size**2, np.zeros(len(self.terms))
        for weighted, beside, strength, residual, inverse in zip(
            self._weighted, self._beside, self.strength, residuals, inverses, strict=True
        ):
            normal += strength**2 * (weighted @ self.terms.T - beside @ inverse @ beside.T)
            side += strength * weighted @ residual.ravel()
        self.inverse = np.asarray(np.linalg.inv(normal))
        self.coefficient = self.inverse @ side
        log_volume = -0.5 * float(np.linalg.slogdet(size**2 * normal)[1])
        return 0.5 * float(side @ self.coefficient), log_volume

    def taken(self, frame: int, inverse: FloatArray, design: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What the envelope changes in the levels of a frame, and what is to be taken off its residual."""
        strength = self.strength[frame]
        change = -strength * inverse @ (self._beside[frame].T @ self.coefficient)
        return change, strength * self.coefficient @ self.terms + change @ design

    def cross(self, sums: FloatArray, frame: int, crossed: FloatArray) -> FloatArray:
        """Products of splines with the terms in a frame, its levels being free, ``(splines, J)``.

        ``sums``: those with the terms themselves. ``crossed``: those with the design, times its covariance.
        """
        return np.asarray(self.strength[frame] * (sums - crossed @ self._beside[frame].T))
