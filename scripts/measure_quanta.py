"""What one quantum of each task costs on a full sensor: processor time, memory, disk.

    python scripts/measure_quanta.py --folder /tmp/quanta

runs every task on one e2v sensor of 4096 x 4004 pixels, one process for each task, and
prints what the middleware has recorded of the quanta. The numbers are those of `algorithms.cost_model`; the requests
in bps/_common.yaml follow from them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from lsst.daf.butler import Butler

from lsst.fringe_sim.middleware import LsstCamFringe, Ts8Fringe

SEED_CONFIG = "resource://lsst.fringe_sim/configs/butler.yaml"
PIPELINES = "resource://lsst.fringe_sim/pipelines"
SENSOR = "RTM-020_S01"
CENTRE = 94

LABORATORY = ("ts8/labFlats.yaml", "LSST-TS8", "instrument='LSST-TS8'", "u/lab")
CAMERA = (
    "lsstCam/focalPlane.yaml",
    "LSSTCam",
    f"instrument='LSSTCam' AND detector={CENTRE} AND exposure.observation_type='science'",
    "u/sky",
)
DISCOVERY = ("ts8/discovery.yaml", "LSST-TS8", "instrument='LSST-TS8'", "u/lab")

STEPS = (
    (LABORATORY, "fringeBias"),
    (LABORATORY, "isrFlatPrep"),
    (LABORATORY, "epoxyFit"),
    (CAMERA, "skyFringeSim"),
    (CAMERA, "fringePca"),
    (CAMERA, "fringeForecast"),
    (CAMERA, "focalPlaneSummary"),
    (DISCOVERY, "effectDiscovery"),
)


@dataclass(frozen=True)
class Measured:
    """Costs of the quanta of one task."""

    label: str
    quanta: int
    processor_s: float
    peak_bytes: float
    disk_bytes: float

    def __str__(self) -> str:
        return (
            f"{self.label:20s} {self.quanta:3d} quanta, each {self.processor_s:7.2f} s of processor time; "
            f"peak {self.peak_bytes / 2**20:6.0f} MiB; {self.disk_bytes / 2**20:6.1f} MiB of products"
        )


def command(*arguments: object) -> None:
    """Run an installed command."""
    program, *rest = map(str, arguments)
    subprocess.run([str(Path(sys.executable).with_name(program)), *rest], check=True)


def prepare(folder: Path, size: str) -> Path:
    """Repository with the raw frames of one sensor, and a night of eleven hours."""
    repo = folder / "repo"
    command(
        *("fringe-sim", "mock-flats", folder / "raws", "--setup", "ts8_e2v", "--detector", SENSOR),
        *("--bias-frames", "3", "--seed", "1", *(("--size", size) if size else ())),
    )
    command("butler", "create", repo, "--seed-config", SEED_CONFIG)
    with Butler.from_config(str(repo), writeable=True) as butler:
        for instrument in (Ts8Fringe, LsstCamFringe):
            instrument().register(butler.registry)
    command("butler", "ingest-fringe-raws", repo, folder / "raws", "--transfer", "hardlink")
    command("butler", "define-fringe-night", repo, "LSSTCam", "--date", "20260115")
    return repo


def run(repo: Path, step: tuple[str, str, str, str], label: str) -> Measured:
    """Run one task in a process of its own."""
    pipeline, instrument, where, out = step
    command(
        *("pipetask", "run", "-b", repo, "-i", f"{instrument}/raw/all", "-o", out, "-j", "1"),
        *("-p", f"{PIPELINES}/{pipeline}#{label}", "-d", where, "--register-dataset-types"),
    )
    with Butler.from_config(str(repo), collections=out) as butler:
        processor, peak, disk = [], [], 0
        refs = butler.query_datasets(f"{label}_metadata", instrument=instrument)
        for ref in refs:
            quantum = butler.get(ref)["quantum"]
            processor.append(quantum.getScalar("endCpuTime") - quantum.getScalar("prepCpuTime"))
            peak.append(quantum.getScalar("endMaxResidentSetSize"))
        for kind in butler.registry.queryDatasetTypes("*"):
            if kind.name.startswith(label) or kind.name == "raw" or kind.isComponent():
                continue
            for product in butler.registry.queryDatasets(kind, collections=out, findFirst=True):
                path = Path(butler.getURI(product).ospath)
                if str(product.run) == str(refs[0].run):
                    disk += path.stat().st_size
    return Measured(label, len(refs), max(processor), max(peak), disk / len(refs))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="new folder; takes 6 GB")
    parser.add_argument("--size", default="", help="columns x rows of a smaller sensor")
    parser.add_argument("--only", help="labels, comma-separated; by default all")
    arguments = parser.parse_args()
    labels = [label for _, label in STEPS]
    chosen = arguments.only.split(",") if arguments.only else labels
    if set(chosen) - set(labels):
        parser.error(f"--only takes some of {', '.join(labels)}")
    arguments.folder.mkdir(parents=True)
    try:
        repo = prepare(arguments.folder, arguments.size)
        for step, label in STEPS:
            if label in chosen:
                print(run(repo, step, label), flush=True)
    finally:
        shutil.rmtree(arguments.folder)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
