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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ..effects import Effect, ImageGeometry, Parameter, activate_effects, apply_to_image, known_effects
from ..errors import InputError, OutOfRangeError, UnknownNameError
from ..model import FringeModel
from ..optics import Beam
from ..optics.illumination import GaussianProfile, TriangularProfile
from ..optics.system import OpticalSystem

__all__ = [
    "FlatMeasurement",
    "FlatSeries",
    "Measurement",
    "PairForecast",
    "RankedMeasurement",
    "break_ambiguity",
    "candidate_measurements",
    "rank_measurements",
]

FloatArray = NDArray[np.float64]
Report = Callable[[str], None]

SENSOR_PX = (4004, 4096)
"""Rows and columns of the sensor whose information is forecast."""

SAMPLES = (6, 24)
"""Thicknesses of the silicon, within one of its fringe orders, and of the varying layer at each of them."""

RESPONSE_SCATTER = 0.01
"""Scatter of the response of single pixels that is known beforehand (relative)."""

DERIVATIVE_STEP = 0.002
"""Step of a difference in units of the prior scale of a parameter."""

THICKNESS_STEP_UM = 1e-4
"""Step of a difference in thickness [µm]; a fringe of the silicon takes 0.13."""

ORDERS_MOVED, STEPS_PER_ORDER = 6, 24
"""Fringe orders, either way, and steps in which the thickness that suits an effect is looked for."""

LINE_STEP_NM = 0.1
"""Spacing of wavelength nodes [nm]: five per fringe of detection layer and support together."""

LEVEL_E = 20_000.0
HIGH_LEVEL_E = 80_000.0
NARROW_FWHM_NM = 0.5
COOLER_K = 20.0
SECOND_F_NUMBER = 2.0
WIDE_NM = (800.0, 1050.0)

DECISIVE_SIGMA = 5.0
"""Separation with which two effects count as told apart."""


@dataclass(frozen=True)
class FlatSeries:
    """Flats that are taken under the same conditions.

    Attributes
    ----------
    wavelength_nm : `tuple` [`float`, ...]
        Nominal wavelengths [nm].
    level_e : `float`
        Mean level [electrons].
    bandwidth_fwhm_nm, temperature_k, f_number : `float` or `None`
        Nominal width of the line [nm], temperature [K] and focal ratio; as in the set-up where not given.
    dark_time_s : `tuple` [`float`, ...]
        Time in which each flat gathers charge [s]; empty, the default, if not known.
    """

    wavelength_nm: tuple[float, ...]
    level_e: float = LEVEL_E
    bandwidth_fwhm_nm: float | None = None
    temperature_k: float | None = None
    f_number: float | None = None
    dark_time_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.wavelength_nm or not all(0.0 < w < math.inf for w in self.wavelength_nm):
            raise InputError("wavelengths of a series [nm]", self.wavelength_nm, "one or more, positive")
        if not 0.0 < self.level_e < math.inf:
            raise OutOfRangeError("level of a series [e]", self.level_e, "positive")
        if self.dark_time_s and len(self.dark_time_s) != len(self.wavelength_nm):
            raise InputError(
                "dark times of a series [s]", self.dark_time_s, "one for each wavelength, or none"
            )

    def at_level(self, level_e: float) -> FlatSeries:
        """The same light for as long as another level takes [electrons]."""
        return replace(self, level_e=level_e, dark_time_s=self._longer(level_e / self.level_e))

    def at_bandwidth(self, fwhm_nm: float, setup_fwhm_nm: float) -> FlatSeries:
        """The same level behind a slit of another width than the set-up's [nm]: exposures get longer."""
        return replace(self, bandwidth_fwhm_nm=fwhm_nm, dark_time_s=self._longer(setup_fwhm_nm / fwhm_nm))

    def at_wavelengths(self, wavelength_nm: tuple[float, ...]) -> FlatSeries:
        """Flats at other wavelengths [nm]; as long as those of the nearest."""
        if not self.dark_time_s:
            return replace(self, wavelength_nm=wavelength_nm)
        order = np.argsort(self.wavelength_nm)
        waves, known = np.array(self.wavelength_nm)[order], np.array(self.dark_time_s)[order]
        times = tuple(np.interp(wavelength_nm, waves, known).tolist())
        return replace(self, wavelength_nm=wavelength_nm, dark_time_s=times)

    def _longer(self, factor: float) -> tuple[float, ...]:
        return tuple(factor * time for time in self.dark_time_s)

    def conditions(self, model: FringeModel) -> FringeModel:
        """Model under the nominal conditions of the series.

        Effects whose null is stated by the set-up (width of the line, temperature) keep their ratio to it.

        Raises
        ------
        InputError
            Another width of a line whose shape has none.
        """
        system = model.base_system
        if self.bandwidth_fwhm_nm is not None:
            if not isinstance(system.profile, GaussianProfile | TriangularProfile):
                raise InputError(
                    "bandwidth of a series [nm]", self.bandwidth_fwhm_nm, "none: the light has no line"
                )
            system = replace(system, profile=replace(system.profile, fwhm_nm=self.bandwidth_fwhm_nm))
        if self.temperature_k is not None:
            system = replace(system, temperature_k=self.temperature_k)
        if self.f_number is not None:
            nodes = 6 + math.ceil(120.0 * (0.5 / self.f_number) ** 2)
            system = replace(system, beam=Beam.cone(self.f_number, nodes=nodes))
        moved = tuple(
            replace(item, values=_in_proportion(item.effect, item.values, model, system))
            for item in model.effects
        )
        return replace(model, base_system=system, effects=moved)


