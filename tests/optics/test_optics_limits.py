"""Limits of what light and layers may be: both ends are in, what lies beyond either is out and is named."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from stated_limits import check_ends

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.optics import (
    Beam,
    Illumination,
    LampSpectrum,
    Layer,
    LayerStack,
    PhaseResponse,
    constant_medium,
    get_medium,
    layer_absorption,
    reduce_to_phase,
)
from lsst.fringe_sim.optics.coherence import phase_states
from lsst.fringe_sim.optics.diffuse import DiffuseReturn
from lsst.fringe_sim.optics.illumination import GaussianProfile, TriangularProfile

INF = np.inf
GLASS = constant_medium("glass", 1.5)


def beam(theta: float, weights: tuple[float, ...] = (0.25, 0.75)) -> Beam:
    return Beam(np.array([0.0, theta]), np.array(weights))


def exposure(*weights: float) -> Illumination:
    shape = (1, len(weights))
    return Illumination(np.full(shape, 960.0), np.zeros(shape), np.array([weights]))


def lamp(*light: float) -> LampSpectrum:
    return LampSpectrum(900.0 + 50.0 * np.arange(len(light)), np.array(light))


def response(ratio: float, spread_um: float) -> PhaseResponse:
    one = np.ones((1, 3))
    return PhaseResponse(
        one, one, one, one + 0j, ratio * one * (0.6 + 0.8j), 20.0 * one + 0j, spread_um=spread_um
    )


def stack(thickness_um: float, roughness_nm: float = 0.0, spread_um: float = 0.0) -> LayerStack:
    film = Layer("film", GLASS, thickness_um, roughness_nm, spread_um)
    return LayerStack((Layer("top", GLASS, INF), film, Layer("bottom", GLASS, INF)))


def absorbed(thickness: float, index: complex = 2.0, theta: float = 0.0, wavelength: float = 0.5) -> Any:
    return layer_absorption([1.0, index, 1.5], [INF, thickness, INF], wavelength, theta)


@pytest.mark.parametrize(
    ("made", "inside", "outside"),
    [
        (GaussianProfile, (1e-9, 199.999), (0.0, -1.0, 200.0, np.nan)),
        (TriangularProfile, (1e-9, 199.999), (0.0, 200.0, np.nan)),
        (Beam.cone, (0.500001, 1e6, INF), (0.5, 0.0, -1.0, -INF, np.nan)),
        (lambda hole: Beam.cone(2.0, hole), (0.0, 0.999), (-1e-9, 1.0, np.nan)),
        (beam, (0.0, np.nextafter(0.5 * np.pi, 0.0)), (-1e-9, 0.5 * np.pi, np.nan)),
        (lambda more: beam(0.1, (0.25, 0.75 + more)), (9e-10, -9e-10), (1.2e-9, -1.2e-9, np.nan)),
        (lambda part: beam(0.1, (part, 1.0 - part)), (0.0, 1.0), (-1e-9, 1.1)),
        (lambda more: exposure(0.25, 0.75 + more), (9e-10, -9e-10), (1.2e-9, -1.2e-9, np.nan)),
        (lambda light: lamp(light, 1.0), (0.0, 1e9), (-1e-9, INF, np.nan)),
        (lambda light: lamp(0.0, light), (1e-9,), (0.0,)),
        (lambda wave: LampSpectrum(np.array([900.0, wave]), np.ones(2)), (900.1,), (900.0, 899.0, INF)),
        (lambda light: Illumination.spectrum([900.0, 950.0], [0.0, light], beam(0.1)), (1e-9,), (0.0, -1e-9)),
        (lambda spread: response(0.5, spread), (0.0, 1e-9, 1e3), (-1e-9, INF, np.nan)),
        (lambda ratio: response(ratio, 0.01), (0.0, 0.94 - 1e-9), (0.94 + 1e-9,)),
        (lambda ratio: response(ratio, 0.0), (0.99,), ()),
        (stack, (0.0, 1e9), (-1e-9, INF, np.nan)),
        (lambda rough: stack(1.0, rough), (0.0, 1e9), (-1e-9, INF, np.nan)),
        (lambda spread: stack(1.0, 0.0, spread), (0.0, INF), (-1e-9, np.nan)),
        (absorbed, (0.0, 2.5e11 * (1.0 - 1e-9)), (-1e-9, 2.5e11 * (1.0 + 1e-9), INF, np.nan)),
        (lambda wave: absorbed(1.0, 2.0, 0.0, wave), (1e-6, 1e9), (0.0, -1e-9, INF, np.nan)),
        (lambda theta: absorbed(1.0, 2.0, theta), (0.0, np.nextafter(0.5 * np.pi, 0.0)), (-1e-9, 0.5 * np.pi)),
        (lambda index: absorbed(1.0, index), (1e-3, 1e-3j, 2.0 + 1.0j), (0.0, -1e-9 + 1j, 1.0 - 1e-9j, INF)),
        (lambda k: layer_absorption([1.0 + 1j * k, 1.5], [INF, INF], 0.5), (0.0,), (1e-9,)),
        (lambda n: constant_medium("x", n), (1e-9,), (0.0, -1e-9)),
        (lambda k: constant_medium("x", 1.5, k), (0.0, 1e-9), (-1e-9,)),
        (lambda kelvin: get_medium("epoxy").index(960.0, kelvin), (100.0, 400.0), (99.999, 400.001, np.nan)),
        (lambda kelvin: get_medium("Si").index(960.0, kelvin), (100.0, 400.0), (99.999, 400.001, np.nan)),
        (lambda um: response(0.5, 0.0).averaged(np.ones(3), um), (0.0, 1e3), (-1e-9, INF, np.nan)),
        (lambda step: response(0.5, 0.0).averaged_on_grid(np.ones(3), 1.0, step, 3), (1.0, -0.5), (-0.501, INF)),
        (lambda many: response(0.5, 0.0).averaged_on_grid(np.ones(3), 0.0, 0.1, many), (1, 2), (0, -1)),
        (lambda order: response(0.5, 0.0).derivative_bound(np.ones(3), order), (1, 2), (0, -1)),
    ],
)  # fmt: skip
def test_ends_are_in(made: Callable[[Any], Any], inside: tuple[Any, ...], outside: tuple[Any, ...]) -> None:
    check_ends(made, inside, outside)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: lamp(1.0, 1.0).at([899.0, 920.0]), "899.0; allowed: 900 to 950"),
        (lambda: lamp(1.0, 1.0).at([920.0, 951.0]), "951.0"),
        (lambda: layer_absorption([1.0, 2.0, 3.0, 1.0], [INF, 1.0, -2.0, INF], 0.5), "-2.0"),
        (lambda: layer_absorption([1.0, 2.0], [INF, INF], [0.5, -0.5]), "wavelength is -0.5"),
        (lambda: get_medium("epoxy").index([960.0, 2e4, 3e4]), "20000.0"),
        (lambda: response(0.5, 0.0).averaged(np.ones(3), [1.0, -2.0, -3.0]), "-2.0"),
        (lambda: reduce_to_phase([1.0, 2.0, 1.5], [0.0, 1.0, 0.0], 0.9, varying=2, layers=[1]), "1 to 1"),
    ],
)
def test_the_first_that_is_wrong_is_named(call: Callable[[], Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        call()


def test_a_flat_without_light_is_named() -> None:
    dark = LampSpectrum(np.array([800.0, 900.0, 950.0, 1100.0]), np.array([1.0, 0.0, 0.0, 1.0]))
    assert Illumination.flat_fields([870.0, 1000.0], GaussianProfile(1.0), beam(0.1), lamp=dark)
    with pytest.raises(InputError, match=r"925\.0"):
        Illumination.flat_fields([870.0, 925.0, 1000.0], GaussianProfile(1.0), beam(0.1), lamp=dark)


def test_what_is_too_short_or_of_another_shape() -> None:
    """One layer, one point of a lamp, no angle, no light; two of each are enough, or one."""
    for made in (
        lambda: lamp(1.0),
        lambda: LampSpectrum(np.array([[900.0, 950.0]]), np.ones((1, 2))),
        lambda: LampSpectrum(np.array([900.0, 950.0]), np.ones(3)),
        lambda: Beam(np.zeros(0), np.zeros(0)),
        lambda: Beam(np.zeros((1, 1)), np.ones((1, 1))),
        lambda: Beam(np.zeros(2), np.ones(1)),
        lambda: Illumination(np.ones(1), np.zeros(1), np.ones(1)),
        lambda: Illumination(np.ones((1, 0)), np.zeros((1, 0)), np.ones((1, 0))),
        lambda: Illumination(np.ones((1, 2)), np.zeros((1, 1)), np.ones((1, 1))),
        lambda: Illumination.spectrum([], [], beam(0.1)),
        lambda: Illumination.spectrum([[900.0]], [[1.0]], beam(0.1)),
        lambda: Illumination.spectrum([900.0, 950.0], [1.0], beam(0.1)),
        lambda: layer_absorption([1.0, 1.5], [INF, INF], 0.5, roughness=[[0.1]]),
        lambda: layer_absorption(1.0, INF, 0.5),
    ):
        with pytest.raises(InputError):
            made()
    assert lamp(1.0, 3.0).at(925.0) == 2.0
    one = Beam(np.array([0.3]), np.ones(1))
    assert one.mean_angle == 0.3
    assert beam(0.4, (0.25, 0.75)).mean_angle == pytest.approx(0.3)
    assert Illumination.spectrum([900.0], [2.0], one).weight.tolist() == [[1.0]]


def test_a_spectrum_is_a_mean_over_lines_and_angles() -> None:
    light = Illumination.spectrum([900.0, 950.0, 980.0], [1.0, 2.0, 5.0], beam(0.2, (0.25, 0.75)))
    np.testing.assert_array_equal(light.wavelength_nm, [[900.0, 900.0, 950.0, 950.0, 980.0, 980.0]])
    np.testing.assert_array_equal(light.theta, [[0.0, 0.2] * 3])
    np.testing.assert_allclose(light.weight, np.outer([0.125, 0.25, 0.625], [0.25, 0.75]).reshape(1, 6))
    assert light.mean_wavelength_nm == pytest.approx(0.125 * 900.0 + 0.25 * 950.0 + 0.625 * 980.0)


def test_responses_that_are_added_and_mixed() -> None:
    """Against sums of their values; a part of a pixel has weight, and a factor its own at every node."""
    rng = np.random.default_rng(29)
    shape = (2, 3)
    a, b, e, x, y = rng.normal(size=(5, *shape))
    kappa = rng.uniform(15.0, 25.0, shape) + 0.1j
    one = PhaseResponse(a, b, e, x + 1j * y, 0.4 * (x - 1j * y) / np.hypot(x, y), kappa)
    other = replace(one, a=b, b=e, e=a, c=y + 2j * x)
    thickness = np.linspace(3.0, 4.0, 5)[:, np.newaxis]
    factor = np.array([2.0, -1.0, 0.5])
    first, second = one.evaluate(thickness), other.evaluate(thickness)
    np.testing.assert_allclose(
        one.plus(other, factor).evaluate(thickness), first + factor * second, rtol=1e-12
    )
    far = replace(other, kappa=1.3 * kappa)
    mixed = one.mixed_with(far, 0.3).evaluate(thickness)
    np.testing.assert_allclose(mixed, 0.7 * first + 0.3 * far.evaluate(thickness), rtol=1e-12)


@pytest.mark.parametrize("shape", [(1.0, [INF, INF]), ([1.0, 1.5], INF), ([1.0, 1.5, 2.0], [INF, INF])])
def test_as_many_layers_as_thicknesses(shape: tuple[Any, Any]) -> None:
    with pytest.raises(InputError, match="the same number of layers"):
        layer_absorption(*shape, 0.5)


def test_the_ends_of_a_line_count_half() -> None:
    """As in any sum by trapezoids; the line is cut off at five standard deviations on either side."""
    offset, weight = GaussianProfile(2.0).nodes(0.1)
    sigma = 2.0 / np.sqrt(8.0 * np.log(2.0))
    np.testing.assert_allclose(offset[[0, -1]], [-5.0 * sigma, 5.0 * sigma])
    assert np.diff(offset).max() <= 0.1
    shape = np.exp(-0.5 * (offset / sigma) ** 2)
    shape[[0, -1]] *= 0.5
    np.testing.assert_allclose(weight, shape / shape.sum(), rtol=1e-12)
    assert GaussianProfile(0.01).nodes(0.1)[0].size == 17
    for width, nodes in ((0.3, 16), (0.85, 18)):
        assert TriangularProfile(width).nodes(0.1)[0].size == nodes


def test_a_material_on_the_way_to_another_table() -> None:
    wave = np.array([900.0, 960.0, 1000.0])
    own, other, third = (
        get_medium(f"Si_{name}").index(wave, 183.0) for name in ("franta2017", "green2008", "schinke2015")
    )
    made = get_medium("Si_franta2017").modified(toward=(("Si_green2008", 0.3), ("Si_schinke2015", -0.5)))
    n = own.real + 0.3 * (other.real - own.real) - 0.5 * (third.real - own.real)
    k = own.imag * (other.imag / own.imag) ** 0.3 * (third.imag / own.imag) ** -0.5
    np.testing.assert_allclose(made.index(wave, 183.0), n + 1j * k, rtol=1e-12)


@pytest.mark.parametrize("spread_um", [0.0, 0.01])
@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("step_um", [0.02, -0.02, 0.0])
def test_a_grid_may_run_either_way(step_um: float, loss: float, spread_um: float) -> None:
    """Over so many micrometres that in a layer which absorbs it is summed in pieces."""
    rng, shape = np.random.default_rng(3), (1, 1, 5)
    a, b, e, x, y = rng.normal(size=(5, *shape))
    kappa = rng.uniform(15.0, 25.0, shape) + 1j * loss
    g = 0.5 * np.exp(2j * np.pi * rng.random(shape))
    made, weight = PhaseResponse(a, b, e, x + 1j * y, g, kappa, spread_um=spread_um), np.full((1, 5), 0.2)
    grid = (20.0, step_um, 900)
    exact = made.averaged(weight, 20.0 + step_um * np.arange(900))
    np.testing.assert_allclose(made.averaged_on_grid(weight, *grid), exact, atol=1e-12)
    slope = made.averaged_derivative_on_grid(weight, *grid)
    back = made.averaged_derivative_on_grid(weight, 20.0 + 899.0 * step_um, -step_um, 900)
    np.testing.assert_allclose(slope, back[:, ::-1], atol=1e-10)


@pytest.mark.parametrize("nodes", [16_384, 16_387])
def test_many_nodes_of_one_exposure_are_summed_in_shares(nodes: int) -> None:
    """Whether the shares are equal or not."""
    rng = np.random.default_rng(37)
    a, b, e, x, y = rng.normal(size=(5, 1, 1, nodes))
    kappa = rng.uniform(15.0, 25.0, (1, 1, nodes)) + 0j
    made = PhaseResponse(a, b, e, x + 1j * y, 0.2 * np.exp(1j * x), kappa)
    weight = np.full((1, nodes), 1.0 / nodes)
    exact = made.averaged(weight, 10.0 + 0.01 * np.arange(0, 300, 60))
    np.testing.assert_allclose(made.averaged_on_grid(weight, 10.0, 0.01, 300)[:, ::60], exact, atol=1e-12)


def test_a_thick_layer_between_mirrors() -> None:
    """Against the mean over many of its phases; of mirrors without loss no sum over phases is long enough."""
    index = np.array([1.0, 0.05 + 6.0j, 1.5, 0.05 + 6.0j, 3.6 + 0.01j, 1.0])
    thickness = np.array([0.0, 0.005, 30.0, 0.005, 2.0, 0.0])
    spread = np.array([0.0, 0.0, INF, 0.0, 0.0, 0.0])
    ours = reduce_to_phase(index, thickness, 0.9, 0.2, "s", varying=4, layers=[4], spread=spread).evaluate(
        2.0
    )
    places = 30.0 + 0.45 / np.sqrt(1.5**2 - np.sin(0.2) ** 2) * np.arange(1024) / 1024
    depth = np.repeat(np.where(thickness == 0.0, INF, thickness)[:, np.newaxis], 1024, axis=1)
    depth[2] = places
    expected = layer_absorption(index, depth, 0.9, 0.2, "s")[4].mean()
    assert ours == pytest.approx(expected, rel=1e-6)
    lossless = np.array([1.0, 1e-9 + 6.0j, 1.5, 1e-9 + 6.0j, 3.6, 1.0])
    states = phase_states(lossless[:, np.newaxis], thickness, np.array([0.9]), np.zeros(1), "s", [2], spread)
    assert sum(state.share for state in states) == pytest.approx(1.0)
    assert len(states) == 512


@pytest.mark.parametrize("below", [1.5, 4.5])
def test_scattered_light_above_anything(below: float) -> None:
    """Of less index than silicon, or of more: what is absorbed and what leaves are parts, and not all of it."""
    silicon = get_medium("Si")
    stack = LayerStack(
        (
            Layer("top", constant_medium("air", 1.0), INF),
            Layer("detection", silicon, 100.0),
            Layer("first", silicon, 0.0),
            Layer("second", silicon, 0.0),
            Layer("film", constant_medium("film", below), 1.0),
            Layer("bottom", GLASS, INF),
        )
    )
    diffuse = DiffuseReturn("first", "second", 0.3, 0.4)
    wave = np.array([900.0, 960.0, 1000.0])
    absorbed, left = diffuse.fate(stack, "detection", wave, 183.0)
    assert np.all((absorbed > 0.0) & (left > 0.0) & (absorbed + left < 1.0))
    assert np.all(np.diff(absorbed) < 0.0)
    # A thick sensor takes all that comes back once.
    thick = stack.replace_layer("detection", thickness_um=1e6)
    absorbed, left = diffuse.fate(thick, "detection", wave, 183.0)
    np.testing.assert_allclose(absorbed, 1.0, atol=1e-9)
    np.testing.assert_allclose(left, 0.0, atol=1e-9)
