"""What commands understand: set-up files, units, overrides, completion; what they refuse, and in which words."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from astropy.io import fits
from click.shell_completion import BashComplete
from recorded_numbers import Record, Words

import lsst.fringe_sim
from lsst.fringe_sim.cli.inputs import read_settings, sky_settings
from lsst.fringe_sim.cli.main import cli, run
from lsst.fringe_sim.cli.parameters import EFFECT, LABORATORY, SKY
from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.raw_frame import read_raw_metadata
from lsst.fringe_sim.model.effects_override import effects_override

SETUPS = Path(lsst.fringe_sim.__file__).parent / "data" / "setups"
COMMANDS = cli.list_commands(click.Context(cli))
PROGRAM = Path(sys.executable).parent / "fringe-sim"


def command(name: str) -> click.Command:
    found = cli.get_command(click.Context(cli), name)
    assert found is not None
    return found


def options(name: str) -> set[str]:
    return {option for item in command(name).params for option in item.opts}


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_what_writes_can_be_tried_first(name: str) -> None:
    if options(name) & {"--out", "--ecsv", "out"}:
        assert "--dry-run" in options(name)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_option_is_explained(name: str) -> None:
    silent = [item.opts for item in command(name).params if isinstance(item, click.Option) and not item.help]
    assert silent == []


TOLD = (
    *("default", "is_eager", "multiple", "nargs", "required", "count"),
    *("is_flag", "expose_value", "show_default"),
)
OF_TYPE = ("min", "max", "min_open", "max_open", "exists", "file_okay", "dir_okay", "choices")


def facts(item: click.Parameter) -> str:
    """What a parameter takes: its names, its bounds, whether a path has to exist, how often it may be given."""
    values = {name: getattr(item, name, None) for name in TOLD}
    values |= {name: getattr(item.type, name, None) for name in OF_TYPE}
    plain = {
        name: value
        for name, value in values.items()
        if value and isinstance(value, bool | int | float | str | tuple)
    }
    return " ".join([*item.opts, *(f"{name}={value}" for name, value in plain.items())])


def test_what_commands_take_is_as_recorded(recorded: Record) -> None:
    recorded([Words(facts(item) for item in command(name).params) for name in sorted(COMMANDS)])


@pytest.mark.parametrize("name", sorted(name for name in COMMANDS if "--setup" in options(name)))
def test_a_set_up_may_be_a_file(name: str) -> None:
    (option,) = (item for item in command(name).params if item.name == "setup")
    assert option.make_metavar(click.Context(command(name))).startswith("NAME|FILE")
    assert "file" in option.help


@pytest.fixture
def own_setup(tmp_path: Path) -> Path:
    """A test stand of one's own: the shipped one, colder and with a wider line."""
    text = (SETUPS / "ts8_e2v.yaml").read_text(encoding="utf-8")
    assert "183.15" in text
    path = tmp_path / "my_stand.yaml"
    path.write_text(text.replace("183.15", "173.15"), encoding="utf-8")
    return path


def test_set_ups_by_name_and_by_file(own_setup: Path) -> None:
    assert LABORATORY.convert("ts8_e2v", None, None).temperature_k == 183.15
    assert LABORATORY.convert(str(own_setup), None, None).temperature_k == 173.15
    assert LABORATORY.convert(str(own_setup), None, None).name == "my_stand"
    with pytest.raises(UnknownNameError, match="did you mean ts8_e2v"):
        LABORATORY.convert("ts8_e2w", None, None)
    with pytest.raises(InputError, match="monochromator"):
        LABORATORY.convert("lsst_e2v", None, None)
    with pytest.raises(InputError, match="telescope"):
        SKY.convert(str(own_setup), None, None)
    with pytest.raises((InputError, FileNotFoundError), match=r"none\.yaml"):
        SKY.convert("none.yaml", None, None)


def test_a_stand_of_ones_own_from_raw_frames_to_header(own_setup: Path, tmp_path: Path, capsys) -> None:
    raws = tmp_path / "raws"
    made = ["mock-flats", str(raws), "--size", "64x64", "--seed", "1", "--wavelengths", "0.9um,960nm"]
    assert run([*made, "--setup", str(own_setup)]) == 0
    flat = sorted(raws.glob("*.fits"))[-1]
    assert read_raw_metadata(flat).require_temperature_k() == pytest.approx(173.15)
    assert read_raw_metadata(flat).require_wavelength_nm() == 960.0
    capsys.readouterr()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("bandwidth.fwhm=2.6", 2.6),
        ("bandwidth.fwhm=2600pm", 2.6),
        ("temperature.kelvin=-100degC", 173.15),
        ("silicon_thickness.offset=500nm", 0.5),
        ("contrast_loss.factor = 0.13", 0.13),
    ],
)
def test_effects_take_units(text: str, value: float) -> None:
    assert EFFECT.convert(text, None, None) == (text.split("=")[0].strip(), pytest.approx(value, rel=1e-12))


