"""Is there a disagreement beyond noise, and where: score tests in channels that need no catalogue."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dctn, irfft2, next_fast_len, rfft2
from scipy.special import chdtrc, fdtrc, gammaincinv, gammaln

from ...array_types import BoolArray, FloatArray
from ...effects import AMPLIFIERS, ImageGeometry
from .columns import PlaneColumns

HARMONICS = 3
BANDS = 8  # Bands of spatial frequency in the test of texture
SPATIAL_ORDER = 4  # Cosine patterns up to this order along both axes together
MEDIAN_OF_SQUARE = 2.0 * float(gammaincinv(0.5, 0.5))  # Median of χ² of one degree of freedom


NEAREST_ECHO = 4
"""Cells below which a moved copy of the image is no echo: diffusion and thickness do that as well."""

LEAST_OVERLAP = 0.1  # Part of the image that a copy must share with the sensor

REACH = 12.0  # Terms of a mixture by Poisson on both sides of the largest [standard deviations]


@dataclass(frozen=True, eq=False)
class State:
    """A fit with all that the tests need."""

    slope: FloatArray  # (W, ny, nx): whitened derivative with respect to thickness
    residual: FloatArray  # (W, ny, nx): whitened residual
    raw_residual: FloatArray  # (W, ny, nx): data minus model, relative; 0 where there are no data
    value: FloatArray  # (W, ny, nx)
    thickness_um: FloatArray  # (ny, nx): fitted field
    root: FloatArray  # (W, ny, nx): one over the standard deviation of the noise; 0 where there are no data

    def whiten(self, values: FloatArray) -> FloatArray:
        """Differences of cells ``(..., W, ny, nx)`` in units of the noise."""
        return self.root * values


@dataclass(frozen=True)
class Channel:
    """Result of one test."""

    name: str  # what was looked at
    # statistic, degrees: χ² and its degrees of freedom under the null hypothesis
    statistic: float
    degrees: float
    # Chance of so large a statistic from noise alone, corrected for the looks within the channel
    probability: float


def fringe_phase(thickness_um: FloatArray, wavelength_nm: FloatArray, index: FloatArray) -> FloatArray:
    """Round-trip phase of the varying layer, ``(W, ny, nx)`` [rad]."""
    return (4.0 * np.pi * index / (1e-3 * wavelength_nm))[:, None, None] * thickness_um


def in_looks(chance: float, looks: float) -> float:
    """Chance that the smallest of so many independent chances is as small (Šidák)."""
    return float(-np.expm1(looks * np.log1p(-min(chance, 1.0 - 1e-16))))


def chance_beyond(statistic: float, degrees: float, noncentrality: float = 0.0) -> float:
    """Chance that a χ² is at least as large."""
    if noncentrality > 0.0:
        return _chance_beyond(max(statistic, 0.0), degrees, 0.5 * noncentrality)
    return float(chdtrc(degrees, max(statistic, 0.0)))


def _chance_beyond(statistic: float, degrees: float, half: float) -> float:
    """The same of a χ² about a mean that is not 0: a mixture by Poisson of central ones (Johnson et al. 1995).

    Far out the largest terms are those about half of the root of the product (scipy.stats takes a second to import).
    """
    largest = max(half, math.sqrt(0.5 * half * statistic))
    number = np.arange(max(math.floor(half - REACH * (math.sqrt(half) + 1.0)), 0),
                       math.ceil(largest + REACH * (math.sqrt(largest) + 1.0)))  # fmt: skip
    share = np.exp(number * math.log(half) - half - gammaln(number + 1.0))
    return min(float((share * chdtrc(degrees + 2.0 * number, statistic)).sum()), 1.0)


def phase_features(state: State, geometry: ImageGeometry, index: FloatArray) -> PlaneColumns:
    """Per wavelength: harmonics of the fringe, the first with a trend in thickness, and a smooth curve."""
    phase = fringe_phase(state.thickness_um, geometry.wavelength_nm, index)
    used = state.thickness_um
    half = max(0.5 * float(np.ptp(used)), 1e-6)
    depth = (used - 0.5 * (used.max() + used.min())) / half
    columns, planes = [], []
    for plane in range(len(phase)):
        shapes = [f(h * phase[plane]) for h in range(1, HARMONICS + 1) for f in (np.cos, np.sin)]
        shapes += [np.cos(phase[plane]) * depth, np.sin(phase[plane]) * depth]
        if half > 0.3:
            shapes += [depth, depth**2]
        columns += [state.root[plane] * shape for shape in shapes]
        planes += [plane] * len(shapes)
    return PlaneColumns(np.stack(columns), np.array(planes), np.eye(len(planes)))


def spatial_features(state: State, geometry: ImageGeometry) -> FloatArray:
    """Cosine patterns over the sensor, the same at all wavelengths and in proportion to wavelength."""
    v, u = 0.5 * np.pi * (geometry.v + 1.0), 0.5 * np.pi * (geometry.u + 1.0)
    colour = _colour(geometry.wavelength_nm)
    columns = []
    for j in range(SPATIAL_ORDER + 1):
        for i in range(SPATIAL_ORDER + 1 - j):
            if i + j == 0:
                continue
            pattern = state.value * (np.cos(j * v) * np.cos(i * u))
            columns.append(state.whiten(pattern))
            if colour.any():
                columns.append(state.whiten(pattern * colour))
    return np.stack(columns)


def amplifier_features(state: State, geometry: ImageGeometry) -> FloatArray:
    """One factor for each amplifier, the same at all wavelengths and in proportion to wavelength."""
    place = geometry.amplifier
    colour = _colour(geometry.wavelength_nm)
    columns = []
    for number in range(len(AMPLIFIERS)):
        inside = state.value * (place == number)
        if inside.any():
            columns.append(state.whiten(inside))
            if colour.any():
                columns.append(state.whiten(inside * colour))
    return np.stack(columns)


def texture_channels(state: State, correlation: float = 0.0) -> list[Channel]:
    """Power of the residual in bands of spatial frequency against the highest band, and single peaks.

    Power is relative to that of noise whose neighbours are correlated.
    """
    noise = _power_of_noise(state.thickness_um.shape, correlation)
    used = (state.root != 0.0).any(axis=0)
    common = state.residual.sum(axis=0) / np.sqrt(len(state.residual))
    result = []
    shared = dctn(common, norm="ortho") ** 2 / noise
    for name, power in (
        ("achromatic texture", shared),
        ("texture", np.mean([dctn(plane, norm="ortho") ** 2 for plane in state.residual], axis=0) / noise),
    ):
        planes = 1 if name.startswith("achromatic") else len(state.residual)
        result.append(_band_channel(name, power, planes, float(used.mean())))
    shared[0, 0] = 0.0
    top = shared / np.median(shared[shared > 0]) * MEDIAN_OF_SQUARE
    single = float(chdtrc(1, top.max()))
    result.append(Channel("achromatic peak", float(top.max()), 1.0, in_looks(single, top.size)))
    return result


def _power_of_noise(shape: tuple[int, ...], correlation: float) -> FloatArray:
    """Power of unit noise with correlated neighbours at the frequencies of a cosine transform."""
    waves = [np.cos(np.pi * np.arange(size) / size) for size in shape]
    return np.asarray(np.maximum(1.0 + 2.0 * correlation * (waves[0][:, None] + waves[1]), 0.1))


def _band_channel(name: str, power: FloatArray, planes: int, filled: float) -> Channel:
    ny, nx = power.shape
    radius = np.hypot(np.arange(ny)[:, None] / ny, np.arange(nx)[None, :] / nx)
    edges = np.linspace(0.0, 1.0, BANDS + 1)
    top = radius >= edges[-2]
    base, base_count = float(power[top].mean()), planes * int(top.sum()) * filled
    smallest, statistic, degrees = 1.0, 0.0, 1.0
    for low, high in itertools.pairwise(edges):
        inside = (radius >= low) & (radius < high) & (radius > 0.0)
        if inside.sum() < 4:
            continue
        count = planes * int(inside.sum()) * filled
        ratio = float(power[inside].mean()) / max(base, 1e-300)
        chance = float(fdtrc(count, base_count, ratio))
        if chance < smallest:
            smallest, statistic, degrees = chance, ratio * count, count
    return Channel(name, statistic, degrees, in_looks(smallest, BANDS - 1))


def echo_channel(state: State) -> Channel:
    """Copies of the image in the residual: moved (cross-talk) or mirrored (reflections), at any distance.

    The residual is correlated with the whitened pattern, and each sum is over its standard deviation. What a change
    of thickness does to a cell is taken out of the residual first: where the field is a little too smooth, its
    misfit has the colours of a fringe, as a copy of the image has. The standard deviation is then an upper bound.

    Reflections of light along the axis are mirrored about the middle. These three copies have half of the chance to
    themselves: among all distances a faint one is lost.
    """
    weight = state.root
    pattern = state.value - state.value.mean(axis=(1, 2), keepdims=True)
    scale = np.abs(weight).max(axis=(1, 2), keepdims=True)
    used = (weight != 0.0).astype(float)
    shape = tuple(next_fast_len(2 * size - 1, real=True) for size in pattern.shape[1:])
    seen = rfft2(beside_thickness(state, state.residual) * used, shape), rfft2(used, shape)
    about_middle: list[FloatArray] = []
    anywhere: list[FloatArray] = []
    for rows, columns in itertools.product((1, -1), (1, -1)):
        copy = (scale * pattern)[:, ::rows, ::columns]
        score = irfft2((seen[0] * rfft2(copy, shape).conj()).sum(axis=0), shape)
        variance = irfft2((seen[1] * rfft2(copy**2, shape).conj()).sum(axis=0), shape)
        enough = variance > LEAST_OVERLAP * float((copy**2).sum())
        if rows == columns == 1:
            enough &= _is_far(shape, NEAREST_ECHO)
        elif enough[0, 0]:
            about_middle.append(score[:1, 0] ** 2 / variance[:1, 0])
        anywhere.append(score[enough] ** 2 / variance[enough])
    largest, chance = min((_largest(group) for group in (about_middle, anywhere)), key=lambda pair: pair[1])
    return Channel("echoes", largest, 1.0, min(2.0 * chance, 1.0))


def _largest(groups: Sequence[FloatArray]) -> tuple[float, float]:
    """Largest of many χ² of one degree of freedom, and the chance of so large a one."""
    looks = sum(values.size for values in groups)
    largest = max((float(values.max()) for values in groups if values.size), default=0.0)
    single = float(chdtrc(1, largest))
    return largest, in_looks(single, looks)


def beside_thickness(state: State, whitened: FloatArray) -> FloatArray:
    """Whitened values without what a thickness of its own would explain in each cell."""
    slope = state.slope
    square = (slope**2).sum(axis=0)
    along = np.divide((slope * whitened).sum(axis=0), square, out=np.zeros(square.shape), where=square > 0.0)
    return np.asarray(whitened - slope * along)


def _is_far(shape: tuple[int, ...], nearest: int) -> BoolArray:
    """Shifts in the order of a Fourier transform that are at least so many cells long."""
    along = [np.minimum(np.arange(size), size - np.arange(size)) for size in shape]
    return np.hypot(along[0][:, None], along[1][None, :]) >= nearest


def _colour(wavelength_nm: FloatArray) -> FloatArray:
    span = float(np.ptp(wavelength_nm))
    if span == 0.0:
        return np.zeros((len(wavelength_nm), 1, 1))
    middle = 0.5 * (wavelength_nm.max() + wavelength_nm.min())
    colour: FloatArray = (2.0 * (wavelength_nm - middle) / span)[:, None, None]
    return colour
