"""Page of a forecast of all sensors of a camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from astropy.table import Table

from ..algorithms.focal_plane import DES_CRITERION
from .figures import focal_plane_figure
from .page import Report

__all__ = ["write_focal_plane_page"]


def write_focal_plane_page(
    folder: Path, cells: Table, summary: Table, airmass: float, nights: int, measured: int
) -> list[str]:
    """Write ``report.html``, and its figure beside it; return what the page says in words.

    ``cells``: as for `focal_plane_figure`. ``summary``: one row per sensor (`summary_table`). ``nights``: those that
    were corrected. ``measured``: sensors with a map of their thickness.
    """
    lines = list(_describe(summary))
    page = Report(
        "Fringes over the focal plane",
        f"{len(summary)} sensors of the LSST Camera in the y band at airmass {airmass:g}; templates from the "
        f"published night, {nights} random night{'s' if nights > 1 else ''} corrected. Sensors with a thickness map "
        f"that was given: {measured}; the others have a random field like the measured ones.",
    )
    page.section("Focal plane")
    for line in lines:
        page.paragraph(line)
    caption = "Strength, ratio to the shot noise, what a correction leaves, and field radius."
    page.figure(focal_plane_figure(cells, summary), caption, folder / "focal_plane.png")
    page.section("Sensors")
    page.table(_shown(summary), "focal_plane", download=summary)
    page.write(folder / "report.html")
    return lines


def _shown(summary: Table) -> Table:
    """Columns of the summary that fit on a page."""
    names = ("detector", "vendor", "field_radius", "rms", "over_noise")
    table = summary[[*names, *(name for name in summary.colnames if name.startswith("residual_"))]].copy()
    for name in table.colnames[2:]:
        table[name].info.format = ".4f"
    return table


def _describe(summary: Table) -> Iterator[str]:
    for vendor in sorted(set(summary["vendor"])):
        rows = summary[summary["vendor"] == vendor]
        rms, ratio = np.asarray(rows["rms"]), np.asarray(rows["over_noise"])
        yield (
            f"{vendor}: {len(rows)} sensors, fringe rms {rms.min():.4f} to {rms.max():.4f} %, "
            f"{ratio.min():.2f} to {ratio.max():.2f} times the shot noise at up to 20 arcsec"
        )
        for number in range(1, 1 + sum(name.startswith("residual_") for name in rows.colnames)):
            left = np.asarray(rows[f"residual_{number}"])
            good = int(np.count_nonzero(left < DES_CRITERION))
            yield (
                f"{vendor} with {number} template{'s' if number > 1 else ''}: at most {left.max():.3f} times "
                f"the noise; {good} of {len(rows)} sensors below {DES_CRITERION}"
            )