@pytest.mark.parametrize("text", ["bandwidth.fwhm=2.6s", "contrast_loss.factor=3nm", "nothing.at_all=3nm"])
def test_units_that_do_not_fit_are_usage_errors(text: str) -> None:
    with pytest.raises(click.BadParameter):
        EFFECT.convert(text, None, None)


def given_as_pairs() -> list[tuple[str, click.Parameter]]:
    """Parameters of all commands that take two things joined by ``=``."""
    return [(name, item) for name in COMMANDS for item in command(name).params if "=" in item.type.name]


@pytest.mark.parametrize("text", ["", "=", "R11_S01", "bandwidth.fwhm", "=1", "R11_S01=", "bandwidth.fwhm="])
def test_a_pair_without_one_of_its_parts_is_a_usage_error(text: str) -> None:
    """Of every command; the message says what was given and what is wanted."""
    pairs = given_as_pairs()
    assert {"--effect", "--thickness"} <= {option for _, item in pairs for option in item.opts}
    for name, item in pairs:
        with pytest.raises(click.BadParameter) as refused:
            item.type.convert(text, item, click.Context(command(name)))
        assert repr(text) in refused.value.message or repr(text.partition("=")[2]) in refused.value.message


def test_the_name_of_a_pair_ends_at_its_first_sign() -> None:
    """A file may have such a sign in its name."""
    (item,) = (item for name, item in given_as_pairs() if name == "focal-plane")
    found = item.type.convert("R11_S01=a=b.fits", item, None)
    assert (found.name, found.path) == ("R11_S01", Path("a=b.fits"))
    assert item.type.convert(found, item, None) == found


def test_negative_temperatures_are_no_options(tmp_path: Path, capsys) -> None:
    arguments = ["mock-flats", str(tmp_path / "raws"), "--size", "64x64", "--seed", "1", "--dry-run"]
    assert run([*arguments, "--temperature", "-100degC"]) == 0
    assert run([*arguments, "--temperature", "-100furlong"]) == 2
    assert "-100furlong" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["fit", "x", "--out", "o", "--setup", "ts8_e2w"], "did you mean ts8_e2v"),
        (["fit", "x", "--out", "o", "--effect", "bandwith.fwhm=2"], "did you mean bandwidth"),
        (["sky", "--thickness", "e2v_321", "--out", "o", "--detector", "R22_S1"], "did you mean R22_S21"),
    ],
)
def test_near_misses_are_offered(arguments: list[str], hint: str, capsys) -> None:
    assert run(arguments) == 1
    assert hint in capsys.readouterr().err


OVERRIDE = """# Effects found in laboratory flats.
config.effects["bandwidth.fwhm"] = 2.6
config.effects["roughness.sigma"] = 25.0
"""


def test_what_a_search_has_found_goes_into_fit_and_sky(tmp_path: Path, capsys) -> None:
    path = tmp_path / "effects.py"
    path.write_text(OVERRIDE, encoding="utf-8")
    settings = read_settings(path)
    assert settings == {"bandwidth.fwhm": 2.6, "roughness.sigma": 25.0}
    assert sky_settings(settings) == {"roughness.sigma": 25.0}
    assert "not taken to the sky: bandwidth" in capsys.readouterr().err
    with pytest.raises(OutOfRangeError):
        sky_settings({"bandwidth.fwhm": 1e6})
    thickness = tmp_path / "thickness.fits"
    fits.writeto(thickness, np.linspace(14.0, 15.0, 64 * 64).reshape(64, 64))
    out = tmp_path / "sky"
    arguments = ["sky", "--setup", "monocam", "--thickness", str(thickness), "--out", str(out)]
    assert run([*arguments, "--effects-file", str(path)]) == 0
    (frame,) = out.glob("*.fits")
    header = fits.getheader(frame)
    assert header["EFFECT0"] == "roughness.sigma"
    assert "EFFECT1" not in header
    image = fits.getheader(frame, 1)
    assert not [key for key in image if key.startswith("WCSNAME")]  # nobody says where 64 by 64 pixels lie


