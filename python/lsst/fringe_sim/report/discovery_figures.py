"""Figures of a search for missing effects: where data and model disagree, who could explain it, what is left."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..algorithms.discovery import Verdict
from ..algorithms.discovery.verdict import MOST_CANDIDATES
from ..style import DIVERGING, LINES, color_bar, figure, panels
from .figures import CURVE_INCH

PERCENT = 100.0
SMALLEST = 1e-300  # Probabilities below this are drawn at it
CHANCE_LIMIT = 1e-3  # Chance below which a test says that there is a disagreement
LARGEST_LINEAR = 30.0  # Axes that reach beyond this are logarithmic

CANDIDATE_INCH, BAR_INCH, LEAST_BARS = (6.4, 1.2), 0.27, 3
"""Size of the figure of candidates without its bars, that of a bar, and the bars for which there is always room."""

BAR_PLACES = {1: (0.0,), 2: (-0.2, 0.2)}  # Where bars beside each other stand, by their number
HALVES = ("C1", "C0")  # Rows of amplifiers, the upper one first

CHANNELS_PER_HALF = 8

WIDE_PULL = 99.95  # From here on a number with a decimal is wider than its amplifier


def where_figure(verdict: Verdict) -> Figure:
    """Disagreement before anything is added: by wavelength, fringe phase, amplifier and test, as far as there is."""
    where = verdict.where
    known = [row for row in where.amplifier if row["sigma"] > 0.0]
    return _of_those_with_data(
        (_draw_wavelengths, where.wavelength),
        (_draw_phase, where.thickness_phase),
        (_draw_amplifiers, known),
        (_draw_tests, where.channels),
    )


def _of_those_with_data(*parts: tuple[Callable[[Axes, Any], None], Sequence[Any]]) -> Figure:
    """Panels of what can be drawn."""
    filled = [(draw, rows) for draw, rows in parts if rows]
    count, columns = len(filled), min(2, len(filled))
    with figure(columns * CURVE_INCH[0], -(-count // 2) * CURVE_INCH[1]) as made:
        for axes, (draw, rows) in zip(panels(made, count, columns), filled, strict=True):
            draw(axes, rows)
        return made


def candidates_figure(verdict: Verdict) -> Figure:
    """Fall of χ² that each effect promises, the most promising first; those that were found stand out."""
    promising = sum(item["score"] > 0.0 for item in verdict.candidates)
    shown = min(max(promising, LEAST_BARS), MOST_CANDIDATES)
    with figure(CANDIDATE_INCH[0], CANDIDATE_INCH[1] + BAR_INCH * shown) as made:
        verdict.plot(made.subplots())
        return made


def gap_figure(verdict: Verdict) -> Figure:
    """Rms of data minus model before and after, for all data and for those held out, above the noise floor.

    The second panel, step by step, is there where effects were added.
    """
    gap = verdict.gap
    count = 2 if verdict.steps else 1
    with figure(count * CURVE_INCH[0], CURVE_INCH[1]) as made:
        left, *others = panels(made, count, count)
        pairs = (("all data", gap.before, gap.after), ("held out", gap.heldout_before, gap.heldout_after))
        for place, (_, before, after) in enumerate(pairs):
            bars = [(before, LINES[4], "without the effects"), (after, LINES[1], "with the effects")]
            if not verdict.effects:
                bars = [(before, LINES[4], "unchanged model")]
            for (value, color, label), offset in zip(bars, BAR_PLACES[len(bars)], strict=True):
                left.bar(
                    place + offset, PERCENT * value, 0.36, color=color, label=label if place == 0 else None
                )
        left.axhline(PERCENT * gap.noise_floor, color="black", ls="--", lw=1, label="noise floor")
        left.set_xticks(range(len(pairs)), [name for name, _, _ in pairs])
        left.set_ylabel("rms of data − model [%]")
        finite = [value for _, *values in pairs for value in values if math.isfinite(value)]
        if finite:
            left.set_ylim(0.0, PERCENT * max(*finite, gap.noise_floor) * 1.45)
        left.legend(fontsize=8, loc="upper right")
        left.set_title("gap")
        values = [step.gap_before for step in verdict.steps[:1]] + [step.gap_after for step in verdict.steps]
        labels = ["before"] + ["+ " + " + ".join(step.added) for step in verdict.steps]
        for right in others:
            right.plot(range(len(values)), [PERCENT * value for value in values], "o-", color=LINES[0])
            right.axhline(PERCENT * gap.noise_floor, color="black", ls="--", lw=1)
            right.set_xticks(range(len(values)), [label.replace(" + ", "\n+ ") for label in labels])
            right.set(xlim=(-0.4, len(values) - 0.6), ylabel="rms of data − model [%]")
            right.set_title("step by step, on the data of the selection")
        return made


def leftover_figure(unexplained: Mapping[str, Any]) -> Figure:
    """What is left over: waveform over the fringe phase, wavelengths, spatial scales."""
    return _of_those_with_data(
        (_draw_phase, unexplained.get("thickness_phase_waveform", ())),
        (_draw_colour, unexplained.get("wavelength", ())),
        (_draw_scales, unexplained.get("spatial_power", ())),
    )


def _draw_colour(axes: Axes, rows: Sequence[Mapping[str, float]]) -> None:
    axes.plot(
        [row["wavelength_nm"] for row in rows], [PERCENT * row["variance_beyond_noise"] for row in rows], "o-"
    )
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.set(xlabel="wavelength [nm]", ylabel="variance beyond noise [% of the noise]", title="by wavelength")


def _draw_scales(axes: Axes, rows: Sequence[Mapping[str, float]]) -> None:
    axes.semilogx([row["scale_px"] for row in rows], [row["power"] for row in rows], "o-")
    axes.axhline(1.0, color="black", ls="--", lw=1, label="noise")
    axes.set(xlabel="spatial scale [px]", ylabel="power over that of noise [1]", title="by scale")
    axes.legend()


def _draw_wavelengths(axes: Axes, rows: Sequence[Mapping[str, float]]) -> None:
    axes.bar(
        [row["wavelength_nm"] for row in rows],
        [row["chi2"] / row["degrees"] for row in rows],
        width=0.7 * _step([row["wavelength_nm"] for row in rows]),
        color=LINES[0],
    )
    axes.axhline(1.0, color="black", ls="--", lw=1, label="noise alone")
    highest = max((row["chi2"] / row["degrees"] for row in rows), default=1.0)
    if highest > LARGEST_LINEAR:
        axes.set_yscale("symlog", linthresh=1.0)
    axes.set(ylim=(0.0, max(1.2, 1.25 * highest)), xlabel="wavelength [nm]")
    axes.set(ylabel="χ² of the fringe pattern / degrees [1]", title="by wavelength")
    axes.legend(fontsize=7, loc="upper left", frameon=True)


def _draw_phase(axes: Axes, rows: Sequence[Mapping[str, float]]) -> None:
    axes.errorbar(
        [row["phase"] for row in rows],
        [PERCENT * row["residual"] for row in rows],
        [PERCENT * row["sigma"] for row in rows],
        fmt="o",
        ms=4,
        capsize=2,
        color=LINES[0],
    )
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.set(xlim=(0.0, 1.0), xlabel="thickness over one fringe order [1]", ylabel="mean of data − model [%]")
    axes.set_title("by fringe phase, all wavelengths")


def _draw_amplifiers(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    found = {row["amplifier"]: row["offset"] / row["sigma"] for row in rows if row["sigma"] > 0.0}
    pulls = np.array(
        [[found.get(f"{half}{k}", np.nan) for k in range(CHANNELS_PER_HALF)] for half in HALVES], dtype=float
    )
    reach = max(3.0, float(np.nanmax(np.abs(pulls)))) if np.isfinite(pulls).any() else 3.0
    drawn = axes.imshow(pulls, cmap=DIVERGING, vmin=-reach, vmax=reach, aspect="auto", origin="upper")
    for (row, column), pull in np.ndenumerate(pulls):
        if np.isfinite(pull):
            axes.text(
                column,
                row,
                f"{HALVES[row]}{column}\n{pull:+.{1 if abs(pull) < WIDE_PULL else 0}f}",
                ha="center",
                va="center",
                fontsize=7,
                color="white" if abs(pull) > 0.6 * reach else "black",
            )
    axes.set_xticks([])
    axes.set_yticks([0, 1], ["upper half", "lower half"])
    axes.spines[:].set_visible(False)
    color_bar(axes, drawn, "offset of the amplifier [σ]")
    axes.set_title("by sixteenth of the sensor, named as LSST amplifiers")


def _draw_tests(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    place = np.arange(len(rows))
    chance = [max(_number(row["probability"]), SMALLEST) for row in rows]
    color = [LINES[1] if value < CHANCE_LIMIT else LINES[4] for value in chance]
    axes.barh(place, [-math.log10(value) for value in chance], color=color)
    axes.axvline(-math.log10(CHANCE_LIMIT), color="black", ls="--", lw=1)
    axes.set_yticks(place, [row["name"] for row in rows])
    axes.invert_yaxis()
    if max(-math.log10(value) for value in [*chance, 1.0]) > LARGEST_LINEAR:
        axes.set_xscale("symlog", linthresh=3.0)
    axes.set_xlim(left=0.0)
    axes.set(xlabel="−log₁₀ of the chance (dashed: 10⁻³) [1]", title="tests, each on its own")


def _step(values: Sequence[float]) -> float:
    """Smallest distance of neighbours."""
    steps = np.diff(np.unique(np.asarray(values, dtype=float)))
    return float(steps.min()) if steps.size else 1.0


def _number(value: float | None) -> float:
    return 1.0 if value is None or math.isnan(value) else float(value)
