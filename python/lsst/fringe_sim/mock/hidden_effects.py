"""Physical effects that a mock can hide in its frames, in the mock's own implementation.

Each acts at the place where nature has it: in the optics of the sensor, on the light that arrives, on the charge
that is collected, or in the electronics of an amplifier. At their null values they change nothing. Names and
units agree with the catalogue of the model where both know an effect; no code is shared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import fourier_gaussian, laplace

from ..errors import InputError, OutOfRangeError, UnknownNameError, to_number
from ..resources import read_table
from .optics import Film, FlatFieldOptics

__all__ = [
    "HIDDEN_EFFECTS",
    "ActiveHiddenEffect",
    "AmplifierState",
    "HiddenEffect",
    "HiddenParameter",
    "Island",
    "added_silicon",
    "hidden_islands",
    "validate_effects",
    "with_hidden_optics",
]

FloatArray = NDArray[np.float64]
Values = Mapping[str, float]

AMPLIFIER_NAMES = tuple(f"C{row}{column}" for row in (1, 0) for column in range(8))
REFERENCE_CHARGE_E = 100_000.0
"""Charge at which the coefficient of the non-linearity is stated [electrons]."""

RIM_SQUARES, RIM_POINTS = 8, 8
"""Squares along a side of a pixel that a rim crosses, and points along the side of each."""

COLOUR_PIVOT_NM, COLOUR_REACH_NM = 935.0, 50.0
"""Wavelength at which a chromatic illumination is even, and distance to that at which its numbers are stated [nm]."""

XENON_REFERENCE_NM, XENON_FWHM_NM = 992.592, 2.0
"""The line whose peak is the strength of all, and the width of each [nm]."""


@dataclass(frozen=True)
class HiddenParameter:
    """One number of an effect; a null of NaN means "as the set-up says"."""

    name: str
    unit: str
    null: float
    bounds: tuple[float, float]
    description: str


@dataclass(frozen=True)
class AmplifierState:
    """What one amplifier really does, as opposed to what the tables say of it.

    Attributes
    ----------
    name : `str`
        ``C00`` … ``C17``.
    gain : `float`
        Gain [electrons per ADU].
    read_noise_e : `float`
        Read noise [electrons rms].
    saturation_e : `float`
        Full well [electrons].
    dark_e : `float`
        Charge that gathers in every imaging pixel of a flat without being light [electrons].
    dark_rate_e : `float`
        The same, in each second of the exposure [electrons / s].
    offset_e : `float`
        Level that the imaging pixels of a flat have and its overscan has not, without noise of its own
        [electrons].
    """

    name: str
    gain: float
    read_noise_e: float
    saturation_e: float
    dark_e: float = 0.0
    offset_e: float = 0.0
    dark_rate_e: float = 0.0

    def dark_signal_e(self, seconds: float) -> float:
        """Charge without light of an exposure of so many seconds [electrons]."""
        return self.dark_e + self.dark_rate_e * seconds


@dataclass(frozen=True, eq=False)
class Island:
    """Where on a sensor something is.

    Attributes
    ----------
    part : `numpy.ndarray` [y, x]
        Part of every pixel that lies on it.
    rows, columns : `numpy.ndarray`, shape ``(N,)``
        Pixels that its rim may cross.
    squares : `numpy.ndarray`, shape ``(N, RIM_SQUARES, RIM_SQUARES)``
        Part of each of the equal squares in these pixels, along y and x, that lies on it.
    """

    part: FloatArray
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    squares: FloatArray


@dataclass(frozen=True)
class HiddenEffect:
    """An effect and the one or two places at which it acts.

    Attributes
    ----------
    name, title : `str`
        Key in the mapping of effects; one line for people.
    parameters : `tuple` [`HiddenParameter`, ...]
        Its numbers.
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
    parameters: tuple[HiddenParameter, ...]
    on_optics: Callable[[FlatFieldOptics, Values], FlatFieldOptics] | None = None
    on_island: Callable[[tuple[int, int], Values], Island] | None = None
    on_silicon: Callable[[tuple[int, int], Values], FloatArray] | None = None
    on_light: Callable[[FloatArray, float, Values], FloatArray] | None = None
    on_charge: Callable[[FloatArray, Values], FloatArray] | None = None
    on_amplifier: Callable[[AmplifierState, Values, float], AmplifierState] | None = None

    def parameter(self, name: str) -> HiddenParameter:
        """Parameter called ``name``.

        Raises
        ------
        UnknownNameError
            The effect has no such parameter.
        """
        for candidate in self.parameters:
            if candidate.name == name:
                return candidate
        known = [candidate.name for candidate in self.parameters]
        raise UnknownNameError(f"parameter of effect {self.name}", name, known)

    def complete(self, values: Values) -> dict[str, float]:
        """Values of all parameters, null where none is given."""
        return {p.name: values.get(p.name, p.null) for p in self.parameters}


