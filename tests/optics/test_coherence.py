"""Loss of coherence against independent references: tmm.inc_tmm, refnx, and averaging by brute force."""

import dataclasses
import math

import numpy as np
import pytest
import tmm
import yaml

from lsst.fringe_sim.errors import ConvergenceError, OutOfRangeError, StackError
from lsst.fringe_sim.optics import Beam, LayerStack, layer_absorption, reduce_to_phase
from lsst.fringe_sim.optics.illumination import GaussianProfile, MonochromaticProfile
from lsst.fringe_sim.optics.system import OpticalSystem

INF = math.inf


def gaussian_nodes(sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Trapezoidal sum over ±9 sigma: exact to rounding for what oscillates slower than the spacing resolves."""
    place = np.linspace(-9.0, 9.0, 400 if sigma > 0.1 else 200)
    weight = np.exp(-0.5 * place**2)
    return sigma * place, weight / weight.sum()


def gaussian_mean(function, centre: float, sigma: float) -> np.ndarray:
    place, weight = gaussian_nodes(sigma)
    return sum(w * function(centre + x) for x, w in zip(place, weight, strict=True))


def e2v(angle: float = 0.3, varying: str = "adhesive") -> OpticalSystem:
    return OpticalSystem(
        LayerStack.from_resource("e2v_ccd250"), 183.0, MonochromaticProfile(), Beam.collimated(angle), varying
    )


def random_lossless(rng: np.random.Generator, layers: int) -> tuple[np.ndarray, np.ndarray]:
    n = rng.uniform(1.0, 3.5, layers).astype(complex)
    n[0] = 1.0
    d = np.concatenate([[INF], rng.uniform(0.05, 1.0, layers - 2), [INF]])
    return n, d


def absorbed(
    n: np.ndarray, d: np.ndarray, theta: float, polarization: str, spread: np.ndarray, varying: int
) -> np.ndarray:
    """Fraction absorbed in each inner layer at 0.9, by the closed form in the thickness of a coherent one."""
    finite = np.where(np.isinf(d), 0.0, d)
    return np.array(
        [
            reduce_to_phase(
                n, finite, 0.9, theta, polarization, varying=varying, layers=[layer], spread=spread
            ).evaluate(d[varying])
            for layer in range(1, len(n) - 1)
        ]
    )


# --- incoherent layers -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("polarization", ["s", "p"])
@pytest.mark.parametrize("incoherent", [1, 2, 4, 6])
@pytest.mark.parametrize("extinction", [0.0, 3e-4])
@pytest.mark.rng("incoherent layer agrees with tmm")
def test_incoherent_layer_agrees_with_tmm(
    incoherent: int, polarization: str, extinction: float, rng: np.random.Generator
) -> None:
    """One thick layer (transparent or absorbing) among coherent ones that absorb: intensities add."""
    for _ in range(20):
        n, d = random_lossless(rng, 8)
        n[[3, 5]] += 1j * rng.uniform(0.0, 0.3, 2)
        n[incoherent] = n[incoherent].real + 1j * extinction
        d[incoherent] = rng.uniform(50.0, 200.0)
        kinds = ["i" if layer in (0, incoherent, 7) else "c" for layer in range(8)]
        theta = rng.uniform(0.0, 1.4)
        reference = tmm.inc_tmm(polarization, n, d, kinds, theta, 0.9)
        expected = np.array(tmm.inc_absorp_in_each_layer(reference))[1:-1]
        spread = np.where(np.arange(8) == incoherent, INF, 0.0)
        ours = absorbed(n, d, theta, polarization, spread, varying=5)
        np.testing.assert_allclose(ours, expected, rtol=0.0, atol=2e-12)


@pytest.mark.rng("two incoherent layers are the mean over both thicknesses")
def test_two_incoherent_layers_are_the_mean_over_both_thicknesses(rng: np.random.Generator) -> None:
    """Paths that cross both layers equally often in another order keep their phase; tmm.inc_tmm drops that too."""
    n, d = random_lossless(rng, 7)
    n[3] += 0.1j
    d[[2, 4]] = 20.0, 30.0
    spread = np.array([0.0, 0.0, INF, 0.0, INF, 0.0, 0.0])
    ours = absorbed(n, d, 0.4, "p", spread, varying=5)
    fringe = 0.45 / np.sqrt(n.real**2 - np.sin(0.4) ** 2)
    steps = np.arange(128) / 128.0
    block = np.broadcast_to(d[:, None, None], (7, 128, 128)).copy()
    block[2] += fringe[2] * steps[:, None]
    block[4] += fringe[4] * steps
    expected = layer_absorption(n, block, 0.9, 0.4, "p").mean(axis=(1, 2))
    np.testing.assert_allclose(ours, expected[1:-1], rtol=0.0, atol=1e-12)
    intensities = tmm.inc_tmm("p", n, d, ["i", "c", "i", "c", "i", "c", "i"], 0.4, 0.9)
    assert 1e-9 < abs(ours.sum() - sum(tmm.inc_absorp_in_each_layer(intensities)[1:-1])) < 1e-2


@pytest.mark.rng("spread goes from coherent to incoherent")
def test_spread_goes_from_coherent_to_incoherent(rng: np.random.Generator) -> None:
    n, d = random_lossless(rng, 6)
    n[2] += 0.05j
    coherent = layer_absorption(n, d, 0.9, 0.2)[1:-1]
    null, tiny, wide, none = (
        absorbed(n, d, 0.2, "mixed", np.array([0.0, 0.0, 0.0, 0.0, sigma, 0.0]), varying=1)
        for sigma in (0.0, 1e-9, 1e3, INF)
    )
    np.testing.assert_allclose(null, coherent, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(tiny, coherent, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(wide, none, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("layer", "sigma"), [("insulation", 0.02), ("gate_oxide", 0.05), ("insulation", 0.2)]
)
def test_spread_of_a_transparent_fixed_layer_is_the_mean_over_its_thickness(layer: str, sigma: float) -> None:
    system = e2v()
    light = system.flat_fields([900.0, 970.0])
    thickness = np.linspace(12.0, 12.3, 6)
    centre = system.stack.layers[system.stack.position(layer)].thickness_um
    ours = system.with_layer(layer, thickness_spread_um=sigma).reduce(light)

    def at(value: float) -> np.ndarray:
        # A negative thickness stands for the phase that a Gaussian tail asks for.
        layers = np.where(np.isinf(system.stack.thickness_um), 0.0, system.stack.thickness_um)
        layers[system.stack.position(layer)] = value
        reduced = reduce_to_phase(
            system.stack.indices(light.wavelength_nm, 183.0),
            layers,
            1e-3 * light.wavelength_nm,
            light.theta,
            varying=system.stack.position("adhesive"),
            layers=[system.stack.position("detection")],
        )
        return reduced.evaluate(thickness[:, None, None])[:, :, 0].T

    expected = gaussian_mean(at, centre, sigma)
    np.testing.assert_allclose(ours.averaged(light.weight, thickness), expected, rtol=0.0, atol=1e-12)


def test_incoherent_support_is_the_mean_over_a_fringe_of_it() -> None:
    """They differ by a hundredth of the weak absorption over one fringe of silicon."""
    system = e2v()
    light = system.flat_fields([930.0, 990.0])
    thickness = np.linspace(12.0, 12.3, 20)
    ours = system.with_layer("support", thickness_spread_um=INF).reduce(light)
    silicon = system.stack.indices(light.wavelength_nm, 183.0)[system.stack.position("support")].ravel()
    index = silicon.real
    fringe = 0.5e-3 * light.wavelength_nm.ravel() / np.sqrt(index**2 - np.sin(0.3) ** 2)
    for row in range(2):
        shifts = (np.arange(64) - 31.5) / 64.0 * fringe[row]
        expected = np.mean(
            [
                system.with_layer("support", thickness_um=165.0 + shift)
                .reduce(light)
                .averaged(light.weight, thickness)[row]
                for shift in shifts
            ],
            axis=0,
        )
        absorbed = 4e3 * np.pi * silicon.imag[row] * fringe[row] / light.wavelength_nm.ravel()[row]
        assert np.abs(ours.averaged(light.weight, thickness)[row] - expected).max() < 0.01 * absorbed


# --- spread of the varying layer ---------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.002, 0.03, 0.15])
@pytest.mark.parametrize("extinction", [0.0, 2e-3])
def test_spread_of_the_varying_layer_is_the_mean_over_thickness(sigma: float, extinction: float) -> None:
    system = e2v()
    medium = system.stack.layers[system.stack.position("adhesive")].medium
    system = system.with_layer("adhesive", medium=medium.modified(extinction_offset=extinction))
    light = system.flat_fields([900.0, 970.0])
    grid = (12.0, 0.02, 12)
    thickness = 12.0 + 0.02 * np.arange(12)
    sharp = system.reduce(light)
    blurred = system.with_layer("adhesive", thickness_spread_um=sigma).reduce(light)
    place, weight = gaussian_nodes(sigma)
    expected = sharp.averaged(light.weight, thickness[:, None] + place) @ weight
    slope = sum(
        share * sharp.averaged_derivative_on_grid(light.weight, grid[0] + shift, *grid[1:])
        for shift, share in zip(place, weight, strict=True)
    )
    close = {"rtol": 0.0, "atol": 1e-12}
    np.testing.assert_allclose(blurred.averaged(light.weight, thickness), expected, **close)
    np.testing.assert_allclose(blurred.averaged_on_grid(light.weight, *grid), expected, **close)
    np.testing.assert_allclose(blurred.evaluate(thickness[7])[:, 0], expected[:, 7], **close)
    blurred_slope = blurred.averaged_derivative_on_grid(light.weight, *grid)
    np.testing.assert_allclose(blurred_slope, slope, rtol=0.0, atol=1e-10)


def test_zero_spread_is_exactly_the_identity() -> None:
    system = e2v()
    light = system.flat_fields([900.0, 970.0])
    same = system.with_layer("adhesive", thickness_spread_um=0.0).with_layer(
        "support", thickness_spread_um=0.0
    )
    thickness = np.linspace(5.0, 30.0, 400)
    one, other = system.reduce(light), same.reduce(light)
    np.testing.assert_array_equal(
        one.averaged(light.weight, thickness), other.averaged(light.weight, thickness)
    )
    np.testing.assert_array_equal(
        one.averaged_on_grid(light.weight, 5.0, 0.01, 2000),
        other.averaged_on_grid(light.weight, 5.0, 0.01, 2000),
    )


def test_impossible_spreads_are_refused() -> None:
    system = e2v()
    for layer, spread in (("support", -1.0), ("support", math.nan), ("ambient", 0.1), ("substrate", INF)):
        with pytest.raises(StackError, match="thickness spread"):
            system.with_layer(layer, thickness_spread_um=spread)
    reduced = system.reduce(system.flat_fields([900.0]))
    for spread in (-1.0, math.nan, INF):
        with pytest.raises(OutOfRangeError, match="spread"):
            dataclasses.replace(reduced, spread_um=spread)
    with pytest.raises(ConvergenceError, match="harmonics"):
        dataclasses.replace(reduced, g=np.full_like(reduced.g, 0.99), spread_um=0.1)


# --- roughness ---------------------------------------------------------------------------------------------------


def test_rough_interface_is_the_mean_amplitude_over_heights() -> None:
    """One interface in Kirchhoff's approximation, heights averaged by brute force."""
    upper, lower, sigma, wavelength = 1.6, 3.6, 0.03, 0.95
    smooth = layer_absorption([upper, lower], [INF, INF], wavelength)
    rough = layer_absorption([upper, lower], [INF, INF], wavelength, roughness=[sigma])
    wave_number = 2.0 * np.pi / wavelength
    reflected = gaussian_mean(lambda h: np.exp(2j * upper * wave_number * h), 0.0, sigma)
    through = gaussian_mean(lambda h: np.exp(1j * (upper - lower) * wave_number * h), 0.0, sigma)
    np.testing.assert_allclose(rough[0], smooth[0] * abs(reflected) ** 2, rtol=1e-13)
    np.testing.assert_allclose(rough[1], smooth[1] * abs(through) ** 2, rtol=1e-13)
    assert rough.sum() < 1.0


@pytest.mark.rng("no roughness is exactly the identity")
def test_no_roughness_is_exactly_the_identity(rng: np.random.Generator) -> None:
    n, d = random_lossless(rng, 6)
    np.testing.assert_array_equal(
        layer_absorption(n, d, 0.9, 0.2), layer_absorption(n, d, 0.9, 0.2, roughness=np.zeros(5))
    )


@pytest.fixture(scope="module")
def refnx_reflect():
    """refnx, without what it does to YAML: a package it imports stops every emitter of the process writing tags."""
    emitter, constructors = (
        yaml.emitter.Emitter.process_tag,
        yaml.constructor.SafeConstructor.yaml_constructors,
    )
    kept = dict(constructors)
    try:
        return pytest.importorskip("refnx.reflect", reason="refnx is not installed")
    finally:
        yaml.emitter.Emitter.process_tag = emitter
        constructors.update(kept)


def test_the_independent_references_leave_tables_readable(refnx_reflect) -> None:
    assert yaml.safe_load(yaml.safe_dump({1, 2})) == {1, 2}


@pytest.mark.rng("rough reflectivity agrees with refnx where both hold")
def test_rough_reflectivity_agrees_with_refnx_where_both_hold(
    rng: np.random.Generator, refnx_reflect
) -> None:
    """Near an index of 1 (neutrons, X-rays) the Debye–Waller and the Névot–Croce factor become the same.

    refnx damps by exp(-2 q1 q2 s²), we by exp(-2 q1² s²); they differ by the relative step of q at an interface.
    """
    wavelength, theta = 0.9, 0.5
    wave_number = 2.0 * np.pi / wavelength
    scattering = np.array([0.0, -2e-4, 1e-4, -3e-4, -1e-4])  # 4 pi rho / k²
    thickness = np.array([0.0, 0.7, 1.3, 0.4, 0.0])
    heights = np.array([0.05, 0.08, 0.03, 0.06])
    n = np.sqrt(1.0 - scattering).astype(complex)
    d = np.concatenate([[INF], thickness[1:-1], [INF]])
    layers = np.zeros((5, 4))
    layers[:, 0] = thickness
    layers[:, 1] = scattering * wave_number**2 / (4.0 * np.pi) * 1e6
    q = np.array([2.0 * wave_number * np.cos(theta)])
    smooth = layer_absorption(n, d, wavelength, theta, "s")[0]
    assert smooth == pytest.approx(refnx_reflect.abeles(q, layers)[0], rel=1e-9)
    layers[1:, 3] = heights
    rough = layer_absorption(n, d, wavelength, theta, "s", roughness=heights)[0]
    assert rough < 0.8 * smooth
    assert rough == pytest.approx(refnx_reflect.abeles(q, layers)[0], rel=1e-3)


def test_bad_roughness_is_refused() -> None:
    for roughness in ([-0.1], [0.1, 0.1], [math.nan]):
        with pytest.raises(StackError, match="roughness"):
            layer_absorption([1.0, 1.5], [INF, INF], 0.9, roughness=roughness)


def test_roughness_reduces_contrast() -> None:
    system = dataclasses.replace(e2v(0.0), profile=GaussianProfile(2.0))
    light = system.flat_fields([960.0], 0.2)
    spans = []
    for height in (0.0, 30.0, 60.0):
        rough = system.with_layer("support", roughness_nm=height).reduce(light)
        spans.append(np.ptp(rough.averaged_on_grid(light.weight, 12.0, 0.001, 400)))
    ratio = np.array(spans) / spans[0]
    expected = np.exp(-2.0 * (2.0 * np.pi * 1.6 / 960.0 * np.array([0.0, 30.0, 60.0])) ** 2)
    # The first harmonic carries nearly all of the contrast.
    np.testing.assert_allclose(ratio, expected, atol=0.05)
