"""Night sky against molecular physics, published levels and independent formulae."""

import math

import numpy as np
import pytest
from astropy.table import Table
from hypothesis import given, settings
from hypothesis import strategies as st

from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.sky import (
    ContinuumTerm,
    EmissionLines,
    SkySpectrum,
    SpectralComponent,
    airglow_continuum,
    blend_components,
    moonlight,
    van_rhijn_factor,
    zodiacal_light,
)
from lsst.fringe_sim.resources import read_table

SIX_BANDS = ("7-3", "8-4", "3-0", "9-5", "4-1", "5-2")
HC_K = 1.4387769


@pytest.fixture(scope="module")
def band() -> Bandpass:
    return Bandpass.from_name("lsst_y")


def boltzmann_temperature(lines: EmissionLines, name: str) -> float:
    """Rotational temperature from the slope of ln(I / A g) against energy, N <= 4."""
    table = read_table("sky", "oh_lines_palace_yband.ecsv")
    table.sort("wavelength", kind="stable")
    chosen = (table["band"] == name) & (table["N_up"] <= 4)
    rate = np.asarray(table["A"] * table["g_up"])[chosen]
    slope = np.polyfit(np.asarray(table["E_rot"])[chosen], np.log(lines.photon_radiance[chosen] / rate), 1)[0]
    return -HC_K / slope


def test_reference_lines_are_those_of_the_table():
    lines = EmissionLines.oh()
    table = read_table("sky", "oh_lines_palace_yband.ecsv")
    assert len(lines.wavelength_nm) == 1831
    total = sum(lines.of_band(name).photon_radiance.sum() for name in SIX_BANDS)
    assert total == pytest.approx(518, rel=2e-3)
    # intensities of the table are rounded to four digits
    order = np.argsort(table["wavelength"], kind="stable")
    np.testing.assert_allclose(lines.photon_radiance, np.asarray(table["photon_radiance"])[order], rtol=2e-3)


@pytest.mark.parametrize("name", ["8-4", "3-0", "9-5", "4-1", "5-2", "7-3"])
def test_low_levels_of_the_reference_are_near_200_k(name):
    assert 191 < boltzmann_temperature(EmissionLines.oh(), name) < 203


def test_reference_vibrational_temperature():
    table = read_table("sky", "oh_levels_palace.ecsv")
    chosen = (table["v_up"] >= 3) & (table["v_up"] <= 9)
    slope = np.polyfit(np.asarray(table["E_v0"])[chosen], np.asarray(table["ln_pop_N1"])[chosen], 1)[0]
    assert -HC_K / slope == pytest.approx(10_970, rel=2e-3)


@settings(max_examples=15, deadline=None)
@given(st.floats(140.0, 320.0))
def test_rotational_temperature_is_recovered(temperature):
    lines = EmissionLines.oh(temperature)
    for name in SIX_BANDS:
        assert boltzmann_temperature(lines, name) == pytest.approx(temperature, rel=1e-6)


def test_rotational_temperature_keeps_the_vibrational_population():
    table = read_table("sky", "oh_lines_palace_yband.ecsv")
    cold, hot = EmissionLines.oh(180.0), EmissionLines.oh(230.0)
    order = np.argsort(table["wavelength"], kind="stable")
    rate = np.asarray(table["A"] * table["g_up"])[order]
    key = np.array([f"{row['v_up']} {row['N_up']} {row['F_up']} {row['parity_up']}" for row in table])[order]
    weight, upper = np.asarray(table["g_up"])[order], np.asarray(table["v_up"])[order]
    _, first = np.unique(key, return_index=True)
    for level in (3, 4, 5, 7, 8, 9):  # of 6 only the outskirts are in the list
        chosen = first[upper[first] == level]
        totals = [(weight * lines.photon_radiance / rate)[chosen].sum() for lines in (cold, hot)]
        assert totals[0] == pytest.approx(totals[1], rel=1e-12)


