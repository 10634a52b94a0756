"""Zero points, areas and quantum efficiencies, each against its own few lines."""

from importlib.resources import files

import numpy as np
import pytest
import yaml

from lsst.fringe_sim.algorithms.sky_frame import throughput_electrons
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.readout import electrons_to_microjansky, zero_point
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.instrument.telescope import Telescope
from lsst.fringe_sim.model import FringeModel

DATA = files("lsst.fringe_sim").joinpath("data")


def table(name: str) -> dict[str, np.ndarray]:
    """Columns of a shipped table of numbers."""
    rows = [line.split() for line in DATA.joinpath("sky", name).read_text().splitlines() if line[0] != "#"]
    return dict(zip(rows[0], np.array(rows[1:], dtype=float).T, strict=True))


@pytest.mark.parametrize(
    ("curve", "airmass", "magnitude"), [("hardware_y", None, 26.99), ("atmos_10", 1.0, 26.82)]
)
def test_zero_point_of_the_lsst(curve, airmass, magnitude) -> None:
    """One electron per second: 3631 Jy / h photons per unit of ln(wavelength), through 32.4 m²."""
    rows = table("throughput_lsst_y.ecsv")
    through = rows["hardware_y"] * (rows["atmos_10"] if airmass else 1.0)
    electrons = 32.40 * 3631e-26 / 6.62607015e-34 * np.trapezoid(through, np.log(rows["wavelength"]))
    own = 2.5 * np.log10(electrons)
    assert own == pytest.approx(magnitude, abs=0.005)
    assert zero_point(Bandpass.from_name("lsst_y"), 32.40, airmass) == pytest.approx(own, abs=2e-3)


def test_one_sky_below_and_above_the_air() -> None:
    """2717 electrons in 30 s: 132 µJy arcsec⁻² as it arrives, 154 µJy arcsec⁻² for a source above the air."""
    band = Bandpass.from_name("lsst_y")
    for airmass, microjansky in ((None, 131.8), (1.0, 154.3)):
        found = electrons_to_microjansky(2717.0, zero_point(band, 32.40, airmass), 30.0, 0.2)
        magnitude = 26.99 if airmass is None else 26.82
        own = 10.0 ** (0.4 * (23.9 - magnitude)) * 2717.0 / 30.0 / 0.2**2
        assert found == pytest.approx(microjansky, rel=0.005)
        assert found == pytest.approx(own, rel=0.005)


def test_every_vendor_has_its_own_efficiency() -> None:
    """The level of ITL sensors was that of e2v sensors, 6 % too low."""
    rows = table("qe_lsst_detectors.ecsv")
    wave = np.array([920.0, 960.0, 1000.0, 1040.0])
    levels = {}
    for setup, column in (("lsst_e2v", "e2v_QE"), ("lsst_itl", "itl_QE")):
        model = FringeModel.from_setup(setup)
        band = Bandpass.from_name(model.setup.bandpass)
        own = np.interp(wave, rows["wavelength"], rows[column] * rows["losses"])
        np.testing.assert_allclose(band.quantum_efficiency(wave), own, rtol=2e-3)
        levels[setup] = throughput_electrons(SkySpectrum.dark(), band, model)
        assert band.name == "lsst_y"
    assert levels["lsst_itl"] / levels["lsst_e2v"] == pytest.approx(1.058, abs=0.005)


@pytest.mark.parametrize(
    ("setup", "telescope"),
    [("hsc", "hsc"), ("lsst_e2v", "lsst"), ("lsst_itl", "lsst"), ("monocam", "monocam")],
)
def test_set_up_and_telescope_have_one_area(setup, telescope) -> None:
    content = yaml.safe_load(DATA.joinpath("telescopes", f"{telescope}.yaml").read_text())
    assert Setup.from_name(setup).effective_area_m2 == content["collecting_area_m2"]


def test_area_of_hyper_suprime_cam() -> None:
    """8.2 m less a hole of a tenth of the diameter, and what rays find in their way."""
    kept = Telescope.from_name("hsc").trace(0.0).kept_fraction
    area = 0.25 * np.pi * 8.2**2 * (1.0 - 0.1**2) * kept
    assert Setup.from_name("hsc").effective_area_m2 == pytest.approx(area, rel=2e-3)
