"""Effects of one's own: from a file, from a module, from an installed package."""

from pathlib import Path

import click
import numpy as np
import pytest

from lsst.fringe_sim.cli.main import cli, run
from lsst.fringe_sim.effects import EFFECTS, LEARNED, catalogue, effects_from, known_effects
from lsst.fringe_sim.effects.catalogue import ENTRY_POINTS
from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.model.effects_override import effects_override, read_effects_override

OWN = """
from dataclasses import replace

from lsst.fringe_sim.effects.base import Parameter, PlainNullEffect
from lsst.fringe_sim.optics import Layer, get_medium


class Delamination(PlainNullEffect):
    name = "{name}"
    title = "gap behind the adhesive"
    acts_on = "stack"
    reference = "a test"
    parameters = (Parameter("gap", "nm", 0.0, (0.0, 2000.0), 50.0, "thickness of the gap"),)

    def change_system(self, system, values):
        gap = Layer("gap", get_medium("vacuum"), 1e-3 * values["gap"])
        return replace(system, stack=system.stack.with_inserted(gap, before="support"))


EFFECTS = [Delamination()]
"""


def written(folder: Path, text: str = OWN.format(name="delamination")) -> Path:
    path = folder / "my_effects.py"
    path.write_text(text)
    return path


def test_the_catalogue_of_the_package_alone() -> None:
    assert known_effects() == (*EFFECTS, *LEARNED)


def test_an_effect_of_ones_own_acts_like_any_other(tmp_path: Path) -> None:
    thickness = np.linspace(14.0, 14.3, 31)
    plain = FringeModel.from_setup("ts8_e2v").response(thickness, [960.0])
    with effects_from(written(tmp_path)) as (own,):
        assert known_effects() == (*EFFECTS, *LEARNED, own)
        model = FringeModel.from_setup("ts8_e2v", {"delamination.gap": 240.0})
        again = plain_model = FringeModel.from_setup("ts8_e2v", {"delamination.gap": 0.0})
        assert np.abs(model.response(thickness, [960.0]) - plain).max() > 0.01
        np.testing.assert_array_equal(again.response(thickness, [960.0]), plain)
        assert plain_model.with_effects({"delamination.gap": 240.0}).effect_settings == {
            "delamination.gap": 240.0
        }
    assert known_effects() == (*EFFECTS, *LEARNED)
    with pytest.raises(UnknownNameError, match="delamination"):
        FringeModel.from_setup("ts8_e2v", {"delamination.gap": 240.0})


def test_a_module_on_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path).rename(tmp_path / "module_of_own_effects.py")
    monkeypatch.syspath_prepend(tmp_path)
    with effects_from("module_of_own_effects"):
        assert known_effects()[-1].name == "delamination"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\n", "EFFECTS"),
        ("EFFECTS = [3]\n", "instances of subclasses of Effect"),
        ("EFFECTS = 3\n", "instances of subclasses of Effect"),
        ("import there_is_no_such_module\n", "there_is_no_such_module"),
        ("EFFECTS = [\n", "SyntaxError"),
        ("raise SystemExit(0)\n", "SystemExit"),
        (OWN.format(name="delamination").replace('name = "delamination"', "name = 3"), "identifier"),
        (OWN.format(name="bandwidth"), "no other effect"),
        (OWN.format(name="two words"), "identifier"),
        (OWN.format(name="delamination").replace('reference = "a test"', "pass"), "reference"),
        (
            OWN.format(name="delamination").replace(
                'reference = "a test"', "reference = property(lambda effect: 1 / 0)"
            ),
            "reference",
        ),
    ],
)
def test_what_is_no_catalogue_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(InputError, match=words), effects_from(written(tmp_path, text)):
        pass
    assert known_effects() == (*EFFECTS, *LEARNED)


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(written(tmp_path))
    assert run(["effects", "delamination", "--effects-from", path]) == 0
    said = capsys.readouterr().out
    assert "gap behind the adhesive" in said
    assert "bandwidth" not in said
    assert run(["effects", "delamination"]) == 1
    assert run(["effects", "--effects-from", str(tmp_path / "none.py")]) == 1
    assert "none.py" in capsys.readouterr().err


def test_every_command_with_effects_takes_those_of_ones_own() -> None:
    """But for the mock, whose catalogue shares no code with the model."""
    context = click.Context(cli)
    options = {
        name: {option for parameter in command.params for option in parameter.opts}
        for name in cli.list_commands(context)
        if (command := cli.get_command(context, name)) is not None
    }
    with_effects = {name for name, found in options.items() if found & {"--effect", "--effects-file"}}
    with_own = {name for name, found in options.items() if "--effects-from" in found}
    assert {"fit", "sky", "discover"} <= with_own
    assert with_effects - with_own == {"mock-flats", "mock-visits"}


def test_an_override_names_the_catalogue_that_it_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own, override = str(written(tmp_path)), tmp_path / "effects.py"
    with effects_from(own):
        text = effects_override({"delamination.gap": 120.0, "bandwidth.fwhm": 2.2}, "ts8_e2v", "named")
        assert read_effects_override(text) == {"delamination.gap": 120.0, "bandwidth.fwhm": 2.2}
    override.write_text(text)
    plan = ["plan-flats", "--wavelengths", "900,960", "--dry-run", "--effects-file", str(override)]
    assert run(plan) == 1
    assert f"--effects-from {own}" in capsys.readouterr().err
    assert run([*plan, "--effects-from", own]) == 0
    assert "Needs" not in effects_override({"bandwidth.fwhm": 2.2}, "ts8_e2v", "named")


def test_an_installed_package_offers_effects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path).rename(tmp_path / "installed_effects.py")
    info = tmp_path / "installed_effects-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: installed-effects\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[{ENTRY_POINTS}]\nours = installed_effects:EFFECTS\n")
    monkeypatch.syspath_prepend(tmp_path)
    catalogue._installed.cache_clear()
    try:
        assert known_effects()[-1].name == "delamination"
        text = effects_override({"delamination.gap": 120.0}, "ts8_e2v", "named")
    finally:
        catalogue._installed.cache_clear()
        monkeypatch.undo()
    assert known_effects() == (*EFFECTS, *LEARNED)
    with pytest.raises(InputError, match="entry point ours = installed_effects:EFFECTS"):
        read_effects_override(text)


def test_what_acts_on_the_spectrum_is_of_the_sky_alone() -> None:
    """A map of the thickness does not have to know of it."""
    of_spectrum = [effect for effect in EFFECTS if effect.acts_on == "spectrum"]
    assert "flat_fringes" in {effect.name for effect in of_spectrum}
    assert all(effect.sky_only for effect in of_spectrum)
