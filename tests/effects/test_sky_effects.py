"""Effects on the night sky: what changes, what stays, and who sees it."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.sky_frame import sky_response, throughput_electrons
from lsst.fringe_sim.algorithms.sky_response import sky_with_effects
from lsst.fringe_sim.effects import EFFECTS, apply_to_sky
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum
from lsst.fringe_sim.model import FringeModel

RANGE_UM = (14.0, 15.0)


@pytest.fixture(scope="module")
def sky() -> SkySpectrum:
    return SkySpectrum.dark()


def changed(sky: SkySpectrum, **settings: float) -> SkySpectrum:
    model = FringeModel.from_setup(
        "lsst_e2v", {key.replace("__", "."): value for key, value in settings.items()}
    )
    return sky_with_effects(model, sky)


def band_photons(sky: SkySpectrum) -> dict[str, float]:
    return {name: float(sky.lines.of_band(name).photon_radiance.sum()) for name in sky.lines.bands}


def test_an_equal_temperature_agrees_with_the_recomputed_list() -> None:
    """From 190 K to 230 K by the effect, and by the line list itself."""
    cold, warm = (SkySpectrum(EmissionLines.oh(kelvin)) for kelvin in (190.0, 230.0))
    by_effect = changed(cold, rotational_temperature__offset=40.0).lines.photon_radiance
    np.testing.assert_allclose(by_effect, warm.lines.photon_radiance, rtol=1e-9)


def test_bands_continuum_and_water_are_factors(sky) -> None:
    after = changed(sky, oh_bands__band_8_4=2.0, sky_continuum__scale=0.5, water_vapour__scale=2.0)
    expected = band_photons(sky) | {"8-4": 2.0 * band_photons(sky)["8-4"]}
    assert band_photons(after) == pytest.approx(expected)
    np.testing.assert_allclose(after.lines.transmission, sky.lines.transmission**2)
    for before, term in zip(sky.continua, after.continua, strict=True):
        np.testing.assert_allclose(term.photon_radiance, 0.5 * before.photon_radiance)


@pytest.mark.slow
def test_the_simulation_of_the_sky_sees_them(sky) -> None:
    """More continuum means a brighter sky and weaker fringes, in the response and in the level."""
    band = Bandpass.from_name("lsst_y")
    fringes, levels, electrons = [], [], []
    for settings in ({}, {"sky_continuum.scale": 3.0}):
        model = FringeModel.from_setup("lsst_e2v", settings)
        response = sky_response(model, sky, thickness_range_um=RANGE_UM)
        values = response.sky().values[0]
        fringes.append(np.ptp(values) / values.mean())
        levels.append(response.level)
        electrons.append(throughput_electrons(sky, band, model))
    assert fringes[1] < 0.95 * fringes[0]
    assert levels[1] > 1.05 * levels[0]
    assert electrons[1] / electrons[0] == pytest.approx(levels[1] / levels[0], rel=0.05)


def test_flats_do_not_see_them() -> None:
    model = FringeModel.from_setup("ts8_e2v", {"rotational_temperature.offset": 50.0})
    plain = FringeModel.from_setup("ts8_e2v")
    thickness, wavelengths = np.linspace(14.0, 15.0, 5), np.array([900.0, 960.0])
    np.testing.assert_array_equal(
        model.response(thickness, wavelengths), plain.response(thickness, wavelengths)
    )


def test_lines_without_energies_have_no_temperature(sky) -> None:
    bare = EmissionLines(
        sky.lines.wavelength_nm, sky.lines.photon_radiance, sky.lines.transmission, sky.lines.band
    )
    model = FringeModel.from_setup("lsst_e2v", {"rotational_temperature.offset": 20.0}, catalogue=EFFECTS)
    with pytest.raises(InputError, match="rotational levels"):
        apply_to_sky(model.effects, model.base_system, SkySpectrum(bare))
