"""The page of a search for missing effects, as a scientist reads it: verdict, evidence, rest, what to do next."""

from __future__ import annotations

import math
import shlex
from typing import Any

import numpy as np
from astropy.table import Table

from ..algorithms.discovery import Verdict, probability_text
from ..algorithms.discovery.verdict import NamedEffect
from ..algorithms.discovery.verdict_words import accuracy_text, chance_text, learned_text
from ..algorithms.flat_residual import ResidualPair
from ..products import SensorSection
from .discovery_figures import candidates_figure, gap_figure, leftover_figure, where_figure
from .figures import pixel_noise, residuals_figure, thickness_figure
from .learned_part import add_learned
from .page import Origin, Report
from .words import amplitude_text, masked_text, measured_text, number_text, of_sensor, sigma_text

__all__ = ["discovery_page", "headline"]

PERCENT = 100.0
FRACTIONS = {"before", "after", "noise floor", "rms", "residual", "sigma", "cos", "sin"}
"""Columns with fractions of the counts, which pages show in percent."""

MANY = 6
"""Parameters from which on the summary tells an effect by the rms of their values; the table has them all."""


def discovery_page(
    verdict: Verdict,
    residuals: ResidualPair | None = None,
    *,
    section: SensorSection | None = None,
    origin: Origin | None = None,
) -> Report:
    """Page that shows a verdict; ``.write(path)`` puts it on disk.

    Parameters
    ----------
    verdict : `Verdict`
        What the search found.
    residuals : `ResidualPair`, optional
        Images of data minus model; without them the page has curves and tables only.
    section : `SensorSection`, optional
        Pixels of the sensor that the data show, where that is known.
    origin : `Origin`, optional
        Command that searched, and pages of what it was given.

    Returns
    -------
    page : `Report`
        Self-contained: no script, nothing fetched.
    """
    report = Report(headline(verdict), _lead(verdict), origin or Origin())
    report.summary(_summary(verdict, residuals, section))
    _answer(report, verdict)
    _where(report, verdict)
    if residuals is not None:
        _maps(report, residuals)
    _candidates(report, verdict)
    _gap(report, verdict)
    _unexplained(report, verdict)
    add_learned(report, verdict)
    _next(report, verdict)
    _use(report, verdict)
    _data(report, verdict)
    return report


def headline(verdict: Verdict) -> str:
    """The verdict in one line."""
    if not verdict.complete and verdict.verdict == "unexplained":
        return "The search was stopped before it had an answer"
    if verdict.within_accuracy:
        return "Model and data disagree within the accuracy of the model"
    if verdict.verdict == "no_discrepancy":
        return "Model and data agree within the noise"
    if verdict.unexplained.get("too_poor"):
        return "These data are too poor to be searched"
    if verdict.verdict == "unexplained":
        return "Model and data disagree, and no known effect explains it"
    names = " and ".join(
        f"{effect.name} or one of {len(effect.ambiguous_with)} like it"
        if effect.ambiguous_with
        else effect.name
        for effect in verdict.effects
    )
    return f"Missing from the model: {names}"


def _was_searched(verdict: Verdict) -> bool:
    """Whether the data were good enough to be averaged and fitted."""
    return "cell_px" in verdict.data


def _lead(verdict: Verdict) -> str:
    data = verdict.data
    if not _was_searched(verdict):
        return f"Set-up {verdict.setup}."
    planes, rows, columns = data["shape"]
    cells = "pixels" if data["cell_px"] == 1 else f"cells of {data['cell_px']} × {data['cell_px']} px"
    low, high = min(data["wavelength_nm"]), max(data["wavelength_nm"])
    return (
        f"{planes} exposures from {low:g} to {high:g} nm, {columns} × {rows} {cells}, against the model of set-up "
        f"{verdict.setup}."
    )


