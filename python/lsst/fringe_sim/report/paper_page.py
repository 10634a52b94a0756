"""The page of ``fringe-sim reproduce-paper``: the paper beside its recomputation."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..paper.published import Finding
from ..paper.reproduce import Reproduction, findings_table
from ..paper.section import Graph, PaperSection, Picture
from ..style import figure, panels, show_image
from .figures import CURVE_INCH, MAP_INCH
from .page import Origin, Report
from .words import number_text

PER_ROW = 3
MANY = 5  # More panels than this are drawn small, as a gallery

STATUS_MARKS = {"agrees": "good", "erratum": "note", "differs": "bad", "skipped": "void"}
STATUS_WORDS = {"agrees": "agrees", "erratum": "paper errs", "differs": "differs", "skipped": "skipped"}


def write_paper_page(
    made: Reproduction,
    path: str | os.PathLike[str],
    notices: Sequence[str] = (),
    origin: Origin | None = None,
) -> Path:
    """Write the page.

    ``notices``: what the reader must know first, as that published curves were not at hand. ``origin``: command.
    """
    report = Report(
        "The paper, recomputed",
        "Guo, Walter, Lage & Lupton, PASP 135, 034503 (doi 10.1088/1538-3873/acbe67): every number that can be "
        "recomputed, beside the published one.",
        origin or Origin(),
    )
    open_points = [f for f in made.all_findings if f.status == "differs"]
    report.summary(_summary(made, open_points))
    report.section("All numbers")
    report.paragraph(
        '"Paper errs" means that the recomputed number confirms a correction of the paper, for the reason given. '
        '"Amplitude" is not defined in the paper; every line says which of its meanings is used.'
    )
    report.paragraph(
        '"Here" has the optical constants of silicon that the paper uses, a law extrapolated to the cold; "cold '
        'silicon" has those that were measured there.'
    )
    for notice in notices:
        report.paragraph(notice)
    _add_table(report, made.all_findings, "paper_summary", made.table())
    if open_points:
        report.section(
            "Where they differ", "Neither the paper nor a correction of it is met, within the tolerance."
        )
        _explain(report, open_points)
    for section, findings in zip(made.sections, made.findings, strict=True):
        report.section(section.title, section.text)
        for drawn in section_figures(section):
            report.figure(drawn, section.caption)
        name = f"paper_{section.title.split(':')[0].replace(' ', '_').lower()}"
        _add_table(report, findings, name, findings_table(findings))
        _explain(report, [f for f in findings if f.status != "differs"])
    return report.write(path)


def _summary(made: Reproduction, open_points: Sequence[Finding]) -> list[tuple[str, str]]:
    """How many numbers agree, and how far off the others are."""
    stated = [(f.value, 0.5 * (f.number.low + f.number.high)) for f in open_points]
    off = [abs(value / middle - 1.0) for value, middle in stated if np.isfinite(middle) and middle != 0.0]
    return [
        ("result", f"{made.summary()[0].upper()}{made.summary()[1:]}"),
        ("where they differ", ", ".join(dict.fromkeys(f.number.place for f in open_points)) or "nowhere"),
        ("largest relative difference of these", f"{number_text(100.0 * max(off), 2)} %" if off else ""),
    ]


def section_figures(section: PaperSection) -> Iterator[Figure]:
    """Panels of a section, in rows."""
    if not section.panels:
        return
    columns = min(PER_ROW, len(section.panels))
    rows = -(-len(section.panels) // columns)
    width, height = MAP_INCH if len(section.panels) > MANY else CURVE_INCH
    with figure(width * columns, height * rows) as made:
        axes = panels(made, len(section.panels), columns)
        for panel, place in zip(section.panels, axes, strict=True):
            if isinstance(panel, Picture):
                show_image(
                    place,
                    panel.values,
                    label=panel.label,
                    title=panel.title,
                    diverging=panel.diverging,
                    step_px=panel.step_px,
                )
            else:
                _draw_graph(place, panel)
        yield made


def _draw_graph(axes: Axes, graph: Graph) -> None:
    for curve in graph.curves:
        thick = {"o": {"ms": 4}, ".": {"ms": 3}}.get(curve.style, {"lw": 1.0})
        style = "o-" if curve.style == "o" and len(curve.x) > 2 and curve.label != "measured" else curve.style
        y = np.asarray(curve.y, dtype=float)
        if graph.logarithmic:
            y = np.where(y > graph.lowest, y, np.nan)
        axes.plot(curve.x, y, style, label=curve.label, **thick)
    axes.set(title=graph.title, xlabel=graph.xlabel, ylabel=graph.ylabel)
    if graph.logarithmic:
        axes.set_yscale("log")
    if len(graph.curves) > 1:
        columns = 1 + len(graph.curves) // MANY
        _leave_room(axes, -(-len(graph.curves) // columns))
        axes.legend(fontsize=7, loc="upper right", ncols=columns)


def _leave_room(axes: Axes, lines: int) -> None:
    """Extend the vertical axis so that a legend of so many lines covers no curve."""
    transform = axes.yaxis.get_transform()
    low, high = transform.transform(np.array(axes.get_ylim()))
    share = min(0.06 * lines + 0.02, 0.5)
    axes.set_ylim(top=float(transform.inverted().transform(low + (high - low) / (1.0 - share))))


def _add_table(report: Report, findings: Sequence[Finding], name: str, download: Table) -> None:
    """The few columns that a reader compares."""
    shown = Table(
        {
            "where": [f.number.place for f in findings],
            "quantity": [f.number.quantity for f in findings],
            "paper": _with_unit(findings, [f.number.stated for f in findings]),
            "here": _with_unit(findings, [f"{f.value:.4g}" for f in findings]),
            "cold silicon": _with_unit(findings, [f"{f.cold:.4g}" for f in findings]),
            "tolerance": [f"±{f.number.tolerance:g}" for f in findings],
            "corrected": [
                "" if np.isnan(f.number.corrected) else f"{f.number.corrected:g}" for f in findings
            ],
            "verdict": [STATUS_WORDS[f.status] for f in findings],
        }
    )
    report.table(shown, name, download=download, marks=[STATUS_MARKS[f.status] for f in findings])


def _with_unit(findings: Sequence[Finding], numbers: Sequence[str]) -> list[str]:
    units = (f.number.unit.replace("um", "µm").replace("uJy", "µJy").replace("-2", "⁻²") for f in findings)
    return [
        f"{number} {unit}".strip() if number not in ("–", "nan") else "–"
        for number, unit in zip(numbers, units, strict=True)
    ]


def _explain(report: Report, findings: Sequence[Finding]) -> None:
    report.remarks(
        [
            (f"{f.number.place}, {f.number.quantity}", f.number.note)
            for f in findings
            if f.number.note and f.status != "skipped"
        ]
    )
