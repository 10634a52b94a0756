"""Rings in a noisy map: a matched filter over all places of their centre."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from ..array_types import BoolArray, FloatArray
from ..blocks import block_sums
from ..compiled import kernel

FARTHEST_PX = 8000.0  # Distance of the centre from the middle of a sensor [px]: the radius of a wafer

SHORTEST_CELLS = 2.3
"""Shortest period that is looked for, in cells: with two, rings along rows or columns would be any other wave too."""

CLEARLY = 12.0
"""Power that a pattern must have over what the best of as many places has in noise, and over a plane wave: rings
that are not seen to be bent may be anything."""

FEWEST_CELLS = 500

SIDE_CELLS = 100  # Side of the map that is searched [cells]; the work grows with the fourth power of it


@dataclass(frozen=True)
class Rings:
    """A wave in the radius."""

    centre: tuple[float, float]  # Row and column of the centre [px]
    period: float  # Distance of rings [px]
    amplitude: complex  # Of cosine and sine of the phase, which is 0 in the middle of the sensor


@dataclass(frozen=True, eq=False)
class _Samples:
    """Values at places; ``cell`` is their distance [px]."""

    y: FloatArray
    x: FloatArray
    value: FloatArray
    cell: float

    @cached_property
    def across(self) -> float:
        return float(np.hypot(np.ptp(self.y), np.ptp(self.x)))

    @cached_property
    def middle(self) -> FloatArray:
        return 0.5 * np.array([self.y.min() + self.y.max(), self.x.min() + self.x.max()])

    @cached_property
    def variance(self) -> float:
        return float(self.value.var())

    def within(self, half: float) -> _Samples:
        """Those less than so far from the middle, along rows and columns."""
        near = (np.abs(self.y - self.middle[0]) < half) & (np.abs(self.x - self.middle[1]) < half)
        return _Samples(self.y[near], self.x[near], self.value[near], self.cell)

    def wave(self, centre: FloatArray, period: float, middle: FloatArray) -> complex:
        """Mean of the values with the phase of rings taken off."""
        radius = np.hypot(self.y - centre[0], self.x - centre[1]) - np.hypot(*(middle - centre))
        return complex((self.value * np.exp(2j * np.pi * radius / period)).mean())

    def power(self, wave: complex) -> float:
        """Power of a wave in units of that of noise: χ² of two degrees of freedom."""
        return 2.0 * self.value.size * abs(wave) ** 2 / self.variance


def find_rings(
    image: FloatArray, used: BoolArray, y_px: FloatArray, x_px: FloatArray, middle: FloatArray
) -> Rings | None:
    """The clearest rings in a map, if they are no noise and seen to be bent.

    Large maps are searched twice, averaged over larger cells and in a part of full resolution; where rings are found
    in a part, they are followed outwards.

    ``image`` ``(ny, nx)``: the map.
    ``used`` ``(ny, nx)``: where it has data.
    ``y_px``, ``x_px`` ``(ny,)``: rows and columns [px].
    ``middle`` ``(2,)``: row and column of the middle of the sensor.
    """
    if used.sum() < FEWEST_CELLS:
        return None
    whole = _samples(image, used, y_px, x_px)
    factor = min(math.ceil(max(image.shape) / SIDE_CELLS), *image.shape)
    if factor == 1:
        return _found_in(whole, whole, middle)
    return _found_in(_averaged(image, used, y_px, x_px, factor), whole, middle) or _found_in(
        whole.within(0.5 * SIDE_CELLS * whole.cell), whole, middle
    )


def _samples(image: FloatArray, used: BoolArray, y_px: FloatArray, x_px: FloatArray) -> _Samples:
    y, x = np.meshgrid(y_px, x_px, indexing="ij")
    cell = float(max(np.diff(y_px).max(initial=1.0), np.diff(x_px).max(initial=1.0)))
    return _Samples(y[used], x[used], image[used] - image[used].mean(), cell)


def _averaged(
    image: FloatArray, used: BoolArray, y_px: FloatArray, x_px: FloatArray, factor: int
) -> _Samples:
    """The map averaged over blocks of at least half of which are used."""
    rows, columns = image.shape[0] // factor, image.shape[1] // factor

    number = block_sums(used.astype(float), factor)
    mean = np.divide(
        block_sums(np.where(used, image, 0.0), factor), number, out=np.zeros(number.shape), where=number > 0
    )
    y, x = (
        place[: n * factor].reshape(n, factor).mean(axis=1) for place, n in ((y_px, rows), (x_px, columns))
    )
    return _samples(mean, number > 0.5 * factor**2, y, x)


def _found_in(part: _Samples, whole: _Samples, middle: FloatArray) -> Rings | None:
    """Rings that are clear in a part of the data, as all data have them."""
    if part.value.size < FEWEST_CELLS or not part.value.any():
        return None
    centres = _places(part)
    power, period = _strongest(part, centres)
    best = int(np.argmax(power))
    if power[best] < 2.0 * math.log(len(centres) * part.across / part.cell) + CLEARLY:
        return None
    centre, length = centres[best], float(period[best])
    reach = 0.5 * part.across
    while True:  # twice as far each time: what is known of a part says where the next rings lie
        wider = whole.within(reach)
        centre, length, bent = _refined(wider, centre, length, middle)
        if wider.value.size == whole.value.size:
            break
        reach *= 2.0
    if bent < CLEARLY:
        return None
    return Rings(
        (float(centre[0]), float(centre[1])), float(length), 2.0 * whole.wave(centre, length, middle)
    )


def _places(part: _Samples) -> FloatArray:
    """Centres close enough to one another that no ring of the shortest period is missed, ``(N, 2)``."""
    cell, across = part.cell, part.across
    near = np.arange(-across, across, 0.7 * SHORTEST_CELLS * cell)
    inside = np.stack(np.meshgrid(near, near, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = inside[np.hypot(*inside.T) < across]
    # Farther away, what counts is the direction and the curvature of the rings.
    curvature = np.arange(1.0 / FARTHEST_PX, 1.0 / across, 2.0 * SHORTEST_CELLS * cell / across**2)
    angle = np.arange(0.0, 2.0 * np.pi, 0.5 * SHORTEST_CELLS * cell / across)
    far = np.stack(
        [np.outer(1.0 / curvature, np.sin(angle)), np.outer(1.0 / curvature, np.cos(angle))], axis=-1
    )
    return np.concatenate([inside, far.reshape(-1, 2)]) + part.middle


def _strongest(part: _Samples, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest power of a wave in the radius about each centre, in units of that of noise, and its period [px]."""
    width = 0.5 * part.cell
    bins = int(2 ** math.ceil(math.log2(part.across / width + 2)))
    frequency = np.fft.rfftfreq(2 * bins, width)
    allowed = (frequency > 3.0 / part.across) & (frequency < 1.0 / (SHORTEST_CELLS * part.cell))
    unit = 2.0 / (part.value.size * part.variance)
    power, period = np.zeros(len(centres)), np.ones(len(centres))
    for first in range(0, len(centres), 1024):
        chunk = slice(first, first + 1024)
        sums = _radial_sums(part.y, part.x, part.value, centres[chunk], width, bins)
        spectrum = np.abs(np.fft.rfft(sums, 2 * bins, axis=1)[:, allowed]) ** 2 * unit
        power[chunk], period[chunk] = spectrum.max(axis=1), 1.0 / frequency[allowed][spectrum.argmax(axis=1)]
    return power, period