@pytest.mark.parametrize(
    "line",
    [
        "import os",
        "x = 1",
        'config.effects["bandwidth.fwhm"] = 2.0; import os',
        'config.effects["bandwidth.fwhm"] = open("executed", "w").fileno()',
        'config.effects["bandwidth.fwhm"] = ',
        'config.effects["',
        "config.effects[\"bandwidth.fwhm'] = 2.0",
        '    config.effects["bandwidth.fwhm"] = 2.0',
    ],
)
def test_overrides_with_anything_else_are_refused(line: str, tmp_path: Path) -> None:
    path = tmp_path / "effects.py"
    path.write_text(f"{OVERRIDE}{line}\n", encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        read_settings(path)
    assert caught.value.value == line.rstrip()


def test_overrides_may_be_written_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "effects.py"
    path.write_text("\n# mine\nconfig.effects['bandwidth.fwhm']=2.6  # nm\n", encoding="utf-8")
    assert read_settings(path) == {"bandwidth.fwhm": 2.6}


def test_an_override_of_a_search_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "effects.py"
    effects = {"bandwidth.fwhm": 2.3125, "roughness.sigma": 12.5, "ar_coating.scale": 1.01}
    for found in (effects, {}):
        text = effects_override(found, "ts8_e2v", "named", known={"bandwidth.fwhm": 2.0} if found else None)
        path.write_text(text)
        assert read_settings(path) == found
        for end in range(len(text) - 1):  # the last character is a line break
            path.write_text(text[:end])
            with pytest.raises(InputError, match=re.escape(str(path))):
                read_settings(path)


@pytest.mark.parametrize("name", ["effects_disk_full.py", "effects_quota.py"])
def test_what_a_full_disk_has_left_is_no_override(name: str, trials: Path, tmp_path: Path, capsys) -> None:
    path = trials / name
    assert run(["fit", "none.fits", "--effects-file", str(path), "--out", str(tmp_path / "fit")]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert name in message


def test_an_empty_settings_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    path.write_text("")
    with pytest.raises(InputError, match="empty"):
        read_settings(path)
    path.write_text("{}")
    assert read_settings(path) == {}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_a_script_of_the_shell(shell: str, capsys) -> None:
    assert run(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "_FRINGE_SIM_COMPLETE" in script
    if program := shutil.which(shell):
        done = subprocess.run([program, "-n"], input=script, text=True, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("words", "incomplete", "expected"),
    [
        ([], "fo", {"focal-plane"}),
        (["fit"], "--setu", {"--setup"}),
        (["sky", "--setup"], "ls", {"lsst_e2v", "lsst_itl"}),
        (["fit", "--setup"], "l", {"l"}),
        (["fit", "--effect"], "bandw", {"bandwidth.fwhm="}),
    ],
)
def test_commands_options_and_names_are_completed(words: list[str], incomplete: str, expected: set) -> None:
    shell = BashComplete(cli, {}, "fringe-sim", "_FRINGE_SIM_COMPLETE")
    assert {item.value for item in shell.get_completions(words, incomplete)} == expected


def test_the_program_answers_a_shell() -> None:
    asked = {"_FRINGE_SIM_COMPLETE": "bash_complete", "COMP_WORDS": "fringe-sim prov", "COMP_CWORD": "1"}
    done = subprocess.run(
        [str(PROGRAM)], env={**os.environ, **asked}, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["plain,provenance"]


def test_messages_in_a_log_have_no_colour(capsys) -> None:
    assert run(["fit", "x", "--out", "o", "--setup", "nothing"]) == 1
    assert "\x1b" not in capsys.readouterr().err


def test_messages_on_a_terminal_have_some_unless_told_otherwise(tmp_path: Path) -> None:
    """Through a pseudo-terminal, as a person sees it."""
    import pty

    for setting, coloured in (({}, True), ({"NO_COLOR": "1"}, False)):
        parent, child = pty.openpty()
        environment = {key: value for key, value in os.environ.items() if key != "NO_COLOR"} | setting
        arguments = [str(PROGRAM), "provenance", "nothing.fits"]
        done = subprocess.run(arguments, stderr=child, env=environment, cwd=tmp_path, check=False)
        os.close(child)
        text = os.read(parent, 4096).decode()
        os.close(parent)
        assert done.returncode == 1
        assert ("\x1b[" in text) is coloured
