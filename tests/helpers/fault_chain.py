"""A small chain on a repository of its own, run by the real commands, that can be hurt in many ways.

What must hold after every fault is asked here: every visible dataset can be read, no earlier one has changed, and
what comes out in the end is what an undisturbed run makes.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from astropy.io import fits
from lsst.daf.butler import Butler, Config, DatasetRef
from numpy.typing import NDArray

from lsst.fringe_sim.middleware import Ts8Fringe
from lsst.fringe_sim.middleware.raw_ingest import ingest_raws
from lsst.fringe_sim.middleware.repository import recover_repository
from lsst.fringe_sim.mock.raw_frames import write_mock_flats

SEED_CONFIG = "resource://lsst.fringe_sim/configs/butler.yaml"
PIPELINE = "resource://lsst.fringe_sim/pipelines/ts8/labFlats.yaml"
SENSOR = "RTM-020_S01"
WAVELENGTHS_NM = (880.0, 900.0, 920.0, 940.0, 965.0, 990.0)
ROWS, COLUMNS = 64, 256
OUT = "u/lab"
TASKS = {"fringeBias": "fringeBias", "fringeFlat": "isrFlatPrep", "epoxyThickness": "epoxyFit"}
"""Task by the dataset type that it makes, apart from logs and metadata."""

QUANTA = 2 + len(WAVELENGTHS_NM)


@dataclass(frozen=True)
class Ended:
    """How a command ended; a negative code is the signal that killed it."""

    code: int
    text: str
    seconds: float


def thickness_um() -> NDArray[np.float64]:
    """What the raw frames are made of."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return np.asarray(13.0 + 0.35 * np.sin(x / 60.0) + 0.3 * np.cos(y / 50.0))


def make_template(root: Path, seed_config: str = SEED_CONFIG) -> Path:
    """Repository with the raw frames of one small sensor; not to be changed, copied for each test."""
    made = write_mock_flats(
        root / "raw",
        setup="ts8_e2v",
        detector=SENSOR,
        thickness_um=thickness_um(),
        wavelengths_nm=WAVELENGTHS_NM,
        rng=np.random.default_rng(1),
        size=f"{COLUMNS}x{ROWS}",
        n_bias=2,
    )
    Butler.makeRepo(str(root / "repo"), config=Config(seed_config))
    with Butler.from_config(str(root / "repo"), writeable=True) as butler:
        Ts8Fringe().register(butler.registry)
        report = ingest_raws(butler, [str(made.paths[0].parent)], transfer="copy")
    if report.refused or len(report.ingested) != 2 + len(WAVELENGTHS_NM):
        raise AssertionError(report)
    return root


@dataclass(frozen=True)
class Undisturbed:
    """An undisturbed run: the repository it left, what came out, and how long it took."""

    repo: Path
    results: dict[str, str]
    seconds: float


