"""What a model of the sky's fringes may have wrong in all frames alike: another envelope of the fringes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..array_types import FloatArray
from ..errors import named_units

__all__ = ["Envelope", "ModelError"]

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
        return np.asarray(
            self.amplitude(bands) * np.concatenate([tents * np.cos(phase), tents * np.sin(phase)])
        )

    def amplitude(self, bands: FloatArray) -> float:
        """Amplitude of the fringes of the dark sky."""
        return math.sqrt(2.0) * float(bands.sum(axis=0).std())


@dataclass(frozen=True, eq=False)
class ModelError:
    """Coefficients of an envelope that the frames of a night share, the levels of each frame being free.

    Attributes
    ----------
    envelope : `Envelope`
        What is fitted.
    coefficient, inverse : `numpy.ndarray`, shapes ``(J,)`` and ``(J, J)``
        The coefficients, and their covariance.
    strength : `numpy.ndarray`, shape ``(F,)``
        Fringes of every frame over those of the dark sky.
    beside : `list` of `numpy.ndarray`, shape ``(J, terms)``
        Products of the envelope with the other terms in every frame.
    gain, log_volume : `float`
        By how much half the χ² falls, and the log of the volume that the coefficients take.
    """

    envelope: Envelope
    coefficient: FloatArray
    inverse: FloatArray
    strength: FloatArray
    beside: list[FloatArray]
    gain: float
    log_volume: float

    @classmethod
    def of(
        cls,
        envelope: Envelope,
        sums: tuple[FloatArray, FloatArray],
        levels: FloatArray,
        inverses: Sequence[FloatArray],
        strength: FloatArray,
    ) -> ModelError:
        """From products of all terms in every frame, those of the envelope last, with each other and with the values.

        ``levels`` and ``inverses``: of the other terms, and their covariances.
        """
        size, own = envelope.size, 2 * envelope.nodes_um.size
        normal, side, beside = np.eye(own) / size**2, np.zeros(own), []
        for product, moment, level, inverse, part in zip(*sums, levels, inverses, strength, strict=True):
            beside.append(product[-own:, :-own])
            normal += part**2 * (product[-own:, -own:] - beside[-1] @ inverse @ beside[-1].T)
            side += part * (moment[-own:] - beside[-1] @ level)
        covariance = np.asarray(np.linalg.inv(normal))
        coefficient = covariance @ side
        log_volume = -0.5 * float(np.linalg.slogdet(size**2 * normal)[1])
        gain = 0.5 * float(side @ coefficient)
        return cls(envelope, coefficient, covariance, strength, beside, gain, log_volume)

    def change(self, frame: int, inverse: FloatArray) -> FloatArray:
        """What the envelope changes in the levels of a frame."""
        return np.asarray(-self.strength[frame] * inverse @ (self.beside[frame].T @ self.coefficient))

    def cross(self, sums: FloatArray, frame: int, crossed: FloatArray) -> FloatArray:
        """Products of splines with the terms in a frame, its levels being free, ``(splines, J)``.

        ``sums``: those with the terms themselves. ``crossed``: those with the design, times its covariance.
        """
        return np.asarray(self.strength[frame] * (sums - crossed @ self.beside[frame].T))
