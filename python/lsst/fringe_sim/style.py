"""Look of all figures: sizes, colour maps that everyone can read, thinning of large images."""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from mpl_toolkits.axes_grid1 import make_axes_locatable
from numpy.typing import NDArray
from PIL import Image

from .array_types import FloatArray
from .blocks import means_of_known

SEQUENTIAL = "cividis"
DIVERGING = "PuOr_r"
LINES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
"""Okabe & Ito 2008: distinct for all common kinds of colour vision."""

BAD_COLOR, BAD_GREY = 255, 0.75
"""Place of the colour of masked pixels behind those of the numbers, and the colour."""

TITLE_PLACE = 1.0
"""Height of titles in axes without ticks above. Where it is not given, matplotlib looks at every tick for it."""

BAR_INCH, BAR_GAP_INCH = 0.1, 0.08  # Width of a colour bar, and its distance from what it belongs to
MOST_PIXELS = 600  # Images are averaged down to about this many pixels a side before drawing

_RC: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": cycler(color=LINES),
    "image.origin": "lower",
    "image.interpolation": "nearest",
    "legend.frameon": False,
    "figure.dpi": 110,
}


@contextmanager
def figure(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Iterator[Figure]:
    """A figure in the common style, in inches, that is not known to pyplot."""
    with matplotlib.rc_context(_RC):
        made = Figure(figsize=(width, height), layout=layout)
        FigureCanvasAgg(made)
        yield made


def panels(
    made: Figure,
    count: int,
    most_columns: int,
    margins: tuple[float, float, float, float] | None = None,
    last_row: float = 1.0,
) -> list[Axes]:
    """Axes of panels, each in a part of the figure of its own, which a page may put wherever there is room.

    ``most_columns``: panels side by side where the figure is shown as a whole. ``margins``: left, right, bottom and
    top of every panel, in inches, in a figure without a layout: what a solver finds for dozens of them after seconds
    is known before. ``last_row``: height of the last row over that of the others.
    """
    columns = min(most_columns, count)
    rows = -(-count // columns)
    heights = [*[1.0] * (rows - 1), last_row]
    parts = made.subfigures(rows, columns, squeeze=False, height_ratios=heights).ravel()[:count]
    if margins is None:
        return [part.subplots() for part in parts]
    axes = []
    for part in parts:
        width, height = part.bbox.size / made.dpi
        left, right, bottom, top = margins
        place = part.add_gridspec(
            left=left / width, right=1.0 - right / width, bottom=bottom / height, top=1.0 - top / height
        )
        axes.append(part.add_subplot(place[0, 0]))
    return axes


def finite_range(
    values: NDArray[np.floating], percent: float = 0.5, *, symmetric: bool = False
) -> tuple[float, float]:
    """Colour range that leaves out ``percent`` at either end."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return -1.0, 1.0
    low, high = (float(edge) for edge in np.percentile(finite, [percent, 100.0 - percent]))
    if symmetric:
        reach = max(abs(low), abs(high)) or 1e-12
        return -reach, reach
    around = 0.01 * abs(low) or 1e-12  # of a map that is the same everywhere
    return (low, high) if high > low else (low - around, high + around)


def show_image(axes: Axes, image: NDArray[Any], *, label: str, title: str = "", **drawn: Any) -> AxesImage:
    """Draw an image in detector coordinates beside a colour bar; further arguments are those of `draw_image`."""
    shown = draw_image(axes, image, **drawn)
    axes.set_title(title, y=TITLE_PLACE)
    color_bar(axes, shown, label)
    return shown


def draw_image(
    axes: Axes,
    image: NDArray[Any],
    *,
    mask: NDArray[Any] | None = None,
    diverging: bool = False,
    limits: tuple[float, float] | None = None,
    step_px: float = 1.0,
    most_px: int = MOST_PIXELS,
) -> AxesImage:
    """Draw an image in detector coordinates, thinned if it is large; masked pixels are grey.

    ``step_px`` is the number of pixels of the sensor between samples of the image; it is averaged down to about
    ``most_px`` pixels a side.
    """
    values = np.asarray(image, dtype=float)
    if mask is not None:
        values = np.where(np.asarray(mask) == 0, values, np.nan)
    thin = _thin(values, most_px)
    low, high = limits or finite_range(thin, symmetric=diverging)
    cmap = matplotlib.colormaps[DIVERGING if diverging else SEQUENTIAL].with_extremes(bad=str(BAD_GREY))
    ny, nx = (size * step_px for size in values.shape)
    drawn = axes.imshow(
        thin, cmap=cmap, vmin=low, vmax=high, extent=(-0.5, nx - 0.5, -0.5, ny - 0.5), aspect="equal"
    )
    axes.set(xlabel="column [px]", ylabel="row [px]")
    return drawn


def color_bar(axes: Axes, drawn: ScalarMappable, label: str) -> Colorbar:
    """Colour bar beside axes, as high as they are drawn."""
    place = make_axes_locatable(axes).new_horizontal(BAR_INCH, pad=BAR_GAP_INCH)
    axes.add_child_axes(place)  # a part of the axes, so that a layout leaves room for its label, too
    bar: Colorbar = axes.figure.colorbar(drawn, cax=place, label=label)
    return bar


def to_png(made: Figure) -> bytes:
    """The figure as PNG without time stamps."""
    return pixels_to_png(_pixels(made))


def to_pieces(made: Figure) -> tuple[NDArray[np.uint8], list[tuple[str, NDArray[np.uint8]]]]:
    """Pixels of a figure, and of each of its `panels` with its title; the figure itself where it has none.

    It is drawn once.
    """
    whole = _pixels(made)
    pieces = []
    for part in made.subfigs:
        if part.axes:
            x0, y0, x1, y1 = (round(edge) for edge in part.bbox.extents)
            rows = slice(max(len(whole) - y1, 0), len(whole) - y0)
            pieces.append((part.axes[0].get_title(), whole[rows, x0:x1]))
    return whole, pieces or [("", whole)]


def _pixels(made: Figure) -> NDArray[np.uint8]:
    """Red, green and blue of a figure."""
    # `Figure.savefig` would draw everything once more for the sake of the layout.
    canvas = FigureCanvasAgg(made)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def pixels_to_png(pixels: NDArray[np.uint8], palette: NDArray[np.uint8] | None = None) -> bytes:
    """A picture as PNG without time stamps.

    ``pixels`` (ny, nx, 3): colours; or (ny, nx): their numbers in ``palette`` (256, 3).
    """
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    if palette is not None:
        picture.putpalette(palette.tobytes())
    buffer = io.BytesIO()
    # Images with noise are packed in less than half of the time, and 4 % larger, if nothing is looked for in them
    # but runs.
    picture.save(buffer, "png", compress_type=zlib.Z_RLE)
    return buffer.getvalue()


def map_to_png(
    image: NDArray[np.floating],
    limits: tuple[float, float],
    *,
    mask: NDArray[Any] | None = None,
    diverging: bool = False,
) -> bytes:
    """A map as PNG, one pixel for each of its own, the first row at the bottom; grey where there is no number.

    ``limits``: values of the first and the last colour.
    """
    colors = matplotlib.colormaps[DIVERGING if diverging else SEQUENTIAL](np.linspace(0.0, 1.0, BAD_COLOR))
    palette = np.vstack([colors[:, :3], np.full((1, 3), BAD_GREY)])
    low, high = limits
    scaled = (np.asarray(image, dtype=np.float32) - np.float32(low)) * np.float32(
        (BAD_COLOR - 1) / (high - low)
    )
    known = np.isfinite(scaled) if mask is None else np.isfinite(scaled) & (np.asarray(mask) == 0)
    np.clip(scaled, 0.0, BAD_COLOR - 1, out=scaled)
    numbers = np.where(known, np.rint(scaled, out=scaled), BAD_COLOR).astype(np.uint8)
    return pixels_to_png(numbers[::-1], np.rint(255.0 * palette).astype(np.uint8))


def _thin(values: FloatArray, most_px: int) -> FloatArray:
    """Mean over square blocks, so that fringes do not alias when a large image is drawn small."""
    return means_of_known(values, max(1, min(values.shape) // most_px))
