"""Effects of one's own: from a file, from a module, from an installed package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.effects import EFFECTS, effects_from, known_effects
from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.model import FringeModel

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
    assert known_effects() == EFFECTS


def test_an_effect_of_ones_own_acts_like_any_other(tmp_path: Path) -> None:
    thickness = np.linspace(14.0, 14.3, 31)
    plain = FringeModel.from_setup("ts8_e2v").response(thickness, [960.0])
    with effects_from(written(tmp_path)) as (own,):
        assert known_effects() == (*EFFECTS, own)
        model = FringeModel.from_setup("ts8_e2v", {"delamination.gap": 240.0})
        again = plain_model = FringeModel.from_setup("ts8_e2v", {"delamination.gap": 0.0})
        assert np.abs(model.response(thickness, [960.0]) - plain).max() > 0.01
        np.testing.assert_array_equal(again.response(thickness, [960.0]), plain)
        assert plain_model.with_effects({"delamination.gap": 240.0}).effect_settings == {
            "delamination.gap": 240.0
        }
    assert known_effects() == EFFECTS
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
    ],
)
def test_what_is_no_catalogue_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(InputError, match=words), effects_from(written(tmp_path, text)):
        pass
    assert known_effects() == EFFECTS


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(written(tmp_path))
    assert run(["effects", "delamination", "--effects-from", path]) == 0
    said = capsys.readouterr().out
    assert "gap behind the adhesive" in said
    assert "bandwidth" not in said
    assert run(["effects", "delamination"]) == 1
    assert run(["effects", "--effects-from", str(tmp_path / "none.py")]) == 1
    assert "none.py" in capsys.readouterr().err


def test_what_acts_on_the_spectrum_is_of_the_sky_alone() -> None:
    """A map of the thickness does not have to know of it."""
    of_spectrum = [effect for effect in EFFECTS if effect.acts_on == "spectrum"]
    assert "flat_fringes" in {effect.name for effect in of_spectrum}
    assert all(effect.sky_only for effect in of_spectrum)
