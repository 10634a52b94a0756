"""What a command says of files that it cannot use: one message for one error."""

from __future__ import annotations

from collections.abc import Sequence

import click

from ..errors import FrameFormatError, FringeSimError, InputError


def say_bad(bad: Sequence[FringeSimError]) -> None:
    """Name files that are not used."""
    for error in bad:
        click.echo(f"refused: {error}", err=True)


def refuse_bad(bad: Sequence[FringeSimError], *, skip_bad: bool, others: bool = True) -> None:
    """Name files that cannot be used, and end here unless they are to be skipped and others are left.

    A single one is an error of the command; of several, each is named before.

    `FringeSimError`: there are some.
    """
    if not bad or (skip_bad and others):
        say_bad(bad)
        return
    hint = "or --skip-bad to go on without" if others else ""
    if len(bad) > 1:
        say_bad(bad)
        raise FrameFormatError(
            "frames", f"{len(bad)} unusable", ", ".join(filter(None, ("complete frames", hint)))
        )
    [error] = bad
    if hint and isinstance(error, InputError):
        error.allowed += f"; {hint} it"
    raise error
