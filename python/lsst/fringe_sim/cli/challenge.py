"""``fringe-sim challenge``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..errors import InputError
from ..files import json_text, write_whole
from .command import command, flag, option
from .output import OutputFolder, origin_of, output_folder
from .parameters import LABORATORY, SIZE, laboratory_of_the_mock

if TYPE_CHECKING:
    from ..challenge.result import CaseResult

RECORD = "cases.jsonl"
TABLES = ("challenge.ecsv", "confusion.ecsv", "accuracy.ecsv", "calibration.ecsv", "pulls.ecsv")


@command()
def challenge(
    out: OutputFolder = output_folder(
        "Folder for results, tables and page.", RECORD, *TABLES, "challenge.html", resumes=True
    ),
    seed: int = option("Seed of all cases.", kind=click.IntRange(0), required=True),
    none: int = option("Cases without effect.", 200, click.IntRange(0)),
    one: int = option("Cases with one effect.", 100, click.IntRange(0)),
    two: int = option("Cases with two effects.", 40, click.IntRange(0)),
    outsider: int = option("Cases with a cause that the catalogue lacks.", 100, click.IntRange(0)),
    setup: str = laboratory_of_the_mock,
    size: tuple[int, int] = option("Columns x rows of the sensors.", "96x96", SIZE),
    jobs: int = option("Cases at the same time.", 1, click.IntRange(1)),
    dry_run: bool = flag("Say what would be done, write nothing."),
) -> None:
    """Hide random effects in simulated sensors, search each, and count how often the search is right.

    Every case is written as soon as it ends: started again with the same seed, set-up and size, the command goes on
    where it was. Hundreds of cases take hours.

    \b
    Example:
      fringe-sim challenge --seed 7 --none 20 --one 20 --two 10 --outsider 10 --out challenge
    """
    from ..challenge.page import write_challenge_report
    from ..challenge.result import CASE_KINDS
    from ..challenge.run import run_challenge

    LABORATORY.convert(setup, None, None)
    counts = dict(zip(CASE_KINDS, (none, one, two, outsider), strict=True))
    total = sum(counts.values())
    if dry_run:
        click.echo(f"would run {total} cases of {size[0]} x {size[1]} pixels of {setup}: {counts}")
        return
    record = out.prepare() / RECORD
    known = _earlier_cases(record, {"seed": seed, "setup": setup, "columns": size[0], "rows": size[1]})
    done = sum(case.number < counts[case.kind] for case in known)
    if done:
        click.echo(f"{done} of {total} cases are there from before", err=True)

    def keep(result: CaseResult) -> None:
        nonlocal done
        done += 1
        with record.open("a") as stream:
            stream.write(result.to_json() + "\n")
        truth, found = "+".join(result.truth) or "none", "+".join(result.found) or result.verdict
        click.echo(f"{done} of {total}: {truth} -> {found} ({result.seconds:.0f} s)", err=True)

    result = run_challenge(
        counts, seed, size=(size[1], size[0]), setup=setup, known=known, jobs=jobs, progress=keep
    )
    path = result.write(out.path)
    write_challenge_report(out.path / "challenge.html", result, origin_of(out.path, ()))
    click.echo(json_text(result.summary()))
    click.echo(str(path))


def _earlier_cases(record: Path, identity: dict[str, int | str]) -> list[CaseResult]:
    """Cases that ran before; a new record starts with what they have in common."""
    from ..challenge.result import CaseResult

    lines = record.read_text().splitlines() if record.exists() else []
    if not lines:
        write_whole(record, json.dumps(identity) + "\n")
        return []
    if lines[0] != json.dumps(identity):
        raise InputError(
            f"challenge in {record.parent}", lines[0], f"{json.dumps(identity)}, or another folder"
        )
    # A line that a killed run left unfinished is not a case.
    complete = [line for line in lines[1:] if line.endswith("}")]
    if len(complete) < len(lines) - 1:
        write_whole(record, "\n".join([lines[0], *complete]) + "\n")
    return [CaseResult.from_json(line) for line in complete]
