"""Photon and read noise of large exposures, several times faster than pixel by pixel with GalSim.

The mean of a pixel is split into whole electrons and a remainder, whose Poisson numbers add up. The first comes from
an alias table, of which an exposure of the sky needs a few dozen; where a table would serve too few pixels, the
number comes from Hörmann's transformed rejection. Normal numbers are those of the ziggurat method. Every row has a
random stream of its own, so that the numbers do not depend on how many threads share the rows. Pixels with few
electrons are left to GalSim.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from ..errors import InputError, OutOfRangeError
from ..instrument.readout import add_readout

__all__ = ["FEWEST_ELECTRONS", "add_exposure_noise"]

FloatArray = NDArray[np.float64]

FEWEST_ELECTRONS = 50.0
"""Mean below which a pixel is left to GalSim [e⁻]; transformed rejection is made for more than 10."""

_MOST_LEVELS = 200_000
"""Whole means for which tables are considered [e⁻]."""

_PIXELS_PER_ENTRY = 4
"""Pixels that every entry of an alias table must serve."""

_SAMPLED_ROWS = 4
"""One row in so many is looked at for how frequent a whole mean is."""

_REACH = 8.0
"""Standard deviations on either side that a table covers; 1e-15 lies beyond."""

_LAYERS = 256
_EDGE = 3.6541528853610088
"""Where the tail of the ziggurat of 256 layers begins."""

_AREA = 4.92867323399e-3
"""Area of each of its layers (Marsaglia & Tsang 2000)."""


def add_exposure_noise(
    electrons: ArrayLike, rng: np.random.Generator, read_noise_e: float = 0.0
) -> NDArray[np.float32]:
    """Poisson noise of the photoelectrons and Gaussian read noise.

    Parameters
    ----------
    electrons : array_like, shape ``(ny, nx)``
        Expected electrons per pixel, none negative.
    rng : `numpy.random.Generator`
        Source of randomness; decides the streams of all rows.
    read_noise_e : `float`, optional
        Read noise [e⁻ rms].

    Returns
    -------
    noisy : `numpy.ndarray`, float32, shape ``(ny, nx)``
        The same numbers whatever the number of threads. Whole numbers of electrons without read noise, exact up to
        2²⁴ electrons.

    Raises
    ------
    InputError
        An image that is not two-dimensional, or has pixels that are negative or not finite.
    OutOfRangeError
        A negative read noise.

    References
    ----------
    Walker 1977 and Vose 1991 (alias tables); Hörmann 1993 (PTRS); Marsaglia & Tsang 2000 (ziggurat); Blackman & Vigna
    2021 (xoshiro256++).
    """
    image = np.asarray(electrons)
    if image.dtype not in (np.float32, np.float64):
        image = image.astype(np.float64)
    if image.ndim != 2:
        raise InputError("shape of the image", image.shape, "two axes (y, x)")
    if not 0.0 <= read_noise_e < math.inf:
        raise OutOfRangeError("read noise [e]", read_noise_e, "finite and not negative")
    lowest = float(image.min())
    if not lowest >= 0.0 or not math.isfinite(float(image.max())):
        raise InputError("expected electrons", lowest, "finite and not negative in every pixel")
    key = np.uint64(rng.integers(0, 2**63))
    values = np.ascontiguousarray(image)
    tables = _alias_tables(values, lowest, float(image.max()))
    noisy = _noise_kernel(values, key, read_noise_e, FEWEST_ELECTRONS, *tables, *_ZIGGURAT)
    if lowest < FEWEST_ELECTRONS:
        faint = image < FEWEST_ELECTRONS
        few = add_readout(image[faint][np.newaxis], rng, read_noise_e, gain=1.0)
        noisy[faint] = few[0]
    return noisy


def _ziggurat() -> tuple[FloatArray, FloatArray]:
    """Right ends of the layers and the density there."""
    ends = np.zeros(_LAYERS + 1)
    ends[0] = _AREA / math.exp(-0.5 * _EDGE**2)
    ends[1] = _EDGE
    for layer in range(2, _LAYERS):
        below = ends[layer - 1]
        ends[layer] = math.sqrt(-2.0 * math.log(_AREA / below + math.exp(-0.5 * below**2)))
    return ends, np.exp(-0.5 * ends**2)


_ZIGGURAT = _ziggurat()


@numba.njit(error_model="numpy", inline="always")
def _mix(value: np.uint64) -> np.uint64:  # pragma: no cover - compiled
    """Output function of splitmix64."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(error_model="numpy", inline="always")
def _rotate(value: np.uint64, bits: int) -> np.uint64:  # pragma: no cover - compiled
    return (value << np.uint64(bits)) | (value >> np.uint64(64 - bits))


