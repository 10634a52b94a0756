"""One contract for all effects of the catalogue."""

import dataclasses
import math

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.effects import (
    AMPLIFIERS,
    EFFECTS,
    Effect,
    ImageGeometry,
    Parameter,
    activate_effects,
    apply_to_image,
    apply_to_sky,
)
from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.flat_spectrum import FlatSpectrum
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.mock import HIDDEN_EFFECTS, setup_optics, validate_effects
from lsst.fringe_sim.mock.hidden_effects import AmplifierState, with_hidden_optics
from lsst.fringe_sim.mock.sensor_signal import SensorSignal
from lsst.fringe_sim.model import FringeModel

SKY = SkySpectrum.dark()
WAVELENGTHS = np.array([900.0, 960.0, 985.0])
CASES = [(effect, parameter) for effect in EFFECTS for parameter in effect.parameters]
IDS = [f"{effect.name}.{parameter.name}" for effect, parameter in CASES]
SIZES = [(effect, parameter) for effect, parameter in CASES if parameter.name not in effect.search.places]
PLACES = [(effect, parameter) for effect, parameter in CASES if parameter.name in effect.search.places]


@pytest.fixture(scope="module")
def base() -> FringeModel:
    """A sensor with the lines of the laboratory, and with the temperature of a telescope."""
    model = FringeModel.from_setup("ts8_e2v")
    system = dataclasses.replace(model.base_system, laboratory_temperature_k=193.15)
    return dataclasses.replace(model, base_system=system)


@pytest.fixture(scope="module")
def thickness() -> np.ndarray:
    """A small sensor: one thickness in every pixel, all fringe phases, all amplifiers."""
    return np.linspace(14.0, 15.2, 4 * 16).reshape(16, 4).T.copy()


def observe(model: FringeModel, thickness: np.ndarray, wavelengths: np.ndarray = WAVELENGTHS) -> np.ndarray:
    """Response, image of a flat of 20 000 electrons, and light of the night sky; a change of any is a change."""
    seconds = np.linspace(10.0, 30.0, len(wavelengths))
    geometry = ImageGeometry.of_pixels(thickness.shape, wavelengths, 20_000.0, seconds)
    flats = model.response(thickness, wavelengths), model.flat_image(thickness, geometry)
    sky = apply_to_sky(model.effects, model.base_system, SKY)
    lines = sky.lines.photon_radiance * sky.lines.transmission
    lamp = (sky.flat or FlatSpectrum()).component(Bandpass.from_name("lsst_y"))
    flat, _ = np.histogram(lamp.wavelength_nm, 100, (900.0, 1100.0), weights=lamp.photons)
    return np.concatenate(
        [*(part.ravel() for part in flats), lines, *(c.photon_radiance for c in sky.continua), flat]
    )


def exposures_of(parameter: Parameter) -> np.ndarray:
    """Wavelengths of exposures, with the one that the parameter concerns."""
    return np.array([900.0, parameter.wavelength_nm, 985.0]) if parameter.wavelength_nm > 0.0 else WAVELENGTHS


def test_light_and_bench_of_the_laboratory_stay_there() -> None:
    """The telescope has its own light; the sensor's layers and electronics come along."""
    left_behind = {effect.name for effect in EFFECTS if effect.laboratory_only}
    assert {effect.name for effect in EFFECTS if effect.acts_on == "illumination"} <= left_behind
    assert {"temperature", "ghost_pedestal", "vignetting", "dark_pedestal", "dark_current"} <= left_behind
    assert not {"epoxy_index", "roughness", "silicon_thickness", "charge_diffusion"} & left_behind


def null_of(effect: Effect, name: str, base: FringeModel) -> float:
    return effect.null_values(base.base_system)[name]


def test_names_are_unique() -> None:
    names = [effect.name for effect in EFFECTS]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_every_effect_is_described(effect: Effect) -> None:
    assert effect.title
    assert effect.reference
    assert effect.acts_on in {"stack", "illumination", "response", "image", "spectrum"}
    for parameter in effect.parameters:
        assert parameter.description
        assert parameter.bounds[0] < parameter.bounds[1]
        assert parameter.prior_scale > 0.0
        assert math.isnan(parameter.null) or parameter.bounds[0] <= parameter.null <= parameter.bounds[1]


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_hints_are_about_parameters_of_the_effect(effect: Effect) -> None:
    """A name that is misspelt would be no hint; places alone are no effect."""
    hints, names = effect.search, {parameter.name for parameter in effect.parameters}
    about = {*hints.places, *hints.repeats_after, *hints.steps, *hints.refinements}
    assert about <= names
    assert names - set(hints.places)
    assert set(hints.natural_bounds) <= {bound for item in effect.parameters for bound in item.bounds}