@kernel
def _radial_sums(
    y: FloatArray, x: FloatArray, value: FloatArray, centres: FloatArray, width: float, bins: int
) -> FloatArray:  # pragma: no cover - compiled
    """Sums of the values in rings about each centre, ``(N, bins)``, from the nearest sample on."""
    result = np.zeros((len(centres), bins))
    radius, scale = np.empty(y.size), 1.0 / width
    for n in range(len(centres)):
        nearest = np.inf
        for i in range(y.size):
            down, along = y[i] - centres[n, 0], x[i] - centres[n, 1]
            radius[i] = math.sqrt(down * down + along * along)
            nearest = min(nearest, radius[i])
        for i in range(y.size):
            result[n, int((radius[i] - nearest) * scale)] += value[i]
    return result


def _refined(
    part: _Samples, centre: FloatArray, period: float, middle: FloatArray
) -> tuple[FloatArray, float, float]:
    """Centre and period at the maximum of the power, and by how much that exceeds the power of a plane wave."""
    away = centre - part.middle
    distance, angle = float(np.hypot(*away)), float(np.arctan2(*away))
    step = np.array([part.cell, part.cell, 0.3 * period]) / part.across

    def at(unit: float, far: float) -> FloatArray:
        """Centre in a direction, in units of what the pattern notices."""
        turned = angle + unit * step[0]
        return part.middle + far * np.array([np.sin(turned), np.cos(turned)])

    def ring(unit: FloatArray) -> tuple[FloatArray, float]:
        return at(unit[0], max(distance * (1.0 + unit[1] * step[1]), 0.0)), period * (1.0 + unit[2] * step[2])

    def plane(unit: FloatArray) -> tuple[FloatArray, float]:
        return at(unit[0], 1e3 * FARTHEST_PX), period * (1.0 + unit[1] * step[2])

    def power(place: FloatArray, length: float) -> float:
        return part.power(part.wave(place, length, middle))

    found, length = _highest(ring, power, 3)
    return found, length, power(found, length) - power(*_highest(plane, power, 2))


def _highest(
    shape: Callable[[FloatArray], tuple[FloatArray, float]],
    power: Callable[[FloatArray, float], float],
    number: int,
) -> tuple[FloatArray, float]:
    """Centre and period of the strongest wave of some shapes near the first one."""
    found = minimize(
        lambda unit: -power(*shape(unit)),
        np.zeros(number),
        method="Nelder-Mead",
        options={"maxfev": 300, "xatol": 1e-3, "fatol": 1e-3,
                 "initial_simplex": np.vstack([np.zeros(number), np.eye(number)])},
    )  # fmt: skip
    return shape(found.x)
