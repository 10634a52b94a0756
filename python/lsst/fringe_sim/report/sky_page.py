"""Page of simulated sky frames: frames, amplitudes, components of a night, what coadds keep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy import units
from astropy.table import Table

from ..algorithms.coadd_sources import sources_in_coadds
from ..algorithms.coadds import Coadds, VisitPlaces, coadds_of_frames
from ..algorithms.pca import fit_pca
from ..files import table_text, write_whole
from ..products import SkyFringe
from .figures import coadds_figure, components_figure, sky_figure
from .page import Report, shortened
from .source_figure import bias_figure

__all__ = [
    "COADDS_CAPTION",
    "COADDS_TEXT",
    "SOURCES_FILE",
    "coadd_table",
    "sky_amplitudes",
    "write_sky_report",
]

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
    seed: int,
    places: VisitPlaces | None = None,
    picture: Path | None = None,
    pixel_arcsec: float = 0.2,
) -> Path:
    """Write the page, and ``coadd_sources.ecsv`` beside it where frames without noise are large enough.

    ``seed``: of places and angles of the coadds, where ``places`` are not given. ``picture``: file for its first
    figure alone, if wanted. ``pixel_arcsec``: size of a pixel [arcsec].
    """
    first = frames[0]
    report = Report(
        f"Night sky on {first.detector or 'one sensor'}",
        f"Set-up {setup}, filter {first.physical_filter or 'not named'}, "
        f"{len(frames)} exposure{'s' if len(frames) > 1 else ''} of {first.exposure_s:g} s at airmass "
        f"{first.airmass:g}, {'with' if first.seed is not None else 'without'} noise.",
    )
    report.section(
        "Fringes", "Departure from the mean sky. Three numbers are called amplitude; all are given."
    )
    caption = "A frame, the distribution over its pixels, and the strength by time."
    report.figure(sky_figure(frames), caption, picture)
    report.table(sky_amplitudes(frames), "sky_fringe_amplitudes")
    if len(frames) > 1:
        report.section("Components", "Principal components of the frames: the templates of a correction.")
        report.figure(components_figure(fit_pca(frames)), "Mean, first components, explained variance.")
    found = None if first.seed is not None else coadds_of_frames(frames, np.random.default_rng(seed), places)
    if found is not None:
        report.section("Coadds", COADDS_TEXT if places is None else COADDS_OF_VISITS_TEXT)
        report.figure(coadds_figure(found), COADDS_CAPTION)
        report.table(coadd_table(found), "coadds")
        sources = sources_in_coadds(frames, np.random.default_rng(seed), places, pixel_arcsec=pixel_arcsec)
        if sources is not None:
            write_whole(path.with_name(SOURCES_FILE), table_text(sources))
            _show_sources(report, sources)
    return report.write(path)


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
    report.table(shortened(sources), Path(SOURCES_FILE).stem, download=sources)


def coadd_table(found: Coadds) -> Table:
    """Fringes and noise in the largest squares, one row per coadd."""
    table = Table({"exposures": found.counts})
    table["square"] = np.full(len(found.counts), found.square_px[-1]) * units.pixel
    kinds = {"fringes": found.fringes, "less one template": found.corrected, "noise": found.noise}
    for name, values in kinds.items():
        if values is not None:
            table[name] = PERCENT * values[:, -1] * units.percent
            table[name].info.format = ".2g"
    table["fringes over noise"] = found.fringes[:, -1] / found.noise[:, -1]
    table["fringes over noise"].info.format = ".2f"
    return table
