"""Silicon in the cold: the measured tables, read here line by line, against what set-ups and effects make of them."""

from importlib.resources import files

import numpy as np
import pytest

from lsst.fringe_sim.effects import EFFECTS, activate_effects, apply_to_system
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.setup import Setup, setup_names
from lsst.fringe_sim.mock.raw_frames import setup_optics
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import get_medium

WAVES = np.array([880.0, 920.0, 960.0, 1000.0, 1040.0])


def table(name: str) -> dict[str, np.ndarray]:
    """Columns of a shipped table of numbers."""
    text = files("lsst.fringe_sim").joinpath("data", "media", name).read_text()
    rows = [line.split() for line in text.splitlines() if not line.startswith("#")]
    return dict(zip(rows[0], np.array(rows[1:], dtype=float).T, strict=True))


def at(column: np.ndarray, rows: dict[str, np.ndarray]) -> np.ndarray:
    return np.array([column[rows["wavelength"] == wave].item() for wave in WAVES])


@pytest.mark.parametrize("kelvin", [100, 150, 200, 250])
def test_index_and_extinction_at_the_measured_temperatures(kelvin) -> None:
    """n: that of Green at 300 K plus the measured change; k: that of Green times the measured ratio."""
    green, cold = table("nk_Si_green2008.ecsv"), table("nk_Si_franta2017_T.ecsv")
    change = at(cold[f"n_{kelvin}K"] - cold["n_300K"], cold)
    ratio = at(cold[f"k_{kelvin}K"] / cold["k_300K"], cold)
    index = get_medium("Si").index(WAVES, float(kelvin))
    np.testing.assert_allclose(index.real, at(green["n"], green) + change, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(index.imag, at(green["k"], green) * ratio, rtol=1e-9)


def test_between_them_it_lies_on_a_smooth_curve() -> None:
    """At 173 K near a parabola through the three temperatures around it; slopes a third and two thirds of Green's."""
    cold, silicon = table("nk_Si_franta2017_T.ecsv"), get_medium("Si")
    nodes = (150.0, 200.0, 250.0)
    n, log_k = (
        np.array([at(f(cold[f"{part}_{node:.0f}K"]), cold) for node in nodes])
        for part, f in (("n", np.asarray), ("k", np.log))
    )
    at_173 = [
        np.array([np.polyval(np.polyfit(nodes, column, 2), 173.0) for column in x.T]) for x in (n, log_k)
    ]
    shift = silicon.index(WAVES, 173.0).real - silicon.index(WAVES, 200.0).real
    np.testing.assert_allclose(shift, at_173[0] - n[1], rtol=0.0, atol=3e-4)
    ratio = np.log(silicon.index(WAVES, 173.0).imag / silicon.index(WAVES, 200.0).imag)
    np.testing.assert_allclose(ratio, at_173[1] - log_k[1], rtol=0.0, atol=0.03)
    slopes = {}
    for name in ("Si", "Si_green2008"):
        low, high = (get_medium(name).index(960.0, kelvin) for kelvin in (168.0, 178.0))
        slopes[name] = (high.real - low.real) / 10.0, np.log(high.imag / low.imag) / 10.0
    assert slopes["Si_green2008"][0] / slopes["Si"][0] == pytest.approx(2.75, abs=0.1)
    assert slopes["Si_green2008"][1] / slopes["Si"][1] == pytest.approx(1.6, abs=0.05)


def test_every_set_up_has_it_and_that_of_the_paper_can_be_chosen() -> None:
    for name in setup_names():
        setup = Setup.from_name(name)
        own = {layer.medium.name for layer in setup.stack.layers if layer.medium.is_silicon}
        assert own == {"Si"}
        old = setup.with_silicon("Si_green2008").stack.indices(960.0, 173.15)
        changed = np.flatnonzero(old != setup.stack.indices(960.0, 173.15))
        assert [setup.stack.names[place] for place in changed] == ["detection", "gates", "support"]
    with pytest.raises(InputError, match="silicon"):
        Setup.from_name("ts8_e2v").with_silicon("SiO2")


@pytest.mark.parametrize(("parameter", "other"), [("franta", "Si_franta2017"), ("schinke", "Si_schinke2015")])
def test_tables_of_silicon_differ_in_all_layers_and_colours(parameter, other) -> None:
    system = Setup.from_name("ts8_e2v").optical_system()
    changed = apply_to_system(activate_effects({f"silicon_constants.{parameter}": 1.0}, EFFECTS), system)
    expected = system.stack.with_silicon(other).indices(WAVES, 183.15)
    np.testing.assert_allclose(changed.stack.indices(WAVES, 183.15), expected, rtol=1e-12)
    half = apply_to_system(activate_effects({f"silicon_constants.{parameter}": 0.5}, EFFECTS), system)
    own, middle = system.stack.indices(WAVES, 183.15)[3], half.stack.indices(WAVES, 183.15)[3]
    np.testing.assert_allclose(middle.real, 0.5 * (own + expected[3]).real, rtol=1e-12)
    np.testing.assert_allclose(middle.imag**2, own.imag * expected[3].imag, rtol=1e-12)


def test_tables_disagree_by_what_is_stated() -> None:
    """k of Franta over Green 1.26 at 850, 1.24 at 900, 1.05 at 960 and 0.97 at 1000 nm; of Schinke within 2 %."""
    own, franta, schinke = (
        get_medium(name).index([850.0, 900.0, 960.0, 1000.0], kelvin)
        for name, kelvin in (("Si", 300.0), ("Si_franta2017", 300.0), ("Si_schinke2015", 295.0))
    )
    np.testing.assert_allclose(franta.imag / own.imag, [1.26, 1.24, 1.05, 0.97], atol=0.01)
    np.testing.assert_allclose(schinke.imag / own.imag, [0.95, 0.96, 0.96, 0.97], atol=0.02)
    assert np.all(np.abs(franta.real - own.real - 0.004) < 0.001)


def test_absorption_is_scaled_in_every_layer_of_silicon() -> None:
    system = Setup.from_name("ts8_e2v").optical_system()
    more = apply_to_system(activate_effects({"silicon_absorption.scale": 1.2}, EFFECTS), system)
    before, after = (each.stack.indices(960.0, 183.15).imag for each in (system, more))
    silicon = [system.stack.position(name) for name in ("detection", "gates", "support")]
    np.testing.assert_allclose(after[silicon], 1.2 * before[silicon], rtol=1e-12)
    assert np.all(np.delete(after, silicon) == np.delete(before, silicon))


def test_the_mock_can_take_another_table() -> None:
    """Its flats are those of the model with the constants of that table, and not those of the set-up."""
    thickness = np.linspace(14.0, 14.3, 7)
    optics = setup_optics("ts8_e2v", "Si_franta2017")[0]
    for wave in (900.0, 960.0):
        flat = optics.flat_field(thickness, wave)
        same = FringeModel.from_setup("ts8_e2v", {"silicon_constants.franta": 1.0})
        np.testing.assert_allclose(flat, same.response(thickness, [wave])[0], rtol=2e-5)
        usual = setup_optics("ts8_e2v")[0].flat_field(thickness, wave)
        assert np.abs(flat / usual - 1.0).max() > 1e-3
