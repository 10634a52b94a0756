"""The fringe model: response, grids, derivative, quadrature, and the laws it must obey."""

import numpy as np
import pytest
from astropy import units

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import layer_absorption

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


def test_shapes_follow_the_arguments(model) -> None:
    assert model.response(14.0, [960.0]).shape == (1,)
    assert model.response(np.full((3, 4), 14.0), WAVELENGTHS).shape == (12, 3, 4)
    assert model.response_on_grid(WAVELENGTHS, 14.0, 0.01, 7).shape == (12, 7)


@pytest.mark.rng("response is the brute force average over the line")
def test_response_is_the_brute_force_average_over_the_line(model, rng) -> None:
    """An independent sum over the Gaussian line with the general transfer matrix."""
    thickness = rng.uniform(6.0, 28.0)
    offset = np.linspace(-4.5, 4.5, 2001)
    weight = np.exp(-4.0 * np.log(2.0) * (offset / 2.0) ** 2)
    stack = model.setup.stack.replace_layer("adhesive", thickness_um=thickness)
    for wavelength in (885.0, 960.0):
        wave = wavelength + offset
        fraction = layer_absorption(
            stack.indices(wave, 183.15),
            np.broadcast_to(stack.thickness_um[:, None], (10, wave.size)),
            1e-3 * wave,
        )
        brute = weight @ fraction[3] / weight.sum()
        assert model.response(thickness, wavelength)[0] == pytest.approx(brute, abs=2e-7)


def test_grid_agrees_with_points(model) -> None:
    grid = model.response_on_grid(WAVELENGTHS, 9.3, 0.0137, 500)
    points = model.response(9.3 + 0.0137 * np.arange(500), WAVELENGTHS)
    np.testing.assert_allclose(grid, points, rtol=0.0, atol=1e-13)


def test_order_of_wavelengths_does_not_matter(model) -> None:
    thickness = np.linspace(14.0, 15.0, 11)
    forward = model.response(thickness, WAVELENGTHS)
    np.testing.assert_array_equal(model.response(thickness, WAVELENGTHS[::-1])[::-1], forward)


def test_quadrature_is_converged(model) -> None:
    assert model.quadrature_error(WAVELENGTHS, np.linspace(5.0, 30.0, 101)) < 1e-7


def test_total_and_detection_are_anticorrelated() -> None:
    """1 - R - T rises where the detection layer gets less: half an order apart (paper-wide correlation -0.99995)."""
    thickness = np.linspace(14.0, 14.3, 200)
    detection = FringeModel.from_setup("ts8_e2v").response(thickness, [960.0])[0]
    total = FringeModel.from_setup("ts8_e2v", observable="total").response(thickness, [960.0])[0]
    assert np.corrcoef(detection, total)[0, 1] < -0.999


def test_narrow_bandpass_shows_the_silicon() -> None:
    """At 1 nm the fringes of 100 um of silicon appear; at 2 nm they do not."""
    wavelengths = np.arange(955.0, 965.0, 0.1)
    ripple = {}
    for name in ("bnl_ts8_e2v", "ts8_e2v"):
        response = FringeModel.from_setup(name).response(14.0, wavelengths)
        smooth = np.polyval(np.polyfit(wavelengths - 960.0, response, 6), wavelengths - 960.0)
        ripple[name] = np.std(response - smooth)
    assert ripple["bnl_ts8_e2v"] > 10.0 * ripple["ts8_e2v"]


def test_settings_round_trip() -> None:
    settings = {"bandwidth.fwhm": 2.4, "contrast_loss.factor": 0.3}
    model = FringeModel.from_setup("ts8_e2v", effects=settings)
    assert model.effect_settings == settings
    assert model.with_effects(model.effect_settings).effects == model.effects


def test_wavelengths_outside_the_tables_are_refused(model) -> None:
    with pytest.raises(OutOfRangeError, match="wavelength"):
        model.response([14.0], [2000.0])
    with pytest.raises(InputError, match="one or more"):
        model.response([14.0], [])


@pytest.mark.parametrize("thickness", [-1.0, np.nan, np.inf])
def test_impossible_thicknesses_are_refused(model, thickness) -> None:
    with pytest.raises(OutOfRangeError, match="thickness"):
        model.response([14.0, thickness], [960.0])


def test_quantities_are_converted_or_refused(model) -> None:
    plain = model.response([16.0, 16.1], [960.0])
    given = model.response([16000.0, 16100.0] * units.nm, [0.96] * units.um)
    np.testing.assert_allclose(given, plain, rtol=1e-12)
    for thickness, wavelength in ((16.0 * units.s, 960.0), (16.0, 960.0 * units.K)):
        with pytest.raises(InputError, match="quantity"):
            model.response(thickness, wavelength)


def test_lengths_in_another_unit_are_named(model) -> None:
    with pytest.raises(OutOfRangeError, match=r"wavelength \[nm\] is 0\.96;"):
        model.response([16], [0.96])
    for thickness in (16000.0, 0.016):
        with pytest.raises(OutOfRangeError, match=r"thickness of adhesive \[um\]"):
            model.response([thickness], [960.0])
