"""Page of simulated sky frames: frames, amplitudes, components of a night, what coadds keep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy import units
from astropy.table import Table
from numpy.typing import NDArray

from ..algorithms.coadd_sources import NightResults
from ..algorithms.coadds import Coadds
from ..files import table_text, write_whole
from ..products import SensorSection, SkyFringe
from .figures import coadds_figure, components_figure, sky_figure
from .page import Origin, Report
from .source_figure import bias_figure
from .words import masked_text, of_sensor, span_text

PERCENT = 100.0

SOURCES_FILE = "coadd_sources.ecsv"

COADDS_TEXT = (
    "What stays of the fringes in coadds of randomly placed and rotated pieces of these frames, uncorrected and "
    "after the subtraction of the one template that takes most of them, beside the photon noise."
)

COADDS_OF_VISITS_TEXT = (
    "What stays of the fringes in coadds of the given visits, uncorrected and after the subtraction of the one "
    "template that takes most of them, beside the photon noise."
)

CAPTION_OF_COMPONENTS = "Mean, and the first components with their share of the variance."

COADDS_CAPTION = (
    "Standard deviation of means over squares: of the largest against the number of exposures, and of the deepest "
    "coadd against the side. The Dark Energy Survey asks for fringes below a tenth of the noise up to 20 arcsec."
)

SOURCES_TEXT = (
    "What the fringes do to stars and exponential discs in single visits and in the coadd of all: bias, its error "
    "and scatter of fluxes and sizes, as parts of them, and of ellipticities (adaptive moments), beside the scatter "
    "that the noise makes. Each source is compared with itself in the same noise without fringes. Magnitudes are "
    "relative to the sky of one square arcsecond."
)


def sky_amplitudes(frames: Sequence[SkyFringe]) -> Table:
    """Level and fringe amplitudes of sky frames, one row per frame."""
    rows = []
    for frame in frames:
        values = PERCENT * frame.fraction()[frame.mask == 0].astype(float)
        low, high = np.percentile(values, [1.0, 99.0])
        rows.append(
            (frame.hour % 24.0, frame.mean_electrons, values.std(), 0.5 * np.ptp(values), 0.5 * (high - low))
        )
    hour, level, rms, half, trimmed = (np.array(column) for column in zip(*rows, strict=True))
    table = Table()
    table["local time"] = np.round(hour, 3) * units.hour
    table["sky"] = np.round(level, 1) * units.electron
    table["rms"] = np.round(rms, 4) * units.percent
    table["half peak to peak"] = np.round(half, 4) * units.percent
    table["half range 1-99"] = np.round(trimmed, 4) * units.percent
    return table


def write_sky_report(
    path: Path,
    frames: Sequence[SkyFringe],
    setup: str,
    results: NightResults,
    *,
    picture: Path | None = None,
    section: SensorSection | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write the page, and ``coadd_sources.ecsv`` beside it where there are sources.

    ``results``: what the frames come to. ``picture``: file beside the page for the first frame with all its pixels,
    if wanted. ``section``: pixels of the sensor that the frames show, where that is known. ``origin``: command, and
    pages of what it was given.
    """
    first = frames[0]
    report = Report(
        f"Night sky on {first.detector or 'one sensor'}",
        f"Set-up {setup}, filter {first.physical_filter or 'not named'}, "
        f"{len(frames)} exposure{'s' if len(frames) > 1 else ''} of {first.exposure_s:g} s at airmass "
        f"{first.airmass:g}, {'with' if first.seed is not None else 'without'} noise.",
        origin or Origin(),
    )
    amplitudes = sky_amplitudes(frames)
    found = results.coadds
    report.summary(_summary(frames, amplitudes, found, section))
    noise = "" if first.seed is None else " In the table they are those of the frames, noise included."
    report.section(
        "Fringes", f"Departure from the mean sky. Three numbers are called amplitude; all are given.{noise}"
    )
    which = "The first frame" if len(frames) > 1 else "The frame"
    report.figure(sky_figure(frames), f"{which}, and its distribution over the pixels{_through(frames)}.")
    if picture is not None:
        shown = PERCENT * first.fraction()
        report.map(picture, shown, mask=first.mask, unit="% of the sky", diverging=True)
    report.table(amplitudes, "sky_fringe_amplitudes")
    if results.components is not None:
        report.section("Components", "Principal components of the frames: the templates of a correction.")
        report.figure(components_figure(results.components), CAPTION_OF_COMPONENTS)
    if found is not None:
        report.section("Coadds", COADDS_OF_VISITS_TEXT if results.places_given else COADDS_TEXT)
        report.figure(coadds_figure(found), COADDS_CAPTION)
        report.table(coadd_table(found), "coadds")
        if results.sources is not None:
            write_whole(path.with_name(SOURCES_FILE), table_text(results.sources))
            _show_sources(report, results.sources)
    return report.write(path)