@numba.njit(error_model="numpy", inline="always")
def _next(state: NDArray) -> np.uint64:  # pragma: no cover - compiled
    """Next number of xoshiro256++."""
    result = _rotate(state[0] + state[3], 23) + state[0]
    shifted = state[1] << np.uint64(17)
    state[2] ^= state[0]
    state[3] ^= state[1]
    state[1] ^= state[2]
    state[0] ^= state[3]
    state[2] ^= shifted
    state[3] = _rotate(state[3], 45)
    return result


@numba.njit(error_model="numpy", inline="always")
def _uniform(state: NDArray) -> float:  # pragma: no cover - compiled
    """Uniform number in (0, 1)."""
    return (float(_next(state) >> np.uint64(12)) + 0.5) * (1.0 / 4503599627370496.0)


@numba.njit(error_model="numpy", inline="always")
def _poisson(mean: float, state: NDArray) -> float:  # pragma: no cover - compiled
    """Transformed rejection with squeeze; both uniform numbers from one draw, with 32 bits each."""
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    quick = 0.9277 - 3.6224 / (b - 2.0)
    while True:
        draw = _next(state)
        u = (float(draw >> np.uint64(32)) + 0.5) * (1.0 / 4294967296.0) - 0.5
        v = (float(draw & np.uint64(0xFFFFFFFF)) + 0.5) * (1.0 / 4294967296.0)
        room = 0.5 - abs(u)
        count = math.floor((2.0 * a / room + b) * u + mean + 0.43)
        if room >= 0.07 and v <= quick:
            return count
        if count < 0.0 or (room < 0.013 and v > room):
            continue
        steep = 1.1239 + 1.1328 / (b - 3.4)
        if math.log(v * steep / (a / (room * room) + b)) <= count * math.log(mean) - mean - math.lgamma(
            count + 1.0
        ):
            return count


@numba.njit(error_model="numpy", inline="always")
def _normal(ends: NDArray, density: NDArray, state: NDArray) -> float:  # pragma: no cover - compiled
    while True:
        draw = _next(state)
        layer = int(draw & np.uint64(255))
        u = 2.0 * ((float(draw >> np.uint64(12)) + 0.5) * (1.0 / 4503599627370496.0)) - 1.0
        x = u * ends[layer]
        if abs(x) < ends[layer + 1]:
            return x
        if layer == 0:
            while True:
                beyond = -math.log(_uniform(state)) / _EDGE
                if -2.0 * math.log(_uniform(state)) > beyond * beyond:
                    return _EDGE + beyond if u > 0.0 else -_EDGE - beyond
        height = density[layer] + _uniform(state) * (density[layer + 1] - density[layer])
        if height < math.exp(-0.5 * x * x):
            return x


def _alias_tables(
    image: NDArray[np.floating], lowest: float, highest: float
) -> tuple[int, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.uint64]]:
    """Alias tables of those whole means that are frequent enough.

    Returns
    -------
    first : `int`
        Mean of the first level.
    bits, start, base : `numpy.ndarray`, int64, shape ``(levels,)``
        Logarithm of the size of the table of each level (0 for none), its first entry, and the count that its first
        entry stands for.
    entries : `numpy.ndarray`, uint64
        Threshold in the upper half, alias in the lower.
    """
    first = math.floor(max(lowest, FEWEST_ELECTRONS))
    count = min(max(math.floor(highest) - first + 1, 1), _MOST_LEVELS)
    pixels = _SAMPLED_ROWS * _level_counts(image[::_SAMPLED_ROWS], first, count)
    mean = first + np.arange(count, dtype=float)
    reach = np.ceil(_REACH * np.sqrt(mean) + _REACH)
    bits = np.ceil(np.log2(2.0 * reach + 1.0)).astype(np.int64)
    bits[pixels < _PIXELS_PER_ENTRY * 2.0**bits] = 0
    size = np.where(bits > 0, 1 << bits, 0)
    start = np.concatenate([[0], np.cumsum(size)])
    base = np.maximum(np.floor(mean - reach), 0.0).astype(np.int64)
    entries = np.zeros(int(start[-1]) + 1, dtype=np.uint64)
    for level in np.flatnonzero(bits):
        counts = base[level] + np.arange(size[level])
        probability = stats.poisson.pmf(counts, mean[level])
        _fill_alias(probability / probability.sum(), entries[start[level] : start[level + 1]])
    return first, bits, start[:-1], base, entries


@numba.njit(cache=True)
def _level_counts(image: NDArray, first: int, count: int) -> NDArray:  # pragma: no cover - compiled
    pixels = np.zeros(count, dtype=np.int64)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            level = math.floor(image[y, x]) - first
            if 0 <= level < count:
                pixels[level] += 1
    return pixels


