"""The same night over and over in one process and one repository: memory, open files and products stay as they are.

    python tests/faults/soak.py

simulates eleven hours of nine sensors ten times, at reduced size, and prints a line for each night.
"""

import argparse
import datetime
import gc
import hashlib
import logging
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

from fault_chain import content_digest
from lsst.daf.butler import Butler, Config
from lsst.pipe.base import Pipeline
from lsst.pipe.base.simple_pipeline_executor import SimplePipelineExecutor

from lsst.fringe_sim.middleware import LsstCamFringe
from lsst.fringe_sim.middleware.night import NightPlan, define_night, parse_hours

PIPELINE = "resource://lsst.fringe_sim/pipelines/lsstCam/skyFringe.yaml"
RAFT, FIRST = "R22", 90  # A raft and its first detector
DATE = datetime.date(2026, 1, 15)
SHAPE = (80, 72)
PRODUCTS = ("skyFringe", "fringe", "fringeComponents")


@dataclass(frozen=True)
class Night:
    """What was there after a night."""

    quanta: int  # Quanta that ran
    resident_bytes: int  # Memory of the process
    open_files: int  # Its open files
    seconds: float  # How long the night took


def soak(
    root: Path, nights: int, hours: str, sensors: int, say: Callable[[str], None] = lambda line: None
) -> list[Night]:
    """Simulate the same night so many times."""
    repo = str(root / "repo")
    Butler.makeRepo(repo, config=Config("resource://lsst.fringe_sim/configs/butler.yaml"))
    with Butler.from_config(repo, writeable=True) as butler:
        LsstCamFringe().register(butler.registry)
        exposures = define_night(butler, "LSSTCam", [NightPlan(DATE, parse_hours(hours))])
    wanted = len(exposures) * sensors + sensors
    made: list[Night] = []
    first: dict[str, str] = {}
    files: dict[Path, tuple[str, float]] = {}
    for number in range(nights):
        started = time.monotonic()
        quanta = _simulate(repo, f"u/soak/{number:02d}", sensors)
        products = _products(repo, f"u/soak/{number:02d}")
        first = first or products
        if products != first or len(products) != (len(exposures) + 2) * sensors:
            raise AssertionError(f"night {number}: other products than those of the first night")
        if quanta != wanted:
            raise AssertionError(f"night {number}: {quanta} quanta ran, not {wanted}")
        files = _unchanged(root, files)
        _accounted_for(repo, root)
        gc.collect()
        made.append(Night(quanta, _resident(), len(os.listdir("/proc/self/fd")), time.monotonic() - started))
        say(
            f"night {number:2d}: {quanta} quanta, {made[-1].resident_bytes / 2**20:.1f} MiB resident, "
            f"{made[-1].open_files} open files, {made[-1].seconds:.0f} s"
        )
    return made


def growth(nights: list[Night]) -> float:
    """Memory that the process gains with each night [bytes], from the second half of the nights."""
    resident = [night.resident_bytes for night in nights[-max(len(nights) // 2, 2) :]]
    return float(np.polyfit(np.arange(len(resident)), resident, 1)[0])


def _simulate(repo: str, out: str, sensors: int) -> int:
    pipeline = Pipeline.from_uri(PIPELINE)
    pipeline.addConfigOverride("skyFringeSim", "stand_in", True)
    pipeline.addConfigOverride("skyFringeSim", "stand_in_shape", list(SHAPE))
    with SimplePipelineExecutor.prep_butler(repo, inputs=["LSSTCam/raw/all"], output=out) as butler:
        where = (
            f"instrument='LSSTCam' AND detector.raft='{RAFT}' AND detector >= {FIRST} "
            f"AND detector < {FIRST + sensors}"
        )
        executor = SimplePipelineExecutor.from_pipeline(pipeline, where=where, butler=butler)
        return len(executor.run(register_dataset_types=True))


def _products(repo: str, out: str) -> dict[str, str]:
    with Butler.from_config(repo, collections=out) as butler:
        return {
            f"{kind} {ref.dataId.required}": content_digest(butler.getURI(ref).ospath)
            for kind in PRODUCTS
            for ref in butler.registry.queryDatasets(kind, findFirst=True)
        }


def _unchanged(root: Path, before: dict[Path, tuple[str, float]]) -> dict[Path, tuple[str, float]]:
    """Digests of all products; those of before are looked at again only where the file was touched."""
    now: dict[Path, tuple[str, float]] = {}
    for path in root.rglob("*.fits"):
        touched = path.stat().st_mtime
        known = before.get(path)
        if known and known[1] == touched:
            now[path] = known
        else:
            now[path] = (hashlib.sha256(path.read_bytes()).hexdigest(), touched)
    changed = [path for path, (digest, _) in before.items() if path not in now or now[path][0] != digest]
    if changed:
        raise AssertionError(f"{len(changed)} earlier products changed, such as {changed[0]}")
    return now


def _accounted_for(repo: str, root: Path) -> None:
    """Every product on disk is a dataset, and every dataset is on disk."""
    with Butler.from_config(repo) as butler:
        shown = {
            Path(butler.getURI(ref).ospath)
            for kind in PRODUCTS
            for ref in butler.registry.queryDatasets(kind, collections="*")
        }
    there = set(root.rglob("*.fits"))
    if shown != there:
        raise AssertionError(f"{len(shown ^ there)} files without a dataset, or datasets without a file")


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nights", type=int, default=10)
    parser.add_argument("--hours", default="19:29")
    parser.add_argument("--sensors", type=int, default=9)
    arguments = parser.parse_args()
    logging.disable(logging.INFO)
    with tempfile.TemporaryDirectory() as folder:
        nights = soak(
            Path(folder), arguments.nights, arguments.hours, arguments.sensors, lambda x: print(x, flush=True)
        )
    print(
        f"{len(nights)} nights, {sum(night.quanta for night in nights)} quanta; "
        f"{growth(nights) / 2**20:+.2f} MiB a night in the second half; every night identical to the first"
    )


if __name__ == "__main__":
    main()
