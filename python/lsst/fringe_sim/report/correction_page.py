"""Pages of templates from observed frames and of corrected frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

from ..algorithms.observed_frames import FrameRecord, injected_table, summary_table
from ..products import FringeTemplates
from ..style import figure, finite_range, show_image
from .page import Report, shortened
from .source_figure import bias_figure

__all__ = ["frame_figure", "write_correction_report", "write_templates_report"]

PERCENT = 100.0
MOST_PICTURES = 3


def write_templates_report(path: Path, made: Iterable[tuple[str, FringeTemplates]]) -> Path:
    """Write the page of templates, one section per sensor; they are asked for one at a time."""
    report = Report("Fringe templates", "From observed frames, sensor by sensor.")
    for name, product in made:
        report.section(
            name or "Sensor",
            f"{len(product.patterns)} templates from {len(product.scores)} frames in "
            f"{product.physical_filter or 'a filter without a name'}.",
        )
        report.figure(
            _templates_figure(product),
            "Templates in percent of the sky, and how many frames see each pixel.",
        )
        table = Table({"frame": np.arange(len(product.scores))})
        for number, scores in enumerate(product.scores.T):
            table[f"scale {number}"] = np.round(scores, 2)
        report.table(table, f"scales_{name or 'sensor'}")
    return report.write(path)


def write_correction_report(path: Path, records: Sequence[FrameRecord], refused: Sequence[str]) -> Path:
    """Write the page of a night: one row per frame, pictures of the worst and of all that were refused."""
    table = summary_table(records)
    passed = sum(each.proof.passed and each.proof.seen for each in records)
    unseen = sum(not each.proof.seen for each in records)
    left = f" {unseen} left as they are: the fringes of the templates are not seen." if unseen else ""
    report = Report(
        "Fringe correction",
        f"{passed} of {len(table) + len(refused)} images corrected.{left}",
    )
    report.section(
        "Frames",
        "Evidence of the fringes (natural logarithm; below 0 they are not seen, and the frame is left as it is); "
        "structure beyond the noise in apertures up to 20 arcsec, as a fraction of it; the fringes that are left, as "
        "a fraction of the same noise and as a part of those that were subtracted; the uniform background "
        "indicator, 0.98 for white noise; and the probability "
        "that a good template does so badly.",
    )
    if len(table):
        marks = ["good" if each.proof.passed else "bad" for each in records]
        report.table(shortened(table), "frames", download=table, marks=marks)
    _proofs(report, records)
    report.remarks([(line.partition(": ")[0], line.partition(": ")[2]) for line in refused])
    order = sorted(range(len(records)), key=lambda item: records[item].proof.probability)
    bad = [item for item in order if not records[item].proof.passed]
    chosen = (bad + [item for item in order if item not in bad])[: max(MOST_PICTURES, len(bad))]
    if chosen:
        report.section("Pictures", "Frames without background and objects, before and after.")
    for item in chosen:
        each = records[item]
        verdict = "corrected" if each.proof.passed else f"refused: {each.proof.worst}"
        verdict = verdict if each.proof.seen else "left as it is"
        report.figure(frame_figure(each), f"{each.name}: {verdict}.")
    return report.write(path)


def _proofs(report: Report, records: Sequence[FrameRecord]) -> None:
    """What remains of the fringes in correlations, and in the fluxes of sources that were drawn into copies."""
    if any(np.isfinite(each.correlation[1:]).any() for each in records):
        report.section("Correlation", "Of what is left beside background and objects, frame by frame.")
        report.figure(_correlation_figure(records), "Correlation function over the variance of a pixel.")
    sources = injected_table(records)
    if sources is not None:
        report.section(
            "Injected sources",
            "Stars and exponential discs in copies of the frames: bias and scatter of their fluxes and sizes as "
            "fractions of them, and of their ellipticities (adaptive moments), with the fringes and without. "
            "Magnitudes are those of counts, without a zero point.",
        )
        kinds = {kind: sources[sources["kind"] == kind] for kind in np.unique(sources["kind"])}
        names = {"before": "with fringes", "after": "corrected"}
        report.figure(bias_figure(names, kinds), "Bias by magnitude; a point for each frame and flux.")
        report.table(shortened(sources), "injected", download=sources)


def _correlation_figure(records: Sequence[FrameRecord]) -> Figure:
    with figure(6.5, 3.9) as made:
        axes = made.subplots()
        for row, name, colour in ((1, "before", "C1"), (2, "after", "C0")):
            for number, each in enumerate(records):
                label = name if number == 0 else None
                axes.plot(each.correlation[0], each.correlation[row], color=colour, lw=1.0, label=label)
        axes.set(xscale="log", xlabel="separation (px)", ylabel="correlation / variance of a pixel")
        axes.axhline(0.0, color="0.7", lw=0.8)
        axes.legend()
    return made


def frame_figure(record: FrameRecord) -> Figure:
    """A frame less background and objects before its correction, what was subtracted, and what is left."""
    limits = finite_range(record.pictures[0], 1.0, symmetric=True)
    with figure(13.0, 3.9) as made:
        for axes, image, title in zip(
            made.subplots(1, 3), record.pictures, ("before", "subtracted", "after"), strict=True
        ):
            show_image(
                axes,
                image,
                label="counts",
                title=title,
                diverging=True,
                limits=limits,
                step_px=record.step_px,
            )
    return made


def _templates_figure(product: FringeTemplates) -> Figure:
    count = len(product.patterns)
    with figure(4.4 * (count + 1), 3.9) as made:
        panels = np.ravel(made.subplots(1, count + 1))
        for number, axes in enumerate(panels[:count]):
            show_image(
                axes,
                PERCENT * product.patterns[number],
                mask=product.mask,
                label="percent of the sky",
                title=f"template {number}",
                diverging=True,
            )
        show_image(panels[count], product.coverage, label="frames", title="coverage")
    return made
