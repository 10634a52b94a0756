"""Total absorption against the two curves of Fig. 1 of Guo et al. 2022 (1 nm and 2 nm bandpass).

With the index of Green (2008), temperature law included, our curve lies up to 0.019 above the published one at 2 nm.
The difference is smooth, grows with wavelength and follows the slope dA/dln k. Solved for the extinction, the figure
asks for 3 to 6 % less than Green's, in a pattern that is that of the ratio Schinke (2015) / Green (2008) to 1.5 %,
while the phase of its silicon fringes is that of Green's n. The printed table, the polyline (4e-4) and 41 samples
per bandpass (2e-4) are too small to explain it. The difference is thus a table of k, not the optics.
"""

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

from lsst.fringe_sim.optics import Beam, LayerStack, get_medium
from lsst.fringe_sim.optics.illumination import GaussianProfile
from lsst.fringe_sim.optics.system import OpticalSystem

pytestmark = pytest.mark.shared


def curve(shared_dir: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    table = Table.read(shared_dir / "measured" / f"{name}.ecsv")
    return np.array(table["wavelength"]), np.array(table["absorption"])


def total_absorption(wavelength: np.ndarray, fwhm: float, extinction_scale: float = 1.0) -> np.ndarray:
    stack = LayerStack.from_resource("e2v_ccd250")
    silicon = get_medium("Si_green2008").modified(extinction_scale=extinction_scale)
    for layer in ("detection", "gates", "support"):
        stack = stack.with_medium(layer, silicon)
    optics = OpticalSystem(stack, 183.0, GaussianProfile(fwhm), Beam.collimated(), observable="total")
    light = optics.flat_fields(wavelength, 0.1)
    return optics.reduce(light).averaged(light.weight, 14.0)


def test_two_nanometre_curve(shared_dir: Path) -> None:
    wavelength, published = curve(shared_dir, "bandwidth_verify_2nm")
    ours = total_absorption(wavelength, 2.0)
    assert np.abs(ours - published).max() < 0.02
    # The fringes of the epoxy: same place and same size.
    trend = np.polyfit(wavelength - 930.0, ours - published, 3)
    residual = ours - published - np.polyval(trend, wavelength - 930.0)
    assert residual.std() < 1.5e-3


def test_difference_is_the_extinction_of_silicon(shared_dir: Path) -> None:
    wavelength, published = curve(shared_dir, "bandwidth_verify_2nm")
    scales = np.linspace(0.93, 0.97, 9)
    misfit = [total_absorption(wavelength, 2.0, scale) - published for scale in scales]
    rms = [np.sqrt(np.mean(each**2)) for each in misfit]
    best = scales[int(np.argmin(rms))]
    assert 0.945 <= best <= 0.96
    assert np.abs(misfit[int(np.argmin(rms))]).max() < 4e-3
    red = np.arange(880.0, 981.0, 20.0)
    ratio = get_medium("Si_schinke2015").index(red, 295.0).imag / get_medium("Si").index(red, 300.0).imag
    assert ratio.mean() == pytest.approx(best, abs=0.015)


def test_silicon_ripple_of_the_one_nanometre_curve(shared_dir: Path) -> None:
    wavelength, published = curve(shared_dir, "bandwidth_verify_1nm_inset")
    ours = total_absorption(wavelength, 1.0)

    def ripple(values: np.ndarray) -> np.ndarray:
        # Two silicon fringes wide: takes out the epoxy, leaves the silicon.
        x = wavelength - wavelength.mean()
        return values - np.polyval(np.polyfit(x, values, 7), x)

    assert np.corrcoef(ripple(ours), ripple(published))[0, 1] > 0.995
    assert np.ptp(ripple(ours)) == pytest.approx(np.ptp(ripple(published)), rel=0.1)
    assert 0.005 < 0.5 * np.ptp(ripple(published)) < 0.02
    assert 0.5 * np.ptp(ripple(total_absorption(wavelength, 2.0))) < 2e-4
