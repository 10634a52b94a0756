"""``fringe-sim challenge``: cases are kept as they come."""

from pathlib import Path

import pytest

from lsst.fringe_sim.cli.main import run


def challenge(out: Path, *options: str) -> int:
    few = ("--one", "0", "--two", "0", "--outsider", "0", "--none", "2", "--size", "32x32")
    return run(["challenge", "--out", str(out), "--seed", "3", *few, *options])


@pytest.mark.slow
def test_a_challenge_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "a"
    assert challenge(folder) == 0
    record = folder / "cases.jsonl"
    assert len(record.read_text().splitlines()) == 3
    # A run that was killed while it wrote leaves half a line.
    record.write_text(record.read_text()[:-40])
    capsys.readouterr()
    assert challenge(folder) == 0
    assert "1 of 2 cases are there from before" in capsys.readouterr().err
    assert len(record.read_text().splitlines()) == 3
    assert (folder / "challenge.html").exists()
    assert (folder / "calibration.ecsv").exists()


def test_a_record_of_another_challenge_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert challenge(tmp_path, "--none", "0") == 0
    before = (tmp_path / "cases.jsonl").read_text()
    assert challenge(tmp_path, "--seed", "4") == 1
    assert '"seed": 3' in capsys.readouterr().err
    assert challenge(tmp_path, "--setup", "ts8_itl") == 1
    assert (tmp_path / "cases.jsonl").read_text() == before
    assert challenge(tmp_path / "sky", "--setup", "lsst_e2v") == 1
    assert not (tmp_path / "sky").exists()


def test_dry_run_writes_nothing(tmp_path: Path) -> None:
    assert challenge(tmp_path / "a", "--dry-run") == 0
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("size", ["0x3", "3x0", "12"])
def test_sensors_without_pixels_are_refused_before_the_folder_is_made(
    size: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert challenge(tmp_path / "out", "--none", "1", "--size", size) == 2
    assert "is not columns x rows" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