class Chain:
    """One repository and what is done to it."""

    journals = 0
    """Kills that hit the registry in the middle of a transaction."""

    def __init__(self, template: Path, root: Path) -> None:
        self.root = root
        self.repo = root / "repo"
        shutil.copytree(template / "repo", self.repo)

    @classmethod
    def at(cls, repo: Path, root: Path) -> Self:
        """The chain on a repository that exists; ``root`` takes what the commands say."""
        chain = cls.__new__(cls)
        chain.root, chain.repo = root, repo
        return chain

    def command(
        self,
        program: str,
        *arguments: object,
        kill_after: float | None = None,
        kill_at_file: int | None = None,
        environment: Mapping[str, str] | None = None,
        prepare: Callable[[], None] | None = None,
    ) -> Ended:
        """Run an installed command in a process group of its own."""
        started = time.monotonic()
        with tempfile.TemporaryFile(dir=self.root) as said:
            child = subprocess.Popen(
                [str(Path(sys.executable).with_name(program)), *map(str, arguments)],
                stdout=said,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=prepare,
                env={**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **(environment or {})},
            )
            try:
                self._await_files(child, kill_at_file)
                code = child.wait(kill_after)
            except subprocess.TimeoutExpired:
                os.killpg(child.pid, signal.SIGKILL)
                code = child.wait()
                self.journals += (self.repo / "gen3.sqlite3-journal").exists()
                recover_repository(str(self.repo))
            said.seek(0)
            return Ended(code, said.read().decode("utf-8", "replace"), time.monotonic() - started)

    def _await_files(self, child: subprocess.Popen[bytes], number: int | None) -> None:
        there = self._files()
        while number is not None and child.poll() is None and self._files() < there + number:
            time.sleep(0.001)

    def _files(self) -> int:
        return sum(len(files) for _, _, files in os.walk(self.repo / "u"))

    def run(
        self, *extra: object, out: str = OUT, resume: bool = True, subset: str = "", **kwargs: Any
    ) -> Ended:
        """``pipetask run`` of the chain; what collection ``out`` has already is not made again."""
        again = ("--skip-existing-in", out) if resume and self.has_collection(out) else ()
        fit = () if subset else ("-c", "epoxyFit:min_wavelengths=4")
        return self.command(
            *(
                "pipetask",
                "run",
                "-b",
                self.repo,
                "-i",
                "LSST-TS8/raw/all",
                "-o",
                out,
                "-p",
                PIPELINE + subset,
            ),
            *("-c", "isrFlatPrep:edge_px=2", *fit),
            *("-d", "instrument='LSST-TS8'", "-j", "1", "--register-dataset-types", *again, *extra),
            **kwargs,
        )

    def has_collection(self, name: str) -> bool:
        """Whether the repository has a collection."""
        with Butler.from_config(str(self.repo)) as butler:
            return name in butler.collections.query("*")

    def _refs(self, butler: Any, collections: str) -> Iterator[DatasetRef]:
        for kind in sorted(butler.registry.queryDatasetTypes("*"), key=lambda kind: kind.name):
            if not kind.isComponent():
                yield from butler.registry.queryDatasets(kind, collections=collections)

    def visible(self, collections: str = "*") -> dict[str, str]:
        """Digest of the file of every dataset that the Butler shows, by its id.

        Only those of finished quanta are returned: what a quantum stored that was cut off before it stored its
        metadata is made again, and replaced where a run is extended.
        """
        found: dict[DatasetRef, str] = {}
        with Butler.from_config(str(self.repo)) as butler:
            for ref in set(self._refs(butler, collections)):
                path = Path(butler.getURI(ref).ospath)
                if not path.is_file():
                    raise AssertionError(f"{ref} is shown and has no file")
                digest = hashlib.sha256(path.read_bytes()).hexdigest()
                if ref.datasetType.name != "raw":
                    butler.get(ref)  # a product verifies its checksums
                found[ref] = digest
        finished = {(ref.run, ref.dataId, _task_of(ref)) for ref in found if _is_metadata(ref)}
        return {
            str(ref.id): digest
            for ref, digest in found.items()
            if _task_of(ref) is None or (ref.run, ref.dataId, _task_of(ref)) in finished
        }

    def number(self, kind: str, collections: str = OUT) -> int:
        """Number of datasets of a type that a chain of collections shows."""
        with Butler.from_config(str(self.repo)) as butler:
            if not list(butler.registry.queryDatasetTypes(kind)):
                return 0
            first = collections != "*"
            return len(set(butler.registry.queryDatasets(kind, collections=collections, findFirst=first)))

    def at_once(self, *collections: str) -> list[Ended]:
        """Run the chain into several collections at the same time."""
        with ThreadPoolExecutor(len(collections)) as pool:
            return list(pool.map(lambda out: self.run(out=out), collections))

    def complete_quanta(self, collections: str = OUT) -> int:
        """Number of quanta of which all outputs are there; their metadata come last."""
        if not self.has_collection(collections):
            return 0
        return sum(
            self.number(f"{label}_metadata", collections)
            for label in ("fringeBias", "isrFlatPrep", "epoxyFit")
        )

    def results(self, collections: str = OUT) -> dict[str, str]:
        """Digest of pixels and header of every product, without what names the run."""
        found: dict[str, str] = {}
        with Butler.from_config(str(self.repo)) as butler:
            for kind in TASKS:
                for ref in butler.registry.queryDatasets(kind, collections=collections, findFirst=True):
                    found[f"{kind} {ref.dataId.required}"] = content_digest(butler.getURI(ref).ospath)
        return found


def _is_metadata(ref: DatasetRef) -> bool:
    return ref.datasetType.name.endswith("_metadata")


def _task_of(ref: DatasetRef) -> str | None:
    """Task whose quantum made a dataset; `None` for raw frames, and for what is stored before any quantum runs."""
    name = ref.datasetType.name
    for suffix in ("_metadata", "_log"):
        if name.endswith(suffix):
            return name.removesuffix(suffix)
    return TASKS.get(name)


def content_digest(path: str) -> str:
    """Digest of all pixels and keywords of a FITS file but checksums, run, ids, and the time of the run."""
    digest = hashlib.sha256()
    with fits.open(path) as hdus:
        for hdu in hdus:
            cards = {
                key: repr(hdu.header[key])
                for key in hdu.header
                if not key.startswith(("LSST BUTLER", "CALIB_CREATION"))
                and key not in ("CHECKSUM", "DATASUM", "COMMENT", "")
            }
            digest.update(json.dumps(cards, sort_keys=True).encode())
            if hdu.data is not None:
                digest.update(np.ascontiguousarray(hdu.data).tobytes())
    return digest.hexdigest()
