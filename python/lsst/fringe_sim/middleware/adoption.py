"""Datasets of a sensor under another instrument.

A sensor is one thing with two data ids: one of the test stand where it was measured, one of the camera in which it
looks at the sky. What was measured on the stand is adopted by the camera by way of the serial number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from lsst.daf.butler import (
    Butler,
    ButlerUserError,
    DataCoordinate,
    DatasetRef,
    DatasetType,
    FileDataset,
    MissingDatasetTypeError,
)

from ..errors import InputError, UnknownNameError
from ..instrument.detector import Detector
from .instruments import INSTRUMENTS, FringeInstrument


@dataclasses.dataclass(frozen=True)
class AdoptionReport:
    """What became of the datasets."""

    # adopted, present: datasets that are new under the instrument (or would be), and those that the run had
    # before
    adopted: tuple[DatasetRef, ...]
    present: tuple[DatasetRef, ...]
    homeless: tuple[str, ...]  # names of sensors that the instrument does not have


def adopt_datasets(
    butler: Butler,
    dataset_type: str,
    collections: Sequence[str],
    instrument: str,
    run: str,
    *,
    where: str = "",
    transfer: str = "hardlink",
    dry_run: bool = False,
) -> AdoptionReport:
    """Give datasets of sensors the data ids that the same sensors have in another instrument.

    ``butler``: the repository, writeable unless ``dry_run``.
    ``dataset_type``: dataset type with the dimensions instrument and detector, as ``epoxyThickness``.
    ``collections``: where the datasets are; the first that has one wins.
    ``instrument``: name of the instrument that adopts them.
    ``run``: run into which they go; what it has already stays as it is.
    ``where``: condition on the data ids, as ``instrument='LSST-TS8' AND detector.raft='RTM-020'``.
    ``transfer``: how the files come along: ``hardlink``, ``copy``, ``direct``, ….
    ``dry_run``: say what would be adopted, but store nothing.
    `UnknownNameError`: the repository does not know the instrument or the dataset type.
    `InputError`: the dataset type has other dimensions, or there is nothing to adopt.
    """
    known = [record.name for record in butler.query_dimension_records("instrument", explain=False)]
    by_name = {cls.getName(): cls for cls in INSTRUMENTS.values() if cls.getName() in known}
    if instrument not in by_name:
        raise UnknownNameError("instrument", instrument, by_name)
    kind = _dataset_type(butler, dataset_type)
    found = _find(butler, kind, collections, where)
    homes = {each.serial: each for each in by_name[instrument].camera().detectors if each.serial}
    wanted: list[tuple[DatasetRef, DatasetRef]] = []
    present: list[DatasetRef] = []
    homeless: list[str] = []
    for ref in found:
        sensor = _sensor(ref.dataId, by_name)
        if sensor is None or str(ref.dataId["instrument"]) == instrument:
            continue
        if sensor.serial not in homes:
            homeless.append(sensor.name)
            continue
        data_id = DataCoordinate.standardize(
            instrument=instrument, detector=homes[sensor.serial].id, universe=butler.dimensions
        )
        there = _existing(butler, kind, data_id, run)
        if there is None:
            wanted.append((ref, DatasetRef(kind, data_id, run=run)))
        else:
            present.append(there)
    if not wanted and not present:
        raise InputError(
            f"datasets {dataset_type} in {', '.join(collections)}",
            f"{len(found)} found, none of a sensor of {instrument}",
            f"at least one of another instrument whose serial number {instrument} has",
        )
    if wanted and not dry_run:
        butler.collections.register(run)
        butler.ingest(
            *(FileDataset(path=butler.getURI(old), refs=[new]) for old, new in wanted), transfer=transfer
        )
    return AdoptionReport(tuple(new for _, new in wanted), tuple(present), tuple(sorted(homeless)))


def _dataset_type(butler: Butler, name: str) -> DatasetType:
    try:
        kind = butler.get_dataset_type(name)
    except MissingDatasetTypeError:
        known = [item.name for item in butler.registry.queryDatasetTypes("*")]
        raise UnknownNameError("dataset type", name, known) from None
    if set(kind.dimensions.required) != {"instrument", "detector"}:
        raise InputError(f"dimensions of {name}", sorted(kind.dimensions.required), "instrument and detector")
    return kind


def _find(butler: Butler, kind: DatasetType, collections: Sequence[str], where: str) -> list[DatasetRef]:
    try:
        refs = butler.registry.queryDatasets(kind, collections=collections, where=where, findFirst=True)
        return sorted(set(refs))
    except (ButlerUserError, LookupError) as error:
        raise InputError("collections and condition", (*collections, where), str(error)) from error


def _sensor(data_id: DataCoordinate, by_name: Mapping[str, type[FringeInstrument]]) -> Detector | None:
    cls = by_name.get(str(data_id["instrument"]))
    return None if cls is None else cls.camera().detector(int(data_id["detector"]))


def _existing(butler: Butler, kind: DatasetType, data_id: DataCoordinate, run: str) -> DatasetRef | None:
    if run not in butler.collections.query("*"):
        return None
    return butler.find_dataset(kind, data_id, collections=run)
