"""Raw frames into a repository: exposure records from the headers, files by `Butler.ingest`.

Every file is looked at before anything is stored. A file that cannot be used is set aside with one message; the
others go in. What is already there stays as it is, so that ingesting again changes nothing; another file with the
data id of one that is there, as a second mock series of the same hour has it, is refused.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import astropy.units as u
from astro_metadata_translator import ObservationInfo

from lsst.daf.butler import (
    Butler,
    CollectionType,
    DataCoordinate,
    DatasetRef,
    DatasetType,
    FileDataset,
    Timespan,
)
from lsst.daf.butler.registry import ConflictingDefinitionError
from lsst.daf.butler.time_utils import TimeConverter
from lsst.resources import ResourcePath

from ..errors import FrameFormatError, InputError
from ..files import refuse_unfinished
from ..instrument.raw_files import find_raw_files
from ..instrument.raw_frame import RawMetadata, read_raw_header
from ..resources import first_line
from .formatters import RawFrameFormatter
from .instruments import INSTRUMENTS, FringeInstrument
from .translators import TRANSLATORS

RAW = "raw"  # Dataset type of raw frames

COMPARED_BLOCKS, COMPARED_BYTES = 64, 8192
"""Blocks in which a file is compared with that in the repository, and their length."""


@dataclasses.dataclass(frozen=True)
class RawExposure:
    """One raw file that can be ingested."""

    path: str
    info: ObservationInfo  # What its header says
    instrument: str
    notes: tuple[str, ...] = ()  # What was taken for granted because the header does not state it

    @property
    def data_id(self) -> dict[str, Any]:
        """Instrument, exposure and detector."""
        return {
            "instrument": self.instrument,
            "exposure": self.info.exposure_id,
            "detector": self.info.detector_num,
        }


@dataclasses.dataclass(frozen=True)
class IngestReport:
    """What became of the files."""

    # ingested, present: files that are new in the repository (or would be), and files that were there before
    ingested: tuple[RawExposure, ...]
    present: tuple[RawExposure, ...]
    refused: tuple[str, ...]  # one message for each file that could not be used
    run: Mapping[str, str]  # run into which the files of each instrument went

    @property
    def notes(self) -> tuple[str, ...]:
        """What was taken for granted, with the number of frames that do not state it."""
        found = Counter(note for exposure in (*self.ingested, *self.present) for note in exposure.notes)
        return tuple(f"{number} raw frames: {note}" for note, number in found.items())


def raw_dataset_type(butler: Butler) -> DatasetType:
    """Return the dataset type of raw frames."""
    return DatasetType(RAW, ("instrument", "exposure", "detector"), "RawFrame", universe=butler.dimensions)


ATTEMPTS = 3  # How often frames are looked for and stored, if other processes store them at the same time


def ingest_raws(
    butler: Butler,
    paths: Iterable[str],
    *,
    transfer: str | None = "auto",
    run: str | None = None,
    dry_run: bool = False,
) -> IngestReport:
    """Ingest raw frames.

    ``butler``: the repository, writeable unless ``dry_run``.
    ``paths``: files, directories and patterns.
    ``transfer``: how the files come into the repository (``copy``, ``link``, ``direct`` to leave them where
        they are, …).
    ``run``: run for the files; by default ``<instrument>/raw/all``.
    ``dry_run``: look at the files and report, but store nothing.
    Returns what became of each file.
    `InputError`: the repository holds raw frames of another kind, other processes ingest the same frames over and
        over, or a run of `fringe-sim` writes into one of the folders or was stopped there.
    """
    paths = [str(path) for path in paths]
    refuse_unfinished(paths)
    files, unusable = find_raw_files(paths)
    refused = [str(error) for error in unusable]
    registered = _registered_instruments(butler)
    usable: list[RawExposure] = []
    for file in files:
        try:
            usable.append(examine(file, registered))
        except InputError as error:
            refused.append(_one_line(error))
    usable, contradicting = _agreeing(usable)
    refused += contradicting
    runs = {name: run or cls().makeDefaultRawIngestRunName() for name, cls in registered.items()}
    new, present, others = _split_by_presence(butler, usable, runs)
    for attempt in range(0 if dry_run else ATTEMPTS):
        try:
            new, conflicting = _store(butler, new, registered, runs, transfer)
        except ConflictingDefinitionError as error:
            # Another process has stored some of the frames since they were looked for.
            if attempt == ATTEMPTS - 1:
                raise InputError(
                    "raw frames", _one_line(error), "frames that no other process ingests at the same time"
                ) from error
            butler.registry.refresh()
            new, present, others = _split_by_presence(butler, usable, runs)
            continue
        others += conflicting
        break
    refused += others
    used = {exposure.instrument for exposure in (*new, *present)}
    return IngestReport(
        tuple(new), tuple(present), tuple(refused), {name: runs[name] for name in sorted(used)}
    )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _registered_instruments(butler: Butler) -> dict[str, type[FringeInstrument]]:
    """Instruments of this package that the repository knows, by name."""
    names = {record.name for record in butler.query_dimension_records("instrument", explain=False)}
    return {cls.getName(): cls for cls in INSTRUMENTS.values() if cls.getName() in names}


def examine(path: str, registered: Mapping[str, type[FringeInstrument]]) -> RawExposure:
    """Read the header of one file.

    `InputError`: the file is no raw frame, or the repository does not know its instrument or its filter.
    """
    header = read_raw_header(path)
    metadata = RawMetadata.from_header(header, source=path)
    camera = metadata.camera
    instrument = INSTRUMENTS[camera]
    if instrument.getName() not in registered:
        raise InputError(
            "instrument",
            instrument.getName(),
            f"one that the repository knows ({', '.join(sorted(registered)) or 'there is none'}); "
            f"butler register-instrument REPO lsst.fringe_sim.{instrument.__name__} adds it",
            source=path,
        )
    try:
        info = ObservationInfo(header, filename=path, translator_class=TRANSLATORS[camera], pedantic=True)
        instrument.band_of(str(info.physical_filter))
        _check_time(info)
    except InputError as error:
        raise (error if error.source else error.in_source(path)) from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        # Whatever the translation stumbles over, the other files go in.
        allowed = "one that the middleware can translate"
        raise FrameFormatError("header", first_line(error), allowed, source=path) from error
    return RawExposure(path, info, instrument.getName(), metadata.notes)


def _check_time(info: ObservationInfo) -> None:
    """Refuse an exposure at a time that no repository can hold."""
    first, last = TimeConverter().epoch, TimeConverter().max_time
    for time in (info.datetime_begin, info.datetime_end):
        if time is None or not first <= time <= last:
            allowed = f"a time from {first.isot[:10]} to {last.isot[:10]}, which a repository can hold"
            raise FrameFormatError("DATE-OBS or MJD-OBS", str(time), allowed)


def _agreeing(exposures: Sequence[RawExposure]) -> tuple[list[RawExposure], list[str]]:
    """Set aside files that contradict an earlier one: the same data id twice, or one exposure told differently."""
    kept: list[RawExposure] = []
    refused = []
    first_of: dict[tuple[str, int], RawExposure] = {}
    by_data_id: dict[tuple[Any, ...], RawExposure] = {}
    for exposure in exposures:
        data_id = tuple(exposure.data_id.values())
        first = first_of.setdefault((exposure.instrument, exposure.data_id["exposure"]), exposure)
        try:
            if data_id in by_data_id:
                raise FrameFormatError(
                    "exposure and detector",
                    exposure.data_id,
                    f"those of no other file; {by_data_id[data_id].path} has the same",
                    source=exposure.path,
                )
            _refuse_contradiction(exposure, first)
        except InputError as error:
            refused.append(_one_line(error))
            continue
        by_data_id[data_id] = exposure
        kept.append(exposure)
    return kept, refused


def _refuse_contradiction(exposure: RawExposure, first: RawExposure) -> None:
    """Sensors that were read together must tell the same of their exposure."""
    record, other = _exposure_record(exposure.info), _exposure_record(first.info)
    for field, value in record.items():
        if value != other[field]:
            raise FrameFormatError(
                f"{field} of exposure {record['id']}",
                str(value),
                f"{other[field]}, as {first.path} has it; a frame of another exposure needs a DATE-OBS or SEQNUM "
                "of its own",
                source=exposure.path,
            )


def _exposure_record(info: ObservationInfo) -> dict[str, Any]:
    """Record of the exposure dimension."""
    exposure_time, dark_time = _seconds(info.exposure_time), _seconds(info.dark_time)
    return {
        "instrument": info.instrument,
        "id": info.exposure_id,
        "obs_id": info.observation_id,
        "group": info.exposure_group,
        "day_obs": info.observing_day,
        "physical_filter": info.physical_filter,
        "exposure_time": exposure_time,
        "dark_time": dark_time,
        "observation_type": info.observation_type,
        "observation_reason": info.observation_reason,
        "seq_num": info.observation_counter,
        "seq_start": info.group_counter_start,
        "seq_end": info.group_counter_end,
        "target_name": info.object,
        "science_program": info.science_program,
        "zenith_angle": _zenith_angle(info.boresight_airmass),
        "has_simulated": info.has_simulated_content,
        "can_see_sky": info.can_see_sky,
        "timespan": Timespan(info.datetime_begin, info.datetime_end),
    }


def _zenith_angle(airmass: float | None) -> float | None:
    """Degrees, as in records of simulated nights."""
    return None if airmass is None else math.degrees(math.acos(1.0 / airmass))


def _seconds(duration: u.Quantity | None) -> float | None:
    return None if duration is None else float(duration.to_value(u.s))


def _split_by_presence(
    butler: Butler, exposures: Sequence[RawExposure], runs: Mapping[str, str]
) -> tuple[list[RawExposure], list[RawExposure], list[str]]:
    """Files that are new, files that the run has already, and a message for each whose place another file has."""
    there: dict[tuple[Any, ...], DatasetRef] = {}
    for instrument in {exposure.instrument for exposure in exposures}:
        if _has_run(butler, runs[instrument]):
            refs = butler.query_datasets(
                RAW, collections=runs[instrument], instrument=instrument, explain=False, limit=None
            )
            there |= {
                tuple(ref.dataId[name] for name in ("instrument", "exposure", "detector")): ref
                for ref in refs
            }
    new: list[RawExposure] = []
    present: list[RawExposure] = []
    others: list[str] = []
    for exposure in exposures:
        ref = there.get(tuple(exposure.data_id.values()))
        if ref is None:
            new.append(exposure)
        elif _same_content(exposure.path, butler.getURI(ref)):
            present.append(exposure)
        else:
            others.append(
                f"{exposure.path}: the repository has another frame of exposure {exposure.data_id['exposure']}, "
                f"detector {exposure.data_id['detector']}; allowed: a DATE-OBS or SEQNUM of its own, or another run"
            )
    return new, present, others


def _same_content(path: str, stored: ResourcePath) -> bool:
    """Whether a file is the one that is stored, by its length and by blocks from its beginning to its end.

    A frame of a camera has noise in every block; to compare all of a night would take as long as to ingest it.
    """
    if not stored.isLocal or not Path(stored.ospath).is_file() or os.path.samefile(path, stored.ospath):
        return True  # elsewhere, gone (which is not mended by a second ingest), or linked
    length = os.path.getsize(path)
    if length != os.path.getsize(stored.ospath):
        return False
    with open(path, "rb") as one, open(stored.ospath, "rb") as other:
        for number in range(COMPARED_BLOCKS):
            place = max(length - COMPARED_BYTES, 0) * number // (COMPARED_BLOCKS - 1)
            one.seek(place)
            other.seek(place)
            if one.read(COMPARED_BYTES) != other.read(COMPARED_BYTES):
                return False
    return True


def _has_run(butler: Butler, run: str) -> bool:
    known_type = bool(list(butler.registry.queryDatasetTypes(RAW)))
    return known_type and run in butler.collections.query("*", collection_types=CollectionType.RUN)


def _store(
    butler: Butler,
    exposures: Sequence[RawExposure],
    registered: Mapping[str, type[FringeInstrument]],
    runs: Mapping[str, str],
    transfer: str | None,
) -> tuple[list[RawExposure], list[str]]:
    """Write records and files; exposures that contradict the repository are set aside."""
    dataset_type = _registered_dataset_type(butler)
    refused = _sync_exposures(butler, exposures, registered)
    stored = [exposure for exposure in exposures if _exposure_key(exposure) not in refused]
    for run in {runs[exposure.instrument] for exposure in stored}:
        butler.collections.register(run)
    datasets = [
        FileDataset(
            path=exposure.path,
            refs=[
                DatasetRef(
                    dataset_type,
                    DataCoordinate.standardize(exposure.data_id, universe=butler.dimensions),
                    run=runs[exposure.instrument],
                )
            ],
            formatter=RawFrameFormatter,
        )
        for exposure in stored
    ]
    if datasets:
        butler.ingest(*datasets, transfer=transfer)
    messages = [
        f"{exposure.path}: {refused[_exposure_key(exposure)]}"
        for exposure in exposures
        if _exposure_key(exposure) in refused
    ]
    return stored, messages


def _registered_dataset_type(butler: Butler) -> DatasetType:
    dataset_type = raw_dataset_type(butler)
    try:
        butler.registry.registerDatasetType(dataset_type)
    except ConflictingDefinitionError as error:
        raise InputError(
            "dataset type",
            RAW,
            f"one of storage class RawFrame; this repository holds raw frames of another package ({error})",
        ) from error
    return dataset_type


def _exposure_key(exposure: RawExposure) -> tuple[str, int]:
    return exposure.instrument, exposure.data_id["exposure"]


def _sync_exposures(
    butler: Butler, exposures: Sequence[RawExposure], registered: Mapping[str, type[FringeInstrument]]
) -> dict[tuple[str, int], str]:
    """Make the records of every exposure; return a message for each that the repository tells differently."""
    refused: dict[tuple[str, int], str] = {}
    for key, info in {_exposure_key(exposure): exposure.info for exposure in exposures}.items():
        try:
            with butler.transaction():
                registered[key[0]]().sync_exposure(butler.registry, _exposure_record(info))
        except ConflictingDefinitionError as error:
            refused[key] = (
                f"exposure {key[1]} of {key[0]} is in the repository with other properties "
                f"({_one_line(error)}); allowed: a DATE-OBS or SEQNUM of its own"
            )
    return refused
