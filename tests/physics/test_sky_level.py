"""Electrons of the dark sky: measured quantum efficiency, and that of the stack with silicon of several temperatures.

The levels of doc/guide/physics.md are those of this module.
"""

import numpy as np
import pytest

from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.optics import LayerStack, layer_absorption

WAVE_NM = np.arange(900.0, 1100.0, 1.0)
PER_PIXEL = 32.40 * 0.2**2 * 30.0  # Square metres, square arcseconds and seconds of a pixel
MEAN_ANGLE = np.deg2rad(19.46)


@pytest.fixture(scope="module")
def band() -> Bandpass:
    return Bandpass.from_name("lsst_y")


@pytest.fixture(scope="module")
def photons(band) -> np.ndarray:
    """Photons per nm bin at the sensor."""
    edges = np.append(WAVE_NM, WAVE_NM[-1] + 1.0) - 0.5
    parts = SkySpectrum.dark().components(band)
    return sum(np.histogram(item.wavelength_nm, edges, weights=item.photons)[0] for item in parts)


def efficiency(temperature_k: float, silicon: str = "Si") -> np.ndarray:
    """Absorption in the detection layer, averaged over its fringes."""
    stack = LayerStack.from_resource("e2v_ccd250").with_silicon(silicon)
    index = stack.indices(WAVE_NM, temperature_k)
    rng = np.random.default_rng(1)
    total = np.zeros(WAVE_NM.size)
    for _ in range(200):
        thickness = np.array(stack.thickness_um, dtype=float)
        thickness[stack.position("adhesive")] = rng.uniform(13.0, 22.0)
        thickness[stack.position("detection")] += rng.uniform(-0.2, 0.2)
        thickness[stack.position("support")] += rng.uniform(-0.3, 0.3)
        depth = thickness[:, None] * np.ones(WAVE_NM.size)
        total += layer_absorption(index, depth, 1e-3 * WAVE_NM, MEAN_ANGLE)[stack.position("detection")]
    return total / 200


def test_level_of_the_measured_efficiency(band, photons) -> None:
    assert PER_PIXEL * photons @ band.quantum_efficiency(WAVE_NM) == pytest.approx(2717, rel=0.10)


@pytest.mark.parametrize(
    ("silicon", "kelvin", "electrons"),
    [
        ("Si", 173.15, 2057),
        ("Si_schinke2015", 173.15, 2058),
        ("Si_franta2017", 173.15, 2096),
        ("Si_green2008", 173.15, 1830),
        ("Si", 215.0, 2775),
        ("Si_green2008", 215.0, 2681),
    ],
)
def test_level_of_the_stack_is_that_of_colder_silicon(silicon, kelvin, electrons, photons) -> None:
    """What is missing is absorption: silicon of 215 K, which the authors' tables assume, gives the measured level."""
    assert PER_PIXEL * photons @ efficiency(kelvin, silicon) == pytest.approx(electrons, rel=0.01)


def test_what_is_missing_grows_with_the_wavelength(band) -> None:
    """Losses in optics, coatings or area would be the same at 920 and at 1040 nm."""
    ratio = efficiency(173.15) / band.quantum_efficiency(WAVE_NM)
    at = {wave: ratio[np.searchsorted(WAVE_NM, wave)] for wave in (920.0, 960.0, 1000.0, 1040.0)}
    assert at[920.0] == pytest.approx(1.00, abs=0.02)
    assert at[920.0] > 1.1 * at[960.0] > 1.5 * at[1000.0] > 2.5 * at[1040.0]
