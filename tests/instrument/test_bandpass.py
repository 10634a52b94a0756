"""Bandpasses against speclite and against the tables they come from."""

import numpy as np
import pytest
import speclite.filters

from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.bandpass import Atmosphere, Bandpass, bandpass_names
from lsst.fringe_sim.resources import read_table


def test_detector_and_air_put_back_give_the_speclite_curve():
    band = Bandpass.from_name("lsst_y")
    curve = speclite.filters.load_filter("lsst2023-y")
    wave = np.asarray(read_table("sky", "throughput_lsst_y.ecsv")["wavelength"])
    air = np.asarray(read_table("sky", "throughput_lsst_y.ecsv")["atmos_std"])
    total = band.transmission(wave) * band.quantum_efficiency(wave) * air
    expected = np.interp(wave, np.asarray(curve.wavelength) / 10, np.asarray(curve.response))
    np.testing.assert_allclose(total, expected, atol=5e-6)


def test_speclite_curve_divided_by_detector_and_air_is_the_bandpass():
    table = read_table("sky", "throughput_lsst_y.ecsv")
    band = Bandpass.from_name("lsst_y")
    divided = Bandpass.from_speclite(
        "lsst2023-y", (table["wavelength"], table["detector"]), standard_air(table)
    )
    wave = np.arange(920.0, 1070.0, 0.5)
    np.testing.assert_allclose(divided.transmission(wave), band.transmission(wave), rtol=2e-4)


def standard_air(table):
    wavelength, air = np.asarray(table["wavelength"]), np.asarray(table["atmos_std"])
    return Atmosphere(wavelength, air, 1.2, 0.0287, 1.6)


def test_no_detector_is_left_in_the_bandpass():
    # The quantum efficiency of 100 µm of silicon halves between 960 and 1000 nm; the optics do not.
    band = Bandpass.from_name("lsst_y")
    assert band.transmission(1000.0) == pytest.approx(band.transmission(960.0), rel=0.1)
    assert band.quantum_efficiency(1000.0) < 0.75 * band.quantum_efficiency(960.0)


def test_hsc_bandpass_is_the_product_without_detector_and_air():
    table = read_table("sky", "throughput_hsc_y.ecsv")
    band = Bandpass.from_name("hsc_y")
    expected = np.asarray(table["optics_no_detector"]) / np.asarray(table["atmosphere"])
    np.testing.assert_allclose(band.transmission(table["wavelength"]), expected, atol=2e-4)


@pytest.mark.parametrize("name", bandpass_names())
def test_transmission_is_a_fraction_and_ends_at_the_table(name):
    band = Bandpass.from_name(name)
    low, high = band.support()
    wave = np.linspace(low, high, 500)
    assert np.all((band.transmission(wave) >= 0) & (band.transmission(wave) <= 1))
    assert band.transmission([500.0, 2000.0]).tolist() == [0.0, 0.0]
    assert band.transmission(low) < 2e-3
    assert band.transmission(high) < 2e-3


def test_air_at_another_airmass_matches_the_standard_atmosphere():
    table = read_table("sky", "throughput_lsst_y.ecsv")
    band = Bandpass.from_name("lsst_y")
    wave = np.asarray(table["wavelength"])
    inside = (wave > 900) & (wave < 1095)
    scaled = band.air.total(wave[inside], 1.2)
    np.testing.assert_allclose(scaled, np.asarray(table["atmos_std"])[inside], atol=0.007)
    weight = band.transmission(wave[inside])
    assert np.average(scaled / np.asarray(table["atmos_std"])[inside], weights=weight) == pytest.approx(
        1, abs=3e-3
    )


@pytest.mark.parametrize("name", bandpass_names())
def test_air_at_the_reference_airmass_is_the_table(name):
    air = Bandpass.from_name(name).air
    np.testing.assert_allclose(
        air.total(air.wavelength_nm, air.reference_airmass), air.transmission, rtol=1e-12
    )
    assert np.all(air.total(air.wavelength_nm, 3.0) <= air.transmission + 1e-12)


def test_scattering_is_the_transmission_of_the_clear_windows():
    air = Bandpass.from_name("lsst_y").air
    for window in (868.0, 1035.0):
        assert air.scattering(window) == pytest.approx(air.total(window), abs=3e-3)
    assert air.total(935.0) < 0.8 * air.scattering(935.0)  # water vapour
    assert air.scattering(1000.0, 2.0) == pytest.approx(air.scattering(1000.0) ** 2)


def test_bad_input_is_named():
    band = Bandpass.from_name("lsst_y")
    with pytest.raises(UnknownNameError, match="hsc_y"):
        Bandpass.from_name("hscy")
    with pytest.raises(UnknownNameError, match="speclite filter"):
        Bandpass.from_speclite("lsst2023-q", ([800, 1100], [0.5, 0.5]), band.air)
    with pytest.raises(InputError, match="blind"):
        Bandpass.from_speclite("lsst2023-y", ([800, 950], [0.5, 0.5]), band.air)
    for airmass in (0.5, np.nan, 20.0):
        with pytest.raises(OutOfRangeError, match="airmass"):
            band.air.total(1000.0, airmass)
