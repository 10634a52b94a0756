"""Light of flat fields, and the fringes that it prints into frames of the sky."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_sky import ForeignSky

from lsst.fringe_sim.algorithms.field_response import SensorPlacement, sensor_response
from lsst.fringe_sim.algorithms.sky_frame import sky_response
from lsst.fringe_sim.algorithms.sky_response import sky_with_effects
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.flat_spectrum import FlatSpectrum
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.model import FringeModel

BAND = "lsst_y"


def test_light_is_that_of_the_lamp_behind_the_filter():
    band = Bandpass.from_name(BAND)
    lamp = FlatSpectrum.from_name("gaussian:980:20").component(band)
    mean = lamp.photons @ lamp.wavelength_nm
    assert lamp.photons.sum() == pytest.approx(1.0)
    assert mean == pytest.approx(980.0, abs=0.5)
    spread = np.sqrt(lamp.photons @ (lamp.wavelength_nm - mean) ** 2)
    assert spread == pytest.approx(20.0 / 2.3548, rel=0.02)
    mixed = FlatSpectrum.gaussian(980.0, 0.5, share=0.3).component(band)
    near = np.abs(mixed.wavelength_nm - 980.0) < 1.0
    white = FlatSpectrum.from_name("white").component(band)
    within = white.photons[np.abs(white.wavelength_nm - 980.0) < 1.0].sum()
    assert mixed.photons[near].sum() == pytest.approx(0.3 + 0.7 * within, rel=1e-3)


def test_a_table_of_ones_own_is_read(tmp_path):
    path = tmp_path / "lamp.ecsv"
    path.write_text(
        "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: wavelength, datatype: float64}\n"
        "# - {name: photons, datatype: float64}\nwavelength photons\n970 0\n980 1\n990 0\n"
    )
    light = FlatSpectrum.from_name(str(path)).component(Bandpass.from_name(BAND))
    assert light.photons @ light.wavelength_nm == pytest.approx(980.0, abs=0.1)
    path.write_text(path.read_text().replace("photons", "counts"))
    with pytest.raises(InputError, match="columns of the flat field"):
        FlatSpectrum.from_name(str(path))


@pytest.mark.parametrize("name", ["blue", "gaussian:980", "gaussian:980:x", "gaussian:980:0", "gaussian:5:1"])
def test_what_is_no_spectrum_is_refused(name):
    with pytest.raises((InputError, OutOfRangeError), match="flat field"):
        FlatSpectrum.from_name(name)


def test_a_lamp_that_the_filter_keeps_out_is_refused():
    with pytest.raises(InputError, match="flat field"):
        FlatSpectrum.gaussian(500.0, 10.0).component(Bandpass.from_name(BAND))


def test_the_effect_is_a_flat_field_of_that_light():
    settings = {"flat_fringes.share": 0.4, "flat_fringes.mean": 980.0, "flat_fringes.fwhm": 3.0}
    flat = sky_with_effects(FringeModel.from_setup("lsst_e2v", settings), SkySpectrum.dark()).flat
    assert flat is not None
    found, expected = (
        each.component(Bandpass.from_name(BAND)) for each in (flat, FlatSpectrum.gaussian(980.0, 3.0, 0.4))
    )
    np.testing.assert_array_equal(found.photons, expected.photons)
    none = FringeModel.from_setup("lsst_e2v", {"flat_fringes.mean": 980.0})
    assert sky_with_effects(none, SkySpectrum.dark()).flat is None


@pytest.mark.slow
@pytest.mark.parametrize(("mean", "fwhm"), [(990.0, 2.0), (970.0, 12.0)])
def test_printed_fringes_are_those_of_a_foreign_simulator(mean, fwhm):
    """Other lines, other silicon, other sums: the frame divided by the flat, and what the flat prints."""
    thickness = np.linspace(14.0, 14.6, 400)
    foreign = ForeignSky()
    wave = np.linspace(mean - 2.0 * fwhm, mean + 2.0 * fwhm, 81)
    grid = np.arange(13.98, 14.63, 0.004)
    seen = foreign._summed(wave, np.exp(-4.0 * np.log(2.0) * ((wave - mean) / fwhm) ** 2), grid, 32)
    flat = np.interp(thickness, grid, seen / seen.mean())
    frame = sum(foreign.detected(thickness).values()) / flat
    model = FringeModel.from_setup("lsst_e2v")
    ours = []
    for light in (None, FlatSpectrum.gaussian(mean, fwhm)):
        sky = replace(SkySpectrum.dark(), flat=light)
        made = sky_response(model, sky, thickness_range_um=(13.95, 14.65)).sky().lookup(thickness)[0]
        ours.append(made / made.mean())
    printed = ours[0] / ours[1]
    assert np.corrcoef(printed, flat)[0, 1] > 0.99
    assert printed.std() == pytest.approx(flat.std(), rel=0.12)
    left, without = (np.std(frame / frame.mean() - each) for each in reversed(ours))
    assert left < 0.3 * without


@pytest.mark.slow
def test_every_pixel_is_divided_by_the_flat_of_its_own_beam():
    """One lamp on the sky and in the flat field: nothing is left of the fringes."""
    model = FringeModel.from_setup("lsst_e2v")
    lamp = FlatSpectrum.gaussian(985.0, 4.0)
    placement = SensorPlacement.of(
        Camera.from_name("lsstCam").detector("R22_S11"), model.setup.pixel_scale_arcsec
    )
    thickness = np.linspace(14.0, 14.5, 64 * 64).reshape(64, 64)
    spread = []
    for flat in (None, lamp):
        sky = replace(_lamp_on_the_sky(), flat=flat)
        image = sensor_response(model, sky, placement, (13.95, 14.55)).sky().frame(thickness)
        spread.append(float(image.std() / image.mean()))
    assert spread[1] < 0.02 * spread[0]


def _lamp_on_the_sky():
    """A sky with a continuum of the shape of a lamp in front of the filter."""
    from lsst.fringe_sim.instrument.sky import ContinuumTerm, EmissionLines

    wave = np.linspace(900.0, 1100.0, 4001)
    photons = np.exp(-4.0 * np.log(2.0) * ((wave - 985.0) / 4.0) ** 2)
    term = ContinuumTerm("lamp", np.array([300.0, *wave, 1300.0]), np.array([0.0, *photons, 0.0]), "local")
    lines = EmissionLines.oh()
    return SkySpectrum(lines.scaled(dict.fromkeys(lines.bands, 0.0)), (term,), 1.0)