ActiveHiddenEffect = tuple[HiddenEffect, Mapping[str, float]]
"""An effect and the values given for it."""


def validate_effects(
    settings: Mapping[str, Any] | None, catalogue: tuple[HiddenEffect, ...] | None = None
) -> tuple[tuple[HiddenEffect, dict[str, float]], ...]:
    """Check settings and return the effects with their values, in the order of the catalogue.

    Parameters
    ----------
    settings : mapping or `None`
        ``{"bandwidth.fwhm": 2.4}`` or ``{"bandwidth": {"fwhm": 2.4}}``, or both mixed.
    catalogue : `tuple` [`HiddenEffect`, ...], optional
        Effects to choose from; `HIDDEN_EFFECTS` by default.

    Raises
    ------
    UnknownNameError
        An effect or a parameter that is not in the catalogue.
    OutOfRangeError
        A value outside the bounds of its parameter.
    InputError
        A value that is not a finite number, or a setting without a parameter.
    """
    effects = HIDDEN_EFFECTS if catalogue is None else catalogue
    by_name = {effect.name: effect for effect in effects}
    chosen: dict[str, dict[str, float]] = {}
    for name, parameter_name, value in _flatten(settings or {}):
        if name not in by_name:
            raise UnknownNameError("effect", name, by_name)
        parameter = by_name[name].parameter(parameter_name)
        chosen.setdefault(name, {})[parameter_name] = _number(f"{name}.{parameter_name}", value, parameter)
    return tuple((effect, chosen[effect.name]) for effect in effects if effect.name in chosen)


