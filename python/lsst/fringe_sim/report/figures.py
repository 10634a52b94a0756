"""Figures of what a run leaves: thickness maps, flats, residuals, sky frames, components, one pixel."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..products import FringeComponents, FringeFrame, SkyFringe, ThicknessMap
from ..style import (
    DIVERGING,
    LINES,
    SEQUENTIAL,
    TITLE_PLACE,
    block_mean,
    figure,
    finite_range,
    gallery,
    show_image,
)

if TYPE_CHECKING:
    from ..algorithms.coadds import Coadds
    from ..algorithms.single_pixel import SinglePixelFit

__all__ = [
    "coadds_figure",
    "components_figure",
    "contrast_figure",
    "flats_figure",
    "focal_plane_figure",
    "phase_figure",
    "residuals_figure",
    "single_pixel_figure",
    "sky_figure",
    "template_figure",
    "thickness_figure",
]

PERCENT = 100.0

GALLERY_PIXELS = 250
"""Frames of a gallery are averaged down to about this many pixels a side, which a panel has."""

RESIDUAL_CELLS = 100
"""Residuals are averaged down to about this many cells a side."""


def contrast_figure(contrast_map: NDArray[np.float32]) -> Figure:
    """Contrast in blocks of a sensor, over that of the whole."""
    with figure(4.6, 3.9) as made:
        show_image(made.subplots(), contrast_map, label="contrast / mean", title="contrast over the sensor")
    return made


def thickness_figure(thickness: ThicknessMap, order_um: float) -> Figure:
    """Thickness with a contour per fringe order, its uncertainty, and the probability of a slipped order."""
    with figure(13.0, 3.9) as made:
        left, middle, right = made.subplots(1, 3)
        show_image(
            left,
            thickness.value,
            mask=thickness.mask,
            label=f"{thickness.layer} thickness [µm]",
            title=f"{thickness.detector or 'sensor'}: one contour per fringe order",
        )
        good = np.where(thickness.mask == 0, thickness.value, np.nan)
        step = max(1, min(good.shape) // 300)
        low, high = np.nanmin(good), np.nanmax(good)
        levels = np.arange(np.ceil(low / order_um), np.floor(high / order_um) + 1) * order_um
        if 0 < len(levels) <= 80:
            left.contour(
                np.arange(0, good.shape[1], step),
                np.arange(0, good.shape[0], step),
                good[::step, ::step],
                levels=levels,
                colors="white",
                linewidths=0.4,
                alpha=0.7,
            )
        show_image(middle, 1e3 * thickness.sigma, mask=thickness.mask, label="σ [nm]", title="uncertainty")
        chance = np.log10(np.clip(thickness.slip_probability, 1e-12, 1.0))
        show_image(
            right,
            chance,
            mask=thickness.mask,
            label="log₁₀ probability",
            title="chance that the order is wrong",
            limits=(-12.0, 0.0),
        )
        return made


def flats_figure(
    amplitude: NDArray[np.floating],
    mask: NDArray[np.integer],
    wavelength_nm: Sequence[float],
    *,
    title: str,
    unit: str = "fringe amplitude [%]",
    limits: tuple[float, float] | None = None,
    most_px: int = GALLERY_PIXELS,
    step_px: float = 1.0,
) -> Figure:
    """Gallery of frames ``[wavelength, y, x]`` on one colour scale.

    ``amplitude``, ``mask`` (W, ny, nx): frames as fractions, and where they are not to be shown. ``limits``:
    ends of the colour scale [%]; from the frames if not given. ``most_px``: frames are averaged down to about
    this many pixels a side. ``step_px``: pixels of the sensor between samples of the frames.
    """
    count = len(wavelength_nm)
    columns = min(6, count)
    rows = -(-count // columns)
    with figure(2.1 * columns + 0.6, 2.15 * rows + 0.5, None) as made:
        panels = gallery(made, count, columns, (0.65, 1.0, 0.48, 0.55), 0.3)
        values = PERCENT * np.where(np.asarray(mask) == 0, amplitude, np.nan)
        limits = limits or finite_range(values[:, ::7, ::7], symmetric=True)
        for panel, image, wavelength in zip(panels, values, wavelength_nm, strict=False):
            drawn = show_image(
                panel,
                image,
                label="",
                title=f"{wavelength:g} nm",
                diverging=True,
                limits=limits,
                colorbar=False,
                most_px=most_px,
                step_px=step_px,
            )
            panel.set_xlabel("")
            panel.set_ylabel("")
            panel.tick_params(labelsize=6)
        width, height = made.get_size_inches()
        bar = made.add_axes((1.0 - 0.85 / width, 0.5 / height + 0.1, 0.17 / width, 0.8 - 1.0 / height))
        made.colorbar(drawn, cax=bar, label=unit)
        made.supxlabel("column [px]", fontsize=8, y=0.07 / height, va="bottom")
        made.supylabel("row [px]", fontsize=8, x=0.07 / width, ha="left")
        made.suptitle(title, y=1.0 - 0.08 / height, va="top")
        return made


def residuals_figure(residual: NDArray[np.floating], wavelength_nm: Sequence[float]) -> Figure:
    """Gallery of what a model leaves of the flats, averaged until noise does not hide it.

    ``residual`` (W, ny, nx): flats minus model, as fractions; NaN where a pixel is not to be shown.
    """
    block = max(1, min(residual.shape[1:]) // RESIDUAL_CELLS)
    coarse = np.stack([block_mean(np.asarray(plane, dtype=float), block) for plane in residual])
    size = f", means over {block} × {block} px" if block > 1 else ""
    return flats_figure(
        coarse,
        np.zeros(coarse.shape, np.int32),
        wavelength_nm,
        title=f"flats minus model{size}",
        unit="flat − model [%]",
        step_px=block,
    )


def phase_figure(
    phase: NDArray[np.floating],
    data: NDArray[np.floating],
    model: NDArray[np.floating],
    wavelength_nm: Sequence[float],
) -> Figure:
    """Data and model folded on fringe phase, one panel per wavelength.

    ``phase`` (B,): centres of the phase bins, in fringe orders. ``data``, ``model`` (W, B).
    """
    count = len(wavelength_nm)
    columns = min(4, count)
    rows = -(-count // columns)
    with figure(2.9 * columns, 1.9 * rows + 0.3, None) as made:
        panels = gallery(made, count, columns, (0.75, 0.12, 0.55, 0.27), 0.3)
        for panel, measured, modelled, wavelength in zip(panels, data, model, wavelength_nm, strict=False):
            panel.plot(phase, PERCENT * measured, ".", ms=3, color=LINES[0], label="flats")
            panel.plot(
                phase, PERCENT * modelled, "-", lw=1, color=LINES[1], label="model at the fitted thickness"
            )
            panel.set_title(f"{wavelength:g} nm", y=TITLE_PLACE)
        panels[0].legend(fontsize=7)
        width, height = made.get_size_inches()
        made.supxlabel("thickness over one fringe order [1]", y=0.07 / height, va="bottom")
        made.supylabel("fringe amplitude [%]", x=0.07 / width, ha="left")
        return made


def sky_figure(frames: Sequence[SkyFringe]) -> Figure:
    """First frame of a night, its histogram, and the fringe strength through the night."""
    with figure(13.0, 3.9) as made:
        left, middle, right = made.subplots(1, 3)
        first = frames[0]
        show_image(
            left,
            PERCENT * _fraction(first),
            mask=first.mask,
            diverging=True,
            label="sky / mean - 1 [%]",
            title=f"{first.detector} {first.physical_filter}, {first.hour % 24.0:g} h, {first.exposure_s:g} s",
        )
        rms = []
        for number, frame in enumerate(frames):
            values = PERCENT * _fraction(frame)[frame.mask == 0]
            rms.append(values.std())
            if number in (0, len(frames) // 2, len(frames) - 1):
                middle.hist(values, bins=120, histtype="step", density=True, label=f"{frame.hour % 24.0:g} h")
        middle.set_xlabel("sky / mean - 1 [%]")
        middle.set_ylabel("density")
        middle.set_title("distribution over pixels")
        middle.legend()
        hours = np.arange(len(frames))
        right.plot(hours, rms, "o-")
        right.set_xticks(hours, [f"{frame.hour % 24.0:g}" for frame in frames])
        right.set_xlabel("local time [h]")
        right.set_ylabel("rms over pixels [%]")
        right.set_title("through the night")
        return made


def components_figure(components: FringeComponents) -> Figure:
    """Mean frame, first two components, and the variance that each component explains."""
    with figure(14.0, 3.6) as made:
        panels = made.subplots(1, 4)
        images = [("mean frame", components.mean)]
        images += [
            (f"component {k + 1}: {PERCENT * components.explained_variance_ratio[k]:.3g} %", image)
            for k, image in enumerate(components.components[:2])
        ]
        for panel, (title, image) in zip(panels, images, strict=False):
            show_image(
                panel,
                PERCENT * image if title == "mean frame" else image,
                mask=components.mask,
                diverging=True,
                label="sky / mean - 1 [%]" if title == "mean frame" else "component [1]",
                title=title,
            )
        scree = panels[-1]
        ratio = np.maximum(components.explained_variance_ratio, 1e-16)
        scree.semilogy(np.arange(1, len(ratio) + 1), ratio, "o-")
        scree.xaxis.set_major_locator(MaxNLocator(integer=True))
        scree.set_xlabel("component")
        scree.set_ylabel("share of the variance")
        scree.set_title("scree")
        for panel in panels[len(images) : -1]:
            panel.set_visible(False)
        return made


def coadds_figure(found: Coadds) -> Figure:
    """Fringes and noise in coadds: against the number of exposures, and against the size of a square."""
    from ..algorithms.focal_plane import DES_CRITERION

    with figure(8.4, 3.7) as made:
        axes = made.subplots(1, 2, sharey=True)
        for axis, x, at in ((axes[0], found.counts, np.s_[:, -1]), (axes[1], found.square_px, np.s_[-1])):
            noise = PERCENT * found.noise[at]
            axis.loglog(x, PERCENT * found.fringes[at], "o-", ms=4, color=LINES[1], label="fringes")
            if found.corrected is not None:
                left = PERCENT * found.corrected[at]
                axis.loglog(x, left, "s-", ms=4, color=LINES[2], label="less one template")
            axis.loglog(x, noise, color=LINES[0], label="noise")
            axis.loglog(x, DES_CRITERION * noise, "--", color=LINES[0], label="a tenth of the noise")
            for each in (axis.xaxis, axis.yaxis):
                each.set_major_formatter(StrMethodFormatter("{x:g}"))
                each.set_minor_formatter(NullFormatter())
        side = found.square_px[-1]
        axes[0].set_title(f"means of {side} × {side} px")
        axes[0].set_xlabel("exposures in the coadd")
        axes[0].set_ylabel("rms [% of the sky]")
        axes[1].set_title(f"{found.counts[-1]} exposures")
        axes[1].set_xlabel("side of the square that is averaged [px]")
        axes[1].legend(fontsize=8)
        return made


def template_figure(template: FringeFrame) -> Figure:
    """The fringe template as calibration users read it."""
    with figure(9.0, 3.9) as made:
        left, right = made.subplots(1, 2)
        show_image(
            left,
            PERCENT * template.image,
            mask=template.mask,
            diverging=True,
            label="(sky - mean) / mean [%]",
            title="fringe template",
        )
        row = template.image.shape[0] // 2
        right.plot(PERCENT * template.image[row], lw=0.8)
        right.set_xlabel("column [px]")
        right.set_ylabel("(sky - mean) / mean [%]")
        right.set_title(f"row {row}")
        return made


def single_pixel_figure(
    wavelength_nm: NDArray[np.floating],
    amplitude: NDArray[np.floating],
    fits: Sequence[tuple[str, SinglePixelFit]],
) -> Figure:
    """Measured points of one pixel with several fits, and the misfit against thickness."""
    with figure(11.5, 3.9) as made:
        left, right = made.subplots(1, 2)
        left.plot(wavelength_nm, PERCENT * amplitude, "o", color="black", label="measured", zorder=3)
        for k, (name, fit) in enumerate(fits):
            color = LINES[k % len(LINES)]
            left.plot(
                wavelength_nm,
                PERCENT * fit.predicted,
                "s--",
                ms=3,
                lw=1,
                color=color,
                label=f"{name}: {fit.thickness_um:.2f} µm, rms {PERCENT * fit.rms:.2f} %",
            )
            right.plot(fit.searched_um, PERCENT * fit.searched_rms, lw=0.7, color=color)
        left.set_xlabel("wavelength [nm]")
        left.set_ylabel("fringe amplitude [%]")
        left.legend(fontsize=7)
        left.set_title("pixel (2100, 2100) of E2V-CCD250-321")
        right.set_xlabel("adhesive thickness [µm]")
        right.set_ylabel("rms misfit [%]")
        right.set_yscale("log")
        right.set_title("misfit at every thickness")
        return made


def focal_plane_figure(cells: Table, sensors: Table) -> Figure:
    """Fringes over a focal plane: strength, ratio to the shot noise, what a correction leaves, and field radius.

    ``cells``: cells of all sensors (`SensorForecast.to_table`), with the sensor in a column ``detector``.
    """
    from ..algorithms.focal_plane import DES_CRITERION

    templates = sum(name.startswith("residual_") for name in sensors.colnames)
    with figure(12.5, 10.5) as made:
        panels = made.subplots(2, 2)
        strength, noise, residual, radius = panels.ravel()
        rms = np.asarray(cells["rms"], dtype=float)
        brightness = float(np.nanmedian(np.asarray(cells["rms_brightness"]) / rms))
        high = float(np.nanpercentile(rms, 99.5))
        drawn = _draw_cells(strength, cells, "rms", Normalize(0.0, high), SEQUENTIAL)
        bar = made.colorbar(
            drawn, ax=strength, label="right: rms [% of the sky]; left: [µJy arcsec⁻²]", shrink=0.85
        )
        bar.ax.secondary_yaxis("left", functions=(_times(brightness), _times(1.0 / brightness)))
        strength.set_title("rms of the fringe in cells of each sensor")
        for panel, column, title in (
            (noise, "over_noise", "fringe over shot noise, largest at 1 to 20″"),
            (residual, "residual_over_noise", f"the same after correction with {templates} templates"),
        ):
            values = np.asarray(cells[column], dtype=float)
            reach = float(np.nanpercentile(np.abs(np.log(values / DES_CRITERION)), 99.0))
            norm = LogNorm(DES_CRITERION * np.exp(-reach), DES_CRITERION * np.exp(reach))
            drawn = _draw_cells(panel, cells, column, norm, DIVERGING)
            made.colorbar(drawn, ax=panel, label="ratio (white: 0.1, the DES criterion)", shrink=0.85)
            panel.set_title(title)
        for number, vendor in enumerate(sorted(set(sensors["vendor"]))):
            chosen = sensors[sensors["vendor"] == vendor]
            radius.semilogy(
                chosen["field_radius"],
                chosen["rms"],
                "os^"[number % 3],
                ms=4,
                color=LINES[number],
                label=vendor,
            )
        radius.semilogy(
            [0.0, 1.44], [0.14, 0.04], "x", ms=9, mew=2, color="black", label="Guo et al. 2022, lines alone"
        )
        radius.set_xlabel("distance of the sensor from the axis [deg]")
        radius.set_ylabel("fringe rms of the sensor [%]")
        radius.set_title("strength over field radius")
        radius.legend()
        return made


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
    panel.set_xlim(-reach, reach)
    panel.set_ylim(-reach, reach)
    panel.set_xlabel("x in the focal plane [mm]")
    panel.set_ylabel("y in the focal plane [mm]")
    if drawn is None:
        raise InputError("cells of the focal plane", 0, "one sensor or more")
    return drawn


def _fraction(frame: SkyFringe) -> NDArray[np.float64]:
    image = np.asarray(frame.image, dtype=float)
    return image if frame.unit == "fraction" else image / frame.mean_electrons - 1.0
