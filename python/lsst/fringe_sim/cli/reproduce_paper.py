"""``fringe-sim reproduce-paper``."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..errors import InputError
from ..files import table_text, write_whole
from .command import command, flag, option
from .output import OutputFolder, origin_of, output_folder
from .parameters import SIZE
from .progress import progress

if TYPE_CHECKING:
    from ..paper.published import Finding

ENVIRONMENT = "FRINGE_SIM_SHARED"
BESIDE = Path("../shared")  # Where the published curves lie beside a development checkout
DETAIL_PX = 1000
DETAIL_CORNER = (1500, 1500)
LEAST_SIDE = 64
SILICON_CHANGE = 0.05  # Relative change by the constants of silicon from which both numbers are printed


@command()
def reproduce_paper(
    out: OutputFolder = output_folder("Folder for the page and the table.", "paper.html", "paper.ecsv"),
    size: tuple[int, int] = option("Pixels for the whole sensor.", "1024x1001", SIZE),
    coadds: int = option("Exposures of the deepest coadd.", 800, click.IntRange(2)),
    published: Path | None = option(
        f"Folder with curves read off the published figures (measured/); by default ${ENVIRONMENT}, then "
        f"{BESIDE}, where they are there.",
        kind=click.Path(exists=True, file_okay=False, path_type=Path),
    ),
    seed: int = option("Seed of noise and rotations.", 1, click.IntRange(0)),
    dry_run: bool = flag("Say what would be computed, write nothing."),
) -> None:
    """Recompute every figure and number of the paper, beside what it states.

    Writes one page, paper.html, and one table, paper.ecsv. Every number is judged by a stated tolerance; where the
    paper errs, the correction and its reason are given; where the recomputation misses, that is said.

    \b
    Examples:
      fringe-sim reproduce-paper --out paper
      fringe-sim reproduce-paper --out paper --published ../shared
    """
    from ..instrument.measured_thickness import E2V_SHAPE, e2v_321
    from ..paper import SECTIONS, reproduce
    from ..paper.section import Context
    from ..report.paper_page import write_paper_page

    columns, rows = size
    if min(size) < LEAST_SIDE or rows > E2V_SHAPE[0] or columns > E2V_SHAPE[1]:
        raise InputError(
            "--size", f"{columns}x{rows}", f"{LEAST_SIDE} px a side to {E2V_SHAPE[1]}x{E2V_SHAPE[0]}"
        )
    folder = published or _found()
    if dry_run:
        compared = f"compared with curves in {folder}" if folder else "without published curves"
        click.echo(f"would recompute {len(SECTIONS)} sections into {out}, {compared}")
        return
    context = Context(
        e2v_321((rows, columns)),
        e2v_321((DETAIL_PX, DETAIL_PX), sampling="window", corner=DETAIL_CORNER),
        coadds,
        seed,
        folder,
    )
    target = out.prepare()
    notices = []
    if folder is not None:
        click.echo(f"published curves: {folder}", err=True)
    else:
        notices.append(
            "Curves and maps read off the published figures are not at hand: comparisons with them are skipped "
            f"(--published FOLDER or ${ENVIRONMENT})."
        )
        click.echo(
            f"skipping comparisons with published curves; --published FOLDER or ${ENVIRONMENT}", err=True
        )
    with progress("recomputing", len(SECTIONS)) as advance:
        made = reproduce(context, advance=advance)
    write_whole(target / "paper.ecsv", table_text(made.table()))
    write_paper_page(made, target / "paper.html", notices, origin_of(target, ()))
    for line in (*_notable(made.all_findings), made.summary(), target / "paper.html", target / "paper.ecsv"):
        click.echo(str(line))


def _notable(findings: Sequence[Finding]) -> Iterator[str]:
    """Numbers that differ from those of the paper, and those that the constants of silicon change."""
    for finding in findings:
        number = finding.number
        if finding.status == "differs":
            yield f"differs: {_told(finding)} (paper {number.stated} ± {number.tolerance:g})"
    for finding in findings:
        if abs(finding.cold - finding.value) > SILICON_CHANGE * abs(finding.value):
            cold = f"{finding.cold:.4g} with those measured in the cold"
            yield f"silicon: {_told(finding)} with the constants of the paper, {cold}"


def _told(finding: Finding) -> str:
    number = finding.number
    return f"{number.place}: {number.quantity}: {finding.value:.4g} {number.unit}"


def _found() -> Path | None:
    """The first of the usual folders with curves in it."""
    named = os.environ.get(ENVIRONMENT)
    for path in ([Path(named)] if named else []) + [BESIDE]:
        if (path / "measured").is_dir():
            return path
    return None
