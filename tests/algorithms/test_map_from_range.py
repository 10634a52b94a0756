"""A thickness map from frames of the sky and a range of the thickness alone."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_sky import ForeignSky, foreign_map, foreign_night

from lsst.fringe_sim.algorithms.map_from_range import RangeMap, map_from_range
from lsst.fringe_sim.algorithms.sky_response import sky_response
from lsst.fringe_sim.errors import InputError, OutOfRangeError, UndeterminedError
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.model import FringeModel, Setup
from lsst.fringe_sim.products import mask_bits

ORDER_UM, RANGE_UM = 0.3, (13.0, 13.9)


def light(thickness_um):
    """Two groups of lines, which no thickness mirrors."""
    phase = 2.0 * np.pi * np.asarray(thickness_um)
    return 1000.0 * (1.0 + 4e-3 * np.cos(phase / ORDER_UM) + 3e-3 * np.cos(phase / 0.37))


def night(rng, layer, frames, noise):
    """Frames whose fringes rise and fall, over their mean less one, and their weights."""
    fringes = light(layer) / 1000.0 - 1.0
    values = [
        rng.uniform(0.6, 1.4) * fringes + noise * rng.standard_normal(layer.shape) + 1e-3 * rng.normal()
        for _ in range(frames)
    ]
    return values, [np.full(layer.shape, noise**-2)] * frames


@pytest.mark.slow
@pytest.mark.rng("a map is found from a range")
def test_a_map_is_found_from_a_range(rng):
    """Pixels without a value take no part, and are not known."""
    layer = foreign_map(rng, (64, 64), 13.1, 13.8)
    values, weights = night(rng, layer, 8, 6e-3)
    weights = [each.copy() for each in weights]
    for weight in weights:
        weight[20:24, 40:50] = 0.0
    for value in values:
        value[20:24, 40:50] = np.nan
    found = map_from_range(values, weights, RANGE_UM, light, ORDER_UM, order_error=0.0)
    away = (found.thickness_um - layer)[found.known]
    assert found.known.mean() > 0.6
    assert not found.known[20:24, 40:50].any()
    assert found.order_probability > 0.9
    assert np.std(away) < 0.03 * ORDER_UM
    assert 0.4 < np.sqrt(np.mean(np.square(away / found.sigma_um[found.known]))) < 1.6
    product = found.thickness_map("adhesive", "S11")
    assert (np.isfinite(product.known_um()) == found.known).all()
    assert found.misfit == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.rng("frames without fringes have no map")
def test_frames_without_fringes_have_no_map(rng):
    """Of noise no part shows the fringes of a map, or hardly any."""
    values, weights = night(rng, np.full((64, 64), 13.4), 8, 6e-3)
    try:
        found = map_from_range(values, weights, RANGE_UM, light, ORDER_UM)
    except UndeterminedError:
        return
    assert found.known.mean() < 0.2


@pytest.mark.slow
@pytest.mark.rng("a model that is wrong is told")
def test_a_model_that_is_wrong_is_told(rng):
    """Behind a fast beam the lines of the foreign simulator make other fringes: of any map a part is left."""
    low, high = 13.0, 14.4
    model = FringeModel.from_setup("lsst_e2v")
    order_um = float(model.fringe_order_um(960.0))
    span = low - 2.0 * order_um, high + 2.0 * order_um
    dark = sky_response(model, SkySpectrum.dark(), thickness_range_um=span).sky()
    layer = foreign_map(rng, (96, 96), 13.1, 14.3)
    frame = foreign_night(ForeignSky(f_number=1.234), layer, rng, 1, electrons=1e9)[0]
    fringes = frame.fringes / frame.sky
    noise = fringes.std() / 2.0
    values = [fringes + noise * rng.standard_normal(layer.shape)]
    weights = [np.full(layer.shape, noise**-2)]
    try:
        found = map_from_range(
            values,
            weights,
            (low, high),
            lambda grid: dark.frame(np.asarray(grid)[None])[0],
            order_um,
            order_error=0.0,
        )
    except UndeterminedError:
        return
    assert found.model_error > 0.3 or found.order_probability < 0.5


@pytest.mark.slow
@pytest.mark.rng("a map of the foreign simulator from a range")
@pytest.mark.parametrize("low", [13.0, 14.1])
def test_a_map_of_another_simulator(rng, low):
    """Its lines, films and silicon are not those of the model, by more than orders differ, so that none is told.

    In the first range the likeliest map is right nevertheless; in the second it is not.
    """
    high = low + 0.9
    setup = replace(
        Setup.from_name("lsst_e2v"), beam_kind="cone", f_number=2.25, obscuration=0.61, temperature_k=173.15
    )
    model = FringeModel.from_setup(setup)
    order_um = float(model.fringe_order_um(960.0))
    span = low - 2.0 * order_um, high + 2.0 * order_um
    dark = sky_response(model, SkySpectrum.dark(), thickness_range_um=span).sky()
    layer = foreign_map(rng, (64, 64), low + 0.1, high - 0.1)
    frames = foreign_night(ForeignSky(f_number=2.25), layer, rng, 40, electrons=6000.0)
    values = [each.image / each.image.mean() - 1.0 for each in frames]
    weights = [np.full(layer.shape, each.image.mean()) for each in frames]
    found = map_from_range(
        values, weights, (low, high), lambda grid: dark.frame(np.asarray(grid)[None])[0], order_um
    )
    away = (found.thickness_um - layer)[found.known] / order_um
    assert found.order_probability < 0.5
    assert found.apart < 0.2
    if low == 13.0:
        assert found.known.mean() > 0.8
        assert found.model_error < 0.3
        assert np.mean(np.abs(away) < 0.1) > 0.98


def test_bad_input_is_named():
    blank = np.zeros((64, 64))
    with pytest.raises(OutOfRangeError, match="range of the thickness"):
        map_from_range([blank], [blank], (14.0, 13.0), light, ORDER_UM)
    with pytest.raises(OutOfRangeError, match="error between orders"):
        map_from_range([blank], [blank], RANGE_UM, light, ORDER_UM, order_error=-0.1)
    with (
        pytest.warns(FutureWarning, match="use order_error"),
        pytest.raises(OutOfRangeError, match="error between orders"),
    ):
        map_from_range([blank], [blank], RANGE_UM, light, ORDER_UM, model_accuracy=-0.1)
    with pytest.raises(InputError, match="frames"):
        map_from_range([], [], RANGE_UM, light, ORDER_UM)
    with pytest.raises(InputError, match="shape of a frame"):
        map_from_range([blank], [blank[1:]], RANGE_UM, light, ORDER_UM)
    with pytest.raises(UndeterminedError, match="planes"):
        map_from_range([blank], [blank], RANGE_UM, light, ORDER_UM)


def test_as_a_product_it_masks_what_is_not_known():
    known = np.array([[True, False, True]])
    found = RangeMap(
        np.array([[13.2, 13.3, 13.4]]), np.array([[0.01, 0.02, 0.03]]), known,
        order_probability=0.9, apart=0.1, strength=1.0, misfit=1.7, model_error=0.2,
    )  # fmt: skip
    product = found.thickness_map("adhesive", "R22_S11")
    np.testing.assert_array_equal(np.isfinite(product.value), known)
    np.testing.assert_allclose(product.value[known], [13.2, 13.4], rtol=1e-6)
    np.testing.assert_allclose(product.sigma[known], [0.01, 0.03], rtol=1e-6)
    np.testing.assert_array_equal(product.mask, [[0, mask_bits("NO_DATA"), 0]])
    np.testing.assert_allclose(product.slip_probability, 0.1, rtol=1e-6)
    np.testing.assert_allclose(product.chi2, 1.7, rtol=1e-6)
    assert (product.layer, product.detector) == ("adhesive", "R22_S11")
