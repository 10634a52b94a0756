"""The command line: exit status, help, near misses, types of arguments."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import click
import pytest

from lsst.fringe_sim.cli.main import cli, run
from lsst.fringe_sim.cli.parameters import EFFECT, SIZE, THICKNESS_RANGE, WAVELENGTHS, Quantity

COMMANDS = cli.list_commands(click.Context(cli))


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_explains_itself(name, capsys) -> None:
    assert run([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert "Usage: fringe-sim" in text
    assert "xample" in text, "every command shows an example"


def test_overview_lists_every_command(capsys) -> None:
    assert run(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS)
    assert {"fit", "sky", "discover", "demo", "setups", "effects"} <= set(COMMANDS)


def test_unknown_command_is_a_usage_error_with_a_hint(capsys) -> None:
    assert run(["efects"]) == 2
    assert "Did you mean effects?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "hint"),
    [
        ("template", " Did you mean templates or amplitudes?"),
        ("sets", " Did you mean setups or effects?"),
        ("setup", " Did you mean setups?"),
        ("co", ""),
    ],
)
def test_at_most_two_commands_are_proposed_and_only_near_ones(word: str, hint: str, capsys) -> None:
    assert run([word]) == 2
    assert f"There is no command '{word}'.{hint}\n" in capsys.readouterr().err


def test_unknown_option_is_a_usage_error() -> None:
    assert run(["setups", "--nonsense"]) == 2


def test_setups_as_json(capsys) -> None:
    assert run(["setups", "--json"]) == 0
    names = {row["name"] for row in json.loads(capsys.readouterr().out)}
    assert {"ts8_e2v", "bnl_ts8_e2v", "ts8_itl", "monocam", "hsc", "lsst_e2v", "lsst_itl"} <= names


def test_effects_as_json(capsys) -> None:
    assert run(["effects", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["bandwidth"]["parameters"][0]["unit"] == "nm"
    assert rows["bandwidth"]["parameters"][0]["null"] is None


def test_one_effect(capsys) -> None:
    assert run(["effects", "bandwidth"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("bandwidth ")
    assert "insulation" not in text


def test_a_name_like_no_other_brings_the_command_that_lists_them(capsys) -> None:
    assert run(["effects", "zzzzz"]) == 1
    told = capsys.readouterr().err
    assert "fringe-sim effects lists them" in told
    assert len(told) < 160


@pytest.mark.parametrize("command", ["fit", "templates"])
def test_one_error_is_one_line(command, tmp_path, capsys) -> None:
    (tmp_path / "empty").mkdir()
    assert run([command, str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "empty" in told
    assert told.count("\n") == 1


def test_internal_failures_have_their_own_status(monkeypatch, capsys) -> None:
    def broken(*args: object, **kwargs: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(cli, "main", broken)
    assert run(["setups"]) == 3
    assert "a bug" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("unit", "text", "value"),
    [
        ("nm", "960", 960.0),
        ("nm", "0.96um", 960.0),
        ("um", "14 µm", 14.0),
        ("um", "14000nm", 14.0),
        ("K", "-90degC", 183.15),
        ("K", "183.15", 183.15),
        ("s", "0.5min", 30.0),
    ],
)
def test_quantities_take_units(unit, text, value) -> None:
    assert Quantity(unit).convert(text, None, None) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("text", ["wide", "960 furlong", "12 s", "1e", ""])
def test_bad_quantities_are_usage_errors(text) -> None:
    with pytest.raises(click.BadParameter):
        Quantity("nm").convert(text, None, None)


def test_wavelength_ranges_include_the_end() -> None:
    assert WAVELENGTHS.convert("880:990:10", None, None) == tuple(float(w) for w in range(880, 991, 10))
    assert WAVELENGTHS.convert("880,0.9um", None, None) == pytest.approx((880.0, 900.0), rel=1e-12)
    assert len(WAVELENGTHS.convert("800:899.9:0.1", None, None)) == 1000
    assert WAVELENGTHS.convert("960:960:0.5", None, None) == (960.0,)


@pytest.mark.parametrize("text", ["880:990", "990:880:10", "880:990:0", "1:100000:0.1", "800:900:0.1"])
def test_bad_wavelength_ranges_are_usage_errors(text) -> None:
    with pytest.raises(click.BadParameter):
        WAVELENGTHS.convert(text, None, None)


def test_ranges_of_a_thickness() -> None:
    assert THICKNESS_RANGE.convert("0.5:600nm", None, None) == pytest.approx((0.5, 0.6))
    assert THICKNESS_RANGE.convert((7.0, 15.0), None, None) == (7.0, 15.0)
    for text in ("0:1", "1:1", "2:1", "-1:1", "1:2:3", "1"):
        with pytest.raises(click.BadParameter):
            THICKNESS_RANGE.convert(text, None, None)


@pytest.mark.parametrize("text", ["0x5", "5x0", "5x5x5", "x5", "5x", "axb", "5,5"])
def test_sizes_without_two_sides_are_usage_errors(text: str) -> None:
    assert SIZE.convert("1x1", None, None) == (1, 1)
    with pytest.raises(click.BadParameter):
        SIZE.convert(text, None, None)


def test_sizes_and_effects() -> None:
    assert SIZE.convert("512x256", None, None) == (512, 256)
    assert EFFECT.convert("bandwidth.fwhm=2.4", None, None) == ("bandwidth.fwhm", 2.4)
    with pytest.raises(click.BadParameter):
        SIZE.convert("512", None, None)
    with pytest.raises(click.BadParameter):
        EFFECT.convert("bandwidth=2.4", None, None)


def in_a_process(program: str, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """Run a command that does something else in place of ``setups``."""
    start = (
        "import click, os, signal\n"
        "from lsst.fringe_sim.cli import catalogue\nfrom lsst.fringe_sim.cli.main import main\n"
        f"@click.command()\ndef setups():\n    {program}\n"
        "catalogue.setups = setups\nmain(['setups'])"
    )
    return subprocess.run(
        [sys.executable, "-c", start], capture_output=True, check=False, env={**os.environ, **environment}
    )


@pytest.mark.parametrize("encoding", ["latin-1", "ascii", "utf-8"])
def test_a_terminal_that_lacks_a_letter_ends_no_command(encoding: str) -> None:
    done = in_a_process("click.echo('σ = 1 µm'); click.echo('σ', err=True)", PYTHONIOENCODING=encoding)
    assert done.returncode == 0, done.stderr
    assert b"= 1" in done.stdout
    assert b"Traceback" not in done.stderr


def test_ctrl_c_is_one_line_and_status_130() -> None:
    done = in_a_process("os.kill(os.getpid(), signal.SIGINT)")
    assert done.returncode == 130
    assert done.stderr.split() == [b"Stopped."]
