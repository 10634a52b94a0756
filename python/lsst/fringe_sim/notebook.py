"""How objects show themselves: in one line at the prompt, in a notebook as a small table, perhaps with a picture.

Drawing is imported on first use.
"""

from __future__ import annotations

import base64
import dataclasses
import html
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PREVIEW_INCH = (4.2, 3.2)

LONGEST_TEXT, MOST_ITEMS = 60, 12  # Characters of a text, and items of a tuple, that a line shows


class OneLine:
    """A dataclass that says in one line what it is: what is not the default, objects by name, arrays by shape.

    The dataclass is declared with ``repr=False``.
    """

    __slots__ = ()

    def __repr__(self) -> str:
        """Type and fields."""
        shown = (
            f"{item.name}={_in_short(getattr(self, item.name))}"
            for item in dataclasses.fields(self)  # type: ignore[arg-type]
            if not item.name.startswith("_") and not _is_default(getattr(self, item.name), item.default)
        )
        return f"{type(self).__name__}({', '.join(shown)})"


def _is_default(value: Any, default: Any) -> bool:
    plain = isinstance(value, bool | int | float | str | tuple)
    return value is default or (plain and type(value) is type(default) and bool(value == default))


def _in_short(value: Any) -> str:
    if isinstance(value, str):
        return repr(value if len(value) <= LONGEST_TEXT else f"{value[: LONGEST_TEXT - 1]}…")
    if isinstance(value, float):
        return f"{value:.6g}"
    if value is None or isinstance(value, bool | int):
        return repr(value)
    if hasattr(value, "shape"):
        return f"<{' x '.join(map(str, value.shape)) or 'one'} {value.dtype}>"
    if isinstance(value, tuple | list) and len(value) <= MOST_ITEMS:
        return f"({', '.join(map(_in_short, value))})"
    if hasattr(value, "__len__"):
        return f"<{len(value)} items>"
    name = getattr(value, "name", None)
    return repr(name) if isinstance(name, str) else f"<{type(value).__name__}>"


class _Nothing:
    """A function that does nothing, and that ``help()`` shows by its name where it is a default."""

    def __call__(self, *args: object) -> None:
        """Nothing."""

    def __repr__(self) -> str:
        return "do_nothing"


do_nothing = _Nothing()


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
