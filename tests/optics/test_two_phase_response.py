"""Two varying layers against the transfer matrix and against the closed form of one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.optics import (
    Beam,
    Illumination,
    LayerStack,
    ThicknessGrid,
    layer_absorption,
    reduce_to_two_phases,
)
from lsst.fringe_sim.optics.illumination import GaussianProfile
from lsst.fringe_sim.optics.system import OpticalSystem


def e2v() -> OpticalSystem:
    return OpticalSystem(
        LayerStack.from_resource("e2v_ccd250"), 183.0, GaussianProfile(1.0), Beam.cone(2.0, 0.3, 6)
    )


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    layers=st.integers(4, 10),
    polarization=st.sampled_from(["s", "p", "mixed"]),
    data=st.data(),
)
def test_closed_form_is_the_transfer_matrix(
    seed: int, layers: int, polarization: str, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    upper = data.draw(st.integers(1, layers - 3))
    lower = data.draw(st.integers(upper + 1, layers - 2))
    n = rng.uniform(1.0, 4.0, layers) + 1j * rng.uniform(0.0, 0.5, layers) * (rng.random(layers) < 0.6)
    n[0] = 1.0
    d = rng.uniform(0.0, 2.0, layers)
    d[[0, -1]] = np.inf
    wavelength, theta = rng.uniform(0.4, 1.1), rng.uniform(0.0, 1.5)
    reduced = reduce_to_two_phases(
        n[:, None, None],
        np.where(np.isinf(d), 0.0, d),
        np.full((1, 1), wavelength),
        theta,
        polarization,
        upper=upper,
        lower=lower,
    )
    low, up = rng.uniform(0.0, 3.0, 5), rng.uniform(0.0, 3.0, 5)
    values = reduced.averaged(np.ones((1, 1)), low, up)[0]
    for i in range(5):
        moved = d.copy()
        moved[lower], moved[upper] = low[i], up[i]
        expected = layer_absorption(n, moved, wavelength, theta, polarization)[upper]
        assert abs(values[i] - expected) < 2e-13


def test_along_each_axis_it_is_the_response_of_one_layer() -> None:
    system = e2v()
    light = system.flat_fields([900.0, 970.0], 0.1)
    both = system.reduce_two_layers(light)
    adhesive = np.linspace(14.0, 14.5, 30)
    expected = (
        system.with_layer("detection", thickness_um=99.7).reduce(light).averaged(light.weight, adhesive)
    )
    np.testing.assert_allclose(both.averaged(light.weight, adhesive, 99.7), expected, rtol=0.0, atol=1e-13)


def test_grid_is_the_points() -> None:
    system = e2v()
    light = system.flat_fields([900.0, 970.0], 0.2)
    both = system.reduce_two_layers(light)
    lower, upper = ThicknessGrid(13.0, 0.02, 37), ThicknessGrid(99.9, 0.003, 75)
    grid = both.averaged_on_grid(light.weight, lower, upper)
    points = both.averaged(light.weight, lower.thickness_um[:, None], upper.thickness_um)
    assert grid.shape == (2, 37, 75)
    np.testing.assert_allclose(grid, points, rtol=0.0, atol=2e-13)


def test_derivatives_agree_with_differences() -> None:
    system = e2v()
    light = system.flat_fields([970.0], 0.2)
    both = system.reduce_two_layers(light)
    low, up, step = np.linspace(14.0, 14.3, 7), np.linspace(99.9, 100.1, 7), 2e-4
    by_lower, by_upper = both.averaged_derivatives(light.weight, low, up)

    def slope(along_lower: float, along_upper: float) -> np.ndarray:
        def at(k: int) -> np.ndarray:
            return both.averaged(light.weight, low + k * step * along_lower, up + k * step * along_upper)

        return (at(-2) - 8 * at(-1) + 8 * at(1) - at(2)) / (12 * step)

    np.testing.assert_allclose(by_lower, slope(1.0, 0.0), rtol=0.0, atol=1e-8 * np.abs(by_lower).max())
    np.testing.assert_allclose(by_upper, slope(0.0, 1.0), rtol=0.0, atol=1e-7 * np.abs(by_upper).max())


def test_a_tenth_of_a_micrometre_of_silicon_changes_the_sky_pattern() -> None:
    """A pattern simulated for 100.0 µm of silicon leaves more than a third of the fringes of 100.1 µm."""
    beam = Beam.cone(1.234, 0.6, 32)
    system = OpticalSystem(LayerStack.from_resource("e2v_ccd250"), 153.0, GaussianProfile(1.0), beam)
    lines = np.array([931.0, 937.0, 943.0, 955.0, 968.0, 972.0, 978.0, 988.0, 1001.0, 1010.0])
    light = Illumination.spectrum(lines, np.ones(10), beam)
    both = system.reduce_two_layers(light)
    adhesive = ThicknessGrid(14.0, 0.01, 800)
    one, other = (
        both.averaged_on_grid(light.weight, adhesive, ThicknessGrid(d, 0.01, 1))[0, :, 0]
        for d in (100.0, 100.1)
    )
    assert np.std(one / one.mean() - other / other.mean()) > 0.35 * np.std(other / other.mean())


def test_bad_input_is_refused() -> None:
    n, d = np.array([1.0, 3.6, 1.6, 3.6, 1.5]), np.array([0.0, 1.0, 1.0, 1.0, 0.0])
    for upper, lower in ((0, 2), (2, 2), (3, 1), (1, 4)):
        with pytest.raises(InputError, match="varying layers"):
            reduce_to_two_phases(n, d, 0.9, upper=upper, lower=lower)
    with pytest.raises(InputError, match="polarization"):
        reduce_to_two_phases(n, d, 0.9, 0.0, "x", upper=1, lower=2)
    with pytest.raises(InputError, match="grid"):
        ThicknessGrid(1.0, 0.1, 0)
    with pytest.raises(OutOfRangeError, match="thickness"):
        ThicknessGrid(-1.0, 0.1, 5)
    system = e2v()
    light = system.flat_fields([970.0], 0.5)
    with pytest.raises(InputError, match="weights"):
        system.reduce_two_layers(light).averaged(light.weight[0], 14.0, 100.0)
    with pytest.raises(InputError, match="spread"):
        system.with_layer("support", thickness_spread_um=np.inf).reduce_two_layers(light)
