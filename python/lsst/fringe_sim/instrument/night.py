"""How the OH bands change through a night and over the field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError, named_units
from ..notebook import OneLine
from ..resources import read_table

__all__ = ["AirglowField", "NightHistory", "StochasticNight", "join_nights", "random_nights"]


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class NightHistory(OneLine):
    """Relative intensity of the OH bands at several times.

    Bands with the same upper vibrational level vary alike, because their lines leave the same level; between
    tabulated levels the intensity is interpolated in v', and beyond them the nearest level is taken.

    Attributes
    ----------
    hours : `numpy.ndarray`, shape ``(T,)``
        Time since the beginning [h].
    upper_level : `numpy.ndarray`, shape ``(V,)``
        Upper vibrational levels v', ascending.
    intensity : `numpy.ndarray`, shape ``(T, V)``
        Intensity relative to the reference radiance.
    """

    hours: FloatArray
    upper_level: FloatArray
    intensity: FloatArray

    def __post_init__(self) -> None:
        if self.intensity.shape != (self.hours.size, self.upper_level.size):
            raise InputError("shape of the intensities", self.intensity.shape, "(times, levels)")
        if not np.all(np.isfinite(self.intensity)) or not np.all(self.intensity >= 0.0):
            raise InputError("band intensities", float(np.min(self.intensity)), "finite and not negative")

    @classmethod
    def guo2022(cls) -> NightHistory:
        """The night of the paper's PCA: 11 hours from 19h to 05h, five bands (after Noll et al. 2015).

        Its intensity falls by a factor of 7 until midnight; it is one strongly varying night. No values are given
        for 7-3, which lies between 5-2 and 8-4 here.
        """
        table = read_table("sky", "oh_temporal_guo2022_noll2015.ecsv")
        columns = sorted((int(name[2]), name) for name in table.colnames if name.startswith("I_"))
        return cls(
            np.asarray(table["hours"], dtype=float),
            np.array([float(level) for level, _ in columns]),
            np.stack([np.asarray(table[name], dtype=float) for _, name in columns], axis=1),
        )

    def __len__(self) -> int:
        return self.hours.size

    def band_scale(self, time: int, bands: Sequence[str]) -> dict[str, float]:
        """Factors on the bands at one time, for `EmissionLines.scaled`.

        Parameters
        ----------
        time : `int`
            Index of the time.
        bands : sequence of `str`
            Names like ``8-4``.

        Raises
        ------
        OutOfRangeError
            There is no such time.
        InputError
            A name that is not of this form.
        """
        if not 0 <= time < len(self):
            raise OutOfRangeError("index of the time", time, f"0 to {len(self) - 1}")
        levels = [_upper_level(band) for band in bands]
        scale = np.interp(levels, self.upper_level, self.intensity[time])
        return dict(zip(bands, scale.tolist(), strict=True))


@named_units
@dataclass(frozen=True)
class StochasticNight:
    """Random nights: log-normal band intensities, correlated in time and between levels.

    ``ln I(v', t) = s + c(t) + tau (v' - 6) y(t) + i_v(t)`` with a level s of the night and Ornstein–Uhlenbeck
    processes c (common), y (tilt with v') and i (of one level alone).

    Attributes
    ----------
    night_sigma, common_sigma : `float`
        Standard deviation of ln I between nights and within one; together 0.31, that of single observations
        (Noll et al. 2012).
    tilt_sigma : `float`
        Standard deviation of the slope of ln I with v'; in the night of Noll et al. 2015 that the paper uses, the
        second principal component of ln I is such a tilt, of 0.03 per level.
    level_sigma : `float`
        Standard deviation of one level alone; the same night leaves 0.01.
    correlation_h : `float`
        Correlation time [h].
    """

    night_sigma: float = 0.23
    common_sigma: float = 0.21
    tilt_sigma: float = 0.03
    level_sigma: float = 0.01
    correlation_h: float = 1.5

    def __post_init__(self) -> None:
        for name in ("night_sigma", "common_sigma", "tilt_sigma", "level_sigma"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise OutOfRangeError(name, getattr(self, name), "finite and not negative")
        if not 0.0 < self.correlation_h < math.inf:
            raise OutOfRangeError("correlation time [h]", self.correlation_h, "positive")

    @named_units
    def draw(self, hours: ArrayLike, rng: np.random.Generator) -> NightHistory:
        """One night.

        Parameters
        ----------
        hours : array_like, shape ``(T,)``
            Times [h], ascending.
        rng : `numpy.random.Generator`
            Source of randomness.

        Returns
        -------
        night : `NightHistory`
            Levels v' = 3 to 9, with mean intensity 1 over many nights.
        """
        times = np.atleast_1d(np.asarray(hours, dtype=float))
        if times.ndim != 1 or not np.all(np.diff(times) >= 0.0):
            raise InputError("hours", times.tolist(), "ascending")
        levels = np.arange(3.0, 10.0)
        night = self.night_sigma * rng.standard_normal()
        paths = _ornstein_uhlenbeck(times, 2 + levels.size, self.correlation_h, rng)
        offset = levels - 6.0
        logarithm = (
            night
            + self.common_sigma * paths[:, :1]
            + self.tilt_sigma * paths[:, 1:2] * offset
            + self.level_sigma * paths[:, 2:]
        )
        variance = (
            self.night_sigma**2 + self.common_sigma**2 + (self.tilt_sigma * offset) ** 2 + self.level_sigma**2
        )
        return NightHistory(times, levels, np.exp(logarithm - 0.5 * variance))


@named_units
@dataclass(frozen=True, eq=False)
class AirglowField:
    """Brightness of the airglow over the field of view relative to its centre.

    Attributes
    ----------
    x_deg, y_deg : `numpy.ndarray`, shape ``(X,)`` and ``(Y,)``
        Field angles of the nodes [deg].
    level : `numpy.ndarray`, shape ``(X, Y)``
        Relative brightness.
    """

    x_deg: FloatArray
    y_deg: FloatArray
    level: FloatArray

    @classmethod
    def imsim(cls) -> AirglowField:
        """The example of imSim: one realisation, 0.98 to 1.97 over the LSST field."""
        table = read_table("sky", "oh_spatial_variation_imsim.ecsv")
        x, y = (np.unique(np.asarray(table[name], dtype=float)) for name in ("dx", "dy"))
        level = np.empty((x.size, y.size))
        level[np.searchsorted(x, table["dx"]), np.searchsorted(y, table["dy"])] = table["level"]
        return cls(x, y, level)

    @classmethod
    @named_units
    def gradient(
        cls, slope_per_deg: float, direction_deg: float = 0.0, radius_deg: float = 2.1
    ) -> AirglowField:
        """Linear variation ``1 + slope * distance`` along a direction, counted from the x axis."""
        if not abs(slope_per_deg) * radius_deg * math.sqrt(2.0) < 1.0:
            raise OutOfRangeError(
                "airglow gradient [1/deg]", slope_per_deg, f"below {1 / (radius_deg * math.sqrt(2)):.3f}"
            )
        nodes = np.array([-radius_deg, radius_deg])
        along = math.cos(math.radians(direction_deg)), math.sin(math.radians(direction_deg))
        level = 1.0 + slope_per_deg * (along[0] * nodes[:, None] + along[1] * nodes[None, :])
        return cls(nodes, nodes, level)

    @named_units
    def at(self, x_deg: ArrayLike, y_deg: ArrayLike) -> FloatArray:
        """Relative brightness at field angles [deg], which broadcast.

        Raises
        ------
        OutOfRangeError
            A position outside the nodes.
        """
        x, y = np.broadcast_arrays(np.asarray(x_deg, dtype=float), np.asarray(y_deg, dtype=float))
        inside = (x >= self.x_deg[0]) & (x <= self.x_deg[-1]) & (y >= self.y_deg[0]) & (y <= self.y_deg[-1])
        if not np.all(inside):
            first = np.flatnonzero(~np.ravel(inside))[0]
            raise OutOfRangeError(
                "field angle [deg]",
                (float(np.ravel(x)[first]), float(np.ravel(y)[first])),
                f"{self.x_deg[0]} to {self.x_deg[-1]} in x and y",
            )
        return np.asarray(RegularGridInterpolator((self.x_deg, self.y_deg), self.level)((x, y)))


def random_nights(count: int, seed: int) -> NightHistory:
    """Eleven hours of each of so many random nights, joined."""
    hours = np.arange(0.0, 11.0)
    return join_nights(
        [StochasticNight().draw(hours, np.random.default_rng([seed, number])) for number in range(count)]
    )


def join_nights(nights: Sequence[NightHistory]) -> NightHistory:
    """Times of several nights, one night after the other.

    Raises
    ------
    InputError
        No night, or nights of different levels.
    """
    if not nights:
        raise InputError("nights", 0, "one or more")
    first = nights[0]
    if any(not np.array_equal(night.upper_level, first.upper_level) for night in nights):
        raise InputError("upper levels of the nights", "different", "the same")
    return NightHistory(
        np.concatenate([night.hours for night in nights]),
        first.upper_level,
        np.concatenate([night.intensity for night in nights]),
    )


def _upper_level(band: str) -> int:
    upper, _, lower = band.partition("-")
    if not (upper.isdigit() and lower.isdigit()):
        raise InputError("OH band", band, "a name like 8-4")
    return int(upper)


def _ornstein_uhlenbeck(
    times: FloatArray, count: int, correlation: float, rng: np.random.Generator
) -> FloatArray:
    """Stationary processes of unit variance sampled at given times, shape ``(T, count)``."""
    noise = rng.standard_normal((times.size, count))
    path = np.empty_like(noise)
    path[0] = noise[0]
    for step in range(1, times.size):
        memory = math.exp(-(times[step] - times[step - 1]) / correlation)
        path[step] = memory * path[step - 1] + math.sqrt(1.0 - memory**2) * noise[step]
    return path
