"""One run in a folder, one writer at a time, and nothing cleared but what a run of this program left."""

import fcntl
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from lsst.fringe_sim.cli.main import cli, run
from lsst.fringe_sim.cli.output import OutputFolder
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.files import refuse_unfinished
from lsst.fringe_sim.model.effects_override import ended

FRAMES = ("--size", "64x64", "--wavelengths", "900", "--bias-frames", "1", "--seed", "1")


def test_every_command_that_writes_can_replace_what_is_there() -> None:
    context = click.Context(cli)
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        options = {option for item in command.params for option in item.opts}
        assert ("--overwrite" in options) == bool({"--out", "out", "--ecsv"} & options), name


@pytest.fixture
def used(tmp_path: Path) -> Path:
    assert run(["mock-flats", str(tmp_path / "raws"), *FRAMES]) == 0
    (tmp_path / "raws" / "notes.txt").write_text("mine")
    return tmp_path / "raws"


def test_frames_of_two_runs_do_not_mix(used: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path.name: path.read_bytes() for path in used.iterdir()}
    other = ("mock-flats", str(used), "--detector", "R11_S02", *FRAMES)
    assert run(other) == 1
    said = capsys.readouterr().err
    assert "--overwrite" in said
    assert f"and {len(before) - 2} more" in said, "one is named, and the notes are no product"
    assert {path.name: path.read_bytes() for path in used.iterdir()} == before
    assert run([*other, "--overwrite"]) == 0
    left = {path.name for path in used.iterdir()}
    assert "notes.txt" in left
    assert left & set(before) == {"notes.txt"}


def test_frames_of_a_camera_are_never_cleared(used: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (real,) = used.glob("*_lambda_flat_*.fits")
    real.write_bytes(real.read_bytes().replace(b"'lsst.fringe_sim'", b"'SLAC           '"))
    before = sorted(used.iterdir())
    for dry in ([], ["--dry-run"]):
        assert run(["mock-flats", str(used), *FRAMES, "--overwrite", *dry]) == 1
        assert real.name in capsys.readouterr().err
    assert sorted(used.iterdir()) == before


def folder(path: Path, **options: bool) -> OutputFolder:
    return OutputFolder(path, ("report.html", "sky_*.fits"), **options)


def test_two_writers_at_once(tmp_path: Path) -> None:
    """The second is refused while the first is at work, and a killed one keeps nobody out."""
    code = (
        "import sys, pathlib, time; from lsst.fringe_sim.cli.output import OutputFolder;"
        f"OutputFolder(pathlib.Path({str(tmp_path)!r}), ('report.html',)).prepare();"
        "print('ready', flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"ready\n"
        with pytest.raises(ValueError, match="no other run is writing"):
            folder(tmp_path).prepare()
        first.kill()
    assert folder(tmp_path).prepare() == tmp_path


@pytest.mark.parametrize("code", [0, 1])
def test_nothing_of_the_lock_is_left(tmp_path: Path, code: int) -> None:
    """Nor of folders that were made for the run, where nothing was written into them."""
    (tmp_path / "old").mkdir()

    @click.command()
    def command() -> None:
        for name in ("old", "new/inner", "filled/inner"):
            folder(tmp_path / name).prepare()
        (tmp_path / "filled" / "notes.txt").write_text("mine")
        raise click.exceptions.Exit(code)

    assert CliRunner().invoke(command).exit_code == code
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["filled", "notes.txt", "old"]


def test_what_a_killed_writer_left_is_cleared(tmp_path: Path) -> None:
    (tmp_path / ".report.html.0123456789ab.part").write_text("half")
    (tmp_path / ".thesis.tex.0123456789ab.part").write_text("mine")
    folder(tmp_path).prepare()
    assert not list(tmp_path.glob(".report*"))
    assert list(tmp_path.glob(".thesis*"))


def test_links_are_cleared_and_not_what_they_lead_to(tmp_path: Path) -> None:
    (tmp_path / "elsewhere.html").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.html").symlink_to(tmp_path / "elsewhere.html")
    folder(tmp_path / "out", overwrite=True).prepare()
    assert not (tmp_path / "out" / "report.html").is_symlink()
    assert (tmp_path / "elsewhere.html").read_text() == "mine"


def test_frames_of_a_run_that_is_at_work_or_was_stopped_are_not_read(
    used: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A part of a series looks like a series."""
    fit = ("fit", str(used), "--out", str(used.parent / "fit"), "--dry-run")
    with (used / ".fringe-sim.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert run(fit) == 1
        assert "into which no run is writing" in capsys.readouterr().err
    assert run(fit) == 1
    assert "run it again with --overwrite" in capsys.readouterr().err.lower()
    assert run(["mock-flats", str(used), *FRAMES, "--overwrite"]) == 0
    run(fit)
    assert "number of wavelengths" in capsys.readouterr().err


@pytest.mark.parametrize("made", [("report.html",), ()])
def test_a_run_that_fails_is_told_by_its_products(tmp_path: Path, made: tuple[str, ...]) -> None:
    @click.command()
    def command() -> None:
        target = folder(tmp_path / "out").prepare()
        for name in made:
            (target / name).write_text("")
        raise KeyboardInterrupt

    CliRunner().invoke(command)
    if not made:
        refuse_unfinished([str(tmp_path)])
        return
    with pytest.raises(InputError, match="came to its end"):
        refuse_unfinished([str(tmp_path)])
    with pytest.raises(InputError, match="came to its end"):
        refuse_unfinished([str(tmp_path / "*" / "*.html")])
    refuse_unfinished([str(tmp_path / "out" / "report.html")])


def test_the_lock_of_another_run_stays(tmp_path: Path) -> None:
    """The folder was replaced while a command was at work, and another one has begun in the new one."""
    out = tmp_path / "out"

    @click.command()
    def command() -> None:
        folder(out).prepare()
        out.rename(tmp_path / "away")
        out.mkdir()
        (out / ".fringe-sim.lock").write_text("of another")

    assert CliRunner().invoke(command).exit_code == 0
    assert (out / ".fringe-sim.lock").read_text() == "of another"


def test_the_truth_of_visits_does_not_take_their_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    night, truth = str(tmp_path / "night"), tmp_path / "truth"
    visits = ("mock-visits", night, "--size", "64x64", "--seed", "1", "--dry-run", "--truth")
    assert run([*visits, night]) == 1
    assert "another folder" in capsys.readouterr().err
    truth.mkdir()
    assert run([*visits, str(truth)]) == 0
    (truth / "visit_1.fits").write_text("of an earlier run")
    assert run([*visits, str(truth)]) == 1
    assert "--overwrite" in capsys.readouterr().err


def test_an_effect_that_a_person_has_finished_is_not_cleared(tmp_path: Path) -> None:
    folder = OutputFolder(tmp_path, ("learned_effect.py",), overwrite=True)
    file = tmp_path / "learned_effect.py"
    file.write_text(ended("EFFECTS = []\n"))
    folder.refuse_used()
    file.write_text(file.read_text().replace("[]", "[Mine()]"))
    with pytest.raises(InputError, match=r"learned_effect\.py is as it was written"):
        folder.refuse_used()
    assert "Mine" in file.read_text()