def _in_proportion(
    effect: Effect, values: Mapping[str, float], model: FringeModel, system: OpticalSystem
) -> dict[str, float]:
    there = effect.null_values(system)
    here = effect.null_values(model.base_system)
    return {
        name: value if there[name] == here[name] else value * there[name] / here[name]
        for name, value in values.items()
    }


@dataclass(frozen=True)
class Measurement:
    """Data that could be taken in addition.

    Attributes
    ----------
    name, title : `str`
        Key, and what to take, for people.
    """

    name: str
    title: str


@dataclass(frozen=True)
class FlatMeasurement(Measurement):
    """Flats that could be taken in addition.

    Attributes
    ----------
    series : `FlatSeries`
        The flats.
    """

    series: FlatSeries


@dataclass(frozen=True)
class PairForecast:
    """How well the effect that was found is told from another one.

    Attributes
    ----------
    effect, other : `str`
        Names.
    likeness_now, likeness_after : `float`
        Cosine between the signatures, 0 to 1, with the present flats and with the further ones.
    separation_now, separation_after : `float`
        Expected difference of the two fits in standard deviations, the square root of Δχ².
    """

    effect: str
    other: str
    likeness_now: float
    likeness_after: float
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
    """A measurement and what it would tell.

    Attributes
    ----------
    measurement : `Measurement`
        What to take.
    pairs : `tuple` [`PairForecast`, ...]
        The effect that was found against each of the others, hardest first.
    """

    measurement: Measurement
    pairs: tuple[PairForecast, ...]

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


def candidate_measurements(
    model: FringeModel,
    wavelength_nm: Sequence[float] | None = None,
    level_e: float = LEVEL_E,
    dark_time_s: Sequence[float] = (),
) -> tuple[FlatMeasurement, ...]:
    """Measurements that a test stand can make besides its usual flats.

    Parameters
    ----------
    model : `FringeModel`
        Laboratory set-up.
    wavelength_nm : sequence of `float`, optional
        Wavelengths of the present flats [nm]; by default those of the set-up.
    level_e : `float`, optional
        Their mean level [electrons].
    dark_time_s : sequence of `float`, optional
        Time in which each of them gathers charge [s], where it is known.
    """
    present = _present(model, wavelength_nm, level_e, dark_time_s)
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
    level = HIGH_LEVEL_E if level_e < 0.5 * HIGH_LEVEL_E else 0.2 * level_e
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


