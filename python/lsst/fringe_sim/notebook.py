"""How objects show themselves in a notebook: a small table, with a picture where there is one.

Drawing is imported on first use.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["InNotebook", "axes_or_new"]

PREVIEW_INCH = (4.2, 3.2)


def axes_or_new(axes: Axes | None) -> Axes:
    """The given axes, or those of a new figure of pyplot, which a notebook shows."""
    if axes is not None:
        return axes
    from matplotlib import pyplot

    return pyplot.subplots(layout="constrained")[1]


class InNotebook:
    """An object with facts, and perhaps a picture."""

    def facts(self) -> Mapping[str, Any]:
        """What a person wants to know of it at a glance, by name."""
        raise NotImplementedError

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw it, on new axes by default; returns the axes."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        """Table of the facts and, where it can be drawn, a preview."""
        rows = "".join(
            f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>"
            for name, value in self.facts().items()
        )
        table = f"<b>{html.escape(type(self).__name__)}</b><table>{rows}</table>"
        if type(self).plot is InNotebook.plot:
            return table
        from .style import figure, to_png

        with figure(*PREVIEW_INCH) as made:
            self.plot(made.subplots())
            picture = base64.b64encode(to_png(made)).decode()
        return f'{table}<img alt="{html.escape(type(self).__name__)}" src="data:image/png;base64,{picture}">'
