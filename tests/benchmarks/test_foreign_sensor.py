"""The foreign sensor in limits that are known without it, and beside the package's optics."""

from dataclasses import replace

import numpy as np
import pytest
from field_matrices import INSULATION, LAYERS, ForeignSensor, Stain, Window
from foreign_flats import ForeignCharge, exposed, smooth_map

from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import get_medium

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
PLAIN = ForeignSensor()
MAP = smooth_map(np.random.default_rng(5), (8, 16), 15.0, 0.8, 3)
GLASS = complex(get_medium("SiO2").index(np.array([950.0]), 183.15)[0])


def flats(sensor: ForeignSensor, planes: slice = slice(7, 8)) -> np.ndarray:
    return sensor.flats(WAVELENGTHS[planes], MAP, 3)


@pytest.mark.parametrize(
    ("sensor", "same"),
    [
        (ForeignSensor(aperture=1e-4), PLAIN),
        (ForeignSensor(roughness_nm=1e-3), PLAIN),
        (ForeignSensor(film=(2.0 + 0.1j, 0.0)), PLAIN),
        (ForeignSensor(film=(GLASS, 0.03)), ForeignSensor(thicker_um={INSULATION: 0.03})),
        (ForeignSensor(satellite=(0.3, 0.0)), PLAIN),
        (ForeignSensor(satellite=(1.0, 0.7)), ForeignSensor(offset_nm=0.7)),
        (ForeignSensor(jitter_nm=(0.7,)), ForeignSensor(offset_nm=0.7)),
        (ForeignSensor(window=Window(0.003, 2000.0, 5.0)), PLAIN),
        (
            ForeignSensor(stain=Stain((0.5, 0.5), (0.6, 0.6), (1.4 + 0j, 0.2), 0.1)),
            ForeignSensor(film=(1.4 + 0j, 0.2)),
        ),
        (ForeignSensor(gains=(0.01,) * 16), PLAIN),
    ],
    ids=["beam", "rough", "no film", "film", "satellite", "all in it", "jitter", "window", "stain", "gain"],
)
def test_limits(sensor: ForeignSensor, same: ForeignSensor) -> None:
    np.testing.assert_allclose(flats(sensor), flats(same), rtol=0.0, atol=2e-6)
    assert np.ptp(flats(same)) > 0.05


@pytest.mark.parametrize(("sine", "polarised"), [(0.0, "s"), (0.3, "s"), (0.3, "p")])
def test_energy_is_lost_in_layers_that_absorb_alone(sine: float, polarised: str) -> None:
    found = PLAIN.net_flux(WAVELENGTHS, np.linspace(14.0, 15.0, 9), 183.15, sine, polarised)
    assert found[0].max() < 1.0
    assert found[len(LAYERS)].min() > 0.0
    for number, (name, _) in enumerate(LAYERS):
        lost = found[number] - found[number + 1]
        k = np.imag(get_medium(name).index(WAVELENGTHS, 183.15) + 0j)[:, np.newaxis]
        assert np.all(lost >= -1e-12)
        assert np.all((np.abs(lost) < 1e-12) == (np.broadcast_to(k, lost.shape) == 0.0)), name


def first_harmonic(sensor: ForeignSensor, wavelength_nm: float) -> complex:
    """First harmonic over one order of adhesive, relative to the mean."""
    index = float(np.real(get_medium("epoxy").index(np.array([wavelength_nm]), 183.15)[0]))
    turns = np.arange(64) / 64.0
    one = sensor.absorbed(np.array([wavelength_nm]), 15.0 + turns * 1e-3 * wavelength_nm / (2.0 * index))[0]
    return complex((one * np.exp(-2j * np.pi * turns)).mean() / one.mean())