def rank_measurements(
    model: FringeModel,
    effects: Mapping[str, Mapping[str, float]],
    *,
    wavelength_nm: Sequence[float] | None = None,
    level_e: float = LEVEL_E,
    dark_time_s: Sequence[float] = (),
    thickness_um: tuple[float, float] | None = None,
    significance: float | None = None,
    measurements: Sequence[FlatMeasurement] | None = None,
    nuisance_effects: Sequence[str] = (),
    catalogue: Sequence[Effect] | None = None,
    report: Report | None = None,
) -> tuple[RankedMeasurement, ...]:
    """Rank further measurements by how well they tell apart effects that the present flats cannot.

    Parameters
    ----------
    model : `FringeModel`
        Laboratory set-up with the effects that are beyond doubt, without those of the class.
    effects : mapping
        The class, the effect that was found first: fitted values by effect and parameter. Where nothing is known
        (an empty mapping) an effect departs from null by its prior scale if it can do so to one side only, and
        otherwise by little.
    wavelength_nm, level_e, dark_time_s
        Wavelengths [nm] and mean level [electrons] of the present flats, by default those of the set-up, and the
        time in which each gathers charge [s], where it is known.
    thickness_um : `tuple` [`float`, `float`], optional
        Smallest and largest thickness of the varying layer on the sensor [µm]; by default within 1.5 of the stack's.
    significance : `float`, optional
        Standard deviations by which the present data ask for the effect (root of Δχ²). Without it, that of a whole
        sensor with photon noise and nothing else unknown, which is far too good: only ratios are to be trusted.
    measurements : sequence of `Measurement`, optional
        Those to compare; by default `candidate_measurements`.
    nuisance_effects : sequence of `str`, optional
        Effects known within their prior scale only; they are projected out, too.
    catalogue : sequence of `Effect`, optional
        Where the effects are.
    report : callable, optional
        Called with a line of text for each measurement.

    Returns
    -------
    ranked : `tuple` [`RankedMeasurement`, ...]
        Largest separation of the hardest pair first. Empty if fewer than two of the effects can be forecast: those
        that couple neighbouring pixels, or are in a part of the sensor only, cannot.

    Raises
    ------
    UnknownNameError, OutOfRangeError
        Effects or parameters that do not exist, values out of bounds.
    InputError
        The set-up is not one of a laboratory.
    """
    if model.setup.kind != "monochromator":
        raise InputError("set-up", model.setup.name, "a laboratory set-up with a monochromator")
    say = report or (lambda text: None)
    catalogue = known_effects() if catalogue is None else catalogue
    known = {effect.name: effect for effect in catalogue}
    unknown = [name for name in (*effects, *nuisance_effects) if name not in known]
    if unknown:
        raise UnknownNameError("effect", unknown[0], known)
    tested = [_Tested.of(known[name], values, model) for name, values in effects.items()]
    tested = [item for item in tested if item.effect.search.reach == "pixel" and not item.effect.local]
    if len(tested) < 2:
        return ()
    further = [_Tested.of(known[name], {}, model) for name in nuisance_effects if name not in effects]
    present = _present(model, wavelength_nm, level_e, dark_time_s)
    forecast = _Forecast(
        model, catalogue, tuple(tested), tuple(further), _Sample.of(model, thickness_um), present
    )
    chosen = measurements or candidate_measurements(model, wavelength_nm, level_e, dark_time_s)
    # Many small matrices: threads of the linear algebra would wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        return _ranked(forecast, chosen, significance, say)


def _ranked(
    forecast: _Forecast,
    measurements: Sequence[FlatMeasurement],
    significance: float | None,
    say: Report,
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
        say(ranked[-1].text)
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
    model: FringeModel, wavelength_nm: Sequence[float] | None, level_e: float, dark_time_s: Sequence[float]
) -> FlatSeries:
    waves = model.setup.wavelengths_nm if wavelength_nm is None else wavelength_nm
    return FlatSeries(
        tuple(float(w) for w in waves), level_e, dark_time_s=tuple(float(time) for time in dark_time_s)
    )


@dataclass(frozen=True)
class _Tested:
    """An effect, the values at which it is differentiated, and the direction from null that was found.

    If it has been fitted, and not to its null, the values are those of the fit.
    """

    effect: Effect
    values: dict[str, float]
    direction: FloatArray
    scale: FloatArray
    fitted: bool = False

    @property
    def settings(self) -> dict[str, dict[str, float]]:
        """The effect at its values."""
        return {self.effect.name: self.values}

    @classmethod
    def of(cls, effect: Effect, values: Mapping[str, float], model: FringeModel) -> _Tested:
        nulls = effect.null_values(model.base_system)
        at, direction = {}, []
        for parameter in effect.parameters:
            null, (low, high) = nulls[parameter.name], parameter.bounds
            one_sided = null <= low or null >= high
            given = float(values.get(parameter.name, null))
            if parameter.name in values and not (one_sided and given == null):
                at[parameter.name] = given
                direction.append(given - null)
                continue
            # What starts from a bound may start with its square, without a derivative at the bound itself.
            sign = -1.0 if null >= high else 1.0
            at[parameter.name] = null + sign * parameter.prior_scale * one_sided
            direction.append(0.0 if values else sign * parameter.prior_scale)
        for name in values:
            effect.parameter(name)
        activate_effects({effect.name: at}, (effect,))
        scales = np.array([parameter.prior_scale for parameter in effect.parameters])
        as_fitted = bool(values) and all(at[name] == value for name, value in values.items())
        return cls(effect, at, np.array(direction), scales, as_fitted)

    def neighbours(self, parameter: Parameter) -> tuple[float, float]:
        """Values on both sides, within the bounds, between which a difference is taken."""
        step = DERIVATIVE_STEP * parameter.prior_scale
        repeats_after = self.effect.search.repeats_after.get(parameter.name, 0.0)
        if repeats_after:
            step = min(step, 0.1 * DERIVATIVE_STEP * repeats_after)
        low, high = parameter.bounds
        value = self.values[parameter.name]
        return max(value - step, low), min(value + step, high)