def test_vibrational_temperature_sets_the_ratio_of_levels_and_keeps_the_photons():
    reference, hot = EmissionLines.oh(), EmissionLines.oh(vibrational_temperature_k=14_000.0)
    cold = EmissionLines.oh(vibrational_temperature_k=8_000.0)
    assert hot.photon_radiance.sum() == pytest.approx(reference.photon_radiance.sum(), rel=1e-12)
    levels = read_table("sky", "oh_levels_palace.ecsv")
    energy = dict(zip(levels["v_up"].tolist(), levels["E_v0"].tolist(), strict=True))

    def ratio(lines):
        return lines.of_band("9-5").photon_radiance.sum() / lines.of_band("3-0").photon_radiance.sum()

    expected = math.exp(-HC_K * (energy[9] - energy[3]) * (1 / 14_000 - 1 / 8_000))
    assert ratio(hot) / ratio(cold) == pytest.approx(expected, rel=1e-9)


def test_hot_population_fills_high_levels():
    table = read_table("sky", "oh_lines_palace_yband.ecsv")
    table.sort("wavelength", kind="stable")
    high = (table["E_rot"] > 3000) & (table["band"] == "3-0")
    single = EmissionLines.oh(190.0)
    double = EmissionLines.oh().with_rotation(lambda levels: levels.thermal(191.0, 7490.0, 0.00222))
    assert single.photon_radiance[high].sum() < 1e-6 * single.photon_radiance.sum()
    reference = EmissionLines.oh()
    # cold and hot population fitted to the levels of v' = 3 reproduce the reference within a few per cent
    chosen = np.asarray(table["band"] == "3-0")
    ratio = np.log(double.photon_radiance / reference.photon_radiance)[chosen]
    assert np.sqrt(np.mean(ratio**2)) < 0.08


def test_band_scale_multiplies_one_band():
    lines, scaled = EmissionLines.oh(), EmissionLines.oh().scaled({"8-4": 2.0, "5-2": 0.0})
    assert scaled.of_band("8-4").photon_radiance.sum() == 2 * lines.of_band("8-4").photon_radiance.sum()
    assert scaled.of_band("5-2").photon_radiance.sum() == 0
    np.testing.assert_array_equal(scaled.of_band("3-0").photon_radiance, lines.of_band("3-0").photon_radiance)


@pytest.mark.shared
def test_line_list_of_the_paper_overweights_4_1_and_5_2(shared_dir):
    paper = Table.read(shared_dir / "data" / "oh_lines_guo2022_fig8.ecsv")
    lines = EmissionLines.oh()

    def share(values, names, name, window):
        return float(values[(names == name) & window].sum())

    wave = np.asarray(paper["wavelength"])
    excess = {}
    for name in SIX_BANDS:
        window = (lines.wavelength_nm > 880) & (lines.wavelength_nm < 1100)
        ours = share(lines.photon_radiance, lines.band, name, window)
        theirs = share(
            np.asarray(paper["intensity"]), np.asarray(paper["band"]), name, (wave > 880) & (wave < 1100)
        )
        excess[name] = theirs / ours
    others = np.mean([excess[name] for name in ("7-3", "8-4", "3-0", "9-5")])
    assert excess["4-1"] / others == pytest.approx(1.75, abs=0.15)
    assert excess["5-2"] / others == pytest.approx(1.9, abs=0.15)


def test_energy_balance_at_the_zenith(band):
    """2717 e⁻ per pixel in 30 s: the LSST dark sky through the standard hardware (32.40 m², 0.2 arcsec)."""
    components = SkySpectrum.dark().components(band)
    electrons = (
        32.40
        * 0.2**2
        * 30
        * sum(float(item.photons @ band.quantum_efficiency(item.wavelength_nm)) for item in components)
    )
    assert electrons == pytest.approx(2717, rel=0.10)
    assert {item.name for item in components} >= {*SIX_BANDS, "airglow continuum", "zodiacal light"}


