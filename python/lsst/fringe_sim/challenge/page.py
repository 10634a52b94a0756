"""The page of a challenge: what was hidden, what was named, and whether stated uncertainties hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..report.figures import CURVE_INCH
from ..report.page import Origin, Report
from ..style import LINES, SEQUENTIAL, figure, panels
from .result import VISIBLE, ChallengeResult

LARGEST_PULL = 6.0
WANTED_SHRINKAGE = 0.95
MIDDLE = 0.5  # of the colours

DECISIVE = ("one_right_class", "one_exact_where_separable", "two_right_class", "outsiders_named")
"""What the summary counts, of `ChallengeResult.summary`."""


def write_challenge_report(path: str | Path, result: ChallengeResult, origin: Origin | None = None) -> Path:
    """Write the page of a challenge; a section without cases says so."""
    kinds = ", ".join(
        f"{sum(case.kind == kind for case in result.cases)} {name}" for kind, name in _KINDS.items()
    )
    report = Report(
        "Challenge of the search for missing effects",
        f"Seed {result.seed}; cases: {kinds}.",
        origin or Origin(),
    )
    report.summary(_summary(result))
    report.table(_summary_table(result), "summary")
    report.section(
        "Names",
        "Which verdict each hidden cause led to. A name counts as right if the truth is in its class; a class has "
        "several members where the data do not tell them apart.",
    )
    if result.cases:
        report.figure(confusion_figure(result), "Hidden cause against verdict, numbers of cases.")
    if len(result.accuracy()):
        report.figure(
            accuracy_figure(result), "Single effects against the signal to noise that an oracle sees."
        )
    report.section("Numbers", "Whether uncertainties and probabilities are what they say.")
    if result.pulls().size:
        report.figure(
            pulls_figure(result), "Errors of the parameters of exact names over their uncertainties."
        )
    if len(result.calibration()):
        report.figure(
            calibration_figure(result), "How often a name is right against how probable it was said to be."
        )
    report.table(result.table(), "challenge")
    return report.write(Path(path))


_KINDS = {
    "none": "without effect",
    "one": "with one effect",
    "two": "with two effects",
    "outsider": "with a cause outside the catalogue",
}


def confusion_figure(result: ChallengeResult) -> Figure:
    """Matrix of hidden causes (single effects, none, outsiders) and verdicts; empty squares are left white.

    Numbers are those of the cases; the colour is their part of all with the same cause.
    """
    single = replace(result, cases=tuple(case for case in result.cases if case.kind != "two"))
    counts = {(_label(row["truth"]), _label(row["found"])): row["cases"] for row in single.confusion()}
    rows, columns = (sorted({pair[side] for pair in counts}) for side in (0, 1))
    matrix = np.full((max(len(rows), 1), max(len(columns), 1)), np.nan)
    for (truth, found), number in counts.items():
        matrix[rows.index(truth), columns.index(found)] = number
    with figure(3.0 + 0.28 * matrix.shape[1], 2.2 + 0.24 * matrix.shape[0]) as made:
        axes = made.subplots()
        part = matrix / np.maximum(np.nansum(matrix, axis=1, keepdims=True), 1.0)
        axes.imshow(part, cmap=SEQUENTIAL, aspect="auto", origin="upper", vmin=0.0, vmax=1.0)
        for (row, column), number in np.ndenumerate(matrix):
            if np.isfinite(number):
                ink = "black" if part[row, column] > MIDDLE else "white"
                axes.text(column, row, f"{number:.0f}", ha="center", va="center", color=ink, fontsize=8)
        axes.set_xticks(range(len(columns)), columns, rotation=90)
        axes.set_yticks(range(len(rows)), rows)
        axes.set(xlabel="verdict, or likeliest member of the named class", ylabel="hidden")
        return made


def _label(names: str) -> str:
    if names == "none":
        return "nothing"
    return "three effects" if names.count("+") > 1 else names.replace("+", " + ")


def accuracy_figure(result: ChallengeResult) -> Figure:
    """Right classes and exact names by signal to noise, and the gap that was closed."""
    single = [case for case in result.of_kind("one") if np.isfinite(case.signal_to_noise)]
    with figure(2 * CURVE_INCH[0], CURVE_INCH[1]) as made:
        names, gap = panels(made, 2, 2)
        _draw_accuracy(names, result.accuracy())
        right = [case for case in single if case.right_class and np.isfinite(case.shrinkage)]
        gap.semilogx([max(c.signal_to_noise, 1.0) for c in right], [c.shrinkage for c in right], ".", ms=5)
        gap.axhline(WANTED_SHRINKAGE, color=LINES[1], lw=1.0, label=f"wanted: {WANTED_SHRINKAGE}")
        gap.set(ylim=(0.0, 2.0), xlabel="signal to noise [1]")
        gap.set_ylabel("fall of held-out variance over the oracle's [1]")
        gap.legend(loc="lower right")
        return made


def _draw_accuracy(axes: Axes, table: Table) -> None:
    place = np.arange(len(table))
    edges = [(row["signal_to_noise_from"], row["signal_to_noise_to"]) for row in table]
    labels = [f"{low:g}–{high:g}" if np.isfinite(high) else f"above {low:g}" for low, high in edges]
    axes.bar(place - 0.2, list(table["right_class"]), 0.4, label="right class")
    axes.bar(place + 0.2, list(table["exact"]), 0.4, label="exactly that name", hatch="//", edgecolor="white")
    for k, row in enumerate(table):
        axes.text(k, 1.01, f"{row['cases']}", ha="center", va="bottom", fontsize=8)
    axes.set_xticks(place, labels)
    axes.set(ylim=(0.0, 1.12), xlabel="signal to noise [1]", ylabel="part of the cases (number above)")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.92), frameon=True)


def pulls_figure(result: ChallengeResult) -> Figure:
    """Distribution of the pulls beside the normal one."""
    pulls = np.clip(result.pulls(), -LARGEST_PULL, LARGEST_PULL)
    with figure(5.0, 3.4) as made:
        axes = made.subplots()
        edges = np.linspace(-LARGEST_PULL, LARGEST_PULL, 25)
        axes.hist(pulls, list(edges), color=LINES[0], label=f"{pulls.size} parameters")
        normal = np.exp(-0.5 * (fine := np.linspace(-LARGEST_PULL, LARGEST_PULL, 200)) ** 2) / np.sqrt(
            2.0 * np.pi
        )
        axes.plot(fine, pulls.size * (edges[1] - edges[0]) * normal, color=LINES[1], label="normal")
        axes.set(xlabel="(found − true) / σ [1]", ylabel="parameters")
        axes.legend()
        return made


def calibration_figure(result: ChallengeResult) -> Figure:
    """Part of the names that are right against their stated probability."""
    table = result.calibration()
    with figure(4.4, 4.0) as made:
        axes = made.subplots()
        axes.plot([0.0, 1.0], [0.0, 1.0], color=LINES[4], lw=1.0, label="as stated")
        axes.errorbar(
            list(table["stated"]), list(table["right"]), list(table["right_sigma"]), fmt="o", label="cases"
        )
        for row in table:
            axes.annotate(
                f"{row['cases']}",
                (row["stated"], row["right"]),
                (5, -10),
                textcoords="offset points",
                fontsize=8,
            )
        axes.set(xlim=(0.0, 1.03), ylim=(0.0, 1.1), xlabel="stated probability of the names [1]")
        axes.set_ylabel("part that is right [1]")
        axes.legend(loc="upper left")
        return made


def _summary(result: ChallengeResult) -> list[tuple[str, str]]:
    """The numbers that decide, and on what."""
    found = result.summary()
    named, null = found["false_discoveries"]
    rows = [(text, _told(found[key])) for key, text, _ in _LEVELS[1:] if key in DECISIVE and found[key][1]]
    right, of = found["named_right"]
    return [
        ("result", f"{right} of {of} names are right; {named} names in {null} cases without an effect"),
        *rows,
        ("cases", f"{len(result.cases)}"),
    ]


def _summary_table(result: ChallengeResult) -> Table:
    """What is wanted and what was reached."""
    summary = result.summary()
    rows = [(text, _told(summary[key]), wanted) for key, text, wanted in _LEVELS if key in summary]
    return Table(rows=rows, names=("what", "reached", "wanted"))


_LEVELS = (
    ("false_discoveries", "names where nothing is hidden", "at most 1 in 200"),
    ("one_right_class", f"one effect of signal to noise {VISIBLE:g} or more: right class", "98 %"),
    ("one_exact_where_separable", "of these named alone: exact", "90 %"),
    ("one_exact", "exact, classes of several members included", ""),
    ("two_right_class", "two visible effects: right classes", "95 %"),
    ("one_of_two_faint_right", "two effects, one too faint: right", ""),
    ("outsiders_named", "names for causes outside the catalogue", "none"),
    ("pulled_effects", "effects named exactly", ""),
    ("pull_mean", "pulls: mean", "0 ± 0.1"),
    ("pull_std", "pulls: width", "1.0 ± 0.15"),
    ("shrinkage_median", "gap closed, part of the oracle's, median", "0.95"),
    ("named_right", "all cases with a name: right", ""),
    ("median_seconds", "processor time of a case, median [s]", ""),
)


def _told(value: object) -> str:
    if isinstance(value, list):
        return f"{value[0]} of {value[1]}"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
