"""Fringe frames for a repository of real images, where this package is not installed.

The hand-off is a directory that ``butler import`` reads: the FITS files, which afw reads as they are, and an
export file in which they are ``ExposureF`` with the formatter of Rubin's own packages. A configuration with which the
fringe correction of ip_isr works goes along.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lsst.daf.butler import (
    Butler,
    ButlerUserError,
    CollectionType,
    DatasetRef,
    FileDataset,
    MissingDatasetTypeError,
)
from lsst.daf.butler.registry import RegistryError

from ..errors import InputError
from ..files import write_whole

FRINGE = "fringe"  # Dataset type that Rubin's instrument signature removal reads

EXPORT_FILE = "export.yaml"

ISR_FILE = "isr_fringe.py"

APERTURES = 20_000  # Places at which the scale of a template is measured; the default of ip_isr is 30 000

EXPOSURE_FORMATTER = "lsst.obs.base.formatters.fitsExposure.FitsExposureFormatter"


def write_handoff(
    butler: Butler, collection: str, directory: str | Path, *, where: str = "", dry_run: bool = False
) -> list[DatasetRef]:
    """Write the fringe frames of a collection for another repository.

    ``butler``: the repository that has the frames.
    ``collection``: calibration collection, whose validity ranges go along, or a run.
    ``directory``: directory for the files; new or empty.
    ``where``: condition on the data ids, as ``instrument='LSSTCam' AND detector.raft='R11'``.
    ``dry_run``: say what would be written, but write nothing.
    Returns the frames.
    `InputError`: there is no such collection, it has no fringe frames, or the directory is not empty.
    """
    target = Path(directory)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError("directory", str(target), "a new or an empty directory")
    refs = _find(butler, collection, where)
    if not dry_run:
        target.mkdir(parents=True, exist_ok=True)
        _export(butler, collection, refs, target)
    return refs


def _find(butler: Butler, collection: str, where: str) -> list[DatasetRef]:
    if collection not in butler.collections.query("*"):
        raise InputError("collection", collection, ", ".join(sorted(butler.collections.query("*"))) or "none")
    try:
        # The registry's query also looks into calibration collections without asking for a time.
        refs = set(butler.registry.queryDatasets(FRINGE, collections=collection, where=where))
    except MissingDatasetTypeError:
        refs = set()
    except (ButlerUserError, RegistryError) as error:
        raise InputError("where", where, f"a condition on data ids ({error})") from error
    if not refs:
        raise InputError(
            "fringe frames", 0, f"at least one in collection {collection!r} where {where or 'all'}"
        )
    return sorted(refs)


def _export(butler: Butler, collection: str, refs: list[DatasetRef], target: Path) -> None:
    storage_class = refs[0].datasetType.storageClass_name
    with butler.export(directory=str(target), filename=EXPORT_FILE, format="yaml", transfer="copy") as export:
        # Instruments, detectors and filters are those of the other repository: no records go along.
        expanded = [ref.expanded(butler.registry.expandDataId(ref.dataId)) for ref in refs]
        export.saveDatasets(expanded, elements=(), rewrite=_for_other_readers)
        if butler.collections.get_info(collection).type is CollectionType.CALIBRATION:
            export.saveCollection(collection)
    # The storage class can be changed in the file only: Python's type behind it need not be installed here.
    file = target / EXPORT_FILE
    text = file.read_text(encoding="utf-8")
    write_whole(file, text.replace(f"storage_class: {storage_class}\n", "storage_class: ExposureF\n"))
    filters = sorted({str(ref.dataId["physical_filter"]) for ref in refs})
    write_whole(target / ISR_FILE, isr_override(filters))


def isr_override(filters: Sequence[str]) -> str:
    """Configuration with which ``IsrTask`` of ip_isr subtracts templates without noise: ``-C isr:isr_fringe.py``.

    ``filters``: physical filters to be corrected; ip_isr corrects none unless it is told.

    The default statistic of an aperture is the median, which is another function of the fringe for a template without
    noise than for a noisy exposure; with it the scales of such templates were several times too large. Means agree.
    """
    return (
        "# Fringe correction with templates of lsst.fringe_sim.\n"
        "from lsst.afw.math import MEAN\n\n"
        "config.doFringe = True\n"
        f"config.fringe.filters = {list(filters)!r}\n"
        f"config.fringe.num = {APERTURES}\n"
        "# Medians of noiseless and of noisy apertures differ; means do not.\n"
        "config.fringe.stats.stat = int(MEAN)\n"
    )


def _for_other_readers(dataset: FileDataset) -> FileDataset:
    return FileDataset(path=dataset.path, refs=dataset.refs, formatter=EXPOSURE_FORMATTER)
