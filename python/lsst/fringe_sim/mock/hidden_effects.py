"""Physical effects that a mock can hide in its frames, in the mock's own implementation.

Each acts at the place where nature has it: in the optics of the sensor, on the light that arrives, on the charge
that is collected, or in the electronics of an amplifier. At their null values they change nothing. Names, units, null
values and bounds are those of the model's catalogue; no physics is shared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import fourier_gaussian, laplace

from ..effects import EFFECTS, Parameter
from ..effects.active import check_settings
from ..resources import read_table
from .hidden_effect import (
    RIM_POINTS,
    RIM_SQUARES,
    ActiveHiddenEffect,
    AmplifierState,
    FloatArray,
    HiddenEffect,
    Island,
    Values,
)
from .optics import Film, FlatFieldOptics

REFERENCE_CHARGE_E = 100_000.0  # Charge at which the coefficient of the non-linearity is stated [electrons]

COLOUR_PIVOT_NM, COLOUR_REACH_NM = 935.0, 50.0
"""Wavelength at which a chromatic illumination is even, and distance to that at which its numbers are stated [nm]."""

XENON_REFERENCE_NM, XENON_FWHM_NM = 992.592, 2.0
"""The line whose peak is the strength of all, and the width of each [nm]."""


def validate_effects(settings: Mapping[str, Any] | None) -> tuple[tuple[HiddenEffect, dict[str, float]], ...]:
    """Check settings and return the effects with their values, in the order of the catalogue.

    Parameters
    ----------
    settings : mapping or `None`
        ``{"bandwidth.fwhm": 2.4}`` or ``{"bandwidth": {"fwhm": 2.4}}``, or both mixed.

    Raises
    ------
    UnknownNameError
        An effect or a parameter that is not in the catalogue.
    OutOfRangeError
        A value outside the bounds of its parameter.
    InputError
        A value that is not a finite number, or a setting without a parameter.
    """
    return check_settings(settings or {}, HIDDEN_EFFECTS)


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


def added_silicon(shape: tuple[int, int], active: Iterable[ActiveHiddenEffect]) -> FloatArray | None:
    """What effects add to the detection layer at every pixel [µm]; `None` if they leave it alone."""
    parts = [
        effect.on_silicon(shape, effect.complete(values))
        for effect, values in active
        if effect.on_silicon is not None
    ]
    return np.sum(parts, axis=0) if parts else None


# Optics ---------------------------------------------------------------------------------------------------


def _named(values: Values, fields: Mapping[str, str]) -> dict[str, Any]:
    """Parameters by the fields that they are."""
    return {field: values[name] for field, name in fields.items()}


def _sets(**fields: str) -> Callable[[FlatFieldOptics, Values], FlatFieldOptics]:
    """The effect that replaces fields of the optics by its parameters."""
    return lambda optics, values: replace(optics, **_named(values, fields))


def _adds(**fields: str) -> Callable[..., Any]:
    """The effect that adds its parameters to fields of the optics or of an amplifier."""
    return lambda state, values, *_: replace(
        state, **{field: getattr(state, field) + more for field, more in _named(values, fields).items()}
    )


def _changes(film: str, **fields: str) -> Callable[[FlatFieldOptics, Values], FlatFieldOptics]:
    """The effect whose parameters are what one film is changed by."""
    return lambda optics, values: optics.with_film(film, **_named(values, fields))


def _other_line(shape: str) -> Callable[[FlatFieldOptics, Values], FlatFieldOptics]:
    """The effect that gives a part of the light to a line of another shape."""
    return lambda optics, values: replace(
        optics, other_lines=(*optics.other_lines, (shape, values["fraction"]))
    )


def _bandwidth(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    fwhm = values["fwhm"]
    return optics if math.isnan(fwhm) else replace(optics, bandwidth_fwhm_nm=fwhm)


def _wavelength_jitter(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(
        optics,
        wavelength_errors_nm=tuple(
            (float(name.removeprefix("at_")), error) for name, error in values.items()
        ),
    )


def _temperature(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    kelvin = values["kelvin"]
    return optics if math.isnan(kelvin) else replace(optics, temperature_k=kelvin)


def _silicon_absorption(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    for film in optics.films:
        if film.medium.partition("_")[0] == "Si":
            optics = optics.with_film(film.name, extinction_scale=values["scale"])
    return optics


def _ar_coating(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    for name in ("ar_outer", "ar_inner"):
        film = optics.films[optics.position(name)]
        optics = optics.with_film(name, thickness_um=film.thickness_um * values["scale"])
    return optics


def _thicker_film(name: str) -> Callable[[FlatFieldOptics, Values], FlatFieldOptics]:
    """The effect that makes one film thicker; an empty name stands for the detection layer."""

    def changed(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
        return _thicker(optics, name or optics.detection, values["offset"])

    return changed


def _thicker(optics: FlatFieldOptics, name: str, by_um: float) -> FlatFieldOptics:
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


def _lamp_lines(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    table = read_table("laboratory", "xenon_lines.ecsv")
    xenon = {float(row["wavelength"]): float(row["intensity"]) for row in table}
    peak = values["strength"] / xenon[XENON_REFERENCE_NM]
    lines = tuple((centre, peak * intensity, XENON_FWHM_NM) for centre, intensity in xenon.items())
    return replace(optics, lamp_lines=lines if values["strength"] else ())


def _tilt(optics: FlatFieldOptics, values: Values) -> FlatFieldOptics:
    return replace(optics, theta=tuple(theta + math.radians(values["angle"]) for theta in optics.theta))


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
    pattern = 1.0 + 0.5 * values["gradient_x"] * u + 0.5 * values["gradient_y"] * v
    for power, letters in ((2, ("xx", "xy", "yy")), (3, ("xxx", "xxy", "xyy", "yyy"))):
        kind = "curvature" if power == 2 else "cubic"
        for term in letters:
            pattern = pattern + values[f"{kind}_{term}"] * u ** term.count("x") * v ** term.count("y")
    return light * pattern


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


def _amplifier_gain(state: AmplifierState, values: Values, deviate: float) -> AmplifierState:
    return replace(state, gain=state.gain * (1.0 + values[state.name] + values["rms"] * deviate))


def _amplifier_offset(state: AmplifierState, values: Values, deviate: float) -> AmplifierState:
    return replace(state, offset_e=state.offset_e + values[state.name] + values["rms"] * deviate)


# Catalogue -------------------------------------------------------------------------------------------------


def _hidden(
    name: str,
    *,
    without: tuple[str, ...] = (),
    positive: bool = False,
    largest_rms: float = 0.0,
    **actions: Callable[..., Any],
) -> HiddenEffect:
    """An effect with the parameters of the model, but some, and what it does.

    Electrons that are counted are ``positive``; an effect with a largest rms may also be drawn for every amplifier.
    """
    (known,) = (effect for effect in EFFECTS if effect.name == name)
    parameters = [parameter for parameter in known.parameters if parameter.name not in without]
    if positive:
        parameters = [replace(each, bounds=(0.0, each.bounds[1])) for each in parameters]
    if largest_rms:
        first = parameters[0]
        what = f"{known.title}: rms of a random one on every amplifier"
        rms = Parameter("rms", first.unit, 0.0, (0.0, largest_rms), first.prior_scale, what)
        parameters = [rms, *parameters]
    return HiddenEffect(name, known.title, tuple(parameters), **actions)


HIDDEN_EFFECTS: tuple[HiddenEffect, ...] = (
    _hidden("bandwidth", on_optics=_bandwidth),
    _hidden("wavelength_offset", on_optics=_adds(wavelength_offset_nm="offset")),
    _hidden("wavelength_scale", on_optics=_adds(wavelength_stretch="stretch")),
    _hidden("wavelength_jitter", on_optics=_wavelength_jitter),
    _hidden("temperature", on_optics=_temperature),
    _hidden("epoxy_index", on_optics=_changes("adhesive", index_shift="offset", cauchy_um2="cauchy")),
    _hidden("epoxy_absorption", on_optics=_changes("adhesive", extinction_shift="k")),
    _hidden("silicon_thickness", on_optics=_thicker_film("")),
    _hidden("silicon_gradient", on_silicon=_silicon_gradient),
    _hidden("silicon_absorption", on_optics=_silicon_absorption),
    _hidden("ar_coating", on_optics=_ar_coating),
    _hidden("support_index", on_optics=_changes("support", index_shift="offset")),
    _hidden("gate_oxide", on_optics=_thicker_film("gate_oxide")),
    _hidden("insulation", on_optics=_thicker_film("insulation")),
    _hidden("gate_thickness", on_optics=_thicker_film("gates")),
    _hidden("black_coating", on_optics=_black_coating),
    _hidden("air_gap", on_optics=_air_gap),
    _hidden("void", on_optics=_air_gap, on_island=_disc),
    _hidden("support_coherence", on_optics=_sets(support_spread_um="spread")),
    _hidden("line_wing", on_optics=_other_line("lorentzian")),
    _hidden("line_triangle", on_optics=_other_line("triangular")),
    _hidden("lamp_lines", on_optics=_lamp_lines),
    _hidden("tilt", on_optics=_tilt),
    _hidden("roughness", on_optics=_sets(roughness_nm="sigma")),
    _hidden("thickness_spread", on_optics=_sets(spread_nm="sigma")),
    _hidden("converging_beam", on_optics=_converging_beam),
    _hidden("ghost_pedestal", on_light=_ghost_pedestal),
    _hidden("contrast_loss", on_optics=_contrast_loss),
    _hidden("illumination", on_light=_illumination),
    _hidden("vignetting", on_light=_vignetting),
    _hidden("chromatic_illumination", without=("even_offset",), on_light=_chromatic_illumination),
    _hidden("midline_step", on_light=_midline_step),
    _hidden("tree_rings", on_light=_tree_rings),
    _hidden("charge_diffusion", on_light=_charge_diffusion),
    _hidden("dark_pedestal", positive=True, on_amplifier=_adds(dark_e="electrons")),
    _hidden("dark_current", positive=True, on_amplifier=_adds(dark_rate_e="rate")),
    _hidden("brighter_fatter", on_charge=_brighter_fatter),
    _hidden("non_linearity", on_charge=_non_linearity),
    _hidden("crosstalk", on_charge=_crosstalk),
    _hidden("amplifier_gain", largest_rms=0.2, on_amplifier=_amplifier_gain),
    _hidden("amplifier_offset", largest_rms=1000.0, on_amplifier=_amplifier_offset),
)
"""Every effect that a mock can hide."""
