"""``fringe-sim challenge``."""

from __future__ import annotations

import json
from pathlib import Path

import click

from ..mock.challenge import CASE_KINDS, CaseResult, run_challenge
from .inputs import prepare_folder
from .parameters import SIZE

__all__ = ["challenge"]


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for the tables.")
@click.option("--seed", type=int, required=True, help="Seed of all cases.")
@click.option(
    "--none", "none", type=click.IntRange(0), default=200, show_default=True, help="Cases without effect."
)
@click.option(
    "--one", "one", type=click.IntRange(0), default=100, show_default=True, help="Cases with one effect."
)
@click.option(
    "--two", "two", type=click.IntRange(0), default=40, show_default=True, help="Cases with two effects."
)
@click.option(
    "--outsider",
    type=click.IntRange(0),
    default=100,
    show_default=True,
    help="Cases with a cause that the catalogue lacks.",
)
@click.option("--size", type=SIZE, default="96x96", show_default=True, help="Columns x rows of the sensors.")
@click.option("--dry-run", is_flag=True, help="Say what would be done, write nothing.")
def challenge(
    out: Path, seed: int, none: int, one: int, two: int, outsider: int, size: tuple[int, int], dry_run: bool
) -> None:
    """Hide random effects in simulated sensors, search each, and count how often the search is right.

    \b
    Example:
      fringe-sim challenge --seed 7 --none 20 --one 20 --two 10 --outsider 10 --out challenge
    """
    counts = dict(zip(CASE_KINDS, (none, one, two, outsider), strict=True))
    total = sum(counts.values())
    if dry_run:
        click.echo(f"would run {total} cases of {size[0]} x {size[1]} pixels: {counts}")
        return
    folder = prepare_folder(out)
    done = 0

    def say(result: CaseResult) -> None:
        nonlocal done
        done += 1
        truth, found = "+".join(result.truth) or "none", "+".join(result.found) or result.verdict
        click.echo(f"{done} of {total}: {truth} -> {found} ({result.seconds:.0f} s)", err=True)

    result = run_challenge(counts, seed, size=(size[1], size[0]), progress=say)
    path = result.write(folder)
    click.echo(json.dumps(result.summary(), indent=2))
    click.echo(str(path))