@dataclass(frozen=True, eq=False)
class _Sample:
    """Pixels that stand for a sensor: every fringe phase of both layers, scattered over the sensor."""

    thickness_um: FloatArray  # (ny, nx): thickness of the varying layer
    # (ny,): thickness of the detection layer minus that of the stack; zero if that is the layer that
    # varies
    silicon_um: FloatArray

    @classmethod
    def of(cls, model: FringeModel, range_um: tuple[float, float] | None) -> _Sample:
        system = model.base_system
        rows, columns = SAMPLES
        if range_um is None:
            middle = float(system.stack.thickness_um[system.stack.position(system.varying)])
            range_um = (middle - 1.5, middle + 1.5)
        low, high = range_um
        if not 0.0 < low < high < math.inf:
            raise OutOfRangeError("thickness range [um]", range_um, "two increasing, positive numbers")
        golden = 0.5 * (math.sqrt(5.0) - 1.0)
        place = ((np.arange(rows * columns) + 0.5) * golden) % 1.0
        silicon: FloatArray = np.zeros(rows)
        if system.varying != system.detection:
            medium = system.stack.layers[system.stack.position(system.detection)].medium
            order_um = 0.5e-3 * 950.0 / float(medium.index(950.0, system.temperature_k).real)
            silicon = np.asarray(order_um * (((np.arange(rows) + 0.5) * golden) % 1.0 - 0.5))
        thickness: FloatArray = np.asarray(low + (high - low) * place, dtype=float)
        return cls(thickness.reshape(rows, columns), silicon)

    def geometry(self, series: FlatSeries) -> ImageGeometry:
        """Positions of the samples, spread over the sensor."""
        y, x = (
            np.linspace(0.0, size - 1.0, count)
            for size, count in zip(SENSOR_PX, self.thickness_um.shape, strict=True)
        )
        waves = np.array(series.wavelength_nm)
        level, dark_time = np.full(waves.shape, series.level_e), np.array(series.dark_time_s)
        return ImageGeometry(SENSOR_PX, y, x, waves, level, dark_time_s=dark_time)


@dataclass(frozen=True, eq=False)
class _Block:
    """One series of flats at the sample, shapes ``(W, P)`` and ``(K, W, P)``."""

    image: FloatArray  # signal relative to its mean
    weight: FloatArray  # inverse standard deviation of the noise of a pixel
    # thickness, silicon: derivatives with respect to the two thicknesses [1/µm]
    thickness: FloatArray
    silicon: FloatArray
    # tested, further: derivatives with respect to the parameters of the effects, in units of their prior
    # scales
    tested: FloatArray
    further: FloatArray
    # What the effect that was found does, and what it does that each of the others does not
    difference: FloatArray


@dataclass(frozen=True)
class _Likeness:
    """Strength of the effect that was found, and what another one cannot imitate of it."""

    strength: float
    separation: float

    @property
    def likeness(self) -> float:
        if not self.strength > 0.0:
            return math.nan
        return math.sqrt(max(1.0 - (self.separation / self.strength) ** 2, 0.0))


