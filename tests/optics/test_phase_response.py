"""The closed form and its harmonic series against the transfer matrix, and against each other."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lsst.fringe_sim.compiled import limit_threads
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.optics import (
    Beam,
    Illumination,
    LayerStack,
    PhaseResponse,
    layer_absorption,
    reduce_to_phase,
)
from lsst.fringe_sim.optics.closed_form import on_grid
from lsst.fringe_sim.optics.harmonics import series_at, series_on_grid
from lsst.fringe_sim.optics.illumination import GaussianProfile
from lsst.fringe_sim.optics.system import OpticalSystem


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    layers=st.integers(3, 9),
    nodes=st.sampled_from([3, 150]),
    polarization=st.sampled_from(["s", "p", "mixed"]),
    rough=st.booleans(),
    data=st.data(),
)
def test_closed_form_is_the_transfer_matrix(
    seed: int, layers: int, nodes: int, polarization: str, rough: bool, data: st.DataObject
) -> None:
    """Any varying layer, any set of absorbing layers, above, in and below it, smooth and rough interfaces."""
    rng = np.random.default_rng(seed)
    varying = data.draw(st.integers(1, layers - 2))
    chosen = data.draw(st.sets(st.integers(1, layers - 2), min_size=1))
    n = rng.uniform(1.0, 4.0, layers) + 1j * rng.uniform(0.0, 0.5, layers) * (rng.random(layers) < 0.6)
    n[0] = 1.0
    d = rng.uniform(0.0, 2.0, layers)
    d[[0, -1]] = np.inf
    wavelength, theta = rng.uniform(0.4, 1.1, nodes), rng.uniform(0.0, 1.5)
    roughness = rng.uniform(0.0, 0.05, layers - 1) if rough else np.zeros(layers - 1)
    thickness = np.array([0.0, 0.3, 2.7])
    finite = np.where(np.isinf(d), 0.0, d)
    index = np.repeat(n[:, None], nodes, axis=1)
    chosen = sorted(chosen)
    reduced = reduce_to_phase(
        index, finite, wavelength, theta, polarization, varying=varying, layers=chosen, roughness=roughness
    )
    values = reduced.evaluate(thickness[:, None])
    for row, value in enumerate(thickness):
        moved = d.copy()
        moved[varying] = value
        expected = layer_absorption(index, moved, wavelength, theta, polarization, roughness=roughness)
        expected = expected[chosen].sum(axis=0)
        np.testing.assert_allclose(values[row], expected, rtol=0.0, atol=2e-13)


def random_response(rng: np.random.Generator, ratio: float, loss: float) -> tuple[PhaseResponse, np.ndarray]:
    """Coefficients without a stack behind them: two polarisations, two exposures, nine nodes."""
    shape = (2, 2, 9)
    a, b, e = rng.normal(size=(3, *shape))
    c = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    g = ratio * rng.uniform(0.3, 1.0, shape) * np.exp(2j * np.pi * rng.random(shape))
    kappa = rng.uniform(15.0, 25.0, shape) + 1j * loss * rng.uniform(0.1, 1.0, shape)
    weight = rng.random(shape[1:])
    return PhaseResponse(a, b, e, c, g, kappa), weight / weight.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("ratio", [0.0, 0.2, 0.85])
@pytest.mark.parametrize("loss", [0.0, 1e-3, 0.3])
@pytest.mark.rng("series is the closed form")
def test_series_is_the_closed_form(ratio: float, loss: float, rng: np.random.Generator) -> None:
    response, weight = random_response(rng, ratio, loss)
    arrays, spread, _ = response._grouped(weight)
    for start, step, count in ((0.0, 0.01, 300), (14.0, 0.0007, 1111), (5.0, 0.5, 40)):
        closed = on_grid(arrays, spread, start, step, count)
        scale = np.abs(closed).max()
        series = series_on_grid(arrays, spread, 0.0, start, step, count)
        assert np.abs(series - closed).max() < 2e-12 * scale
        some = start + step * np.arange(0, count, 101)
        assert np.abs(series_at((*arrays, spread), 0.0, some) - closed[:, ::101]).max() < 1e-12 * scale


@pytest.mark.parametrize("tolerance", [1e-12, 1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("loss", [0.0, 0.02])
@pytest.mark.parametrize("spread_um", [0.0, 0.01])
@pytest.mark.rng("a tolerance is kept")
def test_a_tolerance_is_kept(
    tolerance: float, loss: float, spread_um: float, rng: np.random.Generator
) -> None:
    reduced, weight = random_response(rng, 0.4, loss)
    arrays, weights, _ = reduced._grouped(weight)
    grid = (9.0, 0.004, 700)
    exact = series_on_grid(arrays, weights, spread_um, *grid)
    found = series_on_grid(arrays, weights, spread_um, *grid, tolerance=tolerance)
    assert np.abs(found - exact).max() < tolerance * np.ptp(exact)
    assert tolerance < 1e-11 or np.any(found != exact)


@pytest.mark.parametrize("loss", [0.0, 0.05])
@pytest.mark.rng("a further wave")
def test_a_further_wave_is_a_part_of_the_mean_over_all_phases(loss: float, rng: np.random.Generator) -> None:
    response, _ = random_response(rng, 0.6, loss)
    response = replace(response, kappa=np.broadcast_to(response.kappa[:1], response.kappa.shape))
    cosine, sine = rng.normal(size=(2, *response.node_shape))
    thickness = 3.0 + 0.1 * np.arange(7)[:, np.newaxis, np.newaxis]
    added = response.with_harmonic(2, cosine, sine).evaluate(thickness) - response.evaluate(thickness)
    # Where nothing is absorbed the mean is that of many phases of one period, where it is, of a layer without end.
    period = 2.0 * np.pi / response.kappa[0].real * np.linspace(0.0, 1.0, 200, endpoint=False)[:, None, None]
    mean = response.evaluate(period).mean(axis=0) if loss == 0.0 else response.evaluate(1e6)
    phase = 2.0 * response.kappa[0].real * thickness
    fading = np.exp(-2.0 * response.kappa[0].imag * thickness)
    expected = mean * fading * (cosine * np.cos(phase) + sine * np.sin(phase))
    np.testing.assert_allclose(added, expected, atol=1e-12)


@pytest.mark.rng("grid is the points")
def test_grid_is_the_points(rng: np.random.Generator) -> None:
    response, weight = random_response(rng, 0.4, 0.0)
    for count in (1, 5, 200, 3000):
        thickness = 7.0 + 0.01 * np.arange(count)
        on_grid = response.averaged_on_grid(weight, 7.0, 0.01, count)
        at_points = response.averaged(weight, thickness)
        at_nodes = (weight[:, :, None] * response.evaluate(thickness[:, None, None]).transpose(1, 2, 0)).sum(
            axis=1
        )
        assert on_grid.shape == (2, count)
        np.testing.assert_allclose(on_grid, at_points, rtol=0.0, atol=2e-12)
        np.testing.assert_allclose(at_nodes, at_points, rtol=0.0, atol=2e-12)
        one = response.evaluate(thickness[0])
        np.testing.assert_allclose((weight * one).sum(axis=1), on_grid[:, 0], rtol=0.0, atol=2e-12)


@pytest.mark.parametrize("loss", [0.0, 0.05])
@pytest.mark.rng("derivatives in thickness")
def test_derivatives_in_thickness(loss: float, rng: np.random.Generator) -> None:
    """Central differences of fourth order, whose own error is 1e-9 here."""
    response, weight = random_response(rng, 0.4, loss)
    step, count = 2e-4, 400
    values = response.averaged_on_grid(weight, 6.0, step, count)
    for order, of in ((1, values), (2, response.averaged_derivative_on_grid(weight, 6.0, step, count))):
        numeric = (of[:, :-4] - 8 * of[:, 1:-3] + 8 * of[:, 3:-1] - of[:, 4:]) / (12 * step)
        exact = response.averaged_derivative_on_grid(weight, 6.0, step, count, order)[:, 2:-2]
        assert np.abs(numeric - exact).max() < 2e-8 * np.abs(exact).max()


def test_threads_do_not_change_a_bit() -> None:
    system = OpticalSystem(
        LayerStack.from_resource("e2v_ccd250"), 153.0, GaussianProfile(1.0), Beam.cone(1.234, 0.6, 16)
    )
    light = Illumination.spectrum(np.linspace(950.0, 1000.0, 20), np.ones(20), system.beam)
    reduced = system.reduce(light)
    seen = set()
    for threads in (1, 2, 5):
        limit_threads(threads)
        seen.add(
            (
                reduced.averaged_on_grid(light.weight, 14.0, 0.01, 800).tobytes(),
                reduced.averaged_on_grid(light.weight, 14.0, 0.01, 80).tobytes(),
                reduced.averaged(light.weight, np.linspace(14.0, 15.0, 50)).tobytes(),
            )
        )
    limit_threads(None)
    assert len(seen) == 1


def test_total_is_one_minus_reflected_and_transmitted() -> None:
    stack = LayerStack.from_resource("e2v_ccd250")
    system = OpticalSystem(stack, 183.0, GaussianProfile(1.0), Beam.collimated(), observable="total")
    light = Illumination.spectrum([960.0], [1.0], Beam.collimated())
    total = system.reduce(light).averaged(light.weight, 14.0)
    fractions = layer_absorption(stack.indices(960.0, 183.0), stack.thickness_um, 0.96)
    assert float(total[0]) == pytest.approx(1.0 - fractions[0] - fractions[-1], abs=1e-12)


@pytest.mark.rng("bad arguments are refused")
def test_bad_arguments_are_refused(rng: np.random.Generator) -> None:
    response, weight = random_response(rng, 0.3, 0.0)
    for thickness in (-0.1, np.nan, np.inf):
        with pytest.raises(OutOfRangeError, match="thickness"):
            response.averaged(weight, thickness)
    with pytest.raises(InputError, match="weights"):
        response.averaged(weight[:, :4], 5.0)
    with pytest.raises(InputError, match="grid"):
        response.averaged_on_grid(weight, 5.0, 0.1, 0)
    with pytest.raises(OutOfRangeError, match="thickness"):
        response.averaged_on_grid(weight, -5.0, 0.1, 10)
    with pytest.raises(InputError, match="derivative"):
        response.averaged_derivative_on_grid(weight, 5.0, 0.1, 10, 0)
    n, d = np.array([1.0, 1.6, 3.6]), np.array([0.0, 1.0, 0.0])
    for varying, layers in ((0, [1]), (2, [1]), (1, [0]), (1, [2])):
        with pytest.raises(InputError, match="layer"):
            reduce_to_phase(n, d, 0.9, varying=varying, layers=layers)
    with pytest.raises(InputError, match="polarization"):
        reduce_to_phase(n, d, 0.9, 0.0, "circular", varying=1, layers=[1])