def test_airmass_follows_van_rhijn_and_the_air(band):
    # shell at 90 km, zenith distance 60 deg: 1 / sqrt(1 - (6371/6461 sin 60)²)
    assert van_rhijn_factor(2.0) == pytest.approx(1.92184, abs=1e-5)
    assert van_rhijn_factor(1.0) == 1.0
    assert van_rhijn_factor(5.0) < 5.0
    low, high = (
        {item.name: item.photons.sum() for item in SkySpectrum.dark(airmass=airmass).components(band)}
        for airmass in (1.0, 2.0)
    )
    assert 1.7 < high["3-0"] / low["3-0"] < van_rhijn_factor(2.0)
    assert high["zodiacal light"] < low["zodiacal light"]
    # water vapour: the part of 8-4 near 935 nm loses more than 3-0
    assert high["8-4"] / low["8-4"] < high["3-0"] / low["3-0"]


def test_continuum_does_not_depend_on_its_step(band):
    sky = SkySpectrum(EmissionLines.oh(), (airglow_continuum(),))
    sums = [sky.components(band, step)[-1].photons.sum() for step in (0.05, 0.1, 0.4)]
    np.testing.assert_allclose(sums, sums[0], rtol=1e-3)


def test_zodiacal_light_at_the_published_example():
    # 77e-8 W m-2 sr-1 um-1 at 500 nm is 45.6 ph s-1 m-2 um-1 arcsec-2; find a place of that brightness
    table = read_table("sky", "sky_zodiacal_leinert1998.ecsv")
    place = table[np.nanargmin(np.abs(np.asarray(table["brightness"], dtype=float) - 77.0))]
    term = zodiacal_light(float(place["dlon"]), float(place["beta"]))
    assert 1e3 * term.radiance(500.0) == pytest.approx(45.6 * place["brightness"] / 77.0, rel=2e-3)
    assert zodiacal_light(-100.0, -30.0).radiance(1000.0) == zodiacal_light(100.0, 30.0).radiance(1000.0)


def test_solar_colour_of_zodiacal_light():
    # Sun: F(1000)/F(500) = 0.39 in energy (ASTM E-490); reddening of the dust 1 + k log10(2), k = 0.6 beyond 90 deg
    term = zodiacal_light(120.0, 60.0)
    energy = term.radiance([1000.0]) / term.radiance([500.0]) / 2
    assert energy[0] == pytest.approx(0.39 * (1 + 0.6 * math.log10(2)), rel=0.03)


def test_moonlight_in_v_is_krisciunas_and_schaefer():
    phase, separation, moon, target = 0.0, 60.0, 40.0, 20.0
    term = moonlight(phase, separation, moon, target)

    def airmass(zenith):
        return 1 / math.sqrt(1 - 0.96 * math.sin(math.radians(zenith)) ** 2)

    brightness = (
        10 ** (-0.4 * 3.84)
        * (10**5.36 * (1.06 + math.cos(math.radians(separation)) ** 2) + 10 ** (6.15 - separation / 40))
        * 10 ** (-0.4 * 0.172 * airmass(moon))
        * (1 - 10 ** (-0.4 * 0.172 * airmass(target)))
    )
    magnitude = (20.7233 - math.log(brightness / 34.08)) / 0.92104
    # V = 0 is 995 photons s-1 cm-2 A-1 (Bessell 1998) = 9.95e7 s-1 m-2 nm-1
    assert term.radiance(551.0) == pytest.approx(9.95e7 * 10 ** (-0.4 * magnitude), rel=0.03)


def test_moonlight_fades_with_phase_distance_and_wavelength():
    def level(phase=0.0, separation=60.0, moon=40.0, wave=1000.0):
        return float(moonlight(phase, separation, moon).radiance(wave))

    assert level() > level(phase=60.0) > level(phase=120.0) > 0
    assert level(separation=10.0) > level(separation=40.0)
    assert level(moon=20.0) > level(moon=80.0)
    assert level(moon=95.0) == 0
    assert level(wave=551.0) > 3 * level(wave=1000.0)