@dataclass(frozen=True, eq=False)
class _Forecast:
    """Fisher information of sets of flats about the effects of a class, of which the ``present`` ones are there."""

    model: FringeModel
    catalogue: Sequence[Effect]
    tested: tuple[_Tested, ...]
    further: tuple[_Tested, ...]
    sample: _Sample
    present: FlatSeries
    _blocks: dict[FlatSeries, _Block] = field(default_factory=dict, init=False)
    _flats: dict[tuple[object, ...], FloatArray] = field(default_factory=dict, init=False)
    _shifts: dict[str, FloatArray] = field(default_factory=dict, init=False)

    def pairs(self, series: Sequence[FlatSeries]) -> list[_Likeness]:
        """The first effect against each of the others."""
        sizes = [item.scale.size for item in self.tested]
        signature = self.signatures([self._block(each) for each in series])
        tested, difference = np.split(signature, [sum(sizes)], axis=1)
        strength = float(np.linalg.norm(difference[:, 0]))
        tangents = np.split(tested, np.cumsum(sizes)[:-1], axis=1)[1:]
        result = []
        for tangent, own in zip(tangents, difference[:, 1:].T, strict=True):
            basis = _orthonormal(tangent)
            result.append(_Likeness(strength, float(np.linalg.norm(own - basis @ (basis.T @ own)))))
        return result

    def signatures(self, blocks: Sequence[_Block]) -> FloatArray:
        """What the effects do to the flats of a sensor and nothing else does, in units of the noise.

        Returns (rows, K): one column for each parameter, and one for each difference; the products of columns
        are the Fisher information.
        """
        joined = [np.concatenate([getattr(block, name) for block in blocks], axis=-2) for name in _FIELDS]
        image, weight, thickness, silicon, tested, further, difference = joined
        asked = np.concatenate([tested, difference])
        flats, pixels = image.shape
        level = np.zeros((flats, flats, pixels))
        level[np.arange(flats), np.arange(flats)] = image
        columns = np.concatenate([asked, further, silicon[np.newaxis], level]) * weight
        local = np.stack([thickness, image]) * weight
        # The response of a pixel is known a little: a further datum of each pixel, whose expectation no effect moves.
        columns = np.concatenate([columns, np.zeros((len(columns), 1, pixels))], axis=1)
        known = np.zeros((2, 1, pixels))
        known[1] = 1.0 / RESPONSE_SCATTER
        local = np.concatenate([local, known], axis=1)
        basis, _ = np.linalg.qr(np.ascontiguousarray(local.transpose(2, 1, 0)))
        design = np.ascontiguousarray(columns.transpose(2, 1, 0))
        design -= basis @ (basis.transpose(0, 2, 1) @ design)
        design = design.reshape(-1, len(columns)) * math.sqrt(SENSOR_PX[0] * SENSOR_PX[1] / pixels)
        wanted, nuisance = np.split(design, [len(asked)], axis=1)
        # Derivatives are per prior scale, so that the priors are unit rows.
        prior = np.eye(nuisance.shape[1])[: len(further)]
        nuisance = _orthonormal(np.concatenate([nuisance, prior]))
        wanted = np.concatenate([wanted, np.zeros((len(prior), wanted.shape[1]))])
        signature: FloatArray = wanted - nuisance @ (nuisance.T @ wanted)
        return signature

    def _block(self, series: FlatSeries) -> _Block:
        if series not in self._blocks:
            self._blocks[series] = self._differentiated(series)
        return self._blocks[series]

    def _differentiated(self, series: FlatSeries) -> _Block:
        step, found = THICKNESS_STEP_UM, self.tested[0]
        base = found.settings if found.fitted else {}
        image = self._observe(series, base)
        thickness = self._observe(series, base, step) - self._observe(series, base, -step)
        silicon = np.zeros(image.shape)
        if self.model.base_system.varying != self.model.base_system.detection:
            silicon = self._observe(series, base, 0.0, step) - self._observe(series, base, 0.0, -step)
        tested, further = (
            np.array([
                self._slope(series, item, parameter, self._shift(item))
                for item in items for parameter in item.effect.parameters
            ]).reshape(-1, *image.shape)
            for items in (self.tested, self.further)
        )  # fmt: skip
        own = tested[: found.scale.size]
        strong = image - self._observe(series, {}) if found.fitted else self._along(found, own)
        difference = [strong] + [
            image - self._observe(series, other.settings, self._shift(other))
            if found.fitted and other.fitted
            else strong
            for other in self.tested[1:]
        ]
        weight = np.sqrt(series.level_e / np.maximum(image, 1e-6))
        return _Block(
            image, weight, thickness / (2.0 * step), silicon / (2.0 * step), tested, further,
            np.stack(difference),
        )  # fmt: skip

    def _along(self, item: _Tested, slopes: FloatArray) -> FloatArray:
        """An effect of which only the direction is known."""
        return np.asarray(np.tensordot(item.direction / item.scale, slopes, axes=1))

    def _shift(self, item: _Tested) -> FloatArray:
        """Move of the thickness of every pixel [µm] with which an effect comes next to the one that was found."""
        found = self.tested[0]
        if item is found or not (found.fitted and item.fitted):
            return np.zeros(self.sample.thickness_um.shape)
        name = item.effect.name
        if name not in self._shifts:
            self._shifts[name] = self._nearest_shift(item)
        return self._shifts[name]

    def _nearest_shift(self, item: _Tested) -> FloatArray:
        """Best move of all pixels together within some orders, then of each of them within half an order."""
        order = float(self.model.fringe_order_um(np.median(self.present.wavelength_nm)))
        steps = np.arange(-ORDERS_MOVED * STEPS_PER_ORDER, ORDERS_MOVED * STEPS_PER_ORDER + 1)
        steps = steps[self.sample.thickness_um.min() + steps * (order / STEPS_PER_ORDER) > 0.0]
        shifts = steps * (order / STEPS_PER_ORDER)
        wanted = self._observe(self.present, self.tested[0].settings)
        weight = 1.0 / np.maximum(wanted, 1e-6)
        cost = []
        for shift in shifts:
            other = self._observe(self.present, item.settings, float(shift))
            response = (weight * other * wanted).sum(axis=0) / (weight * other**2).sum(axis=0)
            cost.append((weight * (wanted - response * other) ** 2).sum(axis=0))
        misfit = np.array(cost)
        common = int(misfit.sum(axis=1).argmin())
        misfit[np.abs(steps - steps[common]) > STEPS_PER_ORDER // 4] = np.inf
        return np.asarray(shifts[misfit.argmin(axis=0)].reshape(self.sample.thickness_um.shape))

    def _slope(
        self, series: FlatSeries, item: _Tested, parameter: Parameter, shift_um: FloatArray | float = 0.0
    ) -> FloatArray:
        """Derivative with respect to a parameter, in units of its prior scale."""
        low, high = item.neighbours(parameter)
        ends = [
            self._observe(series, {item.effect.name: {**item.values, parameter.name: value}}, shift_um)
            for value in (low, high)
        ]
        slope: FloatArray = (ends[1] - ends[0]) * (parameter.prior_scale / (high - low))
        return slope

    def _observe(
        self,
        series: FlatSeries,
        effects: Mapping[str, Mapping[str, float]],
        shift_um: FloatArray | float = 0.0,
        silicon_um: float = 0.0,
    ) -> FloatArray:
        """Flats of the sample over their means, shape ``(W, P)``."""
        model = self.model.with_effects({**self.model.effect_settings, **effects}, self.catalogue)
        model = series.conditions(model)
        optical = tuple(item for item in model.effects if item.effect.acts_on != "image")
        # Neither the level, nor the time it takes, nor an effect on the image changes what the optics do.
        settings = tuple((item.effect.name, *sorted(item.values.items())) for item in optical)
        moved = np.broadcast_to(shift_um, self.sample.thickness_um.shape)
        key = (replace(series, level_e=1.0, dark_time_s=()), settings, moved.tobytes(), silicon_um)
        if key not in self._flats:
            bare = replace(model, effects=optical)
            self._flats[key] = self._optical(bare, series, moved, silicon_um)
        geometry = self.sample.geometry(series)
        image = apply_to_image(model.effects, model.base_system, self._flats[key], geometry)
        return image.reshape(len(image), -1)

    def _optical(
        self, model: FringeModel, series: FlatSeries, shift_um: FloatArray, silicon_um: float
    ) -> FloatArray:
        """Response of the sample over its means, shape ``(W, ny, nx)``."""
        system, waves = model.base_system, np.array(series.wavelength_nm)
        nominal = system.stack.layers[system.stack.position(system.detection)].thickness_um
        rows = []
        places = zip(self.sample.thickness_um + shift_um, self.sample.silicon_um, strict=True)
        for thickness, offset in places:
            moved = system.with_layer(system.detection, thickness_um=nominal + offset + silicon_um)
            one = replace(model, base_system=moved)
            rows.append(one.respond(one.system.flat_fields(waves, LINE_STEP_NM), thickness, waves))
        image = np.stack(rows, axis=1)
        image /= image.mean(axis=(1, 2), keepdims=True)
        return image


_FIELDS = ("image", "weight", "thickness", "silicon", "tested", "further", "difference")


def _orthonormal(columns: FloatArray) -> FloatArray:
    """Orthonormal basis of what the columns span; directions that are only rounding are left out."""
    norm = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(norm > 0.0, norm, 1.0)
    basis, size, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(basis[:, size > 1e-9 * max(float(size.max()), 1e-300)])
