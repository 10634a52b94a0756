"""Laws of interference: spacing of fringes in wavelength and in thickness, and what a bandwidth leaves of them."""

import numpy as np
import pytest
from scipy.signal import find_peaks

from lsst.fringe_sim.optics import Beam, Illumination, LayerStack, get_medium, layer_absorption
from lsst.fringe_sim.optics.illumination import SIGMA_PER_FWHM, GaussianProfile, MonochromaticProfile
from lsst.fringe_sim.optics.system import OpticalSystem


def system(varying: str = "adhesive", temperature: float = 183.0) -> OpticalSystem:
    stack = LayerStack.from_resource("e2v_ccd250")
    return OpticalSystem(stack, temperature, MonochromaticProfile(), Beam.collimated(), varying)


def slab(wavelength: np.ndarray, thickness_um: float = 100.0) -> np.ndarray:
    """Light reflected by a plate of silicon at 183 K on silica."""
    index = np.stack([get_medium(name).index(wavelength, 183.0) for name in ("vacuum", "Si", "SiO2")])
    return layer_absorption(index, [np.inf, thickness_um, np.inf], 1e-3 * wavelength)[0]


def test_silicon_fringes_follow_the_group_index() -> None:
    """1.173 ± 0.01 nm at 960 nm for 100 µm: lambda²/(2 n_g d), not lambda²/(2 n d) = 1.28 nm."""
    wavelength = np.arange(955.0, 965.0, 0.002)
    peaks, _ = find_peaks(slab(wavelength))
    spacing = np.interp(960.0, wavelength[peaks[:-1]], np.diff(wavelength[peaks]))
    assert spacing == pytest.approx(1.173, abs=0.01)
    n = get_medium("Si").index([959.0, 960.0, 961.0], 183.0).real
    group = n[1] - 960.0 * (n[2] - n[0]) / 2.0
    assert spacing == pytest.approx(960.0**2 / (2.0 * group * 100e3), rel=2e-3)


def test_epoxy_fringes_have_the_spacing_of_equation_1() -> None:
    """lambda² / (2 n d + lambda) is the exact distance to the next shorter extremum: 20.1 nm for 14 µm at 960 nm."""
    assert pytest.approx(20.1, abs=0.05) == 960.0**2 / (2.0 * 1.6 * 14e3 + 960.0)
    wavelength = np.arange(850.0, 1000.0, 0.01)
    reflected = layer_absorption([1.0, 1.6, 3.6], [np.inf, 14.0, np.inf], 1e-3 * wavelength)[0]
    peaks = wavelength[find_peaks(reflected)[0]]
    expected = peaks[1:] ** 2 / (2.0 * 1.6 * 14e3 + peaks[1:])
    np.testing.assert_allclose(np.diff(peaks), expected, atol=0.011)


@pytest.mark.parametrize(
    ("varying", "wavelength", "start"), [("adhesive", 960.0, 14.0), ("detection", 1000.0, 100.0)]
)
def test_one_order_of_thickness_is_half_a_wavelength_in_the_medium(
    varying: str, wavelength: float, start: float
) -> None:
    optics = system(varying)
    light = Illumination.flat_fields([wavelength], optics.profile, optics.beam)
    index = float(optics.stack.indices(wavelength, 183.0)[optics.stack.position(varying)].real)
    order = 0.5e-3 * wavelength / index
    reduced = optics.reduce(light)
    one = reduced.averaged(light.weight, start + np.linspace(0.0, order, 50))
    next_one = reduced.averaged(light.weight, start + order + np.linspace(0.0, order, 50))
    # Another order of silicon absorbs a little more: 17 per cm times 0.14 µm, twice through.
    np.testing.assert_allclose(one, next_one, rtol=0.0, atol=5e-4 if varying == "detection" else 1e-12)


def test_thickness_of_one_order() -> None:
    """Equation 3: 300 nm of epoxy at 960 nm (not 30), 138.9 nm of silicon of index 3.6 at 1000 nm."""
    epoxy = get_medium("epoxy").index(960.0).real
    assert 0.5 * 960.0 / epoxy == pytest.approx(300.0)
    assert pytest.approx(138.9, abs=0.02) == 0.5 * 1000.0 / 3.6
    assert 0.5 * 1000.0 / get_medium("Si").index(1000.0, 183.0).real == pytest.approx(140.9, abs=0.1)


def test_gaussian_bandwidth_damps_by_the_coherence_law() -> None:
    """A fringe of spacing p loses exp(-2 pi² sigma²/p²) of its contrast."""
    n = get_medium("Si").index([959.0, 960.0, 961.0], 183.0).real
    spacing = 960.0**2 / (2.0 * (n[1] - 960.0 * (n[2] - n[0]) / 2.0) * 100e3)
    for fwhm in (0.3, 0.6, 1.0):
        offset, weight = GaussianProfile(fwhm).nodes(0.02)
        wavelength = np.arange(959.4, 960.6, 0.01)
        sharp = np.ptp(slab(wavelength))
        blurred = np.ptp(np.array([slab(w + offset) @ weight for w in wavelength]))
        expected = np.exp(-2.0 * (np.pi * fwhm * SIGMA_PER_FWHM / spacing) ** 2)
        # Overtones of the slab and its absorption across the band are what is left of the difference.
        assert blurred / sharp == pytest.approx(expected, rel=0.04)


def test_detected_is_part_of_what_the_stack_absorbs() -> None:
    optics = system()
    light = Illumination.flat_fields(np.arange(880.0, 991.0, 10.0), optics.profile, optics.beam)
    thickness = np.linspace(5.0, 30.0, 200)
    detected = optics.reduce(light).averaged(light.weight, thickness)
    total = (
        OpticalSystem(optics.stack, 183.0, optics.profile, optics.beam, observable="total")
        .reduce(light)
        .averaged(light.weight, thickness)
    )
    assert np.all((detected > 0.0) & (detected < total) & (total < 1.0))


def test_detected_and_total_absorption_are_anti_correlated_at_960_nm() -> None:
    """What the epoxy sends back into the sensor is missing in the support (paper-inventory, erratum 4)."""
    optics = OpticalSystem(
        LayerStack.from_resource("e2v_ccd250"), 183.0, GaussianProfile(2.0), Beam.collimated()
    )
    light = optics.flat_fields([960.0])
    grid = (14.0, 0.001, 600)
    detected = optics.reduce(light).averaged_on_grid(light.weight, *grid)[0]
    everything = (
        OpticalSystem(optics.stack, 183.0, optics.profile, optics.beam, observable="total")
        .reduce(light)
        .averaged_on_grid(light.weight, *grid)[0]
    )
    assert np.corrcoef(detected, everything)[0, 1] < -0.999
    swing = 0.5 * np.ptp(detected) / detected.mean()
    assert swing == pytest.approx(0.13, abs=0.015)
