"""Exact derivatives against differences of sixth order, parameter by parameter."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest

from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.optics import (
    Beam,
    Illumination,
    LampSpectrum,
    LayerStack,
    get_medium,
    medium_names,
    response_gradient,
)
from lsst.fringe_sim.optics.dual import Dual
from lsst.fringe_sim.optics.illumination import GaussianProfile, MonochromaticProfile
from lsst.fringe_sim.optics.sensitivity import LAYER_PARAMETERS, SYSTEM_PARAMETERS
from lsst.fringe_sim.optics.system import OpticalSystem

THICKNESS = np.array([[13.0, 13.07], [14.1, 19.33]])
WAVELENGTHS = np.array([903.0, 975.0])


def system(**changes: object) -> OpticalSystem:
    stack = LayerStack.from_resource("e2v_ccd250").replace_layer("support", roughness_nm=25.0)
    media = stack.layers[stack.position("adhesive")].medium.modified(
        extinction_offset=3e-4, dispersion_um2=0.01
    )
    stack = stack.with_medium("adhesive", media)
    base = OpticalSystem(
        stack,
        183.0,
        GaussianProfile(0.8),
        Beam.cone(3.0, 0.3, 4),
        wavelength_offset_nm=0.2,
        wavelength_stretch=1e-3,
        wavelength_errors_nm=(((880.0, 0.3), (900.0, -0.5), (1000.0, 0.8)),),
    )
    return dataclasses.replace(base, **changes)


def light_of(optics: OpticalSystem) -> Illumination:
    # The number of nodes must not change with the width, so that the derivative is that of the rule itself.
    fwhm = getattr(optics.profile, "fwhm_nm", 1.0)
    return optics.flat_fields(WAVELENGTHS, 0.3 * fwhm)


def respond(optics: OpticalSystem) -> np.ndarray:
    light = light_of(optics)
    return optics.reduce(light).averaged(light.weight, THICKNESS)


def sixth_order(function: Callable[[float], np.ndarray], step: float) -> np.ndarray:
    weights = {1: 45.0, 2: -9.0, 3: 1.0}
    return sum(w * (function(k * step) - function(-k * step)) for k, w in weights.items()) / (60.0 * step)


def with_layer(name: str, **shift: float) -> Callable[[OpticalSystem, float], OpticalSystem]:
    def moved(optics: OpticalSystem, amount: float) -> OpticalSystem:
        layer = optics.stack.layers[optics.stack.position(name)]
        changes = {
            key: (layer.medium.modified(**{key[7:]: getattr(layer.medium, key[7:]) + amount}), "medium")
            if key.startswith("medium_")
            else (getattr(layer, key) + amount, key)
            for key in shift
        }
        return optics.with_layer(name, **{target: value for value, target in changes.values()})

    return moved


CASES: dict[str, tuple[Callable[[OpticalSystem, float], OpticalSystem], float]] = {
    "thickness.adhesive": (lambda s, x: s, 2e-4),
    "thickness.detection": (with_layer("detection", thickness_um=1.0), 5e-5),
    "thickness.insulation": (with_layer("insulation", thickness_um=1.0), 3e-4),
    "thickness.support": (with_layer("support", thickness_um=1.0), 5e-5),
    "index.adhesive": (with_layer("adhesive", medium_index_offset=1.0), 2e-5),
    "index.detection": (with_layer("detection", medium_index_offset=1.0), 1e-6),
    "extinction.adhesive": (with_layer("adhesive", medium_extinction_offset=1.0), 2e-5),
    "extinction.support": (with_layer("support", medium_extinction_offset=1.0), 1e-6),
    "roughness.support": (with_layer("support", roughness_nm=1.0), 0.3),
    "temperature": (lambda s, x: dataclasses.replace(s, temperature_k=s.temperature_k + x), 0.05),
    "wavelength_offset": (
        lambda s, x: dataclasses.replace(s, wavelength_offset_nm=s.wavelength_offset_nm + x),
        2e-3,
    ),
    "wavelength_stretch": (
        lambda s, x: dataclasses.replace(s, wavelength_stretch=s.wavelength_stretch + x),
        1e-4,
    ),
    "bandwidth": (
        lambda s, x: dataclasses.replace(s, profile=GaussianProfile(s.profile.fwhm_nm + x)),  # type: ignore[attr-defined]
        2e-3,
    ),
    "beam_scale": (
        lambda s, x: dataclasses.replace(
            s, beam=Beam(np.arcsin(np.sin(s.beam.theta) * (1.0 + x)), s.beam.weight)
        ),
        2e-3,
    ),
}


@pytest.mark.parametrize("observable", ["detection", "total"])
@pytest.mark.parametrize("name", sorted(CASES))
def test_gradient_agrees_with_differences(name: str, observable: str) -> None:
    change, step = CASES[name]
    optics = system(observable=observable)
    gradient = response_gradient(optics, light_of(optics), THICKNESS, [name])
    np.testing.assert_allclose(gradient.response, respond(optics), rtol=0.0, atol=1e-13)
    if name == "thickness.adhesive":
        light = light_of(optics)
        reduced = optics.reduce(light)
        numeric = sixth_order(lambda x: reduced.averaged(light.weight, THICKNESS + x), step)
    else:
        numeric = sixth_order(lambda x: respond(change(optics, x)), step)
    scale = np.abs(numeric).max()
    np.testing.assert_allclose(gradient.gradient[0], numeric, rtol=0.0, atol=3e-7 * scale)
    assert gradient.gradient.shape == (1, *gradient.response.shape) == (1, 2, 2, 2)


@pytest.mark.parametrize("polarization", ["s", "p"])
def test_gradient_of_each_polarisation_and_of_several_at_once(polarization: str) -> None:
    optics = system(polarization=polarization)
    names = ["index.adhesive", "temperature", "thickness.gates", "thickness.adhesive"]
    together = response_gradient(optics, light_of(optics), THICKNESS, names)
    for row, name in enumerate(names):
        alone = response_gradient(optics, light_of(optics), THICKNESS, [name])
        np.testing.assert_allclose(together.gradient[row], alone.gradient[0], rtol=1e-12)


@pytest.mark.parametrize("name", ["thickness_spread", "index.adhesive", "temperature"])
def test_gradient_with_a_spread_and_an_incoherent_support(name: str) -> None:
    optics = system(profile=GaussianProfile(0.02), beam=Beam.collimated(0.2))
    optics = optics.with_layer("adhesive", thickness_spread_um=0.03)
    optics = optics.with_layer("support", thickness_spread_um=math.inf)
    changes = {
        **CASES,
        "thickness_spread": (with_layer("adhesive", thickness_spread_um=1.0), 1e-3),
    }
    change, step = changes[name]
    gradient = response_gradient(optics, light_of(optics), THICKNESS, [name]).gradient[0]
    numeric = sixth_order(lambda x: respond(change(optics, x)), step)
    np.testing.assert_allclose(gradient, numeric, rtol=0.0, atol=3e-7 * np.abs(numeric).max())


def test_no_spread_has_no_gradient() -> None:
    optics = system()
    gradient = response_gradient(optics, light_of(optics), THICKNESS, ["thickness_spread"])
    np.testing.assert_array_equal(gradient.gradient, 0.0)


@pytest.mark.parametrize("name", medium_names())
def test_slopes_of_media(name: str) -> None:
    medium = get_medium(name).modified(index_scale=1.01, extinction_scale=0.9, dispersion_um2=0.02)
    low, high = medium.wavelength_range_nm
    wavelength = np.linspace(max(low, 700.0), min(high, 1050.0), 23)[1:-1] + 0.123
    by_wavelength, by_temperature = medium.slopes(wavelength, 190.0)
    numeric = sixth_order(lambda x: medium.index(wavelength + x, 190.0), 0.01)
    np.testing.assert_allclose(by_wavelength, numeric, rtol=0.0, atol=1e-9)
    numeric = sixth_order(lambda x: medium.index(wavelength, 190.0 + x), 0.5)
    np.testing.assert_allclose(by_temperature, numeric, rtol=0.0, atol=1e-11)


def test_unknown_and_impossible_parameters_are_refused() -> None:
    optics = system()
    light = light_of(optics)
    for names in (["colour"], ["colour.adhesive"], ["index.adhesiv"]):
        with pytest.raises(UnknownNameError):
            response_gradient(optics, light, 14.0, names)
    for names in (["thickness.ambient"], ["roughness.ambient"]):
        with pytest.raises(InputError):
            response_gradient(optics, light, 14.0, names)
    single = system(profile=MonochromaticProfile())
    with pytest.raises(InputError, match="FWHM"):
        response_gradient(single, light, 14.0, ["bandwidth"])
    lamp = LampSpectrum(np.array([800.0, 1100.0]), np.array([1.0, 2.0]))
    with pytest.raises(InputError, match="lamp"):
        response_gradient(system(lamp=lamp), light, 14.0, ["wavelength_offset"])
    partly = optics.with_layer("support", thickness_spread_um=0.1)
    with pytest.raises(InputError, match="spread"):
        response_gradient(partly, light, 14.0, ["temperature"])
    assert not set(LAYER_PARAMETERS) & set(SYSTEM_PARAMETERS)


def test_dual_numbers_refuse_what_they_do_not_know() -> None:
    one = Dual(np.ones(2), np.ones((1, 2)))
    for operation in (np.tan, np.mean, lambda x: x**3, lambda x: np.add(x, x, out=np.empty(2))):
        with pytest.raises(TypeError):
            operation(one)
    with pytest.raises(ValueError, match="tangent"):
        Dual(np.ones(2), np.ones((1, 3)))