@numba.njit(cache=True)
def _fill_alias(probability: NDArray, entries: NDArray) -> None:  # pragma: no cover - compiled
    """Vose's method."""
    size = probability.size
    scaled = probability * size
    small, large = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.int64)
    smalls, larges = 0, 0
    for item in range(size):
        if scaled[item] < 1.0:
            small[smalls] = item
            smalls += 1
        else:
            large[larges] = item
            larges += 1
    full = np.uint64(0xFFFFFFFF)
    while smalls > 0 and larges > 0:
        smalls -= 1
        low, high = small[smalls], large[larges - 1]
        threshold = np.uint64(min(scaled[low] * 4294967296.0, 4294967295.0))
        entries[low] = (threshold << np.uint64(32)) | np.uint64(high)
        scaled[high] -= 1.0 - scaled[low]
        if scaled[high] < 1.0:
            larges -= 1
            small[smalls] = high
            smalls += 1
    for item in range(larges):
        entries[large[item]] = (full << np.uint64(32)) | np.uint64(large[item])
    for item in range(smalls):
        entries[small[item]] = (full << np.uint64(32)) | np.uint64(small[item])


@numba.njit(error_model="numpy", fastmath={"contract"})
def _remainders(mean: NDArray, u: NDArray, count: NDArray) -> None:  # pragma: no cover - compiled
    """Poisson numbers of means below 1, by inversion; -1 where there are more than three.

    Comparisons are added up, as branches would be mispredicted, and so that several pixels are worked on at once.
    """
    for x in range(mean.size):
        # exp(-mean) as an eighth power, to 1e-8.
        t = -0.125 * mean[x]
        none = 1.0 + t * (1.0 + t * (0.5 + t * (1.0 / 6.0 + t * (1.0 / 24.0 + t * (1.0 / 120.0)))))
        none *= none
        none *= none
        none *= none
        one = none * mean[x]
        two = one * mean[x] * 0.5
        three = two * mean[x] * (1.0 / 3.0)
        up_to_one = none + one
        up_to_two = up_to_one + two
        more = 1.0 if u[x] >= none else 0.0
        more += 1.0 if u[x] >= up_to_one else 0.0
        more += 1.0 if u[x] >= up_to_two else 0.0
        count[x] = -1.0 if u[x] >= up_to_two + three else more


@numba.njit(error_model="numpy")
def _many(mean: float, u: float) -> float:  # pragma: no cover - compiled
    """Poisson number of a mean below 1 where it exceeds three: one in fifty, at most."""
    term = math.exp(-mean)
    below, count = term, 0.0
    while u >= below and (count < 3.0 or term > 1e-12):
        count += 1.0
        term *= mean / count
        below += term
    return max(count, 4.0)


@numba.njit(cache=True, error_model="numpy", parallel=True)
def _noise_kernel(
    image: NDArray,
    key: np.uint64,
    read_noise: float,
    least: float,
    first: int,
    bits: NDArray,
    start: NDArray,
    base: NDArray,
    entries: NDArray,
    ends: NDArray,
    density: NDArray,
) -> NDArray:  # pragma: no cover - compiled
    height, width = image.shape
    out = np.zeros((height, width), dtype=np.float32)
    step = np.uint64(0x9E3779B97F4A7C15)
    half = np.uint64(0xFFFFFFFF)
    remaining, scale = np.empty(33, dtype=np.uint64), np.empty(33)
    for size in range(33):
        remaining[size] = (np.uint64(1) << np.uint64(32 - size)) - np.uint64(1)
        scale[size] = 0.5 ** (32 - size)
    for y in numba.prange(height):
        state = np.empty(4, dtype=np.uint64)
        word = _mix(key + step * np.uint64(y + 1))
        for k in range(4):
            word += step
            state[k] = _mix(word)
        # Random numbers in the order of the pixels, then what needs none for a whole row at once.
        rest, u, more, values = np.zeros(width), np.zeros(width), np.empty(width), np.zeros(width)
        for x in range(width):
            mean = float(image[y, x])
            if mean < least:
                continue
            whole = math.floor(mean)
            level = int(whole) - first
            if level < bits.size and bits[level] > 0:
                draw = _next(state)
                # 20 bits or more in the middle are for the remainder: a resolution of 1e-6.
                size = bits[level]
                index = np.int64(draw >> np.uint64(64 - size))
                entry = entries[start[level] + index]
                other = np.int64(entry & half)
                index = other if (draw & half) >= entry >> np.uint64(32) else index
                middle = np.int64((draw >> np.uint64(32)) & remaining[size])
                u[x] = (float(middle) + 0.5) * scale[size]
                rest[x] = mean - whole
                value = float(base[level] + index)
            else:
                value = float(_poisson(mean, state))
            if read_noise > 0.0:
                value += read_noise * _normal(ends, density, state)
            values[x] = value
        _remainders(rest, u, more)
        for x in range(width):
            if more[x] < 0.0:
                more[x] = _many(rest[x], u[x])
            out[y, x] = values[x] + more[x]
    return out
