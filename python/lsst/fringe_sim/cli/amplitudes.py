"""``fringe-sim amplitudes``: Table 2 of the paper."""

from __future__ import annotations

from pathlib import Path

import click

from ..algorithms.amplitude_table import CASES, SkyCase, compare_amplitudes
from ..errors import printable_name
from ..files import table_text, write_whole
from ..instrument.measured_thickness import e2v_321
from ..model import Setup
from ..resources import read_user_table
from .command import command, flag, option
from .inputs import read_thickness
from .output import OutputFolder, output_folder
from .parameters import BUILT_IN, ChosenEffects, model_effects

STEP_PX = 16


@command()
def amplitudes(
    thickness: str = option("Adhesive: 'e2v_321' or a FITS file [µm].", BUILT_IN),
    lines: tuple[Path, ...] = option(
        "Another line list beside PALACE: ECSV with wavelength [nm] and intensity; may be repeated.",
        kind=click.Path(exists=True, dir_okay=False, path_type=Path),
        multiple=True,
    ),
    cases: tuple[str, ...] = option(
        "Row of the table; may be repeated. All by default.",
        kind=click.Choice([case.name for case in CASES]),
        names="--case",
        multiple=True,
    ),
    effects: ChosenEffects = model_effects(),
    out: OutputFolder | None = output_folder(
        "Folder for the table as ECSV.", "amplitudes.ecsv", required=False
    ),
    dry_run: bool = flag("Check everything, compute nothing."),
) -> None:
    """Fringe amplitudes of every set-up of the paper: its Table 2.

    One set of effects is used in the laboratory and, without those of the bench, on the sky; what the set-ups give
    without any stands beside it.

    \b
    Examples:
      fringe-sim amplitudes
      fringe-sim amplitudes --effect contrast_loss.factor=0.13 --out table2
    """
    skies = [read_line_list(path) for path in lines] + list(SkyCase.palace())
    adhesive = (
        e2v_321()[::STEP_PX, ::STEP_PX]
        if thickness == BUILT_IN
        else read_thickness(thickness, Setup.from_name("ts8_e2v"))
    )
    if dry_run:
        click.echo(f"would compute every set-up with {', '.join(sky.name for sky in skies)}")
        return
    folder = out.prepare() if out is not None else None
    rows = [case for case in CASES if not cases or case.name in cases]
    table = compare_amplitudes(adhesive, skies, effects.settings, rows)
    shown = table.copy()
    shown.remove_columns(["setup", "temperature", "layer"])
    click.echo("\n".join(shown.pformat(max_lines=-1, max_width=-1, align="<")))
    for sentence in table.meta["contradiction"]:
        click.echo(sentence)
    if folder is not None:
        write_whole(folder / "amplitudes.ecsv", table_text(table))
        click.echo(str(folder / "amplitudes.ecsv"))


def read_line_list(path: Path) -> SkyCase:
    """Line list of the user, named like its file."""
    return SkyCase.of_table(
        printable_name("name of the line list", path.stem), read_user_table(path, "line list")
    )
