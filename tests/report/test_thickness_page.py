"""Numbers on the page of a thickness map: what is left at each wavelength, and fringes folded by their phase."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube, ThicknessMap
from lsst.fringe_sim.report.thickness_page import phase_folded, residual_table

WAVELENGTHS_NM = np.array([900.0, 950.0, 990.0])
SHAPE = (60, 80)


def layer_um() -> NDArray[np.float64]:
    """Four orders and more, every thickness once."""
    return np.linspace(13.0, 14.3, SHAPE[0] * SHAPE[1]).reshape(SHAPE)


def map_of(value: NDArray[np.float64], mask: NDArray[np.int32]) -> ThicknessMap:
    nothing = np.zeros(value.shape)
    return ThicknessMap(value, nothing + 0.002, nothing, nothing, mask, "adhesive")


def folded_by_hand(
    amplitude: NDArray[np.float64], phase: NDArray[np.float64], bins: int
) -> NDArray[np.float64]:
    """Mean amplitude between one boundary of phase and the next."""
    edges = np.linspace(0.0, 1.0, bins + 1)
    between = [(low <= phase) & (phase < high) for low, high in itertools.pairwise(edges)]
    return np.array([amplitude[chosen].mean() for chosen in between])


def test_flats_of_the_model_are_folded_to_the_model() -> None:
    model, layer = FringeModel.from_setup("ts8_e2v"), layer_um()
    light = model.response(layer, WAVELENGTHS_NM)
    cube = FringeCube.from_arrays(1e4 * light, WAVELENGTHS_NM)
    fitted = map_of(layer, np.zeros(SHAPE, np.int32))
    phase, measured, modelled = phase_folded(cube, fitted, model)
    np.testing.assert_allclose(np.diff(phase), 1.0 / len(phase), rtol=1e-12)
    assert phase[0] + phase[-1] == pytest.approx(1.0)
    np.testing.assert_allclose(modelled, measured, atol=1e-4)
    for row, order_um in enumerate(model.fringe_order_um(WAVELENGTHS_NM)):
        amplitude = light[row] / light[row].mean() - 1.0
        by_hand = folded_by_hand(amplitude, fitted.value.astype(float) / order_um % 1.0, len(phase))
        np.testing.assert_allclose(measured[row], by_hand, atol=1e-6)
    assert np.ptp(measured, axis=1).min() > 0.05, "fringes are not folded away"


def test_pixels_that_are_bad_anywhere_are_left_out_of_the_fold() -> None:
    model, layer = FringeModel.from_setup("ts8_e2v"), layer_um()
    light = model.response(layer, WAVELENGTHS_NM)
    bad, flat = np.zeros(SHAPE, np.int32), np.zeros(light.shape, np.int32)
    bad[:, :20], flat[1, :, 70:] = 1, 1
    spoiled = np.where((bad != 0) | flat.any(axis=0), 5.0, light)
    cube = FringeCube.from_arrays(1e4 * spoiled, WAVELENGTHS_NM, mask=flat)
    inner = FringeCube.from_arrays(1e4 * light[:, :, 20:70], WAVELENGTHS_NM)
    found = phase_folded(cube, map_of(layer, bad), model)
    wanted = phase_folded(inner, map_of(layer[:, 20:70], bad[:, 20:70]), model)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7)


def test_a_map_without_a_good_pixel_has_bins_and_nothing_in_them() -> None:
    cube = FringeCube.from_arrays(np.full((3, *SHAPE), 1e4), WAVELENGTHS_NM)
    fitted = map_of(layer_um(), np.ones(SHAPE, np.int32))
    phase, measured, modelled = phase_folded(cube, fitted, FringeModel.from_setup("ts8_e2v"))
    assert np.all((phase > 0.0) & (phase < 1.0))
    assert measured.shape == modelled.shape == (3, len(phase))
    assert np.isnan(measured).all()
    assert np.isnan(modelled).all()


def test_what_is_left_is_compared_with_the_noise_of_the_variances() -> None:
    """Electrons with the noise of their number: a residual of that size has a ratio of one."""
    counts = np.full((3, *SHAPE), 1e4)
    cube = FringeCube.from_arrays(counts, WAVELENGTHS_NM, variance=counts)
    signs = np.where(np.indices(SHAPE).sum(axis=0) % 2, 1.0, -1.0)
    residual = np.stack([0.01 * signs, 0.03 * signs, np.full(SHAPE, np.nan)]).astype(np.float32)
    residual[0, :5] = np.nan
    table = residual_table(residual, cube)
    np.testing.assert_array_equal(table["wavelength"], WAVELENGTHS_NM)
    np.testing.assert_allclose(table["noise"][:2], 1.0, rtol=1e-6)
    np.testing.assert_allclose(table["ratio"][:2], [1.0, 3.0], rtol=1e-6)
    assert np.isnan([table["noise"][2], table["ratio"][2]]).all()