def _without_noise(frames: Sequence[SkyFringe], keyword: str, measured: NDArray[np.floating]) -> str:
    """An amplitude as the frames state it, without noise; as it was measured where they do not."""
    stated = [PERCENT * float(each.metadata[keyword]) for each in frames if keyword in each.metadata]
    return span_text(stated if len(stated) == len(frames) else measured)


def _through(frames: Sequence[SkyFringe]) -> str:
    return "; strength of all frames by time" if len(frames) > 1 else ""


def _summary(
    frames: Sequence[SkyFringe], amplitudes: Table, found: Coadds | None, section: SensorSection | None
) -> list[tuple[str, str]]:
    first = frames[0]
    told = first.seed is None or all("FRINGRMS" in each.metadata for each in frames)
    noise = "" if told else ", noise included"
    rms = _without_noise(frames, "FRINGRMS", amplitudes["rms"])
    trimmed = _without_noise(frames, "FRING198", amplitudes["half range 1-99"])
    deepest = ""
    if found is not None:
        ratio = float(found.fringes[-1, -1] / found.noise[-1, -1])
        deepest = f"{ratio:.2g} times the noise of {found.counts[-1]} exposures, uncorrected"
    return [
        ("fringes", f"{rms} % of the sky, rms{noise}"),
        ("half of the range from 1 to 99 %", f"{trimmed} % of the sky{noise}"),
        ("sky", f"{span_text(amplitudes['sky'])} electrons in a pixel"),
        ("photon noise of a pixel", f"{PERCENT / math.sqrt(first.mean_electrons):.2g} % of the sky"),
        (f"fringes in means of {found.square_px[-1]} px" if found else "coadds", deepest),
        ("masked", masked_text(first.mask)),
        ("simulated part", of_sensor(first.image.shape, section)),
    ]


def _show_sources(report: Report, sources: Table) -> None:
    names = {"fringes": "with fringes", "corrected": "less one template"}
    known = {end: name for end, name in names.items() if f"bias_{end}" in sources.colnames}
    parts = {
        f"{kind}, visits: {visits}": sources[(sources["kind"] == kind) & (sources["visits"] == visits)]
        for visits in np.unique(sources["visits"])
        for kind in np.unique(sources["kind"])
    }
    report.section("Sources", SOURCES_TEXT)
    report.figure(bias_figure(known, parts), "Bias by magnitude, kind and number of visits.")
    report.table(sources, Path(SOURCES_FILE).stem, download=sources)


def coadd_table(found: Coadds) -> Table:
    """Fringes and noise in the largest squares, one row per coadd."""
    table = Table({"exposures": found.counts})
    table["square"] = np.full(len(found.counts), found.square_px[-1]) * units.pixel
    kinds = {"fringes": found.fringes, "less one template": found.corrected, "noise": found.noise}
    for name, values in kinds.items():
        if values is not None:
            table[name] = PERCENT * values[:, -1] * units.percent
    table["fringes over noise"] = found.fringes[:, -1] / found.noise[:, -1]
    return table
