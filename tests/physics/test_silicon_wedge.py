"""Silicon that is thicker on one side, in flats whose line shows its own fringes: the mock against own lines."""

import numpy as np
import pytest
from field_matrices import DETECTION, ForeignSensor

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit import SiliconSearch, silicon_map
from lsst.fringe_sim.mock import setup_optics, validate_effects
from lsst.fringe_sim.mock.hidden_effects import with_hidden_optics
from lsst.fringe_sim.mock.sensor_signal import SensorSignal
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

NARROW_NM = 0.3
RISE_UM = 0.16
"""From the left to the right edge: more than one fringe of the silicon, a sixth of it in every pixel."""


def mock_flats(
    thickness_um: np.ndarray, wavelengths_nm: np.ndarray, fwhm_nm: float, **rise_um: float
) -> np.ndarray:
    """Detected part of the light of every flat, from the optics of the mock."""
    hidden = validate_effects({"silicon_gradient": rise_um, "bandwidth": {"fwhm": fwhm_nm}})
    optics = with_hidden_optics(setup_optics("ts8_e2v")[0], hidden)
    signal = SensorSignal.with_effects(optics, thickness_um, tuple(wavelengths_nm), hidden)
    return np.stack([signal.flat(row) for row in range(len(wavelengths_nm))])


def own_flat(wavelength_nm: float, fwhm_nm: float, epoxy_um: np.ndarray, added_um: np.ndarray) -> np.ndarray:
    """One flat of pixels over whose area both layers rise along x: matrices of fields, five places in a pixel."""
    away = np.linspace(-6.0, 6.0, 161)
    share = np.exp(-0.5 * away**2) / np.exp(-0.5 * away**2).sum()
    nodes = wavelength_nm + fwhm_nm / np.sqrt(8.0 * np.log(2.0)) * away
    rises = [np.gradient(each) for each in (epoxy_um, added_um)]
    light = np.zeros(epoxy_um.size)
    for place, weight in zip(*np.polynomial.legendre.leggauss(5), strict=True):
        for column in range(epoxy_um.size):
            epoxy, added = (
                each[column] + 0.5 * place * rise[column]
                for each, rise in zip((epoxy_um, added_um), rises, strict=True)
            )
            seen = ForeignSensor(thicker_um={DETECTION: added}).absorbed(nodes, np.array([epoxy]))
            light[column] += 0.5 * weight * (share @ seen)[0]
    return light


@pytest.mark.parametrize(
    ("wavelength_nm", "fwhm_nm", "ripple"), [(938.0, 0.3, 0.1), (985.0, 0.1, 0.2), (985.0, 2.0, 0.0)]
)
def test_every_pixel_sees_the_silicon_of_its_own_thickness(wavelength_nm, fwhm_nm, ripple) -> None:
    """Narrow lines show the fringes of the silicon; a line of 2 nm hides all but a thousandth of them."""
    columns = np.arange(8)
    epoxy = np.tile(15.0 + 0.01 * columns, (2, 1))
    (flat,) = mock_flats(epoxy, np.array([wavelength_nm]), fwhm_nm, gradient_x=RISE_UM)
    own = own_flat(wavelength_nm, fwhm_nm, epoxy[0], RISE_UM * (columns / 7.0 - 0.5))
    np.testing.assert_allclose(flat, np.tile(own, (2, 1)), rtol=2e-5)
    even = own_flat(wavelength_nm, fwhm_nm, epoxy[0], np.zeros(8))
    assert np.ptp(own / even) > ripple


@pytest.mark.slow
@pytest.mark.rng("a wedge of the mock")
def test_flats_of_the_mock_give_both_layers_back(rng) -> None:
    """Twelve broad flats and six narrow ones; what is fitted shares no optics with what made them.

    Slopes are a tenth of a fringe in a pixel; with twice as much, over which the mock averages, pulls are 1.11.
    """
    shape, narrow = (96, 104), np.array([925.0, 938.0, 946.0, 957.0, 969.0, 983.0])
    broad, noise = np.arange(880.0, 991.0, 10.0), 0.004
    truth = random_field(shape, rng, mean=14.0, span=1.0)
    rise = {"gradient_x": 0.22, "gradient_y": -0.07}
    flats = np.concatenate(
        [mock_flats(truth, broad, 2.0, **rise), mock_flats(truth, narrow, NARROW_NM, **rise)]
    )
    flats = flats / flats.mean(axis=(1, 2), keepdims=True) + noise * rng.standard_normal(flats.shape)
    width = np.repeat([2.0, NARROW_NM], [broad.size, narrow.size])
    model = FringeModel.from_setup("ts8_e2v")
    cube = FringeCube(
        flats.astype(np.float32), np.full(flats.shape, noise**2, np.float32), np.zeros(flats.shape, np.int16),
        FlatExposures(np.concatenate([broad, narrow]), width, np.array(model.setup.temperature_k)), "relative",
    )  # fmt: skip
    fitted = fit_thickness(cube, model, silicon=SiliconSearch(degree=1))
    good = fitted.mask == 0
    pull = ((fitted.value - truth) / fitted.sigma)[good]
    assert good.mean() > 0.98
    assert pull.mean() == pytest.approx(0.0, abs=0.05)
    assert pull.std() == pytest.approx(1.0, abs=0.1)
    silicon = silicon_map(fitted, model)
    assert silicon is not None
    v, u = (np.linspace(-0.5, 0.5, size) for size in shape)
    expected = 100.0 + rise["gradient_y"] * v[:, np.newaxis] + rise["gradient_x"] * u
    np.testing.assert_array_less(np.abs(silicon.value - expected), 5.0 * silicon.sigma + 5e-6)