@pytest.mark.parametrize(("effect", "parameter"), CASES, ids=IDS)
def test_null_is_exactly_the_identity_and_all_within_bounds_is_finite(
    effect, parameter, base, thickness
) -> None:
    null, seen = null_of(effect, parameter.name, base), exposures_of(parameter)
    before, reference = dataclasses.replace(base.base_system), observe(base, thickness, seen)
    for value in np.linspace(*parameter.bounds, 5):
        response = observe(base.with_effects({effect.name: {parameter.name: value}}), thickness, seen)
        assert np.all(np.isfinite(response))
        assert np.all(response >= 0.0)
    changed = base.with_effects({effect.name: {parameter.name: null}})
    assert changed.system is base.base_system == before
    np.testing.assert_array_equal(observe(changed, thickness, seen), reference)


@pytest.mark.parametrize(("effect", "parameter"), PLACES, ids=lambda item: item.name)
def test_a_place_changes_something_only_where_there_is_an_effect(effect, parameter, base, thickness) -> None:
    moved = {parameter.name: null_of(effect, parameter.name, base) + 0.3 * parameter.prior_scale}
    alone = base.with_effects({effect.name: moved})
    np.testing.assert_array_equal(observe(alone, thickness), observe(base, thickness))
    size = next(item for item in effect.parameters if item.name not in effect.search.places)
    strong = {size.name: null_of(effect, size.name, base) + size.prior_scale}
    there, elsewhere = (base.with_effects({effect.name: {**strong, **place}}) for place in ({}, moved))
    assert np.abs(observe(there, thickness) - observe(elsewhere, thickness)).max() > 0.0


@pytest.mark.parametrize(("effect", "parameter"), SIZES, ids=lambda item: item.name)
def test_onset_is_monotone_and_smooth(effect, parameter, base, thickness) -> None:
    """Small departures from null change the response, and more the larger they are."""
    null, seen = null_of(effect, parameter.name, base), exposures_of(parameter)
    low, high = parameter.bounds
    direction = 1.0 if null < high else -1.0
    reference = observe(base, thickness, seen)
    changes = []
    for size in (0.01, 0.02, 0.04):
        value = float(np.clip(null + direction * size * parameter.prior_scale, low, high))
        response = observe(base.with_effects({effect.name: {parameter.name: value}}), thickness, seen)
        changes.append(np.abs(response - reference).max())
    assert 0.0 < changes[0] < changes[1] < changes[2]


# Where an effect is, on a sensor of SHAPE.
WHERE = {
    "tree_rings": {"centre_x": -100.0, "centre_y": -60.0, "period": 24.0},
    "void": {"centre_x": 14.3, "centre_y": 22.1, "radius": 9.0},
}
SHAPE = (36, 48)
HIDDEN = {effect.name: effect for effect in HIDDEN_EFFECTS}

COARSE = {"lamp_lines": 3e-5, "contrast_loss": 3e-5, "silicon_gradient": 0.1}
"""Where the two differ by more than quadrature: lines of the lamp are on a grid of 0.1 nm, the mean over the phase is
that of one thickness or of single waves, and a wedge is seen without the fringes of the silicon itself."""


@pytest.mark.parametrize("effect", [e for e in EFFECTS if e.name in HIDDEN], ids=lambda effect: effect.name)
def test_agrees_with_the_mock(effect: Effect, base: FringeModel) -> None:
    """Two implementations that share only tables and names: of the optics, or of what is done to flats."""
    waves, seconds = np.array([884.0, 986.0]), np.array([10.0, 30.0])
    hidden, values = HIDDEN[effect.name], dict(WHERE.get(effect.name, {}))
    for number, item in enumerate(
        size for size in effect.parameters if size.name not in effect.search.places
    ):
        signs = (1.0, -1.0) if number % 2 else (-1.0, 1.0)
        steps = (null_of(effect, item.name, base) + sign * item.prior_scale for sign in signs)
        low, high = hidden.parameter(item.name).bounds
        values[item.name] = next(value for value in steps if low <= value <= high)
    model = base.with_effects({effect.name: values})
    if hidden.on_optics and not hidden.on_island:
        thickness = np.linspace(14.0, 22.0, 23)
        optics = hidden.on_optics(setup_optics("ts8_e2v")[0], hidden.complete(values))
        ours, plain = (np.stack([one.flat_field(thickness, wave) for wave in waves])
                       for one in (optics, setup_optics("ts8_e2v")[0]))  # fmt: skip
        assert np.abs(ours - plain).max() > 1e-5
        np.testing.assert_allclose(
            ours / ours.mean(axis=1, keepdims=True),
            model.response(thickness, waves) / model.response(thickness, waves).mean(axis=1, keepdims=True),
            rtol=COARSE.get(effect.name, 3e-6),
        )
        return
    thickness = 14.0 + np.linspace(0.0, 0.35, SHAPE[0])[:, np.newaxis] + np.linspace(0.0, 0.1, SHAPE[1])
    flats, level = flats_of_the_mock(thickness, waves, seconds, {effect.name: values})
    change = flats - flats_of_the_mock(thickness, waves, seconds, {})[0]
    geometry = ImageGeometry.of_pixels(SHAPE, waves, level, seconds)
    with_it, without = (one.flat_image(thickness, geometry) for one in (model, base))
    with_it, without = (one / one.mean(axis=(1, 2), keepdims=True) for one in (with_it, without))
    assert np.abs(change).max() > 1e-5
    # The mock averages light over pixels, and sees rings and rims at points inside them.
    allowed = COARSE.get(effect.name, 0.02) * np.abs(change).max()
    np.testing.assert_allclose(with_it - without, change, atol=allowed, rtol=0.0)


