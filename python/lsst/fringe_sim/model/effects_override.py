"""Effects in a config override, as a search leaves it: written, and read without executing anything."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ..errors import InputError

__all__ = ["effects_override", "read_effects_override"]

_STATEMENT = re.compile(r"""config\.effects\[(["'])([\w.]+)\1\]\s*=\s*([^#]+?)\s*(?:#.*)?""")


def effects_override(settings: Mapping[str, float], origin: str) -> str:
    """Text of an override that puts effects into fit, sky simulation and templates.

    Parameters
    ----------
    settings : mapping
        Values by ``effect.parameter``.
    origin : `str`
        Where they are from, in one line.
    """
    lines = [f"# {origin}", "# Use with -C label:effects.py on any task that reads effects."]
    lines += [f'config.effects["{key}"] = {value!r}' for key, value in settings.items()]
    return "\n".join(lines) + "\n"


def read_effects_override(text: str, source: str | None = None) -> dict[str, float]:
    """Effects in the text of an override file that a search has left; nothing is executed.

    Parameters
    ----------
    text : `str`
        Lines that each set one effect to a number; empty lines and comments are passed over.
    source : `str`, optional
        File that the text is from, for the error.

    Returns
    -------
    effects : `dict` [`str`, `float`]
        Values by ``effect.parameter``.

    Raises
    ------
    InputError
        A line that is anything else.
    """
    found: dict[str, float] = {}
    for line in map(str.rstrip, text.splitlines()):
        if not line or line.lstrip().startswith("#"):
            continue
        statement = _STATEMENT.fullmatch(line)
        try:
            if statement is None:
                raise ValueError
            found[statement[2]] = float(statement[3])
        except ValueError:
            allowed = 'lines of config.effects["effect.parameter"] = number'
            raise InputError("statement", line, allowed, source=source) from None
    return found
