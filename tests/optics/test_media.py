"""Media: exact at the nodes, silent nowhere outside, temperature laws of silicon."""

import numpy as np
import pytest
from astropy.table import Table

from lsst.fringe_sim.errors import OutOfRangeError, UnknownNameError
from lsst.fringe_sim.optics import constant_medium, get_medium, medium_names
from lsst.fringe_sim.resources import read_table, read_yaml

TABLES = {name: entry for name, entry in read_yaml("media", "media.yaml").items() if "table" in entry}


@pytest.mark.parametrize("name", sorted(TABLES))
def test_tabulated_nodes_are_met_exactly(name: str) -> None:
    """An extinction below 1e-12 (a metre of it absorbs nothing) is raised to that."""
    entry, medium = TABLES[name], get_medium(name)
    table: Table = read_table("media", entry["table"])
    low, high = medium.wavelength_range_nm
    table = table[(table["wavelength"] >= low) & (table["wavelength"] <= high)]
    n, k = (np.asarray(table[column]) for column in entry.get("columns", ("n", "k")))
    index = medium.index(np.asarray(table["wavelength"]), entry.get("measured_at_k", 300.0))
    np.testing.assert_allclose(index.real, n, rtol=1e-13)
    np.testing.assert_allclose(index.imag, np.where(np.all(k == 0), 0.0, k), rtol=1e-11, atol=1.01e-12)


@pytest.mark.parametrize("name", medium_names())
def test_outside_its_range_a_medium_refuses(name: str) -> None:
    medium = get_medium(name)
    low, high = medium.wavelength_range_nm
    assert np.isfinite(medium.index([low, high])).all()
    for wavelength in (low - 1e-6, high + 1e-6 * high, np.nan):
        with pytest.raises(OutOfRangeError, match="wavelength"):
            medium.index(wavelength)
    with pytest.raises(OutOfRangeError, match="temperature"):
        medium.index(low, 99.0)
    assert medium.source


@pytest.mark.parametrize("name", sorted(TABLES))
def test_a_medium_is_known_from_end_to_end_of_its_table(name: str) -> None:
    """Silicon whose temperature was measured only where it was: from 300 to 1200 nm."""
    wavelength = np.asarray(read_table("media", TABLES[name]["table"])["wavelength"])
    low, high = float(wavelength.min()), float(wavelength.max())
    if TABLES[name].get("temperature") == "franta2017":
        low, high = max(low, 300.0), min(high, 1200.0)
    assert get_medium(name).wavelength_range_nm == (low, high)


def test_between_nodes_the_index_neither_overshoots_nor_turns_negative() -> None:
    wavelength = np.linspace(600.0, 1100.0, 20_001)
    extinction = get_medium("Si").index(wavelength).imag
    assert np.all(np.diff(extinction) < 0.0)
    assert np.all(extinction > 0.0)


def test_silicon_at_its_reference_temperature_is_the_table() -> None:
    silicon = get_medium("Si")
    wavelength = np.linspace(800.0, 1050.0, 101)
    np.testing.assert_array_equal(silicon.index(wavelength, 300.0), silicon.index(wavelength))
    np.testing.assert_allclose(
        silicon.index(wavelength, 300.0), silicon.index(wavelength, 300.0 * (1 + 1e-13)), rtol=1e-12
    )


def test_power_law_of_green() -> None:
    """X(T) = X(300 K) (T/300 K)^(C 300 K) at a node, with numbers of the table written out."""
    index = get_medium("Si_green2008").index(1000.0, 183.0)
    assert index.imag == pytest.approx(0.0005092958 * (183.0 / 300.0) ** (90.0e-4 * 300.0), rel=1e-12)
    assert index.real == pytest.approx(3.572 * (183.0 / 300.0) ** (0.7e-4 * 300.0), rel=1e-12)


@pytest.mark.parametrize(("temperature", "expected"), [(183.0, 802.0), (173.0, 796.0), (300.0, 864.0)])
def test_depth_of_99_percent_absorption_crosses_100_um(temperature: float, expected: float) -> None:
    """With the constants of the paper, Fig. 3."""
    wavelength = np.arange(700.0, 950.0, 0.1)
    extinction = get_medium("Si_green2008").index(wavelength, temperature).imag
    absorption = 4.0 * np.pi * extinction / (1e-3 * wavelength)
    depth = np.log(100.0) / absorption
    crossing = wavelength[np.searchsorted(depth, 100.0)]
    assert abs(crossing - expected) < 1.0


def test_unknown_name_offers_near_misses() -> None:
    with pytest.raises(UnknownNameError, match="epoxy"):
        get_medium("epoxi")


def test_modifiers_act_where_they_say() -> None:
    medium = get_medium("epoxy").modified(
        index_scale=1.01, index_offset=0.002, extinction_offset=1e-4, dispersion_um2=0.01
    )
    assert medium.index(960.0) == pytest.approx(1.6 * 1.01 + 0.002 + 1e-4j, rel=1e-14)
    cauchy = 0.01 * ((1000.0 / 900.0) ** 2 - (1000.0 / 960.0) ** 2)
    assert medium.index(900.0).real - medium.index(960.0).real == pytest.approx(cauchy, rel=1e-9)
    assert get_medium("Si").modified(extinction_scale=1.2).index(960.0).imag == pytest.approx(
        1.2 * 0.001023685, rel=1e-12
    )


@pytest.mark.parametrize(("n", "k"), [(0.0, 0.0), (-1.0, 0.0), (1.5, -0.1), (np.nan, 0.0), (1.5, np.nan)])
def test_impossible_constants_are_refused(n: float, k: float) -> None:
    with pytest.raises(OutOfRangeError):
        constant_medium("nonsense", n, k)