def fringe(component: SpectralComponent, period_nm: float) -> complex:
    return complex(component.photons @ np.exp(2j * np.pi * component.wavelength_nm / period_nm))


@settings(max_examples=25, deadline=None)
@given(st.floats(0.0, 0.02), st.integers(0, 2**32 - 1))
def test_blending_keeps_photons_and_means_and_bounds_the_fringe(shift, seed):
    rng = np.random.default_rng(seed)
    components = [
        SpectralComponent(str(number), np.sort(rng.uniform(900, 910, size)), rng.exponential(size=size) ** 2)
        for number, size in enumerate((1, 40, 200))
    ]
    blended = blend_components(components, shift)
    total = sum(item.photons.sum() for item in components)
    for before, after in zip(components, blended, strict=True):
        assert after.name == before.name
        assert after.photons.sum() == pytest.approx(before.photons.sum(), rel=1e-12)
        mean = before.photons @ before.wavelength_nm / before.photons.sum()
        assert after.photons @ after.wavelength_nm / after.photons.sum() == pytest.approx(mean, abs=1e-9)
        assert np.all(np.diff(after.wavelength_nm) > 0)
    for period in (0.3, 1.28, 20.0):
        change = abs(
            sum(fringe(b, period) - fringe(a, period) for a, b in zip(components, blended, strict=True))
        )
        assert change <= 0.5 * (2 * np.pi * shift / period) ** 2 * total + 1e-9 * total


def test_blending_by_zero_merges_only_coincident_lines():
    item = SpectralComponent("x", np.array([900.0, 900.0, 901.0]), np.array([1.0, 2.0, 0.0]))
    (blended,) = blend_components([item], 0.0)
    assert blended.wavelength_nm.tolist() == [900.0]
    assert blended.photons.tolist() == [3.0]


def test_bad_input_is_named():
    with pytest.raises(OutOfRangeError, match="temperature"):
        EmissionLines.oh(-5.0)
    with pytest.raises(OutOfRangeError, match="temperature"):
        EmissionLines.oh(math.nan)
    with pytest.raises(UnknownNameError, match="8-4"):
        EmissionLines.oh().scaled({"8-3": 1.0})
    with pytest.raises(OutOfRangeError, match="scale of OH band"):
        EmissionLines.oh().scaled({"8-4": -1.0})
    with pytest.raises(OutOfRangeError, match="from the Sun"):
        zodiacal_light(5.0, 2.0)
    with pytest.raises(OutOfRangeError, match="solar radio flux"):
        airglow_continuum(10.0)
    with pytest.raises(OutOfRangeError, match="separation"):
        moonlight(0.0, 1.0, 30.0)
    with pytest.raises(OutOfRangeError, match="airmass"):
        van_rhijn_factor(0.9)
    with pytest.raises(OutOfRangeError, match="continuum mine"):
        ContinuumTerm("mine", np.array([900.0, 1000.0]), np.ones(2), "airglow").radiance(1001.0)
    with pytest.raises(InputError, match="ascending"):
        EmissionLines(np.array([2.0, 1.0]), np.ones(2), np.ones(2), np.array(["8-4", "8-4"]))
    with pytest.raises(InputError, match="one common shape"):
        EmissionLines(np.ones(3), np.ones(2), np.ones(2), np.array(["8-4", "8-4"]))


@pytest.mark.parametrize(
    ("wavelength", "transmission", "words"),
    [(9400.0, 0.9, "wavelength of a line"), (0.94, 0.9, "wavelength of a line"), (940.0, -1.0, "transmission"),
     (940.0, 1.1, "transmission")],
)  # fmt: skip
def test_lines_of_another_unit_are_refused(wavelength: float, transmission: float, words: str) -> None:
    with pytest.raises(OutOfRangeError, match=words):
        EmissionLines(np.array([wavelength]), np.ones(1), np.array([transmission]), np.array(["8-4"]))
