"""One self-contained HTML page: opens from disk, needs no network and no script."""

from __future__ import annotations

import base64
import html
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from astropy.table import Table
from matplotlib.figure import Figure

from ..files import table_text, write_whole
from ..style import to_png

__all__ = ["Report", "shortened"]

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 0 auto; padding: 1rem; color: #1b1b1b; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
.lead { color: #444; margin-top: 0; } nav a { display: inline-block; margin-right: 1.1rem; }
figure { margin: 1rem 0; } figcaption { color: #444; font-size: .92rem; }
img { box-sizing: border-box; max-width: 100%; height: auto; border: 1px solid #ddd; }
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


@dataclass
class Report:
    """A page that grows section by section.

    Parameters
    ----------
    title : `str`
        Heading of the page.
    lead : `str`
        One sentence under it.
    """

    title: str
    lead: str = ""
    _body: list[str] = field(default_factory=list, repr=False)
    _sections: list[tuple[str, str]] = field(default_factory=list, repr=False)

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
        """Add a figure; a click enlarges it. It is also written into a file, if one is named."""
        picture = to_png(made)
        if file is not None:
            write_whole(file, picture)
        data = base64.b64encode(picture).decode("ascii")
        text = html.escape(caption, quote=True)
        self._body.append(
            f'<figure><label class="zoom"><input type="checkbox"><img alt="{text}" '
            f'src="data:image/png;base64,{data}"></label><figcaption>{text}</figcaption></figure>'
        )

    def table(
        self,
        table: Table,
        name: str,
        *,
        download: Table | None = None,
        marks: Sequence[str] | None = None,
    ) -> None:
        """Add a table with its units, and a link that saves it as ECSV.

        Parameters
        ----------
        table : `astropy.table.Table`
            Few rows; numbers are shown as astropy formats them.
        name : `str`
            File name of the download, without its ending.
        download : `astropy.table.Table`, optional
            What is saved in place of ``table``, as with more columns and more digits.
        marks : sequence of `str`, optional
            One of ``good``, ``note``, ``bad``, ``void`` for every row: its colour; the last column says the same.
        """
        words = [column.dtype.kind in "US" for column in table.itercols()]
        kinds = [' class="words"' if word else "" for word in words]
        heads = "".join(
            f"<th{kind}>{html.escape(column.name)}{f' [{column.unit}]' if column.unit else ''}</th>"
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
        plain = (table if download is None else download).copy(copy_data=False)
        plain.meta.clear()  # the page says it; some readers stumble over it
        data = base64.b64encode(table_text(plain).encode()).decode("ascii")
        self._body.append(
            f'<div class="tables"><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
            f'<p><a download="{html.escape(name, quote=True)}.ecsv" '
            f'href="data:text/plain;base64,{data}">{html.escape(name)}.ecsv</a></p>'
        )

    def to_html(self) -> str:
        """The page as text."""
        links = "".join(f'<a href="#{anchor}">{html.escape(title)}</a>' for anchor, title in self._sections)
        return (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{html.escape(self.title)}</title><style>{_STYLE}</style></head><body>"
            f'<h1>{html.escape(self.title)}</h1><p class="lead">{html.escape(self.lead)}</p>'
            f"<nav>{links}</nav>{''.join(self._body)}</body></html>\n"
        )

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the page; an existing file is replaced when the new one is complete."""
        return write_whole(path, self.to_html())


def shortened(table: Table) -> Table:
    """A copy of a table whose numbers are shown with three digits."""
    shown = table.copy()
    for column in shown.itercols():
        if column.dtype.kind == "f":
            column.info.format = ".3g"
    return shown
