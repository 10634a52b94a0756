"""``fringe-sim evidence``."""

from __future__ import annotations

import click

from ..files import json_text, write_whole
from .command import command, flag, option
from .output import OutputFolder, output_folder
from .parameters import with_effects_from
from .progress import progress


@command()
def evidence(
    effects: tuple[str, ...] = with_effects_from(
        option(
            "Effect of the set; may be repeated. Without any, sets that lower the contrast are compared.",
            names="--effect",
            multiple=True,
            metavar="NAME[.PARAMETER]",
        )
    ),
    out: OutputFolder | None = output_folder(
        "Folder for the verdict.", "evidence.json", "evidence.txt", required=False
    ),
    dry_run: bool = flag("Say what would be compared, compute nothing."),
) -> None:
    """Judge effects by all public data of the real sensor together.

    Twelve flats of one pixel, contrast, shape and phase of the 960 nm flat, the published thickness map, the quantum
    efficiency of two vendors, and what MonoCam and Hyper Suprime-Cam saw. Effects of the bench compete with those
    that a sensor takes along to the telescope. Every kind is foretold from the others.

    \b
    Examples:
      fringe-sim evidence
      fringe-sim evidence --effect diffuse_gate_side --effect bandwidth --out verdict
    """
    from ..algorithms.public_evidence.joint import parse_set
    from ..algorithms.public_evidence.verdict import RIVALS, compare
    from ..report.evidence_text import evidence_text

    # A set is judged against each of its members alone.
    sets = [(name,) for name in effects if len(effects) > 1] + [effects] if effects else list(RIVALS)
    for names in sets:
        parse_set(names)
    if dry_run:
        click.echo(f"would compare {', '.join(' + '.join(names) for names in sets)} and no effect at all")
        return
    folder = out.prepare() if out is not None else None
    with progress("comparing", len(sets) + 1) as advance:
        found = compare(sets, advance=advance)
    text = evidence_text(found)
    click.echo(text)
    if folder is not None:
        write_whole(folder / "evidence.json", f"{json_text(found.content())}\n")
        write_whole(folder / "evidence.txt", f"{text}\n")
        for name in ("evidence.json", "evidence.txt"):
            click.echo(str(folder / name))
