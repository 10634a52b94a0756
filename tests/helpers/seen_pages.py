"""What a reader sees of pages: their words, the tables that can be saved, and all that is drawn in their figures."""

import base64
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.colors import to_rgba, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from recorded_numbers import Words

_TABLE = re.compile(r'download="([^"]+)\.ecsv" href="data:text/plain;base64,([^"]+)"')
_UNREAD = re.compile(r'<div class="(?:all )?made">.*?</div>|<style>.*?</style>|"data:[^"]*"|<pre>.*?</pre>')


def seen_of_page(page: Path) -> dict[str, Any]:
    """Words of a page, and its tables as they are saved."""
    text = page.read_text(encoding="utf-8")
    tables = {
        name: Table.read(base64.b64decode(data).decode(), format="ascii.ecsv")
        for name, data in _TABLE.findall(text)
    }
    shown = re.sub(r"<[^>]*>", " ", _UNREAD.sub("", text))
    return {"words": Words(re.findall(r"[^\W\d_]+", shown)), "tables": tables}


def drawn(made: Figure) -> dict[str, Any]:
    """Numbers and texts of everything in a figure that has been drawn, by kind."""
    found: dict[str, Any] = defaultdict(list)
    for artist in made.findobj():
        if artist.get_visible():
            for name, values in _of_artist(artist):
                if isinstance(values, str):
                    found[f"{name} words"].append(values)
                else:
                    found[name].append(np.ravel(np.asarray(np.ma.filled(values, np.nan), dtype=float)))
    size = {"size": np.array([*made.get_size_inches(), made.dpi])}
    return size | {
        name: Words(parts) if name.endswith("words") else np.concatenate(parts)
        for name, parts in sorted(found.items())
    }


def _of_artist(artist: Artist) -> list[tuple[str, Any]]:
    match artist:
        case Text() if artist.get_text():
            placed = (
                artist.axes is None or artist in artist.axes.texts
            )  # others stand where matplotlib has room
            return [
                ("place of text", artist.get_position() if placed else []),
                ("text", artist.get_text()),
                ("text", [artist.get_fontsize(), artist.get_rotation(), *to_rgba(artist.get_color())]),
            ]
        case Line2D():
            style = [artist.get_linewidth(), artist.get_markersize(), artist.get_markeredgewidth()]
            looks = f"{artist.get_linestyle()} {artist.get_marker()}"
            return [
                ("line", np.ma.filled(np.ma.asarray(artist.get_xydata(), dtype=float), np.nan)),
                ("style", [*style, *to_rgba(artist.get_color()), artist.get_zorder()]),
                ("style", looks),
            ]
        case AxesImage():
            return [
                ("image", artist.get_array()),
                ("place of image", [*artist.get_extent(), *artist.get_clim()]),
                ("image", str(artist.get_cmap().name)),
            ]
        case Collection():
            paths = [path.vertices for path in artist.get_paths()]
            return [
                ("points", np.concatenate([np.ravel(each) for each in [*paths, artist.get_offsets()]])),
                ("style", np.concatenate([np.ravel(artist.get_linewidth()), artist.get_edgecolor().ravel()])),
                ("style", to_rgba_array(artist.get_facecolor()).ravel()),
            ]
        case Patch():
            corners = artist.get_patch_transform().transform(artist.get_path().vertices)
            return [("patch", corners), ("style", [*artist.get_facecolor(), artist.get_linewidth()])]
        case Axes():
            return [
                ("axes", [*artist.get_position().bounds, *artist.get_xlim(), *artist.get_ylim()]),
                ("axes", f"{artist.get_xscale()} {artist.get_yscale()}"),
            ]
    return []
