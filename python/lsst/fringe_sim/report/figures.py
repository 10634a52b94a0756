"""Figures of what a run leaves: thickness maps, flats, residuals, sky frames, components, one pixel."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from ..algorithms.flat_prep_options import GAUSSIAN_MAD
from ..array_types import Float32Array, FloatArray
from ..blocks import means_of_known
from ..products import FringeComponents, FringeFrame, SkyFringe, ThicknessMap
from ..style import LINES, TITLE_PLACE, draw_image, figure, finite_range, panels, show_image

if TYPE_CHECKING:
    from ..algorithms.coadds import Coadds
    from ..algorithms.single_pixel import SinglePixelFit

PERCENT = 100.0

MAP_INCH, CURVE_INCH, SMALL_INCH = (3.4, 2.8), (4.6, 3.4), (1.7, 1.8)
"""Width and height of a panel with a map or a histogram, of one with curves, and of one of many. The first is as wide
as a telephone, and two of the last."""

MAP_MARGINS = (0.62, 0.5, 0.45, 0.28)
"""Room of a panel with a map for what is written left, right, below and above, in inches; a bar takes its own."""

GALLERY_PIXELS = 150
"""Frames of a gallery are averaged down to about this many pixels a side, which a panel has."""

RESIDUAL_CELLS = 100  # Residuals are averaged down to about this many cells a side
SCALE_HEIGHT = 0.65  # Height of a scale of colours over that of the panels, where it has a row for itself
NOISE_SIGMAS = 5.0  # Ends of the colours of residuals, in their noise
LEGEND_ROOM = 5.0  # Factor by which the axis of coadds goes on beyond the largest value
PIXEL_ROOM = 0.3  # Part by which the axis of a pixel goes on above its points, for the legend
LEAST_CHANCE = 1e-12  # Smallest chance of a slipped order that is drawn


@contextmanager
def map_row(count: int) -> Iterator[tuple[Figure, list[Axes]]]:
    """Figure of maps or histograms in a row, all in the same place of their panels."""
    with figure(count * MAP_INCH[0], MAP_INCH[1], None) as made:
        yield made, panels(made, count, count, MAP_MARGINS)


def contrast_figure(contrast_map: Float32Array, step_px: float = 1.0) -> Figure:
    """Contrast in blocks of a sensor, ``step_px`` wide, over that of the whole."""
    with map_row(1) as (made, (axes,)):
        show_image(
            axes, contrast_map, label="contrast / mean [1]", title="contrast over the sensor", step_px=step_px
        )
        return made


def thickness_figure(thickness: ThicknessMap, order_um: float) -> Figure:
    """Thickness with a contour per fringe order, its uncertainty, and the chance of a slipped order.

    The last is left out where less than one pixel is expected to have slipped.
    """
    good = thickness.mask == 0
    chance = np.where(good, thickness.slip_probability, 0.0)
    with map_row(3 if chance.sum() >= 1.0 else 2) as (made, (left, middle, *others)):
        show_image(left, thickness.value, mask=thickness.mask, label="thickness [µm]", title=thickness.layer)
        _draw_orders(left, np.where(good, thickness.value, np.nan), order_um)
        show_image(middle, 1e3 * thickness.sigma, mask=thickness.mask, label="σ [nm]", title="uncertainty")
        for right in others:
            show_image(
                right,
                np.log10(np.clip(chance, LEAST_CHANCE, 1.0)),
                mask=thickness.mask,
                label="log₁₀ of the chance",
                title="chance that the order is wrong",
                limits=(math.log10(LEAST_CHANCE), 0.0),
            )
        return made


def _draw_orders(axes: Axes, value_um: NDArray[np.floating], order_um: float) -> None:
    """Contours of whole fringe orders, if they are few enough to be told apart."""
    step = max(1, min(value_um.shape) // 300)
    known = value_um[np.isfinite(value_um)]
    if known.size == 0:
        return
    low, high = known.min(), known.max()
    levels = np.arange(np.ceil(low / order_um), np.floor(high / order_um) + 1) * order_um
    if 0 < len(levels) <= 80:
        axes.contour(
            np.arange(0, value_um.shape[1], step),
            np.arange(0, value_um.shape[0], step),
            value_um[::step, ::step],
            levels=levels,
            colors="white",
            linewidths=0.4,
            alpha=0.7,
        )


def flats_figure(
    amplitude: NDArray[np.floating],
    mask: NDArray[np.integer],
    wavelength_nm: Sequence[float],
    *,
    title: str = "",
    unit: str = "fringe amplitude [%]",
    most_px: int = GALLERY_PIXELS,
) -> Figure:
    """Gallery of frames ``[wavelength, y, x]`` on one colour scale.

    ``amplitude``, ``mask`` (W, ny, nx): frames as fractions, and where they are not to be shown. ``title``: what
    they are. ``most_px``: frames are averaged down to about this many pixels a side.
    """
    values = PERCENT * np.where(np.asarray(mask) == 0, amplitude, np.nan)
    limits = finite_range(values[:, ::7, ::7], symmetric=True)
    return _gallery_figure(values, wavelength_nm, f"{title}: {unit}" if title else unit, limits, most_px, 1)


def residuals_figure(
    residual: NDArray[np.floating], wavelength_nm: Sequence[float], noise: NDArray[np.floating] | None = None
) -> Figure:
    """Gallery of what a model leaves of the flats, averaged until noise does not hide it, over the noise of means.

    ``residual`` (W, ny, nx): flats minus model, as fractions; NaN where a pixel is not to be shown. ``noise`` (W,):
    standard deviation of a pixel, as a fraction; of cells beside each other if not given.
    """
    block = max(1, min(residual.shape[1:]) // RESIDUAL_CELLS)
    coarse = np.stack([means_of_known(np.asarray(plane, dtype=float), block) for plane in residual])
    sigma = pixel_noise(coarse) if noise is None else np.asarray(noise) / block
    size = f"means over {block} × {block} px" if block > 1 else "pixels"
    return _gallery_figure(
        coarse / np.where(sigma > 0.0, sigma, np.nan)[:, np.newaxis, np.newaxis],
        wavelength_nm,
        f"flat − model, {size} [σ of their noise]",
        (-NOISE_SIGMAS, NOISE_SIGMAS),
        GALLERY_PIXELS,
        block,
    )


def pixel_noise(images: NDArray[np.floating]) -> FloatArray:
    """Standard deviation of what neighbours in images do not share, shape ``(W,)``; NaN where none can tell.

    ``images`` (W, ny, nx), NaN where a pixel is not known.
    """
    ny, nx = (size // 2 * 2 for size in images.shape[1:])
    whole = images[:, :ny, :nx]
    across = whole[:, :, ::2] - whole[:, :, 1::2]
    both = 0.5 * np.abs(across[:, ::2] - across[:, 1::2])
    known = [each[np.isfinite(each)] for each in both]
    return np.array([GAUSSIAN_MAD * np.median(each) if each.size else np.nan for each in known])


def _gallery_figure(
    values: NDArray[np.floating],
    wavelength_nm: Sequence[float],
    label: str,
    limits: tuple[float, float],
    most_px: int,
    step_px: float,
) -> Figure:
    """Images on one scale of colours, which is the last panel."""
    count, columns = len(wavelength_nm), min(6, len(wavelength_nm))
    last = SCALE_HEIGHT if count % columns == 0 else 1.0
    rows = count // columns + last
    with figure(SMALL_INCH[0] * columns, SMALL_INCH[1] * rows, None) as made:
        *frames, scale = panels(made, count + 1, columns, (0.3, 0.12, 0.22, 0.22), last)
        for panel, image, wavelength in zip(frames, values, wavelength_nm, strict=True):
            drawn = draw_image(panel, image, diverging=True, limits=limits, most_px=most_px, step_px=step_px)
            panel.set_title(f"{wavelength:g} nm", y=TITLE_PLACE)
            panel.set(xlabel="", ylabel="")
            panel.locator_params(nbins=2)
            panel.tick_params(labelsize=7, length=2)
        _draw_scale(scale, drawn, label)
        return made


def _draw_scale(axes: Axes, drawn: AxesImage, label: str) -> None:
    """Scale of colours in place of a panel."""
    axes.set_axis_off()
    part = axes.figure
    inch = part.bbox.height / part.figure.dpi
    bar = part.colorbar(
        drawn, cax=part.add_axes((0.12, 1.0 - 0.36 / inch, 0.76, 0.16 / inch)), orientation="horizontal"
    )
    bar.ax.tick_params(labelsize=8)
    bar.ax.locator_params(nbins=3)
    part.text(0.5, 1.0 - 0.6 / inch, textwrap.fill(label, 24), ha="center", va="top", fontsize=9)


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
    columns = min(6, count)
    rows = -(-count // columns)
    with figure(SMALL_INCH[0] * columns, SMALL_INCH[1] * rows, None) as made:
        shown = panels(made, count, columns, (0.47, 0.1, 0.4, 0.22))
        reach = 1.1 * PERCENT * max(float(np.nanmax(np.abs([data, model]))), 1e-6)
        for panel, measured, modelled, wavelength in zip(shown, data, model, wavelength_nm, strict=True):
            panel.plot(phase, PERCENT * measured, ".", ms=3, color=LINES[0])
            panel.plot(phase, PERCENT * modelled, "-", lw=1, color=LINES[1])
            panel.set_title(f"{wavelength:g} nm", y=TITLE_PLACE)
            panel.set_xlabel("phase [orders]", fontsize=8, labelpad=1)
            panel.tick_params(labelsize=7, length=2)
            panel.set(xlim=(0.0, 1.0), ylim=(-reach, reach), xticks=(0.0, 0.5, 1.0))
            panel.locator_params(axis="y", nbins=4)
            panel.yaxis.set_major_formatter(StrMethodFormatter("{x:g} %"))
        return made


def sky_figure(frames: Sequence[SkyFringe]) -> Figure:
    """First frame of a night, its histogram, and the fringe strength through the night if there are more."""
    with map_row(3 if len(frames) > 1 else 2) as (made, (left, middle, *others)):
        first = frames[0]
        show_image(
            left,
            PERCENT * _fraction(first),
            mask=first.mask,
            diverging=True,
            label="sky / mean − 1 [%]",
            title=f"{first.detector}, {first.hour % 24.0:g} h",
        )
        rms = []
        for number, frame in enumerate(frames):
            values = PERCENT * _fraction(frame)[frame.mask == 0]
            rms.append(values.std())
            if number in (0, len(frames) // 2, len(frames) - 1):
                middle.hist(values, bins=120, histtype="step", density=True, label=f"{frame.hour % 24.0:g} h")
        middle.set_xlabel("sky / mean − 1 [%]")
        middle.yaxis.set_visible(False)
        middle.set_title("distribution over pixels")
        middle.legend()
        for right in others:
            hours = np.arange(len(frames))
            right.plot(hours, rms, "o-")
            right.set_xticks(hours, [f"{frame.hour % 24.0:g}" for frame in frames])
            right.set_xlabel("local time [h]")
            right.yaxis.set_major_formatter(StrMethodFormatter("{x:.3g}"))
            right.set_title("rms through the night [%]")
        return made


def components_figure(components: FringeComponents) -> Figure:
    """Mean frame, first two components, and the variance that each component explains."""
    ratio = np.maximum(components.explained_variance_ratio, 1e-16)
    images = [("mean frame", PERCENT * components.mean, "sky / mean − 1 [%]")]
    images += [
        (f"component {k + 1}: {PERCENT * ratio[k]:.3g} %", image, "component [1]")
        for k, image in enumerate(components.components[:2])
    ]
    count = len(images) + (1 if len(ratio) > 1 else 0)
    with map_row(count) as (made, shown):
        for panel, (title, image, label) in zip(shown, images, strict=False):
            show_image(panel, image, mask=components.mask, diverging=True, label=label, title=title)
        for scree in shown[len(images) :]:
            scree.semilogy(np.arange(1, len(ratio) + 1), PERCENT * ratio, "o-")
            scree.yaxis.set_minor_formatter(NullFormatter())
            scree.xaxis.set_major_locator(MaxNLocator(integer=True))
            scree.set(xlabel="component", title="share of the variance [%]")
        return made


def coadds_figure(found: Coadds) -> Figure:
    """Fringes and noise in coadds: against the number of exposures, and against the size of a square."""
    from ..algorithms.focal_plane import DES_CRITERION

    with figure(2 * CURVE_INCH[0], CURVE_INCH[1]) as made:
        axes = panels(made, 2, 2)
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
        lows, highs = zip(*(axis.get_ylim() for axis in axes), strict=True)
        for axis in axes:
            axis.set_ylim(min(lows), LEGEND_ROOM * max(highs))
        side = found.square_px[-1]
        axes[0].set(title=f"means of {side} × {side} px", xlabel="exposures in the coadd")
        axes[0].set_ylabel("rms [% of the sky]")
        axes[1].set(title=f"{found.counts[-1]} exposures", xlabel="side of the square that is averaged [px]")
        axes[1].set_ylabel("rms [% of the sky]")
        axes[1].legend(fontsize=8)
        return made


def template_figure(template: FringeFrame) -> Figure:
    """The fringe template as calibration users read it."""
    with map_row(2) as (made, (left, right)):
        show_image(
            left,
            PERCENT * template.image,
            mask=template.mask,
            diverging=True,
            label="sky / mean − 1 [%]",
            title="fringe template",
        )
        row = template.image.shape[0] // 2
        right.plot(PERCENT * template.image[row], lw=0.8)
        right.set(xlabel="column [px]", title=f"row {row}: sky / mean − 1 [%]")
        return made


def single_pixel_figure(
    wavelength_nm: NDArray[np.floating],
    amplitude: NDArray[np.floating],
    fits: Sequence[tuple[str, SinglePixelFit]],
) -> Figure:
    """Measured points of one pixel with several fits, and the misfit against thickness."""
    with figure(2 * CURVE_INCH[0], CURVE_INCH[1]) as made:
        left, right = panels(made, 2, 2)
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
        left.set(xlabel="wavelength [nm]", ylabel="fringe amplitude [%]")
        low, high = left.get_ylim()
        left.set_ylim(low, high + PIXEL_ROOM * (high - low))
        left.legend(fontsize=7, loc="upper left")
        left.set_title("pixel (2100, 2100) of E2V-CCD250-321")
        right.set(xlabel="adhesive thickness [µm]", ylabel="rms misfit [%]", yscale="log")
        right.set_title("misfit at every thickness")
        return made


def _fraction(frame: SkyFringe) -> FloatArray:
    image = np.asarray(frame.image, dtype=float)
    return image if frame.unit == "fraction" else image / frame.mean_electrons - 1.0
