"""Cold and hot OH against a direct calculation: two Boltzmann distributions fitted here to tabulated populations."""

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.optimize import least_squares

from lsst.fringe_sim.effects import EFFECTS, activate_effects, apply_to_sky
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum
from lsst.fringe_sim.resources import read_table

HC_K = 1.4387769  # hc/k [cm K]


@pytest.fixture(scope="module")
def table() -> dict[str, np.ndarray]:
    """The line list in the order of its wavelengths."""
    rows = read_table("sky", "oh_lines_palace_yband.ecsv")
    order = np.argsort(np.asarray(rows["wavelength"]), kind="stable")
    return {name: np.asarray(rows[name])[order] for name in rows.colnames}


def level_names(table: dict[str, np.ndarray]) -> np.ndarray:
    columns = (table[name].astype(str) for name in ("v_up", "N_up", "F_up", "parity_up"))
    return np.array([" ".join(row) for row in zip(*columns, strict=True)])


def with_effects(lines: EmissionLines, settings: Mapping[str, float]) -> EmissionLines:
    system = Setup.from_name("ts8_e2v").optical_system()
    return apply_to_sky(activate_effects(settings, EFFECTS), system, SkySpectrum(lines)).lines


def part_above(lines: EmissionLines, table: dict[str, np.ndarray], energy_cm: float) -> float:
    """Part of the light behind the y filter that comes from levels above an energy."""
    light = lines.photon_radiance * Bandpass.from_name("lsst_y").transmission(lines.wavelength_nm)
    return float(light[table["E_rot"] > energy_cm].sum() / light.sum())


def two_temperatures(energy: np.ndarray, log_population: np.ndarray) -> np.ndarray:
    """Logarithm of the cold population at zero energy, its temperature, and the same of the hot one."""

    def misfit(p: np.ndarray) -> np.ndarray:
        return np.logaddexp(p[0] - HC_K * energy / p[1], p[2] - HC_K * energy / p[3]) - log_population

    return least_squares(misfit, [log_population[0], 190.0, log_population[0] - 5.0, 2000.0], x_scale="jac").x


@pytest.mark.parametrize("kelvin", [150.0, 191.0, 220.0, 250.0])
def test_the_cold_population_alone_warms(kelvin, table) -> None:
    """Of every level, as populations that are computed from the fit; the hot ones stay."""
    reference, warm = (
        EmissionLines.oh(),
        with_effects(EmissionLines.oh(), {"rotational_temperature.offset": kelvin - 191.0}),
    )
    for v in (3, 4, 5, 7, 8, 9):
        own = table["v_up"] == v
        energy, population, weight = (table[name][own] for name in ("E_rot", "ln_pop", "g_up"))
        _, first = np.unique(level_names(table)[own], return_index=True)
        low = first[energy[first] < (1000.0 if v == 9 else 2200.0)]
        size, cold_k, _, _ = two_temperatures(energy[low], population[low])
        cold = np.minimum(np.exp(size - HC_K * energy / cold_k), np.exp(population))
        warmer = np.exp(-HC_K * energy / kelvin)
        warmer *= (weight * cold)[first].sum() / (weight * warmer)[first].sum()
        direct = (np.exp(population) - cold + warmer) / np.exp(population)
        effect = (warm.photon_radiance / reference.photon_radiance)[own]
        np.testing.assert_allclose(effect, direct, rtol=0.05, err_msg=f"v'={v}")


def test_warmer_air_leaves_the_hot_levels_alone(table) -> None:
    """It used to heat them too: 20 % of the light came from above 2000 cm⁻¹ then."""
    before = part_above(EmissionLines.oh(), table, 2000.0)
    assert before == pytest.approx(0.014, abs=0.001)
    warm = with_effects(EmissionLines.oh(), {"rotational_temperature.offset": 20.0})
    assert part_above(warm, table, 2000.0) == pytest.approx(before, rel=0.05)


def test_a_hot_population_is_added_to_the_cold_one(table) -> None:
    """It used to multiply the hot populations that are listed: 86 % of the light came from above 1500 cm⁻¹ then."""
    before = part_above(EmissionLines.oh(), table, 1500.0)
    assert before == pytest.approx(0.020, abs=0.001)
    direct = EmissionLines.oh().with_rotation(lambda levels: levels.thermal(190.0, 1000.0, 0.01))
    assert part_above(direct, table, 1500.0) == pytest.approx(0.0042, abs=0.0003)
    effect = with_effects(EmissionLines.oh(190.0), {"hot_rotation.ratio": 0.01})
    np.testing.assert_allclose(effect.photon_radiance, direct.photon_radiance, rtol=1e-9)
    both = with_effects(EmissionLines.oh(), {"hot_rotation.ratio": 0.01})
    assert part_above(both, table, 1500.0) == pytest.approx(before + 0.0042, rel=0.1)


def test_twice_the_hot_population_is_twice_its_light(table) -> None:
    before = EmissionLines.oh()
    after = with_effects(before, {"hot_rotation.scale": 2.0})
    ratio = after.photon_radiance / before.photon_radiance
    for v in (3, 4, 5, 7, 8, 9):
        own = table["v_up"] == v
        energy, ratio_v = table["E_rot"][own], ratio[own]
        # All of a level above 1500 cm⁻¹ is hot; what the vibration holds besides gives way a little.
        hot, lowest = ratio_v[energy > 1500.0], ratio_v[energy == 0.0]
        np.testing.assert_allclose(hot, hot.mean(), rtol=0.01)
        assert 1.5 < hot.mean() < 2.0
        assert np.all(lowest < 1.0)


def test_a_vibrational_level_keeps_what_it_holds(table) -> None:
    before = EmissionLines.oh()
    _, first = np.unique(level_names(table), return_index=True)
    for settings in (
        {"rotational_temperature.offset": 40.0},
        {"hot_rotation.ratio": 0.1},
        {"hot_rotation.scale": 3.0},
    ):
        ratio = with_effects(before, settings).photon_radiance / before.photon_radiance
        for v in (3, 4, 5, 7, 8, 9):
            own = first[table["v_up"][first] == v]
            held = table["g_up"][own] * np.exp(table["ln_pop"][own])
            assert (ratio[own] * held).sum() == pytest.approx(held.sum(), rel=1e-4)
