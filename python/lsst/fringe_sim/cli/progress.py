"""Progress of long work: a bar on a terminal, plain lines in a log."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click


@contextmanager
def progress(label: str, steps: int) -> Iterator[Callable[[], None]]:
    """Show progress while the body calls the yielded function once per step."""
    if sys.stderr.isatty():
        with click.progressbar(length=steps, label=label, file=sys.stderr) as bar:
            yield lambda: bar.update(1)
        return
    done = 0
    shown = 0

    def advance() -> None:
        nonlocal done, shown
        done += 1
        quarter = 4 * done // max(steps, 1)
        if quarter > shown:
            shown = quarter
            click.echo(f"{label}: {done} of {steps}", err=True)

    yield advance