def _summary(
    verdict: Verdict, residuals: ResidualPair | None, section: SensorSection | None
) -> list[tuple[str, str]]:
    """What was found, how large it is, and in what."""
    gap, rows = verdict.gap, []
    if math.isfinite(verdict.size["of_counts"]):
        rows.append(("size of the disagreement", verdict.size_text().partition(": ")[2]))
    rows.append(("verdict", _found(verdict)))
    if not verdict.complete:
        rows.append(("complete", "no: the search was stopped, and this is the best answer that it had"))
    told = (("beside the accuracy of the model", accuracy_text(verdict)), ("learned", learned_text(verdict)))
    rows += [(what, text) for what, text in told if text]
    rows.append(("chance that noise alone disagrees as much", _chance(verdict.global_probability)))
    if math.isfinite(gap.heldout_before):
        held = amplitude_text(gap.heldout_before)
        if verdict.effects:
            held += f" → {amplitude_text(gap.heldout_after)}"
        rows.append(("rms on held-out data", f"{held}; noise floor {amplitude_text(gap.noise_floor)}"))
    if residuals is not None:
        best = residuals.after or residuals.before
        known = best.thickness.mask == 0
        rows.append(("median σ of the thickness of a pixel", sigma_text(best.thickness.sigma[known])))
        rows.append(("masked", masked_text(np.isnan(residuals.before.residual))))
    return [*rows, ("searched part", _searched(verdict, section))]


def _found(verdict: Verdict) -> str:
    """The answer in numbers, under a headline that names it."""
    if verdict.effects:
        return "; ".join(
            f"{effect.name}: {_values(effect)}; probability {probability_text(effect.probability)}"
            for effect in verdict.effects
        )
    if verdict.within_accuracy:
        chance = _chance(verdict.accuracy["chance"])
        return f"Noise and errors of the model's tables together disagree as much with a chance of {chance}"
    if verdict.verdict == "no_discrepancy":
        return f"Noise alone disagrees as much with a chance of {_chance(verdict.global_probability)}"
    reason = str(verdict.unexplained.get("reason") or "no known effect explains it")
    return f"No name: {reason}"


def _values(effect: NamedEffect) -> str:
    if len(effect.parameters) > MANY:
        each = list(effect.parameters.values())
        rms = math.sqrt(sum(one.value**2 for one in each) / len(each))
        return f"{len(each)} parameters, rms {number_text(rms, 2)} {each[0].unit}".rstrip()
    texts = {name: measured_text(p.value, p.sigma) for name, p in effect.parameters.items()}
    return ", ".join(
        f"{name} = {value} ± {sigma} {effect.parameters[name].unit}".rstrip()
        for name, (value, sigma) in texts.items()
    )


def _searched(verdict: Verdict, section: SensorSection | None) -> str:
    if not _was_searched(verdict):
        return "nothing"
    cell = int(verdict.data["cell_px"])
    _, rows, columns = verdict.data["shape"]
    shape = rows * cell, columns * cell
    if section is not None and shape != (abs(np.ptp(section.y)) + 1, abs(np.ptp(section.x)) + 1):
        section = None  # a part of the image, or all but some pixels at its rim
    return f"{of_sensor(shape, section)}, in {columns} × {rows} cells"


def _answer(report: Report, verdict: Verdict) -> None:
    report.section("Verdict")
    if verdict.unexplained.get("reason"):
        report.paragraph(f"Why there is no name: {verdict.unexplained['reason']}.")
    if not verdict.effects:
        chance = _chance(verdict.global_probability)
        report.paragraph(f"The chance that noise alone disagrees as much with the unchanged model: {chance}.")
        return
    rows = [
        (
            effect.name,
            name,
            *measured_text(value.value, value.sigma),
            value.unit or "1",
            probability_text(effect.probability),
            ", ".join(effect.ambiguous_with) or "nothing",
        )
        for effect in verdict.effects
        for name, value in effect.parameters.items()
    ]
    names = ("effect", "parameter", "value", "σ", "unit", "probability of the class", "cannot be told from")
    report.table(Table(rows=rows, names=names), "discovery_effects", download=verdict.table())
    report.paragraph(
        "The probability is that of the class: the effect, or one of those that these data cannot tell from it. The "
        "value is right only if the effect is."
    )


def _chance(chance: float | None) -> str:
    if chance is None or math.isnan(chance):
        return "unknown"
    return chance_text(chance)


def _where(report: Report, verdict: Verdict) -> None:
    where = verdict.where
    if not where.channels:
        return
    report.section(
        "Where they disagree",
        "Before anything is added. The model has been fitted with a free thickness and a free level for each "
        "wavelength; what these can absorb does not show.",
    )
    report.figure(
        where_figure(verdict),
        "Strength by wavelength, mean residual over the fringe phase, offsets of the amplifiers, and the tests.",
    )
    if where.scale_px > 0.0:
        report.paragraph(f"The excess is largest in patterns with a period of about {where.scale_px:.3g} px.")
    rows = [(row["name"], row["statistic"], row["degrees"], row["probability"]) for row in where.channels]
    table = Table(rows=rows, names=("test", "statistic", "degrees of freedom", "chance under noise"))
    report.table(table, "discovery_tests")
    _add_curve(report, where.wavelength, "discovery_wavelengths")


