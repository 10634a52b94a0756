"""``fringe-sim reproduce-paper``: page, table, notices; the numbers themselves where the curves are at hand."""

import os
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.paper import published_numbers
from lsst.fringe_sim.paper.optics import FIELDS, _light_path
from lsst.fringe_sim.paper.section import Curve, Graph, PaperSection, Picture
from lsst.fringe_sim.report.paper_page import section_figures

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
    "row_ratio",
    "lines_strength",
    "red_bands",
    "walk_slips_foreign",
}
"""Where neither the paper nor a correction is met; each has a reason in the table."""

NOISY = {"coadd_800", "hsc", "hsc_frame"}
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


def test_curves_are_taken_from_the_first_folder_that_has_some(tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "shared" / "measured").mkdir(parents=True)
    (tmp_path / "elsewhere" / "measured").mkdir(parents=True)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.delenv("FRINGE_SIM_SHARED", raising=False)
    arguments = ["reproduce-paper", "--out", str(tmp_path / "paper"), "--dry-run"]
    assert run(arguments) == 0
    assert "compared with curves in ../shared" in capsys.readouterr().out
    monkeypatch.setenv("FRINGE_SIM_SHARED", str(tmp_path / "elsewhere"))
    assert run(arguments) == 0
    assert "elsewhere" in capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FRINGE_SIM_SHARED", str(tmp_path / "work"))
    assert run(arguments) == 0
    assert "without published curves" in capsys.readouterr().out


def test_logarithmic_graphs_leave_out_what_cannot_be_drawn() -> None:
    x = np.arange(4.0)
    faint = Curve(x, np.array([1.0, 1e-9, -1.0, 2.0]), "faint")
    section = PaperSection("s", "", {}, (Graph("g", "x [px]", "y [1]", (faint, faint), True, 1e-6),))
    (made,) = section_figures(section)
    drawn = np.asarray(made.axes[0].lines[0].get_ydata(), dtype=float)
    assert np.array_equal(np.isnan(drawn), [False, True, True, False])
    assert made.axes[0].get_ylim()[1] > 2.2, "the legend has room above the curves"


def test_light_path_ends_at_one_place_of_the_focal_plane() -> None:
    """Figure 9: the tangent of the field angle times 10.31 m away from the axis; mirrors three, lenses, filter."""
    for field_deg, label in FIELDS:
        path = _light_path(field_deg, label)
        rays = np.split(np.stack([path.x, path.y], axis=1), np.flatnonzero(np.isnan(path.x)) + 1)[:-1]
        ends = np.array([ray[-2] for ray in rays])
        assert len(rays) > 10
        np.testing.assert_allclose(ends[:, 0], 10.31 * np.tan(np.deg2rad(field_deg)), atol=3e-3)
        assert np.ptp(ends[:, 0]) < 2e-4
        assert all(np.count_nonzero(np.diff(np.sign(np.diff(ray[:-1, 1])))) == 3 for ray in rays)


def test_pictures_of_a_thinned_sensor_have_its_pixels_on_their_axes() -> None:
    section = PaperSection("s", "", {}, (Picture("map", "µm", np.ones((50, 40)), step_px=4.0),))
    (made,) = section_figures(section)
    assert made.axes[0].images[0].get_extent() == [-0.5, 159.5, -0.5, 199.5]


def test_a_folder_without_curves_is_refused(tmp_path, capsys) -> None:
    (tmp_path / "empty").mkdir()
    arguments = ["reproduce-paper", "--out", str(tmp_path / "paper"), "--published", str(tmp_path / "empty")]
    assert run(arguments) == 1
    assert "measured" in capsys.readouterr().err
