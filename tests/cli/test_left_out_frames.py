"""Which frames of a folder are used is said; a sensor goes with a set-up of its vendor, and gains with its place."""

from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits

from lsst.fringe_sim.algorithms.flat_prep_options import DEFAULT_OPTIONS
from lsst.fringe_sim.cli.lab_frames import LabSeries, find_series
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.setup import Setup


def change(raws: Path, pattern: str, **cards: Any) -> None:
    for file in raws.glob(pattern):
        with fits.open(file, mode="update") as hdus:
            for keyword, value in cards.items():
                if value is None:
                    del hdus[0].header[keyword]
                else:
                    hdus[0].header[keyword] = value


@pytest.mark.parametrize(
    ("cards", "told"),
    [
        ({"LSST_NUM": "E2V-CCD250-322"}, "2 bias of E2V-CCD250-322"),
        ({"IMGTYPE": "DARK"}, "2 dark of E2V-CCD250-321"),
    ],
)
def test_frames_that_are_left_out_are_said(
    raws: Path, capsys: pytest.CaptureFixture[str], cards: dict[str, str], told: str
) -> None:
    change(raws, "*_bias_*", **cards)
    series = find_series([str(raws)])
    assert (len(series.biases), len(series.flats)) == (0, 2)
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("ending", [".FITS", ".fits.bz2", ".fit"])
def test_files_named_like_frames_are_not_passed_over(raws: Path, ending: str) -> None:
    flat = next(raws.glob("*_0950_*"))
    renamed = flat.rename(flat.with_name(f"{flat.stem}{ending}"))
    with pytest.raises(InputError, match=rf"{renamed.name}.*--skip-bad"):
        find_series([str(raws)])
    assert len(find_series([str(raws)], skip_bad=True).flats) == 1


def test_other_files_beside_the_frames_are_none(raws: Path) -> None:
    for name in ("notes.txt", "a.fits.sha256", "._hidden.FITS", ".a.fits.1.part"):
        (raws / name).write_text("x", encoding="ascii")
    assert len(find_series([str(raws)]).flats) == 2


@pytest.mark.parametrize("command", ["fit", "discover"])
def test_frames_of_the_other_vendor_are_refused_before_work(
    raws: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    out = raws.parent / "out"
    assert run([command, str(raws), "--setup", "ts8_itl", "--out", str(out), "--dry-run"]) == 1
    assert "ts8_e2v" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "told"),
    [
        (("--detector", "R01_S00"), "ts8_itl"),
        (("--size", "100000x100000"), "4096x4004"),
        (("--silicon", "nosuch"), "nosuch"),
    ],
)
def test_mock_flats_are_refused_before_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: tuple[str, ...], told: str
) -> None:
    assert (
        run(["mock-flats", str(tmp_path / "m"), "--seed", "1", "--dry-run", "--size", "64x64", *option]) == 1
    )
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("place", ["R22_S11", "R11_S01"])
def test_without_a_serial_number_gains_are_those_of_the_place(raws: Path, place: str) -> None:
    raft, slot = place.split("_")
    about = {"LSST_NUM": None, "RAFTNAME": None, "CCD_MANU": None, "TSTAND": None, "INSTRUME": "LSSTCam"}
    change(raws, "*", **about, RAFTBAY=raft, SLOTNAME=slot, CCDSLOT=slot)
    series = find_series([str(raws)])
    assert isinstance(series, LabSeries)
    assert series.serial == place
    assert series.read(Setup.from_name("ts8_e2v"), DEFAULT_OPTIONS, lambda: None).detector == place


def test_an_amplifier_without_data_is_said(raws: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with fits.open(next(raws.glob("*_0950_*")), mode="update") as hdus:
        hdus["Segment12"].data[:] = 1000
    find_series([str(raws)]).read(Setup.from_name("ts8_e2v"), DEFAULT_OPTIONS, lambda: None)
    assert "950 nm: amplifiers masked whole (dead, hot or saturated): C12" in capsys.readouterr().err
