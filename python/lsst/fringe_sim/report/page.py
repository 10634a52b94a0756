"""One self-contained HTML page: opens from disk, needs no network and no script.

A page begins with a summary, which is read in half a minute. Its figures are cut into their panels, which stand side
by side as far as the window is wide.
"""

from __future__ import annotations

import base64
import html
import os
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure
from numpy.typing import NDArray

from .. import __version__
from ..files import table_text, write_whole
from ..style import finite_range, map_to_png, pixels_to_png, to_pieces
from .words import number_text

GENERATOR = '<meta name="generator" content="lsst.fringe_sim">'
HEAD_LENGTH = 1000  # What pages of this program say in their beginning, and the length of it
PHONE_PX = 380  # Pictures that are wider do not fit into the smallest windows, where a click enlarges them
MAP_STEP = 5  # Pixels between those that decide the colours of a whole map
SMALLEST_SCALE = 0.9  # Panels are put side by side as long as none is drawn smaller than this

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 0 auto; padding: 1rem; color: #1b1b1b; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
.lead { color: #444; margin-top: 0; } nav a { display: inline-block; margin-right: 1.1rem; }
figure { margin: 1rem 0; } figcaption { color: #444; font-size: .92rem; }
img { box-sizing: border-box; max-width: 100%; height: auto; }
.panels { display: grid; gap: .2rem; align-items: start; }
.summary { border: 1px solid #bbb; border-left: 6px solid #0072b2; padding: .2rem 1rem .6rem; margin: 1rem 0; }
.summary dl { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 15rem), 1fr)); }
.summary dl { gap: .1rem 1.4rem; margin: 0; }
.summary dl > div { margin: .25rem 0; } .summary dl > .all { grid-column: 1 / -1; }
.summary dt { font-size: .82rem; color: #555; } .summary dd { margin: 0; overflow-wrap: anywhere; }
.summary .answer dd { font-size: 1.2rem; font-weight: 600; } .summary .made dd { font-size: .88rem; }
.zoom input { position: absolute; opacity: 0; } .zoom { display: block; overflow-x: auto; cursor: zoom-in; }
.zoom input:checked + img { max-width: none; cursor: zoom-out; }
.zoom input:focus-visible + img { outline: 3px solid #0072b2; }
pre { overflow-x: auto; background: #f5f5f5; padding: .6rem; font-size: .85rem; }
.tables { overflow-x: auto; }
table { border-collapse: collapse; font-size: .92rem; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th:first-child, td:first-child, .words { text-align: left; }
td.words { white-space: normal; min-width: 4.5rem; max-width: 26rem; }
td.mark { white-space: nowrap; } tr.good td.mark { color: #00634a; } tr.note td.mark { color: #0060a0; }
tr.bad td { background: #fff1e5; } tr.bad td.mark { color: #a03c00; font-weight: 600; } tr.void td { color: #767676; }
.small { font-size: .92rem; color: #333; }
@media (max-width: 40rem) { body { padding: .7rem; } th, td { padding: .2rem .4rem; } td.words { max-width: 11rem; } }
"""


@dataclass(frozen=True)
class Origin:
    """Line that was typed (empty if none was), and title and relative address of other pages."""

    command: str = ""
    pages: tuple[tuple[str, str], ...] = ()


@dataclass
class Report:
    """A page that grows section by section.

    Parameters
    ----------
    title : `str`
        Heading of the page.
    lead : `str`
        One sentence under it.
    origin : `Origin`
        Command, and pages that belong to this one.
    """

    title: str
    lead: str = ""
    origin: Origin = field(default_factory=Origin)
    _summary: str = field(default="", repr=False)
    _body: list[str] = field(default_factory=list, repr=False)
    _sections: list[tuple[str, str]] = field(default_factory=list, repr=False)

    def summary(self, rows: Sequence[tuple[str, str]]) -> None:
        """State what a reader wants to know first; the version, the date and the command are added.

        ``rows``: what is stated, and the value with its unit, as text. The first is the answer, a sentence. Rows
        without a value are left out.
        """
        made = [
            ("version", f"lsst.fringe_sim {__version__}"),
            ("date", time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(_now_s()))),
            ("command", self.origin.command),
        ]
        kinds = ["all answer", *[""] * (len(rows) - 1), "made", "made", "all made"]
        self._summary = "".join(
            f'<div class="{kind}"><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>'
            for kind, (name, value) in zip(kinds, [*rows, *made], strict=True)
            if value
        )

    def section(self, title: str, text: str = "") -> None:
        """Begin a section with a paragraph of plain text."""
        anchor = f"s{len(self._sections) + 1}"
        self._sections.append((anchor, title))
        self._body.append(f'<h2 id="{anchor}">{html.escape(title)}</h2>')
        if text:
            self.paragraph(text)

    def paragraph(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._body.append(f"<p>{html.escape(text)}</p>")

    def remarks(self, items: Sequence[tuple[str, str]]) -> None:
        """Add a list of remarks, each a subject and a text; nothing if there are none."""
        if items:
            lines = "".join(f"<li><b>{html.escape(one)}</b>: {html.escape(two)}</li>" for one, two in items)
            self._body.append(f'<ul class="small">{lines}</ul>')

    def code(self, text: str) -> None:
        """Add lines to be typed."""
        self._body.append(f"<pre>{html.escape(text)}</pre>")

    def figure(self, made: Figure, caption: str, file: Path | None = None) -> None:
        """Add a figure, whose panels stand side by side where there is room; it may go into a file as a whole."""
        whole, pieces = to_pieces(made)
        if file is not None:
            write_whole(file, pixels_to_png(whole))
        text = html.escape(caption, quote=True)
        least = int(SMALLEST_SCALE * min(pixels.shape[1] for _, pixels in pieces))
        shown = "".join(_picture(pixels, f"{caption} {title}".strip()) for title, pixels in pieces)
        columns = f"repeat(auto-fill, minmax(min(100%, {least}px), 1fr))"
        self._body.append(
            f'<figure><div class="panels" style="grid-template-columns: {columns}">{shown}</div>'
            f"<figcaption>{text}</figcaption></figure>"
        )

    def map(
        self,
        file: Path,
        image: NDArray[np.floating],
        *,
        mask: NDArray[Any],
        unit: str,
        diverging: bool = False,
    ) -> None:
        """Write a map with all its pixels into a file beside the page, and add a link to it.

        ``image``, ``mask`` (ny, nx): the map in ``unit``, and where it is not to be shown. ``diverging``: its zero is
        the middle of the colours.
        """
        some = np.where(mask[::MAP_STEP, ::MAP_STEP] == 0, image[::MAP_STEP, ::MAP_STEP], np.nan)
        low, high = finite_range(some, symmetric=diverging)
        write_whole(file, map_to_png(image, (low, high), mask=mask, diverging=diverging))
        rows, columns = image.shape
        self.link(
            file.name, file.name, f": {columns} × {rows} px, colours from {low:.3g} to {high:.3g} {unit}."
        )

    def link(self, address: str, text: str, after: str = "", before: str = "") -> None:
        """Add a link to a file beside or below the page, and what is said of it."""
        words = f"{html.escape(before)}{_link(address, text)}{html.escape(after)}"
        self._body.append(f'<p class="small">{words}</p>')

    def table(
        self, table: Table, name: str, *, download: Table | None = None, marks: Sequence[str] | None = None
    ) -> None:
        """Add a table with its units, and a link that saves it as ECSV.

        Parameters
        ----------
        table : `astropy.table.Table`
            Few rows. Three digits are shown of numbers for which no format is set.
        name : `str`
            File name of the download, without its ending.
        download : `astropy.table.Table`, optional
            What is saved in place of ``table``, as with more columns and more digits.
        marks : sequence of `str`, optional
            One of ``good``, ``note``, ``bad``, ``void`` for every row: its colour; the last column says the same.
        """
        plain = (table if download is None else download).copy(copy_data=False)
        plain.meta.clear()  # the page says it; some readers stumble over it
        table = table.copy(copy_data=False)
        for column in table.itercols():
            if column.dtype.kind == "f" and not column.info.format:
                column.info.format = number_text
        words = [column.dtype.kind in "US" for column in table.itercols()]
        kinds = [' class="words"' if word else "" for word in words]
        heads = "".join(
            f"<th{kind}>{html.escape(column.name.replace('_', ' '))}{f' [{column.unit}]' if column.unit else ''}</th>"
            for column, kind in zip(table.itercols(), kinds, strict=True)
        )
        if marks is not None and kinds:
            kinds[-1] = ' class="words mark"'
        cells = zip(
            *(column.pformat(show_name=False, show_unit=False, max_lines=-1) for column in table.itercols()),
            strict=True,
        )
        rows = "".join(
            (f'<tr class="{mark}">' if mark else "<tr>")
            + "".join(
                f"<td{kind}>{html.escape(str(cell))}</td>" for cell, kind in zip(row, kinds, strict=True)
            )
            + "</tr>"
            for row, mark in zip(cells, marks or [""] * len(table), strict=True)
        )
        data = base64.b64encode(table_text(plain).encode()).decode("ascii")
        self._body.append(
            f'<div class="tables"><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
            f'<p><a download="{html.escape(name, quote=True)}.ecsv" '
            f'href="data:text/plain;base64,{data}">{html.escape(name)}.ecsv</a></p>'
        )

    def to_html(self) -> str:
        """The page as text."""
        links = "".join(f'<a href="#{anchor}">{html.escape(title)}</a>' for anchor, title in self._sections)
        others = ", ".join(_link(address, title) for title, address in self.origin.pages)
        if others:
            others = f'<div class="all"><dt>see also</dt><dd>{others}</dd></div>'
        summary = self._summary + others
        if summary:
            summary = f'<section class="summary" aria-label="Summary"><dl>{summary}</dl></section>'
        return (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"{GENERATOR}"
            f"<title>{html.escape(self.title)}</title><style>{_STYLE}</style></head><body>"
            f'<h1>{html.escape(self.title)}</h1><p class="lead">{html.escape(self.lead)}</p>'
            f"{summary}<nav>{links}</nav>{''.join(self._body)}</body></html>\n"
        )

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the page; an existing file is replaced when the new one is complete."""
        return write_whole(path, self.to_html())


def title_of(path: Path) -> str:
    """Title of a page that was written here; empty where there is none."""
    try:
        with path.open(encoding="utf-8", errors="replace") as stream:
            head = stream.read(HEAD_LENGTH)
    except OSError:
        return ""
    found = re.search(r"<title>(.*?)</title>", head)
    return html.unescape(found[1]) if found and GENERATOR in head else ""


def _picture(pixels: NDArray[np.uint8], text: str) -> str:
    """A picture in the page; where it may be too wide, a click enlarges it."""
    height, width, _ = pixels.shape
    data = base64.b64encode(pixels_to_png(pixels)).decode("ascii")
    shown = (
        f'<img alt="{html.escape(text, quote=True)}" width="{width}" height="{height}" '
        f'src="data:image/png;base64,{data}">'
    )
    if width <= PHONE_PX:
        return shown
    return f'<label class="zoom"><input type="checkbox">{shown}</label>'


def _link(address: str, text: str) -> str:
    return f'<a href="{quote(address)}">{html.escape(text)}</a>'


def _now_s() -> float:
    """Time of the clock [s], or that of https://reproducible-builds.org/specs/source-date-epoch."""
    stated = os.environ.get("SOURCE_DATE_EPOCH", "")
    return float(stated) if stated.isdecimal() else time.time()
