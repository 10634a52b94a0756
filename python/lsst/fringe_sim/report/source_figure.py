"""Bias of the fluxes and shapes of sources, as a figure of both pages that have them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

from ..style import LINES, figure

PANELS = {
    "": "flux: bias [parts]",
    "e1_": "first ellipticity: bias",
    "e2_": "second ellipticity: bias",
    "size_": "size: bias [parts]",
}


def bias_figure(images: Mapping[str, str], groups: Mapping[str, Table]) -> Figure:
    """Bias with its error by magnitude, a panel for each quantity.

    ``images``: ends of the names of columns, and what they are called.
    ``groups``: tables with the columns of `bias_columns`, each with a mark of its own, by what they are called.
    """
    with figure(12.6, 3.6) as made:
        for axes, (quantity, label) in zip(made.subplots(1, len(PANELS)), PANELS.items(), strict=True):
            for colour, (image, name) in zip((LINES[1], LINES[0]), images.items(), strict=False):
                for mark, fill, (group, rows) in zip("osD^", (True, False) * 2, groups.items(), strict=False):
                    bias, sigma = (rows[f"{quantity}bias_{image}{end}"] for end in ("", "_sigma"))
                    axes.errorbar(
                        rows["magnitude"], np.asarray(bias), np.asarray(sigma), fmt=mark, color=colour, ms=4,
                        mfc=colour if fill else "white", label=f"{name}, {group}",
                    )  # fmt: skip
            axes.axhline(0.0, color="0.7", lw=0.8, zorder=0)
            axes.set(xlabel="magnitude", title=label)
        axes.legend(fontsize=7)
    return made