def flats_of_the_mock(
    thickness: np.ndarray, waves: np.ndarray, seconds: np.ndarray, settings: dict[str, dict[str, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Noiseless flats over their mean, and their mean level [electrons]."""
    active = [(effect, effect.complete(values)) for effect, values in validate_effects(settings)]
    optics = with_hidden_optics(setup_optics("ts8_e2v")[0], active)
    signal, flats = SensorSignal.with_effects(optics, thickness, tuple(waves), active), []
    amplifier = ImageGeometry.of_pixels(thickness.shape, waves).amplifier
    states = [AmplifierState(name, 1.0, 0.0, 1e9) for name in AMPLIFIERS]
    for effect, values in active:
        if effect.on_amplifier is not None:
            states = [effect.on_amplifier(state, values, 0.0) for state in states]
    for row, wavelength in enumerate(waves):
        light = signal.flat(row) / signal.flat(row).mean()
        for effect, values in active:
            light = effect.on_light(light, float(wavelength), values) if effect.on_light else light
        dark, gain, offset = (
            np.array(each)[amplifier]
            for each in zip(
                *((s.dark_signal_e(seconds[row]), s.gain, s.offset_e) for s in states), strict=True
            )
        )
        charge = 30_000.0 * light / light.mean() + dark
        for effect, values in active:
            charge = effect.on_charge(charge, values) if effect.on_charge else charge
        flats.append((charge + offset) / gain)
    level = np.mean(flats, axis=(1, 2))
    return flats / level[:, np.newaxis, np.newaxis], level


def test_both_spellings_agree() -> None:
    dotted = activate_effects({"bandwidth.fwhm": 2.4}, EFFECTS)
    nested = activate_effects({"bandwidth": {"fwhm": 2.4}}, EFFECTS)
    assert dotted == nested


def test_order_is_that_of_the_catalogue() -> None:
    given = {"ghost_pedestal.fraction": 0.1, "epoxy_index.offset": 0.01, "bandwidth.fwhm": 3.0}
    names = [item.effect.name for item in activate_effects(given, EFFECTS)]
    assert names == ["epoxy_index", "bandwidth", "ghost_pedestal"]


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"bandwith.fwhm": 2.0}, UnknownNameError, "did you mean bandwidth"),
        ({"bandwidth.width": 2.0}, UnknownNameError, "fwhm"),
        ({"bandwidth.fwhm": -1.0}, OutOfRangeError, "0.05 to 20"),
        ({"bandwidth.fwhm": float("nan")}, OutOfRangeError, "0.05 to 20"),
        ({"bandwidth.fwhm": "wide"}, InputError, "a number"),
        ({"bandwidth.fwhm": 10**400}, OutOfRangeError, "a number below"),
        ({"bandwidth": 2.0}, InputError, "name.parameter=value"),
    ],
)
def test_bad_settings_are_refused(settings, error, words) -> None:
    with pytest.raises(error, match=words):
        activate_effects(settings, EFFECTS)


@pytest.mark.parametrize(
    ("effect", "parameter"),
    [
        (effect, parameter)
        for effect, parameter in SIZES
        if effect.acts_on == "image" and effect.name not in {"non_linearity", "crosstalk"}
    ],
    ids=lambda item: item.name,
)
def test_what_is_done_to_an_image_leaves_its_mean(effect, parameter, base) -> None:
    """Otherwise electrons that are added beside it would be measured in units that the effect changed.

    Charge that is lost, or counted twice, is no pattern.
    """
    rng = np.random.default_rng(2)
    geometry = ImageGeometry.of_pixels((80, 80), WAVELENGTHS, 20_000.0, np.array([10.0, 20.0, 30.0]))
    image = 1.0 + 0.02 * rng.standard_normal((3, 80, 80))
    image /= image.mean(axis=(1, 2), keepdims=True)
    value = float(np.clip(4.0 * parameter.prior_scale, *parameter.bounds))
    changed = base.with_effects({effect.name: {parameter.name: value}}).effects[0]
    after = apply_to_image([changed], base.base_system, image, geometry)
    assert np.abs(after - image).max() > 1e-6
    # Noise correlates a little with the pattern, and the ends of 80 samples are not those of the sensor.
    np.testing.assert_allclose(after.mean(axis=(1, 2)), 1.0, atol=0.03 * np.abs(after - image).max())


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_flats_and_sky_with_an_effect_are_as_recorded(effect, base, thickness, recorded: Record) -> None:
    """At three eighths of the bounds of every parameter; a record, beside the closed forms of the other tests."""
    values = {
        item.name: item.bounds[0] + 0.375 * (item.bounds[1] - item.bounds[0]) for item in effect.parameters
    }
    recorded(
        {"seen": observe(base.with_effects({effect.name: values}), thickness), "described": effect.parameters}
    )
