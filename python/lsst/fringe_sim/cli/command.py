"""Commands whose options are declared once: as the default of the parameter that gets the value.

``seed: int = option("Seed of the noise.", 1, click.IntRange(0))`` is ``--seed``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

Decorate = Callable[[Callable[..., None]], Callable[..., None]]
Declare = Callable[[str], Decorate]
"""What the default of a parameter is: from the name of the parameter to a decorator, as those of click."""

EXISTING = click.Path(exists=True, path_type=Path)  # A file or a folder


def command(name: str | None = None) -> Callable[[Callable[..., None]], click.Command]:
    """A command of a function, each of whose parameters has what `option` and its like return as default."""

    def decorate(function: Callable[..., None]) -> click.Command:
        made = function
        for parameter in list(inspect.signature(function).parameters.values())[::-1]:
            made = parameter.default(parameter.name)(made)
        return click.command(name)(made)

    return decorate


def option(help_text: str, default: Any = None, kind: Any = None, names: str = "", **more: Any) -> Any:
    """An option; its default is shown if there is one. ``more``: as of `click.option`.

    ``names``: what stands on the command line, if it is not the name of the parameter.
    """

    def declare(name: str) -> Decorate:
        silent = default is None or default is False or default == ""
        stated = names or f"--{name.replace('_', '-')}"
        # A required option has no default, not even none.
        given = {} if more.get("required") else {"default": default}
        own: Any = {**({} if silent else {"show_default": True}), **given, **more}
        return click.option(stated, name, type=kind, help=help_text, **own)

    return declare


def flag(help_text: str, names: str = "") -> Any:
    """An option without a value."""
    return option(help_text, False, names=names, is_flag=True)


def argument(metavar: str | None = None, kind: Any = None, *, nargs: int = -1, required: bool = True) -> Any:
    """An argument; by default one or more of them."""
    return lambda name: click.argument(name, nargs=nargs, required=required, metavar=metavar, type=kind)


DRY_RUN = flag("Check everything, write nothing.")
