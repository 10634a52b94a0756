"""Rotational levels of OH, each with a cold and a hot population.

In every vibrational level the low rotational levels are populated as in air of some 190 K, the high ones by a hot
population that the chemistry leaves behind (Noll et al. 2020, doi 10.5194/acp-20-5269-2020; PALACE, Noll et al. 2025,
doi 10.5194/gmd-18-4353-2025). The two answer to different causes, so that they are kept apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..array_types import FloatArray
from ..errors import OutOfRangeError
from ..resources import read_table

SECOND_RADIATION_CM_K = 1.4387769  # hc/k [cm K]

COLD_K = 191.0
"""Temperature of the cold population of every vibrational level in PALACE, from the fits of `of_reference` [K]."""

GROUND_CM = 1.0  # A list of levels that starts below this energy is complete at its lower end [1/cm]


@dataclass(frozen=True, eq=False)
class RotationalLevels:
    """Populations of the upper levels of lines."""

    vibration: NDArray[np.int64]  # (K,): vibrational level
    # energy_cm, weight: (K,): energy above the lowest level of the same vibration [1/cm], and statistical
    # weight
    energy_cm: FloatArray
    weight: FloatArray
    # cold, hot: (K,): populations per sublevel [rayleigh seconds]
    cold: FloatArray
    hot: FloatArray
    cold_k: float  # temperature of the cold population [K]
    line_level: NDArray[np.int64]  # (N,): upper level of every line

    @classmethod
    def of_reference(cls) -> RotationalLevels:
        """Populations of PALACE for the lines of the shipped list, in its order.

        Two Boltzmann distributions were fitted to the levels of each vibration below 2200 cm⁻¹ (of v' = 9, below
        1000 cm⁻¹). In every level the smaller of the two is that of the fit, and the larger is the rest of the
        tabulated population.
        """
        table = read_table("sky", "oh_lines_palace_yband.ecsv")
        keys = list(
            zip(*(table[name].tolist() for name in ("v_up", "N_up", "F_up", "parity_up")), strict=True)
        )
        levels = {key: number for number, key in enumerate(dict.fromkeys(keys))}
        first = [keys.index(key) for key in levels]
        vibration = np.asarray(table["v_up"], dtype=np.int64)[first]
        energy, weight, log_population = (
            np.asarray(table[name], dtype=float)[first] for name in ("E_rot", "g_up", "ln_pop")
        )
        cold, hot = _fitted(vibration, energy)
        population, larger = np.exp(log_population), cold > hot
        cold = np.where(larger, population - hot, cold)
        unlisted, number = _lower_levels(vibration, energy)
        more_cold, more_hot = _fitted(unlisted, energy[number])
        return cls(
            np.concatenate([vibration, unlisted]),
            np.concatenate([energy, energy[number]]),
            np.concatenate([weight, weight[number]]),
            np.concatenate([cold, more_cold]),
            np.concatenate([population - cold, more_hot]),
            COLD_K,
            np.array([levels[key] for key in keys]),
        )

    @property
    def line_population(self) -> FloatArray:
        """Population of the upper level of every line, both parts together."""
        return (self.cold + self.hot)[self.line_level]

    def of_lines(self, chosen: NDArray[Any]) -> RotationalLevels:
        """The same levels for lines in another order, or for some of them."""
        return replace(self, line_level=self.line_level[chosen])

    def thermal(self, cold_k: float, hot_k: float | None = None, hot_ratio: float = 0.0) -> RotationalLevels:
        """Boltzmann populations; every vibrational level keeps what it holds.

        ``hot_ratio`` is the hot over the cold population at zero energy.
        """
        if not 0.0 <= hot_ratio < math.inf:
            raise OutOfRangeError("ratio of the hot population", hot_ratio, "finite and not negative")
        cold = boltzmann(self.energy_cm, cold_k)
        hot = np.zeros_like(cold) if hot_k is None else hot_ratio * boltzmann(self.energy_cm, hot_k)
        return replace(self, cold=cold, hot=hot, cold_k=cold_k)._holding(self)

    def warmed(self, kelvin: float) -> RotationalLevels:
        """The cold population at another temperature; what it holds, and the hot population, stay as they are."""
        before, after = (boltzmann(self.energy_cm, each) for each in (self.cold_k, kelvin))
        cold = self.cold * after / before * (self._sum(before) / self._sum(after))
        return replace(self, cold=cold, cold_k=kelvin)

    def with_hot(self, scale: float, added: float, added_k: float) -> RotationalLevels:
        """The hot population multiplied, and one of a given temperature added to it.

        ``added`` is its size over that of the cold one at zero energy. Every vibrational level keeps what it holds.
        """
        at_zero = self._sum(self.cold) / self._sum(boltzmann(self.energy_cm, self.cold_k))
        hot = scale * self.hot + added * at_zero * boltzmann(self.energy_cm, added_k)
        return replace(self, hot=hot)._holding(self)

    def _holding(self, other: RotationalLevels) -> RotationalLevels:
        """These populations, times what lets every vibrational level hold what it holds in ``other``."""
        factor = self._sum(other.cold + other.hot) / self._sum(self.cold + self.hot)
        return replace(self, cold=self.cold * factor, hot=self.hot * factor)

    def _sum(self, population: FloatArray) -> FloatArray:
        """Of every level, the sum over all states of its vibration."""
        held = np.bincount(self.vibration, weights=self.weight * population)
        return np.asarray(held[self.vibration])


def boltzmann(energy_cm: FloatArray, kelvin: float | FloatArray) -> FloatArray:
    """Boltzmann factors of energies [1/cm]. `OutOfRangeError`: a temperature that is not positive."""
    if not np.all((np.asarray(kelvin) > 0.0) & np.isfinite(kelvin)):
        raise OutOfRangeError("temperature [K]", kelvin, "positive")
    return np.asarray(np.exp(-SECOND_RADIATION_CM_K * energy_cm / kelvin))


def _fitted(vibration: NDArray[np.int64], energy_cm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cold and hot populations of levels by the fits."""
    table = read_table("sky", "oh_levels_palace.ecsv")
    place = np.searchsorted(np.asarray(table["v_up"]), vibration)
    whole, ratio, kelvin = (
        np.asarray(table[name], dtype=float)[place] for name in ("ln_pop_N1", "hot_ratio", "T_hot")
    )
    cold = np.exp(whole) / (1.0 + ratio)
    return cold * boltzmann(energy_cm, COLD_K), cold * ratio * boltzmann(energy_cm, kelvin)


def _lower_levels(
    vibration: NDArray[np.int64], energy_cm: FloatArray
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Low levels of which no line is in the list: their vibration, and the number of a level that stands for each.

    Of v' = 6 only the outskirts of 6-2 are listed; the levels of the next vibration, 4 % farther apart, stand for
    those that are missing.
    """
    known = np.unique(vibration)
    lowest = np.array([energy_cm[vibration == each].min() for each in known])
    complete = known[lowest < GROUND_CM]
    found = [(np.empty(0, np.int64), np.empty(0, np.int64))]
    for each, bound in zip(known, lowest, strict=True):
        if bound >= GROUND_CM:
            nearest = complete[np.argmin(np.abs(complete - each))]
            stand_in = np.flatnonzero((vibration == nearest) & (energy_cm < bound))
            found.append((np.full(stand_in.size, each), stand_in))
    return np.concatenate([each[0] for each in found]), np.concatenate([each[1] for each in found])
