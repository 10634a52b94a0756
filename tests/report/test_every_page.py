"""What all pages have in common: a summary first, links that lead somewhere, and room on a telephone."""

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from browser import check_page
from matplotlib import colormaps
from PIL import Image
from recorded_numbers import Record
from small_pages import SMALL_PAGES

from lsst.fringe_sim import __version__
from lsst.fringe_sim.cli.output import origin_of
from lsst.fringe_sim.report import Report
from lsst.fringe_sim.report.page import Origin
from lsst.fringe_sim.style import DIVERGING, figure, map_to_png, panels, to_pieces

PHONE = 400
Seen = Callable[[Path], dict[str, Any]]
COMMAND = "fringe-sim fit 'my raws' --out <fit>"


class Reader(HTMLParser):
    """Order of the elements of a page, texts of its summary, and addresses of its links."""

    def __init__(self) -> None:
        super().__init__()
        self.elements: list[str] = []
        self.links: list[str] = []
        self.names: list[str] = []
        self.values: list[str] = []
        self.kinds: list[str] = []
        self._into: list[str] | None = None

    def handle_starttag(self, tag, attrs) -> None:
        self.elements.append(f"{tag}.{dict(attrs).get('class', '')}".rstrip("."))
        self.links += [value for name, value in attrs if name == "href"]
        if tag in ("dt", "dd"):
            self._into = self.names if tag == "dt" else self.values
            self._into.append("")

    def handle_data(self, data) -> None:
        if self._into is not None:
            self._into[-1] += data

    def handle_endtag(self, tag) -> None:
        if tag in ("dt", "dd"):
            self._into = None


def read(path: Path) -> Reader:
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    return reader


@pytest.fixture(params=SMALL_PAGES)
def page(request: pytest.FixtureRequest, tmp_path: Path, seen: Seen) -> Path:
    """One of the pages, in a folder beside that of another page."""
    beside, folder = tmp_path / "other folder", tmp_path / request.param
    beside.mkdir()
    folder.mkdir()
    other = Report("Other & page").write(beside / "report.html")
    origin = Origin(COMMAND, origin_of(folder, [other]).pages)
    return SMALL_PAGES[request.param](folder, origin)


@pytest.mark.filterwarnings("ignore:Mean of empty slice", "ignore:All-NaN")
def test_every_page_begins_with_a_summary_and_its_links_resolve(
    page: Path, seen: Seen, recorded: Record
) -> None:
    """Its words, numbers and pictures are as recorded: nothing else draws the same pages."""
    shown = seen(page)
    reader = read(page)
    after_heading = reader.elements[reader.elements.index("h1") :]
    assert after_heading[:3] == ["h1", "p.lead", "section.summary"]
    stated = dict(zip(reader.names, reader.values, strict=True))
    assert len(stated) == len(reader.names) >= 6
    assert all(value.strip() for value in stated.values())
    assert not any(re.search(r"\bnan\b", value) for value in stated.values())
    assert __version__ in stated["version"]
    assert stated["command"] == COMMAND
    assert stated["see also"] == "Other & page"
    files = [link for link in reader.links if not link.startswith(("data:", "#"))]
    assert "../other%20folder/report.html" in files
    assert all((page.parent / unquote(link)).is_file() for link in files)
    recorded({"page": page.parent, **shown})


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Mean of empty slice", "ignore:All-NaN")
def test_every_page_fits_on_a_telephone(page: Path, tmp_path: Path) -> None:
    check_page(page, tmp_path, PHONE, f"page_{page.parent.name.replace(' ', '_')}_{PHONE}")


def test_pages_beside_what_a_command_was_given_are_found(tmp_path: Path) -> None:
    for name in ("fit", "out", "foreign"):
        (tmp_path / name).mkdir()
    Report("A <fit>").write(tmp_path / "fit" / "report.html")
    Report("itself").write(tmp_path / "out" / "report.html")
    (tmp_path / "foreign" / "report.html").write_text("<title>of another program</title>")
    given = [
        tmp_path / "fit" / "thickness.fits",
        *(tmp_path / name for name in ("fit", "out", "foreign", "gone")),
    ]
    found = origin_of(tmp_path / "out", given)
    assert found.pages == (("A <fit>", "../fit/report.html"),)
    assert found.command == "", "no command runs"


def test_panels_come_apart_as_they_were_drawn() -> None:
    with figure(6.0, 4.0, None) as made:
        shown = panels(made, 3, 2, (0.4, 0.1, 0.3, 0.3))
        for number, axes in enumerate(shown):
            axes.set_title(f"panel {number}")
            axes.set_facecolor(["#ff0000", "#00ff00", "#0000ff"][number])
    whole, pieces = to_pieces(made)
    assert [title for title, _ in pieces] == ["panel 0", "panel 1", "panel 2"]
    for number, (_, pixels) in enumerate(pieces):
        assert pixels.shape == (220, 330, 3)
        row, column = divmod(number, 2)
        np.testing.assert_array_equal(
            pixels, whole[220 * row : 220 * (row + 1), 330 * column : 330 * (column + 1)]
        )
        colour = np.eye(3, dtype=int)[number] * 255
        assert (pixels[110, 165] == colour).all()


def test_a_map_beside_the_page_has_every_pixel(tmp_path: Path) -> None:
    """First row at the bottom, zero white, masked pixels grey; beyond the ends are the colours of the ends."""
    image = np.array([[0.0, 1.0, 9.0], [-1.0, -9.0, np.nan]])
    mask = np.zeros(image.shape, np.int32)
    mask[0, 1] = 4
    (tmp_path / "map.png").write_bytes(map_to_png(image, (-1.0, 1.0), mask=mask, diverging=True))
    shown = np.asarray(Image.open(tmp_path / "map.png").convert("RGB"), dtype=int)
    assert shown.shape == (2, 3, 3)
    low, middle, high = (np.rint(255 * np.array(colormaps[DIVERGING](at)[:3])) for at in (0.0, 0.5, 1.0))
    assert np.abs(shown[1, 0] - middle).max() <= 2
    assert np.abs(shown[1, 2] - high).max() <= 1
    assert np.abs(shown[0, :2] - low).max() <= 1
    assert (shown[1, 1] == 191).all()
    assert (shown[0, 2] == 191).all()