def _flatten(settings: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            for parameter, number in value.items():
                yield str(key), str(parameter), number
            continue
        effect, _, parameter = str(key).partition(".")
        if not effect or not parameter:
            raise InputError("effect setting", key, "name.parameter=value")
        yield effect, parameter, value


def _number(what: str, value: Any, parameter: HiddenParameter) -> float:
    number = to_number(what, value)
    low, high = parameter.bounds
    if not low <= number <= high:
        raise OutOfRangeError(f"{what} [{parameter.unit or '1'}]", number, f"{low:g} to {high:g}")
    return number


# Optics ---------------------------------------------------------------------------------------------------


def _bandwidth(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    fwhm = values["fwhm"]
    return optics if math.isnan(fwhm) else replace(optics, bandwidth_fwhm_nm=fwhm)


def _wavelength_offset(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, wavelength_offset_nm=optics.wavelength_offset_nm + values["offset"])


def _wavelength_jitter(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(
        optics,
        wavelength_errors_nm=tuple(
            (float(name.removeprefix("at_")), error) for name, error in values.items()
        ),
    )


def _wavelength_scale(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, wavelength_stretch=optics.wavelength_stretch + values["stretch"])


def _temperature(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    kelvin = values["kelvin"]
    return optics if math.isnan(kelvin) else replace(optics, temperature_k=kelvin)


def _epoxy_index(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return optics.with_film("adhesive", index_shift=values["offset"], cauchy_um2=values["cauchy"])


def _epoxy_absorption(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return optics.with_film("adhesive", extinction_shift=values["k"])


def _silicon_absorption(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return optics.with_film(optics.detection, extinction_scale=values["scale"])


def _ar_coating(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    for name in ("ar_outer", "ar_inner"):
        film = optics.films[optics.position(name)]
        optics = optics.with_film(name, thickness_um=film.thickness_um * values["scale"])
    return optics


def _support_index(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return optics.with_film("support", index_shift=values["offset"])


def _thicker(optics: FlatFieldOptics, name: str, by_um: float) -> FlatFieldOptics:
    """Optics with one film thicker."""
    film = optics.films[optics.position(name)]
    return optics.with_film(name, thickness_um=film.thickness_um + by_um)


def _black_coating(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    names = [film.name for film in optics.films]
    if "black_coating" in names:
        return _thicker(optics, "black_coating", values["thickness"])
    return _inserted(optics, Film("black_coating", "litho_black", values["thickness"]), "adhesive")


def _air_gap(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return _inserted(optics, Film("air_gap", "vacuum", 1e-3 * values["thickness"]), "support")


def _inserted(optics: FlatFieldOptics, film: Film, before: str) -> FlatFieldOptics:
    """Optics with one film more; a film of no thickness is none."""
    if film.thickness_um == 0.0:
        return optics
    place = optics.position(before)
    return replace(optics, films=(*optics.films[:place], film, *optics.films[place:]))


def _support_coherence(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, support_spread_um=values["spread"])


def _line_wing(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, other_lines=(*optics.other_lines, ("lorentzian", values["fraction"])))


def _line_triangle(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, other_lines=(*optics.other_lines, ("triangular", values["fraction"])))


def _lamp_lines(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    table = read_table("laboratory", "xenon_lines.ecsv")
    xenon = {float(row["wavelength"]): float(row["intensity"]) for row in table}
    peak = values["strength"] / xenon[XENON_REFERENCE_NM]
    lines = tuple((centre, peak * intensity, XENON_FWHM_NM) for centre, intensity in xenon.items())
    return replace(optics, lamp_lines=lines if values["strength"] else ())


def _tilt(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, theta=tuple(theta + math.radians(values["angle"]) for theta in optics.theta))


def _roughness(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, rough_face="support", roughness_nm=values["sigma"])


def _thickness_spread(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, spread_nm=values["sigma"])


def _converging_beam(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    aperture = values["numerical_aperture"]
    if aperture == 0.0:
        return optics
    # Nodes enough for the phase between axis and rim: half a node per radian is ample for Gauss–Legendre.
    path_um = sum(film.thickness_um for film in optics.films if math.isfinite(film.thickness_um))
    phase = 2.0 * math.pi * path_um * aperture**2 / (1.6 * 0.85)
    nodes, weight = np.polynomial.legendre.leggauss(8 + math.ceil(0.5 * phase))
    # Equal light per unit of sin² of the angle: a uniformly bright source, or a pupil under the sine condition.
    theta = np.arcsin(aperture * np.sqrt(0.5 * (nodes + 1.0)))
    return replace(optics, theta=tuple(theta.tolist()), theta_weight=tuple((0.5 * weight).tolist()))


def _contrast_loss(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, coherent_part=optics.coherent_part * values["factor"])


# Light ----------------------------------------------------------------------------------------------------


def _ghost_pedestal(light: FloatArray, wavelength_nm: float, values: Values) -> FloatArray:
    return light + values["fraction"]


def _illumination(light: FloatArray, wavelength_nm: float, values: Values) -> FloatArray:
    v, u = _sensor_coordinates(light.shape)
    return light * (1.0 + 0.5 * values["gradient_x"] * u + 0.5 * values["gradient_y"] * v)


def _vignetting(light: FloatArray, wavelength_nm: float, values: Values) -> FloatArray:
    v, u = _sensor_coordinates(light.shape)
    return light * (1.0 - 0.5 * values["corner"] * (u * u + v * v))


def _chromatic_illumination(light: FloatArray, wavelength_nm: float, values: Values) -> FloatArray:
    v, u = _sensor_coordinates(light.shape)
    pattern = 0.5 * (values["gradient_x"] * u + values["gradient_y"] * v)
    pattern = pattern + values["curvature_xx"] * u * u + values["curvature_xy"] * u * v
    pattern = pattern + values["curvature_yy"] * v * v
    return light * (1.0 + (wavelength_nm - COLOUR_PIVOT_NM) / COLOUR_REACH_NM * pattern)


def _silicon_gradient(shape: tuple[int, int], values: Values) -> FloatArray:
    v, u = _sensor_coordinates(shape)
    return np.asarray(0.5 * (values["gradient_x"] * u + values["gradient_y"] * v))


def with_hidden_optics(optics: FlatFieldOptics, active: Iterable[ActiveHiddenEffect]) -> FlatFieldOptics:
    """Optics with all effects in them that all of the sensor has."""
    for effect, values in active:
        if effect.on_optics is not None and effect.on_island is None:
            optics = effect.on_optics(optics, effect.complete(values))
    return optics


def hidden_islands(
    optics: FlatFieldOptics, shape: tuple[int, int], active: Iterable[ActiveHiddenEffect]
) -> list[tuple[Island, FlatFieldOptics]]:
    """What sees other optics than the rest of the sensor, and these optics."""
    return [
        (effect.on_island(shape, effect.complete(values)), effect.on_optics(optics, effect.complete(values)))
        for effect, values in active
        if effect.on_island is not None and effect.on_optics is not None
    ]


def _disc(shape: tuple[int, int], values: Values) -> Island:
    """What lies inside a circle, by points in each pixel that the circle may cross."""
    y, x = (np.arange(size, dtype=float) for size in shape)
    away = np.hypot(y[:, np.newaxis] - values["centre_y"], x[np.newaxis, :] - values["centre_x"])
    part = (away < values["radius"]).astype(float)
    rows, columns = np.nonzero(np.abs(away - values["radius"]) < 1.0)
    number = RIM_SQUARES * RIM_POINTS
    point = (np.arange(number) + 0.5) / number - 0.5
    squares = np.empty((len(rows), RIM_SQUARES, RIM_SQUARES))
    for place, (row, column) in enumerate(zip(rows, columns, strict=True)):
        up = (y[row] + point - values["centre_y"])[:, np.newaxis]
        along = (x[column] + point - values["centre_x"])[np.newaxis, :]
        inside = np.hypot(up, along) < values["radius"]
        squares[place] = inside.reshape(RIM_SQUARES, RIM_POINTS, RIM_SQUARES, RIM_POINTS).mean(axis=(1, 3))
    part[rows, columns] = squares.mean(axis=(1, 2))
    return Island(part, rows, columns, squares)


def added_silicon(shape: tuple[int, int], active: Iterable[ActiveHiddenEffect]) -> FloatArray | None:
    """What effects add to the detection layer at every pixel [µm]; `None` if they leave it alone."""
    parts = [
        effect.on_silicon(shape, effect.complete(values))
        for effect, values in active
        if effect.on_silicon is not None
    ]
    return np.sum(parts, axis=0) if parts else None


def _midline_step(light: FloatArray, wavelength_nm: float, values: Values) -> FloatArray:
    upper = np.arange(light.shape[0])[:, np.newaxis] >= light.shape[0] // 2
    return light * np.where(upper, 1.0 + values["fraction"], 1.0)


def _tree_rings(light: FloatArray, wavelength_nm: float, values: Values) -> FloatArray:
    inside = (np.arange(3) - 1.0) / 3.0  # a pixel is seen at nine places
    y, x = (np.add.outer(np.arange(size), inside).ravel() for size in light.shape)
    radius = np.hypot(y[:, np.newaxis] - values["centre_y"], x - values["centre_x"])
    middle = [0.5 * (size - 1) for size in light.shape]
    turns = (radius - math.dist(middle, (values["centre_y"], values["centre_x"]))) / values["period"]
    wave = values["cosine"] * np.cos(2.0 * math.pi * turns) + values["sine"] * np.sin(2.0 * math.pi * turns)
    return light * (1.0 + wave.reshape(light.shape[0], 3, light.shape[1], 3).mean(axis=(1, 3)))


def _sensor_coordinates(shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Coordinates from -1 to 1 along y and x."""
    v = np.linspace(-1.0, 1.0, shape[0])[:, np.newaxis]
    u = np.linspace(-1.0, 1.0, shape[1])[np.newaxis, :]
    return v, u


def _charge_diffusion(light: FloatArray, wavelength_nm: float, values: Values) -> FloatArray:
    """Blur the light before the charge is counted, mirrored at the edges.

    Not a Gaussian sampled at whole pixels, which has another width below 0.7 pixels.
    """
    if not values["sigma"]:
        return light
    for axis, size in enumerate(light.shape):
        spectrum = np.fft.rfft(np.concatenate([light, np.flip(light, axis)], axis=axis), axis=axis)
        radius = [0.0] * light.ndim
        radius[axis] = values["sigma"]
        blurred = np.fft.irfft(fourier_gaussian(spectrum, radius, 2 * size, axis), 2 * size, axis)
        light = np.take(blurred, range(size), axis=axis)
    return light


# Charge and electronics -----------------------------------------------------------------------------------


def _non_linearity(electrons: FloatArray, values: Values) -> FloatArray:
    return electrons * (1.0 - values["quadratic"] * electrons / REFERENCE_CHARGE_E)


def _brighter_fatter(electrons: FloatArray, values: Values) -> FloatArray:
    """Every electron of a pixel pushes a few of those that follow into the four neighbours, both ways."""
    return electrons + 0.25 * values["variance"] / REFERENCE_CHARGE_E * laplace(electrons**2, mode="reflect")


def _crosstalk(electrons: FloatArray, values: Values) -> FloatArray:
    """Segments of one row of amplifiers are read side by side, pixel by pixel."""
    width = electrons.shape[1] // 8
    result = electrons.copy()
    if width and values["from_left"]:
        result[:, width : 8 * width] += values["from_left"] * electrons[:, : 7 * width]
    if width and values["from_right"]:
        result[:, : 7 * width] += values["from_right"] * electrons[:, width : 8 * width]
    return result


def _dark_pedestal(state: AmplifierState, values: Values, deviate: float) -> AmplifierState:
    return replace(state, dark_e=state.dark_e + values["electrons"])


def _dark_current(state: AmplifierState, values: Values, deviate: float) -> AmplifierState:
    return replace(state, dark_rate_e=state.dark_rate_e + values["rate"])


def _amplifier_gain(state: AmplifierState, values: Values, deviate: float) -> AmplifierState:
    return replace(state, gain=state.gain * (1.0 + values[state.name] + values["rms"] * deviate))


def _amplifier_offset(state: AmplifierState, values: Values, deviate: float) -> AmplifierState:
    return replace(state, offset_e=state.offset_e + values[state.name] + values["rms"] * deviate)


def _per_amplifier(
    unit: str, low: float, high: float, high_rms: float, what: str
) -> tuple[HiddenParameter, ...]:
    each = tuple(
        HiddenParameter(name, unit, 0.0, (low, high), f"{what} of {name}") for name in AMPLIFIER_NAMES
    )
    rms = HiddenParameter(
        "rms", unit, 0.0, (0.0, high_rms), f"{what}: rms of a random one on every amplifier"
    )
    return (rms, *each)


_UNSET = math.nan

HIDDEN_EFFECTS: tuple[HiddenEffect, ...] = (
    HiddenEffect(
        "bandwidth",
        "bandpass width",
        (HiddenParameter("fwhm", "nm", _UNSET, (0.05, 20.0), "full width at half maximum"),),
        on_optics=_bandwidth,
    ),
    HiddenEffect(
        "wavelength_offset",
        "wavelength offset",
        (HiddenParameter("offset", "nm", 0.0, (-10.0, 10.0), "true minus nominal wavelength"),),
        on_optics=_wavelength_offset,
    ),
    HiddenEffect(
        "wavelength_scale",
        "wavelength scale",
        (HiddenParameter("stretch", "nm/nm", 0.0, (-0.1, 0.1), "relative error of wavelength differences"),),
        on_optics=_wavelength_scale,
    ),
    HiddenEffect(
        "wavelength_jitter",
        "wavelength error of single exposures",
        tuple(
            HiddenParameter(
                f"at_{nominal}", "nm", 0.0, (-5.0, 5.0), f"true minus nominal wavelength at {nominal} nm"
            )
            for nominal in range(800, 1060, 10)
        ),
        on_optics=_wavelength_jitter,
    ),
    HiddenEffect(
        "temperature",
        "temperature",
        (HiddenParameter("kelvin", "K", _UNSET, (120.0, 320.0), "temperature of the sensor"),),
        on_optics=_temperature,
    ),
    HiddenEffect(
        "epoxy_index",
        "adhesive index and dispersion",
        (
            HiddenParameter("offset", "", 0.0, (-0.3, 0.3), "index minus the tabulated one at 960 nm"),
            HiddenParameter("cauchy", "um2", 0.0, (-0.05, 0.05), "coefficient of 1/wavelength²"),
        ),
        on_optics=_epoxy_index,
    ),
    HiddenEffect(
        "epoxy_absorption",
        "adhesive absorption",
        (HiddenParameter("k", "", 0.0, (0.0, 0.05), "extinction coefficient"),),
        on_optics=_epoxy_absorption,
    ),
    HiddenEffect(
        "silicon_thickness",
        "silicon thickness",
        (HiddenParameter("offset", "um", 0.0, (-20.0, 20.0), "thickness minus that of the stack"),),
        on_optics=lambda optics, values: _thicker(optics, optics.detection, values["offset"]),
    ),
    HiddenEffect(
        "silicon_gradient",
        "silicon thicker on one side",
        (
            HiddenParameter("gradient_x", "um", 0.0, (-10.0, 10.0), "rise from the left to the right edge"),
            HiddenParameter("gradient_y", "um", 0.0, (-10.0, 10.0), "rise from the lower to the upper edge"),
        ),
        on_silicon=_silicon_gradient,
    ),
    HiddenEffect(
        "silicon_absorption",
        "silicon extinction",
        (HiddenParameter("scale", "", 1.0, (0.5, 2.0), "factor on the extinction coefficient"),),
        on_optics=_silicon_absorption,
    ),
    HiddenEffect(
        "ar_coating",
        "anti-reflection coating",
        (HiddenParameter("scale", "", 1.0, (0.5, 1.5), "factor on both thicknesses"),),
        on_optics=_ar_coating,
    ),
    HiddenEffect(
        "support_index",
        "index of the support",
        (HiddenParameter("offset", "", 0.0, (-2.4, 1.0), "index minus that of the stack"),),
        on_optics=_support_index,
    ),
    HiddenEffect(
        "gate_oxide",
        "oxide under the gates",
        (HiddenParameter("offset", "um", 0.0, (-0.09, 0.3), "thickness minus that of the stack"),),
        on_optics=lambda optics, values: _thicker(optics, "gate_oxide", values["offset"]),
    ),
    HiddenEffect(
        "insulation",
        "insulation behind the gates",
        (HiddenParameter("offset", "um", 0.0, (-0.3, 0.5), "thickness minus that of the stack"),),
        on_optics=lambda optics, values: _thicker(optics, "insulation", values["offset"]),
    ),
    HiddenEffect(
        "gate_thickness",
        "polysilicon gates",
        (HiddenParameter("offset", "um", 0.0, (-0.2, 0.3), "thickness minus that of the stack"),),
        on_optics=lambda optics, values: _thicker(optics, "gates", values["offset"]),
    ),
    HiddenEffect(
        "black_coating",
        "black coating behind the gates",
        (HiddenParameter("thickness", "um", 0.0, (0.0, 3.0), "thickness added to that of the stack"),),
        on_optics=_black_coating,
    ),
    HiddenEffect(
        "air_gap",
        "gap between adhesive and support",
        (HiddenParameter("thickness", "nm", 0.0, (0.0, 2000.0), "thickness of the gap"),),
        on_optics=_air_gap,
    ),
    HiddenEffect(
        "void",
        "island on which the adhesive has come off",
        (
            HiddenParameter("thickness", "nm", 0.0, (0.0, 2000.0), "thickness of the gap"),
            HiddenParameter("centre_x", "px", 0.0, (-100.0, 4200.0), "column of its middle"),
            HiddenParameter("centre_y", "px", 0.0, (-100.0, 4200.0), "row of its middle"),
            HiddenParameter("radius", "px", 10.0, (1.0, 2000.0), "its radius"),
        ),
        on_optics=_air_gap,
        on_island=_disc,
    ),
    HiddenEffect(
        "support_coherence",
        "partially incoherent support",
        (HiddenParameter("spread", "um", 0.0, (0.0, 2.0), "rms thickness variation inside a pixel"),),
        on_optics=_support_coherence,
    ),
    HiddenEffect(
        "line_wing",
        "Lorentzian wings of the line",
        (HiddenParameter("fraction", "", 0.0, (0.0, 1.0), "part of the light in a Lorentzian"),),
        on_optics=_line_wing,
    ),
    HiddenEffect(
        "line_triangle",
        "triangular line",
        (HiddenParameter("fraction", "", 0.0, (0.0, 1.0), "part of the light in a triangle"),),
        on_optics=_line_triangle,
    ),
    HiddenEffect(
        "lamp_lines",
        "lines of the xenon lamp",
        (HiddenParameter("strength", "", 0.0, (0.0, 50.0), "peak of the 992.6 nm line over the continuum"),),
        on_optics=_lamp_lines,
    ),
    HiddenEffect(
        "tilt",
        "tilted sensor",
        (HiddenParameter("angle", "deg", 0.0, (0.0, 40.0), "angle of incidence"),),
        on_optics=_tilt,
    ),
    HiddenEffect(
        "roughness",
        "interface roughness",
        (HiddenParameter("sigma", "nm", 0.0, (0.0, 300.0), "rms height of the support surface"),),
        on_optics=_roughness,
    ),
    HiddenEffect(
        "thickness_spread",
        "thickness variation inside a pixel",
        (HiddenParameter("sigma", "nm", 0.0, (0.0, 300.0), "rms variation of the layer that varies"),),
        on_optics=_thickness_spread,
    ),
    HiddenEffect(
        "converging_beam",
        "converging beam or extended source",
        (
            HiddenParameter(
                "numerical_aperture", "", 0.0, (0.0, 0.7), "sine of the largest angle of incidence"
            ),
        ),
        on_optics=_converging_beam,
    ),
    HiddenEffect(
        "ghost_pedestal",
        "scattered light or ghost pedestal",
        (HiddenParameter("fraction", "", 0.0, (0.0, 20.0), "pedestal over mean signal"),),
        on_light=_ghost_pedestal,
    ),
    HiddenEffect(
        "contrast_loss",
        "constant contrast loss",
        (HiddenParameter("factor", "", 1.0, (0.0, 1.5), "factor on the departure from the mean"),),
        on_optics=_contrast_loss,
    ),
    HiddenEffect(
        "illumination",
        "illumination gradient",
        (
            HiddenParameter(
                "gradient_x", "", 0.0, (-0.5, 0.5), "relative rise from the left to the right edge"
            ),
            HiddenParameter(
                "gradient_y", "", 0.0, (-0.5, 0.5), "relative rise from the lower to the upper edge"
            ),
        ),
        on_light=_illumination,
    ),
    HiddenEffect(
        "vignetting",
        "vignetting",
        (
            HiddenParameter(
                "corner", "", 0.0, (0.0, 0.9), "relative loss in the corners, quadratic in radius"
            ),
        ),
        on_light=_vignetting,
    ),
    HiddenEffect(
        "chromatic_illumination",
        "uneven illumination, changing with wavelength",
        tuple(
            HiddenParameter(name, "", 0.0, (-0.3, 0.3), f"coefficient of {term} per {COLOUR_REACH_NM:g} nm")
            for name, term in (
                ("gradient_x", "u / 2"),
                ("gradient_y", "v / 2"),
                ("curvature_xx", "u²"),
                ("curvature_xy", "u v"),
                ("curvature_yy", "v²"),
            )
        ),
        on_light=_chromatic_illumination,
    ),
    HiddenEffect(
        "midline_step",
        "step at the middle row",
        (
            HiddenParameter(
                "fraction", "", 0.0, (-0.2, 0.2), "relative step from the lower to the upper half"
            ),
        ),
        on_light=_midline_step,
    ),
    HiddenEffect(
        "tree_rings",
        "tree rings of the silicon",
        (
            HiddenParameter(
                "cosine", "", 0.0, (-0.05, 0.05), "amplitude of the cosine; phase 0 in the middle"
            ),
            HiddenParameter("sine", "", 0.0, (-0.05, 0.05), "amplitude of the sine"),
            HiddenParameter("centre_x", "px", 0.0, (-10_000.0, 14_000.0), "column of the centre"),
            HiddenParameter("centre_y", "px", 0.0, (-10_000.0, 14_000.0), "row of the centre"),
            HiddenParameter("period", "px", 50.0, (2.0, 500.0), "distance of rings"),
        ),
        on_light=_tree_rings,
    ),
    HiddenEffect(
        "charge_diffusion",
        "charge diffusion",
        (HiddenParameter("sigma", "px", 0.0, (0.0, 5.0), "rms radius along one axis"),),
        on_light=_charge_diffusion,
    ),
    HiddenEffect(
        "dark_pedestal",
        "dark pedestal",
        (HiddenParameter("electrons", "electron", 0.0, (0.0, 100_000.0), "level in every flat"),),
        on_amplifier=_dark_pedestal,
    ),
    HiddenEffect(
        "dark_current",
        "dark current or light leak",
        (HiddenParameter("rate", "electron/s", 0.0, (0.0, 2000.0), "electrons per second of a flat"),),
        on_amplifier=_dark_current,
    ),
    HiddenEffect(
        "brighter_fatter",
        "brighter-fatter effect",
        (
            HiddenParameter(
                "variance", "px2", 0.0, (0.0, 0.5), "spread along one axis behind 100 000 electrons"
            ),
        ),
        on_charge=_brighter_fatter,
    ),
    HiddenEffect(
        "non_linearity",
        "non-linear response to charge",
        (HiddenParameter("quadratic", "", 0.0, (-0.2, 0.2), "relative loss at 100 000 electrons"),),
        on_charge=_non_linearity,
    ),
    HiddenEffect(
        "crosstalk",
        "crosstalk between neighbouring amplifiers",
        (
            HiddenParameter("from_left", "", 0.0, (-0.05, 0.05), "part of the amplifier at lower x"),
            HiddenParameter("from_right", "", 0.0, (-0.05, 0.05), "part of the amplifier at higher x"),
        ),
        on_charge=_crosstalk,
    ),
    HiddenEffect(
        "amplifier_gain",
        "gain errors of the amplifiers",
        _per_amplifier("", -0.5, 0.5, 0.2, "relative gain error"),
        on_amplifier=_amplifier_gain,
    ),
    HiddenEffect(
        "amplifier_offset",
        "bias residuals of the amplifiers",
        _per_amplifier("electron", -5000.0, 5000.0, 1000.0, "offset in flats"),
        on_amplifier=_amplifier_offset,
    ),
)
"""Every effect that a mock can hide."""
