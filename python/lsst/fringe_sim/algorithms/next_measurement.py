"""Which measurement would tell effects apart that the present flats cannot: what could be taken, and its rank.

A search projects all that is free out of what effects do to the data (`discovery.next_flats`). What is left are their
signatures. With the signature ``a`` of the effect that was found and those ``B`` of another one,

    separation² = |a|² (1 - likeness²),    likeness = |projection of a on B| / |a|

is the χ² by which the second effect fits worse, whatever its size: the expected difference of two fits to noiseless
("Asimov") data, to first order.

References
----------
Rao 1948 (doi 10.1017/S0305004100023987) for the projection; Cowan, Cranmer, Gross & Vitells 2011 (doi
10.1140/epjc/s10052-011-1554-0) for Asimov data.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import named_units
from ..model import FringeModel
from .flat_series import LEVEL_E, FlatSeries

HIGH_LEVEL_E = 80_000.0
NARROW_FWHM_NM = 0.5
COOLER_K = 20.0
SECOND_F_NUMBER = 2.0
WIDE_NM = (800.0, 1050.0)

DECISIVE_SIGMA = 5.0  # Separation with which two effects count as told apart


@dataclass(frozen=True)
class Measurement:
    """Data that could be taken in addition."""

    name: str  # Key, and what to take, for people
    title: str


@dataclass(frozen=True)
class FlatMeasurement(Measurement):
    """Flats that could be taken in addition."""

    series: FlatSeries


@dataclass(frozen=True)
class PairForecast:
    """How well the effect that was found is told from another one."""

    effect: str
    other: str
    # Cosine between the signatures, 0 to 1, with the present flats and with the further ones
    likeness_now: float
    likeness_after: float
    # Expected difference of the two fits in standard deviations, the square root of Δχ²
    separation_now: float
    separation_after: float

    @property
    def text(self) -> str:
        """One line."""
        return (
            f"{self.effect} against {self.other}: likeness {self.likeness_now:.3f} -> {self.likeness_after:.3f}, "
            f"separation {self.separation_now:.3g} -> {self.separation_after:.3g} sigma"
        )


@dataclass(frozen=True)
class RankedMeasurement:
    """A measurement and what it would tell."""

    measurement: Measurement  # What to take
    pairs: tuple[PairForecast, ...]  # The effect that was found against each of the others, hardest first

    @property
    def separation(self) -> float:
        """Separation of the hardest pair [standard deviations]."""
        return self.pairs[0].separation_after

    @property
    def gain(self) -> float:
        """Factor by which the separation of the hardest pair grows; infinite if there was none."""
        before = min(pair.separation_now for pair in self.pairs)
        return self.separation / before if before > 0.0 else math.inf

    @property
    def decides(self) -> bool:
        """Whether every pair is told apart."""
        return self.separation >= DECISIVE_SIGMA

    @property
    def text(self) -> str:
        """One line: the measurement and the hardest pair."""
        return f"{self.measurement.title}: {self.pairs[0].text}"


@named_units
def candidate_measurements(
    model: FringeModel,
    wavelength_nm: Sequence[float] | None = None,
    level_e: float = LEVEL_E,
    dark_time_s: Sequence[float] = (),
) -> tuple[FlatMeasurement, ...]:
    """Measurements that a test stand can make besides its usual flats."""
    setup = model.setup
    waves = tuple(float(wave) for wave in (setup.wavelengths_nm if wavelength_nm is None else wavelength_nm))
    present = FlatSeries(waves, level_e, dark_time_s=tuple(float(time) for time in dark_time_s))
    n = f"{len(waves)} flats"
    found = [
        FlatMeasurement("repeat", f"the same {n} once more", present),
        FlatMeasurement(
            "temperature",
            f"{n} at {setup.temperature_k - COOLER_K:.0f} K",
            replace(present, temperature_k=setup.temperature_k - COOLER_K),
        ),
    ]
    level = HIGH_LEVEL_E if present.level_e < 0.5 * HIGH_LEVEL_E else 0.2 * present.level_e
    found.append(FlatMeasurement("level", f"{n} of {level:.0f} electrons", present.at_level(level)))
    if setup.bandwidth_fwhm_nm > 1.5 * NARROW_FWHM_NM:
        title = f"{n} with a bandpass of {NARROW_FWHM_NM:g} nm"
        narrow = present.at_bandwidth(NARROW_FWHM_NM, setup.bandwidth_fwhm_nm)
        found.append(FlatMeasurement("narrow_bandpass", title, narrow))
    if math.isinf(setup.f_number) or setup.f_number > 2.0 * SECOND_F_NUMBER:
        title = f"{n} in a beam of f/{SECOND_F_NUMBER:g}"
        found.append(FlatMeasurement("f_number", title, replace(present, f_number=SECOND_F_NUMBER)))
    further = tuple(
        float(w) for w in np.linspace(*WIDE_NM, 26) if w < min(waves) - 5.0 or w > max(waves) + 5.0
    )
    if further:
        title = f"{len(further)} flats at other wavelengths from {min(further):g} to {max(further):g} nm"
        found.append(FlatMeasurement("wide_range", title, present.at_wavelengths(further)))
    return tuple(found)


def break_ambiguity(ranked: Sequence[RankedMeasurement]) -> str:
    """What to measure next, in a sentence; an empty text if nothing could be forecast."""
    if not ranked:
        return ""
    best = ranked[0]
    if best.decides:
        return best.text
    return f"no measurement that was tried decides; the best are {best.text}"
