"""Pages of templates from observed frames and of corrected frames."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from ..algorithms.observed_frames import FrameRecord, injected_table, summary_table
from ..products import FringeTemplates
from ..style import figure, finite_range, show_image
from .figures import CURVE_INCH, map_row
from .page import Origin, Report
from .source_figure import bias_figure
from .words import measured_text, of_sensor, span_text

PERCENT = 100.0
MOST_PICTURES = 3


def write_templates_report(
    path: Path, made: Iterable[tuple[str, FringeTemplates]], origin: Origin | None = None
) -> Path:
    """Write the page of templates, one section per sensor; they are asked for one at a time."""
    report = Report("Fringe templates", "From observed frames, sensor by sensor.", origin or Origin())
    facts: list[_Facts] = []
    for name, product in made:
        report.section(
            name or "Sensor",
            f"{len(product.patterns)} templates from {len(product.scores)} frames in "
            f"{product.physical_filter or 'a filter without a name'}. A pixel is seen by "
            f"{span_text(product.coverage)} of them.",
        )
        report.figure(_templates_figure(product), "Templates, and how many frames see each pixel.")
        table = Table({"frame": np.arange(len(product.scores))})
        for number, scores in enumerate(product.scores.T):
            table[f"scale {number}"] = scores
        report.table(table, f"scales_{name or 'sensor'}")
        facts.append(_facts(name or "one sensor", product))
    report.summary(_summary_of_templates(facts))
    return report.write(path)


class _Facts(NamedTuple):
    """Numbers of the templates of a sensor."""

    name: str
    templates: int
    frames: int
    rms: float  # of the first template, part of the sky
    sigma: float  # median of a pixel of it
    masked: float  # part of the pixels
    size: str
    per_sky: bool


def _facts(name: str, product: FringeTemplates) -> _Facts:
    good = product.mask == 0
    rms, variance = float(product.patterns[0][good].std()), float(np.median(product.variance[0][good]))
    size = of_sensor(product.mask.shape, None)
    frames, count = product.scores.shape
    return _Facts(name, count, frames, rms, math.sqrt(variance), float((~good).mean()), size, product.per_sky)


def _summary_of_templates(facts: Sequence[_Facts]) -> list[tuple[str, str]]:
    """What was made, from the least to the most over the sensors."""
    who = facts[0].name if len(facts) == 1 else f"{len(facts)} sensors"
    column = {
        name: [getattr(each, name) for each in facts]
        for name in ("templates", "frames", "rms", "sigma", "masked")
    }
    sky = all(each.per_sky for each in facts)
    unit = "% of the sky" if sky else "in the unit of the frames, whose sky was subtracted"
    text = {name: span_text((PERCENT if sky else 1.0) * np.array(column[name])) for name in ("rms", "sigma")}
    return [
        ("result", f"{span_text(column['templates'])} fringe templates of {who}"),
        ("frames", span_text(column["frames"])),
        ("first template, rms", f"{text['rms']} {unit}"),
        ("median σ of a pixel of it", f"{text['sigma']} {unit}"),
        ("masked", f"{span_text(PERCENT * np.array(column['masked']))} % of the pixels"),
        ("part of the sensor", ", ".join(dict.fromkeys(each.size for each in facts))),
    ]


def write_correction_report(
    path: Path, records: Sequence[FrameRecord], refused: Sequence[str], origin: Origin | None = None
) -> Path:
    """Write the page of a night: one row per frame, pictures of the worst and of all that were refused."""
    table = summary_table(records)
    report = Report(
        "Fringe correction", f"{len(table) + len(refused)} images of observed frames.", origin or Origin()
    )
    report.summary(_summary(records, refused))
    report.section(
        "Frames",
        "Evidence of the fringes: natural logarithm; below 0 they are not seen, and the frame is left as it is. "
        "Fringes: rms of what was subtracted. Structure: beyond the noise in apertures up to 20 arcsec, over it. "
        "Left: part of the fringes that is left. Probability: that a good template does so badly.",
    )
    if len(table):
        marks = ["good" if each.proof.passed else "bad" for each in records]
        report.table(_shown(records), "frames", download=table, marks=marks)
    report.remarks([(line.partition(": ")[0], line.partition(": ")[2]) for line in refused])
    _proofs(report, records)
    order = sorted(range(len(records)), key=lambda item: records[item].proof.probability)
    bad = [item for item in order if not records[item].proof.passed]
    chosen = (bad + [item for item in order if item not in bad])[: max(MOST_PICTURES, len(bad))]
    if chosen:
        report.section("Pictures", "Frames without background and objects, before and after.")
    for item in chosen:
        each = records[item]
        report.figure(frame_figure(each), f"{each.name}: {_verdict(each)}.")
    return report.write(path)


def _verdict(record: FrameRecord) -> str:
    if not record.proof.passed:
        return f"refused: {record.proof.worst}"
    if not record.proof.seen:
        return "left as it is"
    return "corrected by templates of this frame itself" if record.of_own_templates else "corrected"


def _shown(records: Sequence[FrameRecord]) -> Table:
    """Columns that fit on a page."""
    proofs = [each.proof for each in records]
    left = [" ± ".join(measured_text(each.part_left, each.part_left_sigma)) for each in proofs]
    columns = {
        "frame": [each.name for each in records],
        "evidence": [each.evidence for each in proofs],
        "fringes": [each.fringe_rms for each in proofs],
        "unit": [each.unit or "counts" for each in records],
        "structure before": [each.structure_before for each in proofs],
        "after": [each.structure_after for each in proofs],
        "left": ["–" if "nan" in text else text for text in left],
        "probability": [each.probability for each in proofs],
        "verdict": [_verdict(each) for each in records],
    }
    return Table(columns)


def _summary(records: Sequence[FrameRecord], refused: Sequence[str]) -> list[tuple[str, str]]:
    """How many frames are better now, and by how much."""
    corrected = [each for each in records if each.proof.passed and each.proof.seen]
    unseen = sum(not each.proof.seen for each in records)
    bad = len(refused) + sum(not each.proof.passed for each in records)
    left = [each.proof.part_left for each in corrected]
    sigma = [each.proof.part_left_sigma for each in corrected]
    structure = [
        [getattr(each.proof, name) for each in corrected] for name in ("structure_before", "structure_after")
    ]
    own = sum(each.of_own_templates for each in corrected)
    unit = next((each.unit for each in corrected if each.unit), "counts")
    rms = _median([each.proof.fringe_rms for each in corrected])
    seen = f"; {unseen} left as they are, for the fringes of the templates are not seen" if unseen else ""
    return [
        ("result", f"{len(corrected)} of {len(records) + len(refused)} images corrected{seen}"),
        ("refused", f"{bad}; the pictures show the frames" if bad else "none"),
        ("part of the fringes that is left, median", f"{_median(left)} ± {_median(sigma)}" if left else ""),
        *(
            [("frames of which the templates are made", f"{own}: what is left cannot be judged from them")]
            if own
            else []
        ),
        (
            "structure beyond the noise, over the noise, median",
            " → ".join(map(_median, structure)) if left else "",
        ),
        ("fringes that were subtracted, rms, median", f"{rms} {unit}" if left else ""),
    ]


def _median(values: Sequence[float]) -> str:
    """Two digits of the median; a dash where there is none."""
    known = [value for value in values if math.isfinite(value)]
    return f"{float(np.median(known)):.2g}" if known else "–"


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
        report.table(_by_magnitude(sources), "injected", download=sources)


def _by_magnitude(sources: Table) -> Table:
    """Mean bias and scatter over all frames, by kind and whole magnitudes."""
    places = sorted({(str(row["kind"]), round(float(row["magnitude"]))) for row in sources})
    rows = []
    for kind, magnitude in places:
        chosen = sources[(sources["kind"] == kind) & (np.round(sources["magnitude"]) == magnitude)]
        weight = np.asarray(chosen["number"], dtype=float)
        numbers: list[float] = []
        for when in ("before", "after"):
            bias = np.asarray(chosen[f"bias_{when}"])
            mean = float(np.average(bias, weights=weight))
            square = np.asarray(chosen[f"scatter_{when}"]) ** 2 + (bias - mean) ** 2
            numbers += [mean, math.sqrt(float(np.average(square, weights=weight)))]
        rows.append((kind, magnitude, int(weight.sum()), *(PERCENT * each for each in numbers)))
    names = ("kind", "magnitude", "number", "bias before", "scatter before", "bias after", "scatter after")
    return Table(rows=rows, names=names, units=(None, "mag", None, *["percent"] * 4))


def _correlation_figure(records: Sequence[FrameRecord]) -> Figure:
    with figure(*CURVE_INCH) as made:
        axes = made.subplots()
        for row, name, colour in ((1, "before", "C1"), (2, "after", "C0")):
            for number, each in enumerate(records):
                label = name if number == 0 else None
                axes.plot(each.correlation[0], each.correlation[row], color=colour, lw=1.0, label=label)
        axes.set(xscale="log", xlabel="separation [px]", ylabel="correlation / variance of a pixel [1]")
        axes.axhline(0.0, color="0.7", lw=0.8)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.legend()
    return made


def frame_figure(record: FrameRecord) -> Figure:
    """A frame less background and objects before its correction, what was subtracted, and what is left.

    The frame alone where its fringes are not seen, and nothing was subtracted.
    """
    titles = ("before", "subtracted", "after") if record.proof.seen else ("as it was, and is",)
    limits = finite_range(record.pictures[0], 1.0, symmetric=True)
    with map_row(len(titles)) as (made, shown):
        for axes, image, title in zip(shown, record.pictures, titles, strict=False):
            show_image(
                axes,
                image,
                label=record.unit or "counts",
                title=title,
                diverging=True,
                limits=limits,
                step_px=record.step_px,
            )
    return made


def _templates_figure(product: FringeTemplates) -> Figure:
    count = len(product.patterns)
    seen_alike = int(product.coverage.min()) == int(product.coverage.max())
    with map_row(count + (0 if seen_alike else 1)) as (made, shown):
        for number, axes in enumerate(shown[:count]):
            show_image(
                axes,
                (PERCENT if product.per_sky else 1.0) * product.patterns[number],
                mask=product.mask,
                label="template [% of the sky]" if product.per_sky else "template [unit of the frames]",
                title=f"template {number}",
                diverging=True,
            )
        for axes in shown[count:]:
            bar = show_image(axes, product.coverage, label="frames", title="coverage").colorbar
            if bar is not None:
                bar.locator = MaxNLocator(integer=True)
                bar.update_ticks()
    return made
