"""Tables over two thicknesses: stated error, frames, refusals."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import TwoLayerTable, two_layer_table
from lsst.fringe_sim.optics import Beam, Illumination, LayerStack
from lsst.fringe_sim.optics.illumination import MonochromaticProfile
from lsst.fringe_sim.optics.system import OpticalSystem

LOWER, UPPER = (14.0, 14.6), (99.9, 100.1)


def sky() -> tuple[OpticalSystem, Illumination]:
    beam = Beam.cone(1.234, 0.6, 8)
    system = OpticalSystem(LayerStack.from_resource("e2v_ccd250"), 153.0, MonochromaticProfile(), beam)
    return system, Illumination.spectrum([940.0, 977.0, 1003.0], [1.0, 2.0, 1.0], beam)


@pytest.fixture(scope="module")
def table() -> TwoLayerTable:
    return two_layer_table(*sky(), LOWER, UPPER, tolerance=1e-6)


def maps(rng: np.random.Generator, shape: tuple[int, int] = (60, 50)) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(*LOWER, shape), rng.uniform(*UPPER, shape)


@pytest.mark.rng("stated error bounds the true one")
def test_stated_error_bounds_the_true_one(table: TwoLayerTable, rng: np.random.Generator) -> None:
    system, light = sky()
    lower, upper = maps(rng)
    exact = system.reduce_two_layers(light).averaged(light.weight, lower, upper)[0]
    true_error = np.abs(table.frame(lower, upper) - exact).max()
    rounding = 3e-7  # of the float32 frame
    assert true_error <= table.interpolation_error + rounding
    assert table.interpolation_error <= 1e-6
    assert table.range_um[0] == pytest.approx(LOWER)
    assert table.range_um[1] == pytest.approx(UPPER)


@pytest.mark.rng("frame does not depend on threads or layout")
def test_frame_does_not_depend_on_threads_or_layout(table: TwoLayerTable, rng: np.random.Generator) -> None:
    lower, upper = maps(rng)
    lower[3, 4], upper[5, 6] = np.nan, np.nan
    many = numba.get_num_threads()
    images = []
    for threads in (1, many):
        numba.set_num_threads(threads)
        images.append(table.frame(lower, upper).tobytes())
    numba.set_num_threads(many)
    assert images[0] == images[1]
    image = table.frame(lower, upper)
    assert np.isnan(image).sum() == 2
    out = np.empty((30, 25), dtype=np.float32)
    assert table.frame(lower[::2, ::2], upper[::2, ::2], 0, out) is out
    np.testing.assert_array_equal(out, image[::2, ::2])


def test_ends_are_inside_and_beyond_is_refused(table: TwoLayerTable) -> None:
    corners = np.array([[LOWER[0], LOWER[1]]]), np.array([[UPPER[1], UPPER[0]]])
    assert np.isfinite(table.frame(*corners)).all()
    with pytest.raises(OutOfRangeError, match="lower layer"):
        table.frame(np.array([[14.3, 14.7]]), np.array([[100.0, 100.0]]))
    with pytest.raises(OutOfRangeError, match="upper layer"):
        table.frame(np.array([[14.3, 14.3]]), np.array([[100.0, 99.0]]))
    with pytest.raises(OutOfRangeError, match="row"):
        table.frame(*corners, row=1)
    with pytest.raises(InputError, match="one shape"):
        table.frame(corners[0], np.zeros((2, 2)))
    with pytest.raises(InputError, match="float32"):
        table.frame(*corners, out=np.empty((1, 2)))
    system, light = sky()
    for lower, upper in (
        ((14.0, 14.0), UPPER),
        (LOWER, (101.0, 100.0)),
        ((-1.0, 2.0), UPPER),
        ((0.0, 1.0), UPPER),
    ):
        with pytest.raises(OutOfRangeError, match="range"):
            two_layer_table(system, light, lower, upper)