def _maps(report: Report, residuals: ResidualPair) -> None:
    report.section(
        "Data minus model",
        "Each wavelength over its mean, at the thickness that fits best, averaged until the noise of pixels hides "
        "nothing, and over the noise that is left. What is seen before and gone after is the effect; what is seen in "
        "both is not explained by it.",
    )
    before, after = residuals.before, residuals.after
    best = before if after is None else after
    for title, one in (("unchanged model", before), ("with what was found", after)):
        if one is not None:
            made = residuals_figure(one.residual, one.wavelength_nm.tolist(), pixel_noise(best.residual))
            report.figure(made, f"Data minus model by wavelength: {title}.")
    table = Table({"wavelength": before.wavelength_nm, "before": PERCENT * before.rms})
    table["wavelength"].unit, table["before"].unit = "nm", "percent"
    if after is not None:
        table["after"] = PERCENT * after.rms
        table["after"].unit = "percent"
    table["wavelength"].info.format = "g"
    report.table(table, "discovery_residual_rms")
    if not (best.thickness.mask == 0).any():
        report.paragraph("The thickness is not known in any pixel.")
        return
    report.figure(
        thickness_figure(best.thickness, residuals.order_um),
        "Thickness with a contour for each fringe order, and its uncertainty.",
    )


def _candidates(report: Report, verdict: Verdict) -> None:
    if not verdict.candidates:
        return
    report.section(
        "Candidates",
        "Every effect of the catalogue with the fall of χ² that its score test promises once all nuisances have had "
        "their share. The best are then fitted; a score is no verdict, and rivals with large scores are rivals only "
        "until the fit.",
    )
    if any(item["score"] > 0.0 for item in verdict.candidates):
        report.figure(candidates_figure(verdict), "The most promising effects.")
    else:
        report.paragraph("None promises anything.")
    rows = [(item["name"], item["score"], item["degrees"]) for item in verdict.candidates]
    table = Table(rows=rows, names=("effect", "fall of χ²", "parameters"))
    report.table(table, "discovery_candidates")


def _gap(report: Report, verdict: Verdict) -> None:
    gap = verdict.gap
    if math.isnan(gap.before):
        return
    report.section(
        "Gap between data and model",
        f"{gap.metric[0].upper()}{gap.metric[1:]}. Held-out data (blocks of the sensor) were not used to choose or "
        "fit the effects. The noise floor is what a perfect model leaves.",
    )
    report.figure(gap_figure(verdict), "Before and after, on all data and on data held out.")
    closed = _closed(gap.heldout_before, gap.heldout_after, gap.noise_floor)
    if verdict.effects and math.isfinite(closed):
        report.paragraph(
            f"On held-out data {PERCENT * closed:.0f} % of the variance above the noise is gone."
        )
    rows = [
        ("all data", gap.before, gap.after, gap.noise_floor),
        ("held out", gap.heldout_before, gap.heldout_after, gap.noise_floor),
    ]
    table = Table(rows=rows, names=("data", "before", "after", "noise floor"))
    _add_in_percent(report, table, "discovery_gap")
    if verdict.steps:
        steps = [
            (
                " + ".join(step.added),
                step.delta_chi2,
                step.log_evidence,
                step.gap_before,
                step.gap_after,
                "yes" if step.consistent else "no",
            )
            for step in verdict.steps
        ]
        names = ("added", "fall of χ²", "log evidence", "before", "after", "only noise left")
        _add_in_percent(report, Table(rows=steps, names=names), "discovery_steps")


def _closed(before: float, after: float, floor: float) -> float:
    """Share of the variance above the noise that is gone; NaN where there was none."""
    above = before**2 - floor**2
    return min(1.0, (before**2 - after**2) / above) if above > 0.0 else math.nan


