"""Pages in a real browser: no complaint, nothing fetched, readable on a desk and in a hand."""

from pathlib import Path

import numpy as np
import pytest
from astropy import units
from astropy.table import Table
from browser import check_page, open_page

from lsst.fringe_sim.report import Report
from lsst.fringe_sim.style import figure, show_image

WIDE, PHONE = 1280, 390


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that a page can hold, each wider than a phone."""
    report = Report("Fringes of one sensor", "A page with everything in it.")
    report.section("Map", "What the map shows. " * 10)
    with figure(13.0, 4.0) as made:
        for axes in made.subplots(1, 3):
            show_image(axes, np.arange(12.0).reshape(3, 4), label="thickness [µm]")
    report.figure(made, "three maps")
    report.code("fringe-sim fit raws " + "--effect bandwidth.fwhm=2.4 " * 8)
    columns = {f"quantity {k}": np.arange(3.0) * units.percent for k in range(12)}
    report.table(Table({"place": ["centre of the field", "edge", "both"], **columns}), "amplitudes")
    report.remarks([("centre", "a remark"), ("edge", "another")])
    return report.write(tmp_path_factory.mktemp("page") / "report.html")


@pytest.mark.parametrize("width", [WIDE, PHONE])
def test_page_is_readable_at_every_width(page: Path, width: int, tmp_path: Path) -> None:
    check_page(page, tmp_path, width, f"report_{width}")


def test_a_click_enlarges_a_figure_and_another_makes_it_small(page: Path, tmp_path: Path) -> None:
    with open_page(page, tmp_path, width=PHONE) as opened:
        image = "document.querySelector('figure img')"
        natural = opened.evaluate(f"{image}.naturalWidth")
        small = opened.evaluate(f"{image}.getBoundingClientRect().width")
        assert small < PHONE < natural
        opened.evaluate(f"{image}.click()")
        assert opened.evaluate(f"{image}.getBoundingClientRect().width") >= natural
        assert opened.evaluate("document.documentElement.scrollWidth") <= PHONE
        opened.evaluate(f"{image}.click()")
        assert opened.evaluate(f"{image}.getBoundingClientRect().width") == small


def test_the_check_sees_what_is_wrong(tmp_path: Path) -> None:
    """A script error, a resource from elsewhere and a line that is too long are all noticed."""
    bad = tmp_path / "bad.html"
    bad.write_text(
        '<!doctype html><p style="width: 3000px">wide</p><img src="missing.png"><script>nonsense()</script>'
    )
    with open_page(bad, tmp_path / "profile", width=PHONE, decode=False) as opened:
        assert any("nonsense" in complaint for complaint in opened.complaints)
        assert any("missing.png" in url for url in opened.fetched)
        assert opened.evaluate("document.documentElement.scrollWidth") >= 3000
