"""``fringe-sim plan-flats``."""

import json

import numpy as np
import pytest
from astropy.table import QTable
from recorded_numbers import Record

from lsst.fringe_sim.cli.main import run

SHORT = [
    "--thickness",
    "9um:10um",
    "--search",
    "8:11",
    "--wavelengths",
    "880:990:22",
    "--candidates",
    "890:990:50",
]


def test_table(capsys, tmp_path, recorded: Record) -> None:
    """Its numbers are those of a record."""
    path = tmp_path / "plan.ecsv"
    assert run(["plan-flats", *SHORT, "--ecsv", str(path)]) == 0
    text = capsys.readouterr().out
    assert "Δχ²" in text
    assert "next flat" in text
    assert "ambiguous" in text.lower()
    table = QTable.read(path)
    assert table["thickness"].unit == "um"
    assert table["sigma"].unit == "nm"
    assert table["rival"].unit == "um"
    assert np.all(table["sigma"].value > 0)
    recorded({"table": path, "said": text.splitlines()})


def test_json_and_units(capsys, recorded: Record) -> None:
    """The same in other units, and as recorded."""
    assert run(["plan-flats", *SHORT, "--json", "--electrons", "20000"]) == 0
    plain = json.loads(capsys.readouterr().out)
    other = ["--thickness", "9000nm:10000nm", "--search", "8:11um", "--wavelengths", "0.88um:0.99um:22nm"]
    assert run(["plan-flats", *other, "--candidates", "890:990:50", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["forecast"]["worst"] == pytest.approx(
        plain["forecast"]["worst"]
    )
    assert len(plain["next"]) == 6
    recorded(plain)
    assert plain["forecast"]["region_px"] == 64


def test_dry_run_writes_nothing(capsys, tmp_path) -> None:
    path = tmp_path / "plan.ecsv"
    assert run(["plan-flats", *SHORT, "--ecsv", str(path), "--dry-run"]) == 0
    assert "would" in capsys.readouterr().out
    assert not path.exists()


def test_bad_arguments(capsys) -> None:
    assert run(["plan-flats", "--thickness", "10:9"]) == 2
    assert run(["plan-flats", "--setup", "lsst_e2v"]) == 1
    assert "monochromator" in capsys.readouterr().err
    assert run(["plan-flats", "--setup", "ts8_e2v", "--thickness", "9:10", "--search", "9.5:11"]) == 1


def test_nyquist_thickness_of_the_paper_is_stated(capsys) -> None:
    """Steps of 10 nm are too wide beyond about 14 um of adhesive."""
    ten = ["--wavelengths", "880:990:10", "--candidates", "890:990:50"]
    assert run(["plan-flats", "--thickness", "13:15um", "--search", "12:16um", *ten, "--json"]) == 0
    limit = json.loads(capsys.readouterr().out)["nyquist_um"]
    assert len(limit) == 11
    assert limit[0] == pytest.approx(1e-3 / (4 * 1.6 * (1 / 880 - 1 / 890)), rel=1e-6)
    assert np.mean(limit) == pytest.approx(14.0, abs=0.5)
    assert run(["plan-flats", "--thickness", "13:15um", "--search", "12:16um", *ten]) == 0
    assert "below the Nyquist rate for layers thicker than 12.2 to 15.2 µm" in capsys.readouterr().out
    assert run(["plan-flats", *SHORT]) == 0
    assert "Nyquist" in capsys.readouterr().out
