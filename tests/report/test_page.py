"""The report page: self-contained, readable, its tables downloadable."""

import base64
import re
from html.parser import HTMLParser

import numpy as np
from astropy import units
from astropy.table import Table

from lsst.fringe_sim.report import Report
from lsst.fringe_sim.style import figure, show_image


class Checker(HTMLParser):
    """Collects links and sources, and demands that tags are closed."""

    VOID = frozenset({"meta", "img", "input", "br"})

    def __init__(self) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag, attrs) -> None:
        if tag not in self.VOID:
            self.stack.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag) -> None:
        assert self.stack.pop() == tag


def build() -> Report:
    report = Report("Fringes of <sensor>", "A & B")
    report.summary([("answer", "it is 0.14 % < 1 %")])
    report.section("Map", "What the map shows.")
    with figure(4.0, 3.0) as made:
        show_image(made.subplots(), np.arange(12.0).reshape(3, 4), label="x [µm]")
    report.figure(made, 'thickness "map"')
    report.table(Table({"rms": [0.14, 0.04] * units.percent, "place": ["centre", "edge"]}), "amplitudes")
    return report


def test_page_is_well_formed_and_needs_no_network(tmp_path) -> None:
    text = build().write(tmp_path / "report.html").read_text(encoding="utf-8")
    checker = Checker()
    checker.feed(text)
    assert checker.stack == []
    assert checker.links
    assert all(link.startswith(("data:", "#")) for link in checker.links)
    assert "<script" not in text


def test_text_is_escaped() -> None:
    text = build().to_html()
    assert "<sensor>" not in text
    assert "A &amp; B" in text


def test_tables_come_back_from_the_link() -> None:
    text = build().to_html()
    data = re.search(r'download="amplitudes.ecsv" href="data:text/plain;base64,([^"]+)"', text)
    table = Table.read(base64.b64decode(data.group(1)).decode(), format="ascii.ecsv")
    assert list(table["rms"]) == [0.14, 0.04]
    assert table["rms"].unit == units.percent


def test_same_input_same_page_at_the_same_time(monkeypatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    assert "2023-11-14 22:13 UTC" in build().to_html()
    assert build().to_html() == build().to_html()


def test_masked_pixels_and_large_images_are_drawn() -> None:
    image = np.random.default_rng(0).normal(size=(1500, 1400))
    mask = np.zeros(image.shape, dtype=np.int32)
    mask[:700] = 1
    with figure(4.0, 3.0) as made:
        drawn = show_image(made.subplots(), image, label="x", mask=mask)
    shown = np.asarray(drawn.get_array(), dtype=float)
    assert shown.shape[0] <= 750
    assert np.isnan(shown[: shown.shape[0] // 2 - 50]).all()
