"""What a hidden effect of the mock is, and what it may change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..array_types import FloatArray
from ..effects import Parameter
from ..effects.base import Described
from .optics import FlatFieldOptics

Values = Mapping[str, float]

RIM_SQUARES, RIM_POINTS = 8, 8
"""Squares along a side of a pixel that a rim crosses, and points along the side of each."""


@dataclass(frozen=True)
class AmplifierState:
    """What one amplifier really does, as opposed to what the tables say of it."""

    name: str  # ``C00`` … ``C17``
    gain: float  # gain [electrons per ADU]
    read_noise_e: float  # read noise [electrons rms]
    saturation_e: float
    dark_e: float = 0.0  # charge that gathers in every imaging pixel of a flat without being light
    # Level that the imaging pixels of a flat have and its overscan has not, without noise of its own
    offset_e: float = 0.0
    dark_rate_e: float = 0.0  # the same, in each second of the exposure [electrons / s]

    def dark_signal_e(self, seconds: float) -> float:
        """Charge without light of an exposure of so many seconds [electrons]."""
        return self.dark_e + self.dark_rate_e * seconds


@dataclass(frozen=True, eq=False)
class Island:
    """Where on a sensor something is."""

    part: FloatArray  # [y, x]: part of every pixel that lies on it
    # rows, columns (N,): pixels that its rim may cross
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    # (N, RIM_SQUARES, RIM_SQUARES): part of each of the equal squares in these pixels, along y and x,
    # that lies on it
    squares: FloatArray


@dataclass(frozen=True)
class HiddenEffect(Described):
    """An effect and the one or two places at which it acts.

    Attributes
    ----------
    name, title, parameters
        Those of the model's catalogue.
    on_optics : callable, optional
        ``(optics, values) -> optics``.
    on_island : callable, optional
        ``(shape, values) -> island``, the part of the sensor that sees what `on_optics` makes; by default all does.
    on_silicon : callable, optional
        ``(shape, values) -> thickness [y, x]``, what is added to the detection layer [µm].
    on_light : callable, optional
        ``(light [y, x], wavelength [nm], values) -> light``; the light is relative to its mean over the sensor.
    on_charge : callable, optional
        ``(electrons [y, x], values) -> electrons``, after the photon noise.
    on_amplifier : callable, optional
        ``(state, values, standard_normal) -> state``, with one normal deviate for each amplifier.
    """

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    on_optics: Callable[[FlatFieldOptics, Values], FlatFieldOptics] | None = None
    on_island: Callable[[tuple[int, int], Values], Island] | None = None
    on_silicon: Callable[[tuple[int, int], Values], FloatArray] | None = None
    on_light: Callable[[FloatArray, float, Values], FloatArray] | None = None
    on_charge: Callable[[FloatArray, Values], FloatArray] | None = None
    on_amplifier: Callable[[AmplifierState, Values, float], AmplifierState] | None = None

    def complete(self, values: Values) -> dict[str, float]:
        """Values of all parameters, null where none is given."""
        return {p.name: values.get(p.name, p.null) for p in self.parameters}


ActiveHiddenEffect = tuple[HiddenEffect, Mapping[str, float]]  # An effect and the values given for it
