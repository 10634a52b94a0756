"""Subcommands that this package adds to ``butler``."""

from __future__ import annotations

import contextlib
import datetime
import functools
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from lsst.daf.butler.cli.opt import options_file_option, repo_argument, transfer_option, where_option
from lsst.daf.butler.cli.utils import ButlerCommand

from ..errors import FringeSimError

if TYPE_CHECKING:
    from lsst.daf.butler import Butler


def get_cli_subcommands() -> list[click.Command]:
    """Return the subcommands; the entry point ``butler.cli`` leads here."""
    return [
        ingest_fringe_raws,
        define_fringe_night,
        adopt_sensor_datasets,
        write_fringe_handoff,
        prepare_fringe_repo,
        recover_fringe_repo,
    ]


def _one_clear_message(command: Callable[..., None]) -> Callable[..., None]:
    """Turn an error that the user can mend into one line and exit status 1."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
        except FringeSimError as error:
            raise click.ClickException(str(error)) from error

    return wrapped


def _butler(repo: str, *, writeable: bool = False) -> contextlib.AbstractContextManager[Butler]:
    """Open a repository; what is none is refused in one line."""
    from .repository import open_repository

    return open_repository(repo, writeable=writeable)


@click.command(short_help="Ingest raw frames in the LSST layout.", cls=ButlerCommand)
@repo_argument(required=True)
@click.argument("paths", metavar="PATH ...", nargs=-1, required=True)
@click.option("--output-run", metavar="RUN", help="Run for the frames; by default INSTRUMENT/raw/all.")
@transfer_option()
@click.option("-n", "--dry-run", is_flag=True, help="Look at every file and report, but store nothing.")
@options_file_option()
@_one_clear_message
def ingest_fringe_raws(
    repo: str, paths: tuple[str, ...], output_run: str | None, transfer: str, dry_run: bool
) -> None:
    """Ingest raw frames: exposure records from their headers, and the files.

    PATH is a file, a directory that is searched with all below it, or a quoted pattern. Frames that the
    repository has already are left alone. A file that cannot be used is reported in one line; the others go in,
    and the exit status is 1.
    """
    from .raw_ingest import ingest_raws
    from .repository import require_prepared

    require_prepared(repo)
    with _butler(repo, writeable=not dry_run) as butler:
        report = ingest_raws(butler, paths, transfer=transfer, run=output_run, dry_run=dry_run)
    for message in report.refused:
        click.echo(f"refused: {message}", err=True)
    for note in report.notes:
        click.echo(note, err=True)
    if dry_run:
        for exposure in report.ingested:
            info = exposure.info
            click.echo(
                f"{exposure.path}: {exposure.instrument} {info.detector_unique_name} exposure "
                f"{info.exposure_id} {info.observation_type} {info.physical_filter} {info.object}"
            )
    runs = ", ".join(report.run.values()) or "no run"
    verb = "would be ingested" if dry_run else "ingested"
    click.echo(
        f"{len(report.ingested)} raw frames {verb} into {runs}; {len(report.present)} were there already; "
        f"{len(report.refused)} refused"
    )
    if report.refused:
        sys.exit(1)


@click.command(short_help="Register the sky exposures of a night.", cls=ButlerCommand)
@repo_argument(required=True)
@click.argument("instrument")
@click.option(
    "--date",
    "dates",
    metavar="YYYYMMDD",
    required=True,
    multiple=True,
    type=click.DateTime(["%Y%m%d", "%Y-%m-%d"]),
    help="Evening on which the night begins; may be given several times.",
)
@click.option(
    "--hours",
    metavar="FIRST:LAST[:STEP]",
    default="19:29",
    show_default=True,
    help="Local hours of the exposures, the last one included; 25 is 1 h after midnight.",
)
@click.option("--exposure-time", type=float, default=30.0, show_default=True, help="Exposure time, seconds.")
@click.option("--airmass", type=float, default=1.2, show_default=True, help="Airmass of the exposures.")
@click.option("--filter", "physical_filter", help="Physical filter; by default the y filter.")
@click.option("-n", "--dry-run", is_flag=True, help="Show the exposures, but store nothing.")
@options_file_option()
@_one_clear_message
def define_fringe_night(
    repo: str,
    instrument: str,
    dates: tuple[datetime.datetime, ...],
    hours: str,
    exposure_time: float,
    airmass: float,
    physical_filter: str | None,
    dry_run: bool,
) -> None:
    """Register a night of sky exposures, for which sky fringes are to be simulated.

    INSTRUMENT is the name of an instrument that the repository knows, as LSSTCam. Only records are made, no
    images. The run INSTRUMENT/raw/all is there afterwards, an input for graphs that need no other. Registering the
    same night again changes nothing.
    """
    from .night import NightPlan, define_night, parse_hours
    from .repository import require_prepared

    require_prepared(repo)
    plans = [
        NightPlan(
            date=date.date(),
            hours=parse_hours(hours),
            exposure_time_s=exposure_time,
            airmass=airmass,
            physical_filter=physical_filter,
        )
        for date in dates
    ]
    with _butler(repo, writeable=not dry_run) as butler:
        records = define_night(butler, instrument, plans, dry_run=dry_run)
    for record in records:
        click.echo(
            f"exposure {record['id']}  {record['target_name']}  {record['physical_filter']}  "
            f"{record['exposure_time']:g} s"
        )
    click.echo(f"{len(records)} exposures {'would be registered' if dry_run else 'registered'}")


@click.command(short_help="Write fringe frames for a repository of real images.", cls=ButlerCommand)
@repo_argument(required=True)
@click.argument("collection")
@click.argument("directory")
@where_option()
@click.option("-n", "--dry-run", is_flag=True, help="Show the frames, but write nothing.")
@options_file_option()
@_one_clear_message
def write_fringe_handoff(repo: str, collection: str, directory: str, where: str, dry_run: bool) -> None:
    """Write fringe frames for a repository of real images, where this package is not installed.

    The frames of COLLECTION go into DIRECTORY, which must be new or empty, with their validity ranges if it is a
    calibration collection. There, "butler import OTHER_REPO DIRECTORY --transfer copy" takes them in as ExposureF.
    """
    from .handoff import write_handoff

    with _butler(repo) as butler:
        refs = write_handoff(butler, collection, directory, where=where, dry_run=dry_run)
    for ref in refs:
        click.echo(str(ref.dataId))
    click.echo(f"{len(refs)} fringe frames {'would be written' if dry_run else 'written'} to {directory}")


@click.command(short_help="Give datasets of sensors to another instrument.", cls=ButlerCommand)
@repo_argument(required=True)
@click.argument("dataset_type")
@click.argument("collection")
@click.argument("instrument")
@click.argument("run")
@where_option()
@transfer_option(default="hardlink", show_default=True)
@click.option("-n", "--dry-run", is_flag=True, help="Show the datasets, but store nothing.")
@options_file_option()
@_one_clear_message
def adopt_sensor_datasets(
    repo: str,
    dataset_type: str,
    collection: str,
    instrument: str,
    run: str,
    where: str,
    transfer: str,
    dry_run: bool,
) -> None:
    """Give datasets of sensors the data ids that the same sensors have in another instrument.

    What was measured of a sensor on a test stand, as its epoxyThickness, is found by its serial number and stored
    in RUN once more, under INSTRUMENT. What RUN has already stays as it is.
    """
    from .adoption import adopt_datasets

    with _butler(repo, writeable=not dry_run) as butler:
        report = adopt_datasets(
            butler,
            dataset_type,
            [collection],
            instrument,
            run,
            where=where,
            transfer=transfer,
            dry_run=dry_run,
        )
    for ref in report.adopted:
        click.echo(f"{ref.datasetType.name} {instrument} {ref.dataId['detector']}")
    if report.homeless:
        click.echo(f"not in {instrument}: {', '.join(report.homeless)}", err=True)
    verb = "would be adopted" if dry_run else "adopted"
    click.echo(f"{len(report.adopted)} datasets {verb} into {run}; {len(report.present)} were there already")


@click.command(short_help="Let a repository hold datasets of this package.", cls=ButlerCommand)
@repo_argument(required=True)
@options_file_option()
@_one_clear_message
def prepare_fringe_repo(repo: str) -> None:
    """Add the storage classes and formatters of this package to the configuration of an existing repository.

    A repository that was created with the seed configuration has them. What is there stays as it is; doing it twice
    changes nothing.
    """
    from .repository import prepare_repository

    added = prepare_repository(repo)
    click.echo(f"{repo}: added {', '.join(dict.fromkeys(added))}" if added else f"{repo}: nothing is missing")


@click.command(short_help="Undo what a killed process left half done.", cls=ButlerCommand)
@repo_argument(required=True)
@options_file_option()
@_one_clear_message
def recover_fringe_repo(repo: str) -> None:
    """Undo the transaction that a killed process has left in an SQLite registry.

    Needed where "pipetask" and "butler" stop with "attempt to write a readonly database". Every dataset that was
    stored before stays; the run can be resumed. Doing it twice, or without need, changes nothing.
    """
    from .repository import recover_repository

    recover_repository(repo)
    click.echo(f"{repo}: the registry is in order")