@pytest.mark.parametrize("roughness_nm", [20.0, 40.0])
def test_fringes_of_a_rough_face_fade_as_those_of_a_gaussian(roughness_nm: float) -> None:
    """Light that absorbs nearly all in the adhesive goes to and fro once: then the law is exact."""
    once = ForeignSensor(epoxy_k=0.006)
    ratio = first_harmonic(replace(once, roughness_nm=roughness_nm), 960.0) / first_harmonic(once, 960.0)
    index = float(np.real(get_medium("epoxy").index(np.array([960.0]), 183.15)[0]))
    law = np.exp(-0.5 * (4.0 * np.pi * index * roughness_nm / 960.0) ** 2)
    assert abs(abs(ratio) / law - 1.0) < 0.03


@pytest.mark.parametrize("contrast", [0.13, 0.6])
def test_lost_contrast_and_pedestals_shrink_all_departures_alike(contrast: float) -> None:
    own, plain = flats(replace(PLAIN, contrast=contrast)) - 1.0, flats(PLAIN) - 1.0
    # The mean over the map and that over an order are not the same.
    factor = float((own * plain).sum() / (plain**2).sum())
    np.testing.assert_allclose(own, factor * plain, atol=1e-9)
    assert abs(factor / contrast - 1.0) < 0.15
    pale = flats(replace(PLAIN, pedestal=1.0 / contrast - 1.0)) - 1.0
    np.testing.assert_allclose(pale, contrast * plain, atol=1e-9)


@pytest.mark.parametrize(
    ("sensor", "settings"),
    [
        (ForeignSensor(aperture=0.12), {"converging_beam.numerical_aperture": 0.12}),
        (ForeignSensor(roughness_nm=60.0), {"roughness.sigma": 60.0}),
        (ForeignSensor(offset_nm=1.3), {"wavelength_offset.offset": 1.3}),
        (ForeignSensor(contrast=0.13), {"contrast_loss.factor": 0.13}),
    ],
    ids=["beam", "roughness", "offset", "contrast"],
)
def test_the_package_agrees(sensor: ForeignSensor, settings: dict[str, float]) -> None:
    thickness = np.linspace(14.0, 14.6, 41)
    found = FringeModel.from_setup("ts8_e2v", settings).response(thickness, WAVELENGTHS)
    found = found / found.mean(axis=1, keepdims=True)
    own = sensor.flats(WAVELENGTHS, thickness[np.newaxis, :], 1)[:, 0]
    plain = PLAIN.flats(WAVELENGTHS, thickness[np.newaxis, :], 1)[:, 0]
    assert np.abs(found - own).max() < 0.003 * np.ptp(plain)


def test_gradients_gains_and_stains_are_where_they_are_meant_to_be() -> None:
    sensor = ForeignSensor(gradient=(0.0, 0.02), gains=(*(0.0,) * 9, 0.01, *(0.0,) * 6))
    ratio = flats(sensor) / flats(PLAIN)
    ratio = ratio[0] / ratio[0, 0, 8]
    assert ratio[0, -1] - ratio[0, 0] == pytest.approx(0.02 * 15 / 16, rel=0.01)
    assert ratio[4, 3] / ratio[3, 3] == pytest.approx(1.01, rel=1e-9)
    patch = flats(ForeignSensor(stain=Stain((0.25, 0.25), (0.25, 0.25), absorbed=0.1))) / flats(PLAIN)
    assert patch[0, 2, 2] / patch[0, 6, 12] == pytest.approx(0.9, rel=1e-9)


def test_charge_that_trails_stays_the_same() -> None:
    thickness = smooth_map(np.random.default_rng(3), (8, 16), 15.0, 0.8)
    plain, trailed = (
        exposed(PLAIN, thickness, np.random.default_rng(4), ForeignCharge(trailing=part)).image.astype(float)
        for part in (0.0, 0.1)
    )
    np.testing.assert_allclose(trailed[:, 1:], 0.9 * plain[:, 1:] + 0.1 * plain[:, :-1], rtol=1e-5)
    assert abs(plain.mean() / 30_000.0 - 1.0) < 0.05
