"""The electronics of a mock sensor: from charge to the integers of a raw frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..array_types import Float32Array, FloatArray
from ..errors import InputError
from ..instrument.camera import Amplifier, Detector, RawSegment
from .hidden_effects import AmplifierState, HiddenEffect

ActiveEffects = Sequence[tuple[HiddenEffect, dict[str, float]]]

ADC_MAXIMUM = 2**18 - 1  # Largest number of the 18-bit converters [ADU]

BIAS_LEVEL_ADU = (27_000.0, 300.0)
"""Mean and scatter between amplifiers of the level without signal [ADU]; TS8 frames show about 27 000."""

ROW_DRIFT_ADU = 0.5  # Rms of the slow wander of the level from row to row [ADU]
BIAS_PATTERN_ADU = 1.0  # Rms of the fixed pattern of the columns of an amplifier [ADU]
BIAS_RAMP = (4.0, 12.0)  # Height [ADU] and length [px] of the settling of the output at the start of each row

DEFERRED_CHARGE = (2e-4, 0.25)
"""Part of the last pixel's charge found in the first overscan pixel, and ratio from one pixel to the next."""


@dataclass(frozen=True, eq=False)
class Readout:
    """The electronics of one sensor: what it adds to the charge, in the order of the raw file."""

    sensor: Detector
    states: tuple[AmplifierState, ...]
    level_adu: tuple[float, ...]
    pattern_adu: tuple[FloatArray, ...]

    @classmethod
    def of(cls, sensor: Detector, states: tuple[AmplifierState, ...], rng: np.random.Generator) -> Readout:
        """Electronics with random levels and column patterns."""
        levels = rng.normal(*BIAS_LEVEL_ADU, size=len(sensor.amplifiers))
        patterns = tuple(_column_pattern(raw_segment(amp).shape[1], rng) for amp in sensor.amplifiers)
        return cls(sensor, states, tuple(levels.tolist()), patterns)

    def read(
        self, electrons: FloatArray, seconds: float, active: ActiveEffects, rng: np.random.Generator
    ) -> list[NDArray[np.int32]]:
        """Raw images of all amplifiers, without charge in 0 s; each has its own stream of random numbers."""
        streams = rng.spawn(len(self.sensor.amplifiers))

        def one(number: int) -> NDArray[np.int32]:
            amp = self.sensor.amplifiers[number]
            view = electrons[amp.section][:: -1 if amp.flip_y else 1, :: -1 if amp.flip_x else 1]
            return self._read_amplifier(number, view, seconds, active, streams[number])

        # The random number generators work without the interpreter lock.
        with ThreadPoolExecutor(max_workers=2) as pool:
            return list(pool.map(one, range(len(streams))))

    def _read_amplifier(
        self,
        number: int,
        electrons: FloatArray,
        seconds: float,
        active: ActiveEffects,
        rng: np.random.Generator,
    ) -> NDArray[np.int32]:
        state = self.states[number]
        segment = raw_segment(self.sensor.amplifiers[number])
        image = np.zeros(segment.shape, dtype=np.float32)
        if seconds > 0.0:
            charge = rng.poisson(electrons + state.dark_signal_e(seconds)).astype(np.float64)
            np.minimum(charge, state.saturation_e, out=charge)
            for effect, values in active:
                if effect.on_charge is not None:
                    charge = effect.on_charge(charge, effect.complete(values))
            charge += state.offset_e
            _place_charge(image, charge, segment)
        image += np.float32(state.read_noise_e) * rng.standard_normal(image.shape, dtype=np.float32)
        image *= np.float32(1.0 / state.gain)
        image += (self.level_adu[number] + self.pattern_adu[number]).astype(np.float32)
        image += _row_drift(image.shape[0], rng).astype(np.float32)[:, np.newaxis]
        np.rint(image, out=image)
        np.clip(image, 0, ADC_MAXIMUM, out=image)
        return image.astype(np.int32)


def raw_segment(amp: Amplifier) -> RawSegment:
    """Layout of the raw image of an amplifier, which must have one."""
    if amp.raw is None:
        raise InputError("amplifier", amp.name, "an amplifier in the LSST raw layout")
    return amp.raw


def _place_charge(image: Float32Array, charge: FloatArray, segment: RawSegment) -> None:
    """Put the charge into the imaging section, and what transfer leaves behind into the overscans."""
    rows = slice(segment.data_y0, segment.data_y0 + charge.shape[0])
    columns = slice(segment.data_x0, segment.data_x0 + charge.shape[1])
    image[rows, columns] = charge
    part, ratio = DEFERRED_CHARGE
    trail = part * ratio ** np.arange(6)
    reach_x = min(len(trail), image.shape[1] - columns.stop)
    image[rows, columns.stop : columns.stop + reach_x] = charge[:, -1:] * trail[:reach_x]
    reach_y = min(len(trail), image.shape[0] - rows.stop)
    image[rows.stop : rows.stop + reach_y, columns] = charge[-1:] * trail[:reach_y, np.newaxis]


def _column_pattern(width: int, rng: np.random.Generator) -> FloatArray:
    """Fixed pattern along a row: settling at its start, and a small random offset of every column [ADU]."""
    height, length = BIAS_RAMP
    settling = height * np.exp(-np.arange(width) / length)
    return settling + BIAS_PATTERN_ADU * rng.standard_normal(width)


def _row_drift(rows: int, rng: np.random.Generator) -> FloatArray:
    """Wander of the level from row to row, common to imaging pixels and overscan [ADU]."""
    steps = rng.standard_normal(rows)
    memory = 0.98
    drift = np.empty(rows)
    value = steps[0]
    for row in range(rows):
        value = memory * value + math.sqrt(1.0 - memory**2) * steps[row]
        drift[row] = value
    return ROW_DRIFT_ADU * drift
