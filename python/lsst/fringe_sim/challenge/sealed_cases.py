"""Sealed cases: sensors with random effects, from the mock's own optics and its own hidden effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from ..array_types import FloatArray
from ..errors import InputError, UnknownNameError
from ..mock.hidden_effects import AmplifierState, HiddenEffect, validate_effects, with_hidden_optics
from ..mock.optics import FlatFieldOptics
from ..mock.raw_files import exposure_time
from ..mock.raw_frames import setup_optics
from ..mock.sensor_signal import SensorSignal
from ..mock.thickness import random_field
from ..products.fringe_cube import FlatExposures, FringeCube
from ..products.mask import mask_bits
from .result import CASE_KINDS

Draw = Callable[[np.random.Generator], dict[str, float]]

FULL_SPAN_PX = 96
"""Side from which on a sensor has the full range of thickness [px]: smaller ones get no finer fringes."""

STATED_FWHM_NM, STATED_KELVIN = 2.0, 183.15
"""What the sizes of bandwidth and temperature are about; other set-ups move them with what they state."""

THICKNESS_UM: Mapping[str, tuple[tuple[float, float], tuple[float, float]]] = MappingProxyType(
    {"adhesive": ((13.0, 20.0), (1.5, 5.0)), "detection": ((97.0, 103.0), (0.6, 2.0))}
)
"""Limits of mean and span of the layer that varies: five to sixteen fringes of adhesive or of silicon [µm]."""

OF_THE_LAYER = {"detection": ("silicon_thickness", "silicon_gradient")}
"""Effects that are nothing but the thickness of a layer, where that layer varies."""


READ_NOISE_E = 6.0


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * _decades(rng, low, high))


def _decades(rng: np.random.Generator, low: float, high: float) -> float:
    """Log-uniform between two powers of ten."""
    return float(10.0 ** rng.uniform(low, high))


def _errors(rng: np.random.Generator, rms: float) -> list[tuple[int, float]]:
    """Independent errors of the twelve exposures, with at most three times their rms."""
    return [(node, rms * float(np.clip(rng.normal(), -3.0, 3.0))) for node in range(880, 991, 10)]


def _rings(rng: np.random.Generator, size: float) -> dict[str, float]:
    """Rings about a point on a small sensor or not far from it."""
    phase = float(rng.uniform(0.0, 2.0 * math.pi))
    return {
        "tree_rings.cosine": size * math.cos(phase),
        "tree_rings.sine": size * math.sin(phase),
        "tree_rings.centre_x": float(rng.uniform(-200.0, 300.0)),
        "tree_rings.centre_y": float(rng.uniform(-200.0, 300.0)),
        "tree_rings.period": float(rng.uniform(5.0, 25.0)),
    }


def _island(rng: np.random.Generator, gap_nm: float) -> dict[str, float]:
    """An island that lies on a small sensor with most of its area."""
    return {
        "void.thickness": gap_nm,
        "void.centre_x": float(rng.uniform(10.0, 86.0)),
        "void.centre_y": float(rng.uniform(10.0, 86.0)),
        "void.radius": float(rng.uniform(5.0, 20.0)),
    }


SIZES: Mapping[str, Draw] = MappingProxyType(
    {
        "bandwidth": lambda r: {"bandwidth.fwhm": STATED_FWHM_NM + _signed(r, -1.3, 0.0) * 0.9},
        "wavelength_offset": lambda r: {"wavelength_offset.offset": _signed(r, -0.7, 0.5)},
        "wavelength_scale": lambda r: {"wavelength_scale.stretch": _signed(r, -3.0, -1.5)},
        "wavelength_jitter": lambda r: {
            f"wavelength_jitter.at_{node}": error for node, error in _errors(r, _decades(r, -1.3, 0.0))
        },
        "temperature": lambda r: {"temperature.kelvin": STATED_KELVIN + _signed(r, 0.3, 1.4)},
        "epoxy_index": lambda r: {"epoxy_index.offset": _signed(r, -2.3, -1.0)},
        "epoxy_dispersion": lambda r: {"epoxy_index.cauchy": _signed(r, -3.3, -2.0)},
        "epoxy_absorption": lambda r: {"epoxy_absorption.k": _decades(r, -5.0, -2.5)},
        "silicon_thickness": lambda r: {"silicon_thickness.offset": _signed(r, -0.5, 1.0)},
        "silicon_gradient": lambda r: {
            "silicon_gradient.gradient_x": _signed(r, -1.5, 0.3),
            "silicon_gradient.gradient_y": _signed(r, -1.5, 0.3),
        },
        "silicon_absorption": lambda r: {"silicon_absorption.scale": 1.0 + _signed(r, -2.3, -0.7)},
        "ar_coating": lambda r: {"ar_coating.scale": 1.0 + _signed(r, -1.7, -0.7)},
        "gate_oxide": lambda r: {"gate_oxide.offset": _signed(r, -2.6, -1.1)},
        "insulation": lambda r: {"insulation.offset": _signed(r, -2.3, -1.0)},
        "gate_thickness": lambda r: {"gate_thickness.offset": _signed(r, -2.3, -0.8)},
        "black_coating": lambda r: {"black_coating.thickness": _decades(r, -2.0, 0.3)},
        "air_gap": lambda r: {"air_gap.thickness": _decades(r, 0.3, 2.7)},
        "void": lambda r: _island(r, _decades(r, 1.0, 2.7)),
        "line_wing": lambda r: {"line_wing.fraction": _decades(r, -2.3, -0.3)},
        "line_triangle": lambda r: {"line_triangle.fraction": float(r.uniform(0.1, 1.0))},
        "lamp_lines": lambda r: {"lamp_lines.strength": _decades(r, -1.0, 1.0)},
        "tilt": lambda r: {"tilt.angle": _decades(r, 0.3, 1.4)},
        "roughness": lambda r: {"roughness.sigma": _decades(r, 0.8, 2.0)},
        "thickness_spread": lambda r: {"thickness_spread.sigma": _decades(r, 0.3, 1.7)},
        "converging_beam": lambda r: {"converging_beam.numerical_aperture": _decades(r, -1.3, -0.6)},
        "support_index": lambda r: {"support_index.offset": -_decades(r, -2.0, 0.1)},
        "ghost_pedestal": lambda r: {"ghost_pedestal.fraction": _decades(r, -2.5, 0.5)},
        "contrast_loss": lambda r: {"contrast_loss.factor": 1.0 - _decades(r, -2.3, -0.1)},
        "illumination": lambda r: {
            "illumination.gradient_x": _signed(r, -3.5, -1.0),
            "illumination.gradient_y": _signed(r, -3.5, -1.0),
        },
        "vignetting": lambda r: {"vignetting.corner": _decades(r, -3.3, -0.7)},
        "chromatic_illumination": lambda r: {
            f"chromatic_illumination.{name}": _signed(r, -3.5, -1.5)
            for name in ("gradient_x", "gradient_y", "curvature_xx", "curvature_yy")
        },
        "charge_diffusion": lambda r: {"charge_diffusion.sigma": _decades(r, -0.7, 0.5)},
        "brighter_fatter": lambda r: {"brighter_fatter.variance": _decades(r, -2.3, -0.9)},
        "midline_step": lambda r: {"midline_step.fraction": _signed(r, -3.5, -1.7)},
        "tree_rings": lambda r: _rings(r, _decades(r, -3.5, -2.3)),
        "crosstalk": lambda r: {"crosstalk.from_left": _decades(r, -3.7, -2.0)},
        "amplifier_gain": lambda r: {"amplifier_gain.rms": _decades(r, -3.3, -1.7)},
        "amplifier_offset": lambda r: {"amplifier_offset.rms": _decades(r, 1.0, 2.5)},
        "dark_pedestal": lambda r: {"dark_pedestal.electrons": _decades(r, 2.0, 4.0)},
        "dark_current": lambda r: {"dark_current.rate": _decades(r, 0.3, 2.3)},
        "non_linearity": lambda r: {"non_linearity.quadratic": _signed(r, -2.3, -0.9)},
    }
)
"""Random sizes of the effects that are hidden, from hardly visible to overwhelming."""


def _second_film(image: FloatArray, wavelength: float, scene: Mapping[str, Any]) -> FloatArray:
    """Fringes of another layer, whose thickness has nothing to do with the adhesive."""
    phase = 4.0 * math.pi * 1.46 * scene["film"] / (1e-3 * wavelength)
    return image * (1.0 + scene["size"] * np.cos(phase))


def _annealing(image: FloatArray, wavelength: float, scene: Mapping[str, Any]) -> FloatArray:
    """Crossed stripes, as the laser leaves them that anneals the back of a sensor."""
    y, x = np.indices(image.shape)
    turned = x * math.cos(scene["turn"]) + y * math.sin(scene["turn"])
    across = y * math.cos(scene["turn"]) - x * math.sin(scene["turn"])
    stripes = np.cos(2.0 * math.pi * turned / scene["period"]) + np.cos(2.0 * math.pi * across / 15.0)
    return image * (1.0 + scene["size"] * stripes)


def _ghost_image(image: FloatArray, wavelength: float, scene: Mapping[str, Any]) -> FloatArray:
    """A faint image of the sensor on itself, upside down and out of focus."""
    return image + scene["size"] * gaussian_filter(image[::-1, ::-1], 1.0)


def _stains(image: FloatArray, wavelength: float, scene: Mapping[str, Any]) -> FloatArray:
    """A few round stains that absorb the more the shorter the wavelength."""
    y, x = np.indices(image.shape)
    depth = sum(np.exp(-0.5 * ((y - cy) ** 2 + (x - cx) ** 2) / r**2) for cy, cx, r in scene["stains"])
    return image * (1.0 - scene["size"] * (900.0 / wavelength) ** 2 * depth)


def _columns(image: FloatArray, wavelength: float, scene: Mapping[str, Any]) -> FloatArray:
    """Every column has a response of its own."""
    return image * (1.0 + scene["size"] * scene["columns"][np.newaxis, :])


def _jitter(image: FloatArray, wavelength: float, scene: Mapping[str, Any]) -> FloatArray:
    """A plane of light whose direction changes from exposure to exposure."""
    angle = 2.399963 * wavelength / 10.0
    v = np.linspace(-1.0, 1.0, image.shape[0])[:, np.newaxis]
    u = np.linspace(-1.0, 1.0, image.shape[1])[np.newaxis, :]
    return image * (1.0 + scene["size"] * (math.cos(angle) * u + math.sin(angle) * v))


OUTSIDERS: Mapping[str, tuple[Callable[..., FloatArray], float, float]] = MappingProxyType(
    {
        "second_film": (_second_film, -3.5, -2.3),
        "annealing": (_annealing, -3.5, -2.3),
        "ghost_image": (_ghost_image, -2.5, -1.3),
        "stains": (_stains, -3.0, -1.7),
        "columns": (_columns, -3.5, -2.5),
        "wandering_light": (_jitter, -3.5, -2.0),
    }
)
"""Causes that the catalogue does not hold, with the decades of their size."""


@dataclass(frozen=True, eq=False)
class SealedCase:
    """One case: what the search gets, and the truth."""

    cube: FringeCube  # Flats, masks, stated noise
    setup: str  # What the search is told of sensor and light
    kind: str  # One of `CASE_KINDS`
    names: tuple[str, ...]  # Effects that are in, by their name in the catalogue; the name of an outsider
    values: dict[str, float]  # Their sizes by ``name.parameter``
    thickness_um: FloatArray  # True thickness [µm]
    noise_factor: float  # True over stated noise variance


def draw_case(
    kind: str,
    rng: np.random.Generator,
    *,
    size: tuple[int, int] = (96, 96),
    only: Sequence[str] = (),
    setup: str = "ts8_e2v",
) -> SealedCase:
    """Draw a sensor, its effects and its noise."""
    if kind not in CASE_KINDS:
        raise UnknownNameError("kind of case", kind, CASE_KINDS)
    optics, _ = setup_optics(setup)
    if optics.varying not in THICKNESS_UM:
        raise InputError("varying", optics.varying, " or ".join(THICKNESS_UM), source=setup)
    means, spans = THICKNESS_UM[optics.varying]
    values: dict[str, float] = {}
    outsider = ""
    if kind in ("one", "two"):
        pool = [name for name in only or SIZES if name not in OF_THE_LAYER.get(optics.varying, ())]
        for name in rng.choice(pool, size=1 if kind == "one" else 2, replace=False):
            values.update(SIZES[str(name)](rng))
    elif kind == "outsider":
        outsider = str(rng.choice(list(only) or list(OUTSIDERS)))
    mean, span = float(rng.uniform(*means)), float(rng.uniform(*spans))
    thickness = random_field(size, rng, mean=mean, span=span * min(1.0, min(size) / FULL_SPAN_PX))
    noise_factor = float(rng.uniform(0.8, 1.2) ** 2)
    values = _about_stated(values, optics)
    cube, sizes = expose(thickness, values, rng, outsider=outsider, noise_factor=noise_factor, setup=setup)
    names = tuple(dict.fromkeys(key.split(".")[0] for key in values)) or ((outsider,) if outsider else ())
    return SealedCase(cube, setup, kind, names, {**values, **sizes}, thickness, noise_factor)


def _about_stated(values: Mapping[str, float], optics: FlatFieldOptics) -> dict[str, float]:
    """Sizes of effects that are about what a set-up states."""
    moves = {
        "bandwidth.fwhm": optics.bandwidth_fwhm_nm - STATED_FWHM_NM,
        "temperature.kelvin": optics.temperature_k - STATED_KELVIN,
    }
    return {key: value + moves.get(key, 0.0) for key, value in values.items()}


def expose(
    thickness: FloatArray,
    values: Mapping[str, float],
    rng: np.random.Generator,
    *,
    outsider: str = "",
    noise_factor: float = 1.0,
    setup: str = "ts8_e2v",
) -> tuple[FringeCube, dict[str, float]]:
    """Expose one sensor in a run of flats, and the size of the outsider by ``outsider.size``."""
    if outsider and outsider not in OUTSIDERS:
        raise UnknownNameError("outsider", outsider, OUTSIDERS)
    stated, _ = setup_optics(setup)
    active = validate_effects(values)
    optics = with_hidden_optics(stated, active)
    wavelengths = np.arange(880.0, 991.0, 10.0)
    if rng.random() < 0.3:  # real runs lose exposures
        wavelengths = np.sort(rng.choice(wavelengths, size=10, replace=False))
    shape = (thickness.shape[0], thickness.shape[1])
    signal = SensorSignal.with_effects(optics, thickness, tuple(wavelengths), active)
    response = 1.0 + float(rng.choice([0.0, 0.003, 0.006])) * rng.standard_normal(shape)
    states = _amplifiers(active, rng)
    gain, offset = (
        _of_pixels(shape, [getattr(state, name) for state in states]) for name in ("gain", "offset_e")
    )
    seconds = [exposure_time(float(wavelength)) for wavelength in wavelengths]
    scene, sizes = _scene(outsider, shape, rng)
    level = _decades(rng, 4.0, 4.7)
    images, variances = [], []
    for row, wavelength in enumerate(wavelengths):
        light = signal.flat(row)
        light = light / light.mean()
        for effect, own in active:
            if effect.on_light is not None:
                light = effect.on_light(light, float(wavelength), effect.complete(own))
        if outsider:
            light = OUTSIDERS[outsider][0](light, float(wavelength), scene)
        light = light / light.mean() * level * (1.0 + 0.02 * rng.standard_normal())
        dark = _of_pixels(shape, [state.dark_signal_e(seconds[row]) for state in states])
        charge = rng.poisson(light * response + dark).astype(float)
        for effect, own in active:
            if effect.on_charge is not None:
                charge = effect.on_charge(charge, effect.complete(own))
        counts = (charge + offset + READ_NOISE_E * rng.standard_normal(shape)) / gain
        images.append(counts)
        variances.append((np.maximum(counts, 1.0) + READ_NOISE_E**2) / noise_factor)
    mask = np.zeros((len(wavelengths), *shape), dtype=np.int16)
    if rng.random() < 0.5:
        mask[:, rng.random(shape) < 0.005] = mask_bits("BAD")
        mask[:, :, rng.integers(shape[1])] = mask_bits("BAD")
    cube = FringeCube(
        np.array(images, dtype=np.float32),
        np.array(variances, dtype=np.float32),
        mask,
        FlatExposures(
            wavelengths,
            np.array(stated.bandwidth_fwhm_nm),
            np.array(stated.temperature_k),
            dark_time_s=np.array(seconds),
        ),
        "electron",
        detector="sealed",
    )
    return cube, sizes


def _amplifiers(
    active: Sequence[tuple[HiddenEffect, dict[str, float]]], rng: np.random.Generator
) -> list[AmplifierState]:
    """The two rows of eight amplifiers, as they really are."""
    deviates = rng.standard_normal((2, 8, max(len(active), 1))).reshape(16, -1)
    states = []
    for number, own_deviates in enumerate(deviates):
        state = AmplifierState(f"C{number // 8}{number % 8}", 1.0, READ_NOISE_E, 1e9)
        for (effect, own), deviate in zip(active, own_deviates, strict=False):
            if effect.on_amplifier is not None:
                state = effect.on_amplifier(state, effect.complete(own), float(deviate))
        states.append(state)
    return states


def _of_pixels(shape: tuple[int, ...], values: Sequence[float]) -> FloatArray:
    """Numbers of the amplifiers, put into their pixels."""
    row, column = (
        np.searchsorted(size * np.arange(1, parts) // parts, np.arange(size), side="right")
        for size, parts in zip(shape, (2, 8), strict=True)
    )
    return np.asarray(values)[8 * row[:, np.newaxis] + column[np.newaxis, :]]


def _scene(
    outsider: str, shape: tuple[int, ...], rng: np.random.Generator
) -> tuple[dict[str, Any], dict[str, float]]:
    if not outsider:
        return {}, {}
    _, low, high = OUTSIDERS[outsider]
    size = _decades(rng, low, high)
    scene = {
        "size": size,
        "film": random_field((shape[0], shape[1]), rng, mean=8.0, span=2.0),
        "period": float(rng.uniform(6.0, 20.0)),
        "turn": float(rng.uniform(0.0, 0.5 * math.pi)),
        "stains": [
            (rng.uniform(0, shape[0]), rng.uniform(0, shape[1]), rng.uniform(4, 12)) for _ in range(4)
        ],
        "columns": rng.standard_normal(shape[1]),
    }
    return scene, {f"{outsider}.size": size}