def _unexplained(report: Report, verdict: Verdict) -> None:
    left = verdict.unexplained
    if not left:
        words = "Nothing beyond noise in any test." if verdict.where.channels else "Not known."
        report.section("What stays unexplained", words)
        return
    report.section(
        "What stays unexplained",
        "Described without a name, so that a person can write the next effect: its shape over the fringe phase, its "
        "colour, its scales.",
    )
    if left.get("channels"):
        report.paragraph(f"Tests that still fail: {', '.join(left['channels'])}.")
    for item in left.get("partial", ()):
        report.paragraph(
            f"{item['name']} explains a part (probability {probability_text(item['probability'])}): not named."
        )
    if left.get("thickness_phase_waveform"):
        report.figure(leftover_figure(left), "What the best model leaves.")
        _add_curve(report, left["wavelength"], "discovery_left_by_wavelength")
    if left.get("harmonics"):
        _add_curve(report, left["harmonics"], "discovery_left_harmonics")
    modes = left.get("principal_modes")
    if modes:
        listed = ", ".join(f"{value:.3g}" for value in modes)
        report.paragraph(f"Strength of the principal modes over the wavelengths (noise: 1): {listed}.")
    if left.get("places"):
        report.paragraph("Places that fit worse than the rest of the sensor:")
        report.table(_place_table(left["places"]), "discovery_left_places")


def _next(report: Report, verdict: Verdict) -> None:
    undecided = [effect for effect in verdict.effects if effect.ambiguous_with]
    rows = verdict.next_measurements
    if not undecided and not rows:
        words = {
            "no_discrepancy": "None is needed for this question.",
            "named": "The data decide between the effects of the catalogue; none is needed for this question.",
            "unexplained": "Write the missing effect from the description above, then search again.",
        }
        better = "None with this model: better constants of its layers come first."
        report.section("Next measurement", better if verdict.within_accuracy else words[verdict.verdict])
        return
    report.section("Next measurement", "What would tell the members of a class apart, best first.")
    report.remarks([(effect.name, effect.break_ambiguity) for effect in undecided if effect.break_ambiguity])
    if rows:
        table = Table(
            rows=[
                (
                    row["effect"],
                    row["title"],
                    _separation(row["separation_sigma"]),
                    "yes" if row["decides"] else "no",
                )
                for row in rows
            ],
            names=("effect", "measurement", "separation [σ]", "decides"),
        )
        report.table(table, "discovery_next_measurements")


def _separation(value: float | None) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.3g}"


def _use(report: Report, verdict: Verdict) -> None:
    if not verdict.effects:
        return
    report.section(
        "To use it",
        "effects.py beside this page puts the effects into any task (-C label:effects.py); on the command line:",
    )
    report.code(
        f"fringe-sim fit RAWS --setup {shlex.quote(verdict.setup)} --effects-file effects.py --out fit\n"
        "fringe-sim sky --thickness fit/thickness.fits --effects-file effects.py --out sky"
    )
    report.paragraph("Effects of the laboratory, as the width of its line, are not taken to the sky.")


def _data(report: Report, verdict: Verdict) -> None:
    data = verdict.data
    report.section("Data and notes")
    if _was_searched(verdict):
        table = Table(
            {"wavelength": data["wavelength_nm"], "noise over the stated noise": data["noise_factor"]}
        )
        table["wavelength"].unit = "nm"
        table["wavelength"].info.format = "g"
        report.table(table, "discovery_noise")
        low, high = data["thickness_um"]
        report.paragraph(
            f"Thickness from {low:.2f} to {high:.2f} µm; scatter of the pixel response "
            f"{PERCENT * data['response_scatter']:.3g} %."
        )
    report.remarks([("Note", note) for note in verdict.notes])


def _add_curve(report: Report, rows: Any, name: str) -> None:
    """Add the rows of a curve as a table, units taken out of the names of the columns."""
    table = Table(rows=[dict(row) for row in rows])
    for column in [name for name in table.colnames if name.endswith("_nm")]:
        plain = column.removesuffix("_nm")
        table.rename_column(column, plain)
        table[plain].unit, table[plain].info.format = "nm", "g"
    _add_in_percent(report, table, name)


def _add_in_percent(report: Report, table: Table, name: str) -> None:
    """Add a table whose fractions of the counts are shown in percent; what it saves keeps them as they are."""
    shown = table.copy()
    for column in FRACTIONS.intersection(table.colnames):
        shown[column] = PERCENT * table[column]
        shown[column].unit = "percent"
    report.table(shown, name, download=table)


def _place_table(places: Any) -> Table:
    """Places that fit worst, as a person looks for them."""
    names = ("row", "column", "diameter", "part of the excess [%]", "worst cell [σ]")
    rows = [
        (item["y_px"], item["x_px"], item["diameter_px"], 100.0 * item["excess_share"], item["sigma"])
        for item in places
    ]
    return Table(rows=rows, names=names, units=("pix", "pix", "pix", None, None))
