"""The part of a page that shows a correction learned from what no effect explains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..algorithms.discovery import Verdict
from ..algorithms.discovery.skeleton import PHASES, patterns_of, wave_form
from ..algorithms.discovery.verdict_words import learned_text
from ..style import DIVERGING, figure, panels
from .figures import CURVE_INCH
from .page import Report

PERCENT = 100.0

SIDE = 64  # Samples along a side of a pattern that is drawn: the finest line of a correction has so many half waves

MOST_EXPOSURES = 12


def learned_figure(learned: Mapping[str, Any]) -> Figure:
    """The correction: its wave form by wavelength, or its pattern over the sensor, in percent of the counts."""
    if learned["name"] == "learned_response":
        nodes, shape = wave_form(learned["own"])
        with figure(*CURVE_INCH) as made:
            (axes,) = panels(made, 1, 1)
            edges = (-0.5 / PHASES, 1.0 - 0.5 / PHASES, nodes[0] - 5.0, nodes[-1] + 5.0)
            _show(axes, shape, "wave form", extent=edges)
            axes.set(xlabel="fringe phase [fringes]", ylabel="wavelength [nm]")
            return made
    nodes, patterns = patterns_of(learned["name"], learned["own"], SIDE)
    nodes, patterns = nodes[:MOST_EXPOSURES], patterns[:MOST_EXPOSURES]
    columns = min(4, len(patterns))
    with figure(columns * 3.0, -(-len(patterns) // columns) * 2.6) as made:
        for axes, node, pattern in zip(panels(made, len(patterns), columns), nodes, patterns, strict=True):
            title = f"{node} nm" if len(patterns) > 1 else "pattern"
            _show(axes, pattern, title, extent=(-1.0, 1.0, -1.0, 1.0))
        return made


def _show(axes: Axes, image: np.ndarray, title: str, extent: tuple[float, float, float, float]) -> None:
    reach = PERCENT * max(float(np.abs(image).max()), 1e-12)
    drawn = axes.imshow(
        PERCENT * image, cmap=DIVERGING, vmin=-reach, vmax=reach, aspect="auto", origin="lower", extent=extent
    )
    axes.set_title(title)
    axes.figure.colorbar(drawn, ax=axes, label="[%]")


def add_learned(report: Report, verdict: Verdict) -> None:
    """Say what was learned, show it, and tell how to use it; nothing where nothing was learned."""
    if not verdict.has_learned:
        return
    told = verdict.learned
    report.section(
        "What was learned",
        "A correction without a cause: no physics. It was learned from a part of the cells, and judged by others "
        "that took no part in learning.",
    )
    text = learned_text(verdict)
    report.paragraph(f"{text[0].upper()}{text[1:]}.")
    report.figure(learned_figure(told), "The correction, in percent of the counts.")
    rows = [
        ("without the correction", PERCENT * told["before_rms"]),
        ("with it", PERCENT * told["after_rms"]),
        ("noise floor", PERCENT * told["noise_floor"]),
    ]
    report.table(
        Table(rows=rows, names=("data minus model", "rms"), units=(None, "percent")), "discovery_learned"
    )
    report.paragraph(
        f"χ² of the cells that judge falls by {told['heldout_gain']:.0f}, and by {told['unseen_gain']:.0f} in those "
        "of them that no choice of effects has seen. Noise alone does as well with a chance of "
        f"{told['chance']:.2g}, counted on noise drawn on the fitted model; more than {told['false_alarms']:g} is "
        "not believed."
    )
    report.paragraph(
        "learned.py beside this page puts it into any task (-C label:learned.py); patterns of the light stay in the "
        "laboratory. learned_effect.py is the beginning of an effect: a person writes the cause into it."
    )
    if told["name"] != "learned_response":
        report.paragraph(
            "A fit uses it for data minus model alone: the thickness does not change with effects of the image."
        )
    report.code("fringe-sim fit RAWS --effects-file learned.py --out fit")
