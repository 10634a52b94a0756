"""Page of a forecast of all sensors of a camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import StrMethodFormatter
from numpy.typing import ArrayLike

from ..algorithms.focal_plane import DES_CRITERION
from ..errors import InputError
from ..style import DIVERGING, LINES, SEQUENTIAL, figure, panels
from .page import Origin, Report
from .words import span_text

PLAIN = "{x:.2g}"  # Format of logarithmic scales
PLANE_INCH = (4.6, 3.7)  # Width and height of a panel


def write_focal_plane_page(
    folder: Path,
    cells: Table,
    summary: Table,
    airmass: float,
    nights: int,
    measured: int,
    origin: Origin | None = None,
) -> list[str]:
    """Write ``report.html``, and its figure beside it; return what the page says in words.

    ``cells``: as for `focal_plane_figure`. ``summary``: one row per sensor (`summary_table`). ``nights``: those that
    were corrected. ``measured``: sensors with a map of their thickness. ``origin``: command, and pages of the maps.
    """
    lines = list(_describe(summary))
    page = Report(
        "Fringes over the focal plane",
        "Forecast for sensors of the LSST Camera in the y band. Templates are made from the published night, and "
        "correct random nights.",
        origin or Origin(),
    )
    stand_ins = len(summary) - measured
    page.summary(
        [
            ("fringes", _answer(summary)),
            ("thickness", f"{measured} given maps, {stand_ins} random fields like the measured ones"),
            ("forecast for", f"{len(summary)} sensors, each as a whole"),
            ("airmass", f"{airmass:g}"),
            ("nights that were corrected", f"{nights}"),
        ]
    )
    page.section("Focal plane")
    page.remarks([(vendor, text) for vendor, _, text in (line.partition(": ") for line in lines)])
    caption = "Strength, ratio to the shot noise, what a correction leaves, and field radius."
    page.figure(focal_plane_figure(cells, summary), caption, folder / "focal_plane.png")
    page.link("focal_plane.png", "focal_plane.png", ": all four in one picture.")
    page.section("Sensors")
    page.table(_shown(summary), "focal_plane", download=summary)
    page.write(folder / "report.html")
    return lines


def _shown(summary: Table) -> Table:
    """Columns of the summary that fit on a page."""
    names = ("detector", "vendor", "field_radius", "rms", "over_noise")
    table = summary[[*names, *(name for name in summary.colnames if name.startswith("residual_"))]].copy()
    return table


def _answer(summary: Table) -> str:
    """Strength of the fringes, and in how many sensors a correction leaves little enough of them."""
    rms, last = np.asarray(summary["rms"]), max(_templates(summary), 1)
    said = f"{span_text(rms)} % of the sky, rms over a sensor"
    if f"residual_{last}" not in summary.colnames:
        return said
    good = int(np.count_nonzero(np.asarray(summary[f"residual_{last}"]) < DES_CRITERION))
    return (
        f"{said}; with {last} template{'s' if last > 1 else ''} {good} of {len(summary)} sensors are below "
        f"{DES_CRITERION:g} of the shot noise, as the Dark Energy Survey asks"
    )


def _templates(summary: Table) -> int:
    return sum(name.startswith("residual_") for name in summary.colnames)


def _describe(summary: Table) -> Iterator[str]:
    for vendor in sorted(set(summary["vendor"])):
        rows = summary[summary["vendor"] == vendor]
        rms, ratio = np.asarray(rows["rms"]), np.asarray(rows["over_noise"])
        yield (
            f"{vendor}: {len(rows)} sensors, fringe rms {span_text(rms)} %, "
            f"{span_text(ratio)} times the shot noise at up to 20 arcsec"
        )
        for number in range(1, 1 + _templates(rows)):
            left = np.asarray(rows[f"residual_{number}"])
            good = int(np.count_nonzero(left < DES_CRITERION))
            yield (
                f"{vendor} with {number} template{'s' if number > 1 else ''}: at most {left.max():.2g} times "
                f"the noise; {good} of {len(rows)} sensors below {DES_CRITERION}"
            )


def focal_plane_figure(cells: Table, sensors: Table) -> Figure:
    """Fringes over a focal plane: strength, ratio to the shot noise, what a correction leaves, and field radius.

    ``cells``: cells of all sensors (`SensorForecast.to_table`), with the sensor in a column ``detector``.

    `InputError`: there are none.
    """
    if len(cells) == 0:
        raise InputError("cells of the focal plane", 0, "one sensor or more")
    templates = _templates(sensors)
    with figure(2 * PLANE_INCH[0], 2 * PLANE_INCH[1]) as made:
        strength, noise, residual, radius = panels(made, 4, 2)
        rms = np.asarray(cells["rms"], dtype=float)
        brightness = float(np.nanmedian(np.asarray(cells["rms_brightness"]) / rms))
        high = float(np.nanpercentile(rms, 99.5))
        drawn = _draw_cells(strength, cells, "rms", Normalize(0.0, high), SEQUENTIAL)
        bar = strength.figure.colorbar(drawn, ax=strength, label="rms [% of the sky]", shrink=0.85)
        other = bar.ax.secondary_yaxis("left", functions=(_times(brightness), _times(1.0 / brightness)))
        other.set_ylabel("rms [µJy arcsec⁻²]")
        strength.set_title("rms of the fringes in cells of each sensor")
        also = f"the same after correction, {templates} template{'s' if templates > 1 else ''}"
        for panel, column, title in (
            (noise, "over_noise", "fringes over shot noise, largest at 1 to 20″"),
            (residual, "residual_over_noise", also),
        ):
            values = np.asarray(cells[column], dtype=float)
            reach = float(np.nanpercentile(np.abs(np.log(values / DES_CRITERION)), 99.0))
            norm = LogNorm(DES_CRITERION * np.exp(-reach), DES_CRITERION * np.exp(reach))
            drawn = _draw_cells(panel, cells, column, norm, DIVERGING)
            label = f"ratio (white: {DES_CRITERION:g}, criterion of DES)"
            bar = panel.figure.colorbar(
                drawn, ax=panel, label=label, shrink=0.85, format=StrMethodFormatter(PLAIN)
            )
            bar.ax.yaxis.set_minor_formatter(PLAIN)
            panel.set_title(title)
        _draw_radius(radius, sensors)
        return made


def _draw_radius(axes: Axes, sensors: Table) -> None:
    """Strength over field radius, vendor by vendor, beside the published range."""
    for number, vendor in enumerate(sorted(set(sensors["vendor"]))):
        chosen = sensors[sensors["vendor"] == vendor]
        axes.semilogy(
            chosen["field_radius"], chosen["rms"], "os^"[number % 3], ms=4, color=LINES[number], label=vendor
        )
    axes.semilogy(
        [0.0, 1.44], [0.14, 0.04], "x", ms=9, mew=2, color="black", label="Guo et al. 2022, lines alone"
    )
    axes.set(xlabel="distance of the sensor from the axis [deg]", ylabel="fringe rms of the sensor [%]")
    axes.set_title("strength over field radius")
    axes.yaxis.set_major_formatter(PLAIN)
    axes.yaxis.set_minor_formatter(PLAIN)
    axes.legend()


def _times(factor: float) -> Callable[[ArrayLike], ArrayLike]:
    """Scale of a second axis."""
    return lambda value: np.asarray(value, dtype=float) * factor


def _draw_cells(panel: Axes, cells: Table, column: str, norm: Normalize, cmap: str) -> AxesImage:
    """Draw one image per sensor at its place in the focal plane."""
    names, x, y = np.asarray(cells["detector"]), np.asarray(cells["x"]), np.asarray(cells["y"])
    values = np.asarray(cells[column], dtype=float)
    drawn: AxesImage | None = None
    for name in dict.fromkeys(names.tolist()):
        chosen = names == name
        side = math.isqrt(int(chosen.sum()))
        half = [0.5 * np.ptp(axis[chosen]) / max(side - 1, 1) for axis in (x, y)]
        extent = (
            *(x[chosen].min() - half[0], x[chosen].max() + half[0]),
            *(y[chosen].min() - half[1], y[chosen].max() + half[1]),
        )
        image = values[chosen].reshape(side, side)
        drawn = panel.imshow(image, extent=extent, norm=norm, cmap=cmap, aspect="equal")
    reach = 1.05 * max(np.abs(x).max(), np.abs(y).max())
    panel.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x in the focal plane [mm]")
    panel.set_ylabel("y in the focal plane [mm]")
    assert drawn is not None
    return drawn
