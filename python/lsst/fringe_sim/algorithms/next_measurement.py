"""Which measurement would tell effects apart that the present flats cannot.

The data are flats of a sensor whose pixels each have a thickness and a response of their own, and whose flats each
have a level of their own; the thickness of the silicon is known up to a constant. All of that is projected out of
what the effects do to the flats: what is left are their signatures. With the signature ``a`` of the effect that was
found and those ``B`` of another one,

    separation² = |a|² (1 - likeness²),    likeness = |projection of a on B| / |a|

is the χ² by which the second effect fits worse, whatever its size: the expected difference of two fits to noiseless
("Asimov") data, to first order. Where both have been fitted, the difference of what they do at their sizes, each at
the thickness that suits it, takes the place of ``a`` in the separation, which is then good to second order.
Signatures and their products (the Fisher information) add up over flats only together with the nuisances that flats
share; so present and further flats are projected as one set.

References
----------
Rao 1948 (doi 10.1017/S0305004100023987) for the projection; Cowan, Cranmer, Gross & Vitells 2011 (doi
10.1140/epjc/s10052-011-1554-0) for Asimov data.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from ..effects import Effect, known_effects
from ..errors import InputError, UnknownNameError, named_units
from ..model import FringeModel
from .flat_series import LEVEL_E, FlatSeries
from .measurement_forecast import Forecast, Sample, Tested

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
    return _candidates(model, _present(model, wavelength_nm, level_e, dark_time_s))


def _candidates(model: FringeModel, present: FlatSeries) -> tuple[FlatMeasurement, ...]:
    waves, setup = present.wavelength_nm, model.setup
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


@named_units
def rank_measurements(
    model: FringeModel,
    effects: Mapping[str, Mapping[str, float]],
    present: FlatSeries | None = None,
    *,
    thickness_um: tuple[float, float] | None = None,
    significance: float | None = None,
    measurements: Sequence[FlatMeasurement] | None = None,
    nuisance_effects: Sequence[str] = (),
    catalogue: Sequence[Effect] | None = None,
) -> tuple[RankedMeasurement, ...]:
    """Rank further measurements by how well they tell apart effects that the present flats cannot.

    ``model`` has the effects that are beyond doubt, without those of the class: ``effects``, fitted values by effect
    and parameter, that which was found first. Where nothing is known (an empty mapping) an effect departs from null
    by its prior scale if it can do so to one side only, and otherwise by little. ``present``: the flats that there
    are, by default those of the set-up; ``thickness_um`` is by default within 1.5 of the stack's. ``significance``:
    standard deviations by which the present data ask for the effect; without it, that of a whole sensor with photon
    noise and nothing else unknown, which is far too good: only ratios are to be trusted. ``nuisance_effects`` are
    known within their prior scale only, and projected out, too.

    The largest separation of the hardest pair comes first. Empty if fewer than two of the effects can be forecast:
    those that couple neighbouring pixels, or are in a part of the sensor only, cannot.
    """
    if model.setup.kind != "monochromator":
        raise InputError("set-up", model.setup.name, "a laboratory set-up with a monochromator")
    catalogue = known_effects(catalogue)
    known = {effect.name: effect for effect in catalogue}
    unknown = [name for name in (*effects, *nuisance_effects) if name not in known]
    if unknown:
        raise UnknownNameError("effect", unknown[0], known)
    tested = [Tested.of(known[name], values, model) for name, values in effects.items()]
    tested = [item for item in tested if item.effect.search.reach == "pixel" and not item.effect.local]
    if len(tested) < 2:
        return ()
    further = [Tested.of(known[name], {}, model) for name in nuisance_effects if name not in effects]
    flats = present or _present(model)
    sample = Sample.of(model, thickness_um)
    forecast = Forecast(model, catalogue, tuple(tested), tuple(further), sample, flats)
    chosen = measurements or _candidates(model, flats)
    # Many small matrices: threads of the linear algebra would wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        return _ranked(forecast, chosen, significance)


def _ranked(
    forecast: Forecast, measurements: Sequence[FlatMeasurement], significance: float | None
) -> tuple[RankedMeasurement, ...]:
    before = forecast.pairs([forecast.present])
    first, *others = (item.effect.name for item in forecast.tested)
    scale = 1.0 if significance is None else significance / max(before[0].strength, 1e-300)
    ranked = []
    for measurement in measurements:
        after = forecast.pairs([forecast.present, measurement.series])
        pairs = [
            PairForecast(
                first, other, now.likeness, then.likeness, scale * now.separation, scale * then.separation
            )
            for other, now, then in zip(others, before, after, strict=True)
        ]
        pairs.sort(key=lambda pair: pair.separation_after)
        ranked.append(RankedMeasurement(measurement, tuple(pairs)))
    return tuple(sorted(ranked, key=lambda item: -item.separation))


def break_ambiguity(ranked: Sequence[RankedMeasurement]) -> str:
    """What to measure next, in a sentence; an empty text if nothing could be forecast."""
    if not ranked:
        return ""
    best = ranked[0]
    if best.decides:
        return best.text
    return f"no measurement that was tried decides; the best are {best.text}"


def _present(
    model: FringeModel,
    wavelength_nm: Sequence[float] | None = None,
    level_e: float = LEVEL_E,
    dark_time_s: Sequence[float] = (),
) -> FlatSeries:
    waves = model.setup.wavelengths_nm if wavelength_nm is None else wavelength_nm
    return FlatSeries(
        tuple(float(w) for w in waves), level_e, dark_time_s=tuple(float(time) for time in dark_time_s)
    )
