"""``fringe-sim reproduce-paper``: page, table, notices; the numbers themselves where the curves are at hand."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from astropy.table import Table

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.paper import published_numbers

CHECKOUT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("FRINGE_SIM_SHARED", CHECKOUT.parent / "shared"))

OPEN = {
    "absorption_level",
    "pixel_contrast",
    "flat_detection",
    "flat_measured",
    "hsc",
    "silicon_change",
    "over_limit",
}
"""Where neither the paper nor a correction is met; each has a reason in the table."""

NOISY = {"coadd_800", "hsc"}
"""Depend on random fields; judged at the full number of exposures only."""


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """The command at reduced size, with published curves where they are at hand."""
    folder = tmp_path_factory.mktemp("paper")
    options = ["--published", str(SHARED)] if (SHARED / "measured").is_dir() else []
    assert (
        run(["reproduce-paper", "--out", str(folder), "--size", "512x501", "--coadds", "60", *options]) == 0
    )
    return folder


@pytest.mark.slow
def test_every_number_of_the_table_is_recomputed_or_skipped(out) -> None:
    table = Table.read(out / "paper.ecsv")
    assert sorted(table["item"]) == sorted(published_numbers())
    assert set(table["status"]) <= {"agrees", "erratum", "differs", "skipped"}
    if (SHARED / "measured").is_dir():
        assert "skipped" not in set(table["status"])


@pytest.mark.slow
def test_only_the_open_questions_differ(out) -> None:
    table = Table.read(out / "paper.ecsv")
    differing = set(table["item"][table["status"] == "differs"]) - NOISY
    assert differing <= OPEN - NOISY
    assert all(published_numbers()[item].note for item in OPEN), "every miss has a reason"
    confirmed = set(table["item"][table["status"] == "erratum"])
    assert {"order_adhesive", "spacing_adhesive", "limit_30", "walk_pixel"} <= confirmed


@pytest.mark.slow
def test_page_shows_figures_and_verdicts(out) -> None:
    text = (out / "paper.html").read_text(encoding="utf-8")
    assert text.count("<figure>") >= 15
    assert "paper errs" in text
    assert "Where they differ" in text
    assert 'download="paper_summary.ecsv"' in text


def test_dry_run_writes_nothing(tmp_path, capsys) -> None:
    assert run(["reproduce-paper", "--out", str(tmp_path / "paper"), "--dry-run"]) == 0
    assert "would recompute" in capsys.readouterr().out
    assert not (tmp_path / "paper").exists()


@pytest.mark.parametrize("size", ["10x10", "9000x100"])
def test_sizes_are_checked_before_work(size, tmp_path, capsys) -> None:
    assert run(["reproduce-paper", "--out", str(tmp_path / "paper"), "--size", size]) == 1
    assert "--size" in capsys.readouterr().err


def test_a_folder_without_curves_is_refused(tmp_path, capsys) -> None:
    (tmp_path / "empty").mkdir()
    arguments = ["reproduce-paper", "--out", str(tmp_path / "paper"), "--published", str(tmp_path / "empty")]
    assert run(arguments) == 1
    assert "measured" in capsys.readouterr().err
