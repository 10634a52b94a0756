"""Kill `fringe-sim discover` and `pipetask run` with SIGKILL at random moments, and say what was lost.

usage: python scripts/kills.py [--discover 20] [--pipetask 50] [--seed N]

A search writes one verdict. After a kill its folder holds a verdict of one run or none, every file in it is whole,
and the next search takes the folder; the one that is left in peace in the end writes what an undisturbed one does.
Half of the kills are at any moment, half at the writing of the files. For `pipetask`, see
tests/faults/kill_and_resume.py. The seed is drawn anew unless one is given, and printed; a fault ends the script with
an assertion.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import secrets
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from lsst.fringe_sim.cli.inputs import read_settings
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube

ROOT = Path(__file__).resolve().parents[1]
NAMES = ("discovery.json", "discovery.ecsv", "effects.py")
"""Files of a verdict that are the same to the byte whenever it is found; the report states the time."""


def make_cube(path: Path) -> None:
    """Flats of a small sensor as the model has them, so that a search has little to find."""
    rng = np.random.default_rng(3)
    wavelength = np.arange(880.0, 1000.0, 10.0)
    y, x = np.mgrid[:32, :32] / 32
    response = FringeModel.from_setup("ts8_e2v").response(13.5 + 0.8 * x + 0.5 * y**2, wavelength)
    response /= response.mean(axis=(1, 2), keepdims=True)
    image = rng.poisson(30_000 * response).astype(np.float32)
    FringeCube.from_arrays(
        image, wavelength, variance=image, bandwidth_fwhm_nm=2.0, temperature_k=183.15
    ).write_fits(path)


def search(cube: Path, out: Path) -> subprocess.Popen[bytes]:
    """Start a search that replaces what is there."""
    command = [sys.executable, "-m", "lsst.fringe_sim", "discover", str(cube), "--setup", "ts8_e2v"]
    command += ["--out", str(out), "--overwrite", "--seed", "3", "--cells", "400"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def contents(out: Path) -> dict[str, str]:
    """Digest of every file of a verdict; paths and times are left out."""
    found = {}
    for name in NAMES:
        if (out / name).is_file():
            text = (out / name).read_text(encoding="utf-8").replace(str(out), "OUT")
            found[name] = hashlib.sha256(text.encode()).hexdigest()
    return found


def check(out: Path, wanted: dict[str, str]) -> str:
    """What a kill has left: a whole verdict, or a folder without its index; nothing that is half of a file."""
    found = contents(out)
    for name, digest in found.items():
        if digest != wanted[name]:
            raise AssertionError(f"{name} is not what an undisturbed search writes")
    if "discovery.json" in found:
        json.loads((out / "discovery.json").read_text(encoding="utf-8"))
        read_settings(out / "effects.py")
        if found != wanted:
            raise AssertionError(f"an index beside {sorted(found)}")
        return "a verdict"
    return "no index"


def wait_for_a_file(process: subprocess.Popen[bytes], out: Path, before: set[str]) -> None:
    """Until the folder holds another file than at the start, or the process ends."""
    while process.poll() is None:
        names = {path.name for path in out.iterdir()} if out.is_dir() else set()
        if any(name.endswith(".part") for name in names - before):
            return
        time.sleep(0.0005)


def kill_searches(kills: int, rng: np.random.Generator) -> None:
    """Kill so many searches in one folder, then let one come to its end."""
    with tempfile.TemporaryDirectory() as folder:
        cube, out = Path(folder) / "cube.fits", Path(folder) / "verdict"
        make_cube(cube)
        if search(cube, out).wait() != 0:
            raise AssertionError("the undisturbed search failed")
        wanted, started = contents(out), time.monotonic()
        if set(wanted) != set(NAMES) or search(cube, out).wait() != 0 or contents(out) != wanted:
            raise AssertionError("two undisturbed searches differ")
        seconds, left = time.monotonic() - started, []
        print(f"undisturbed: {seconds:.1f} s", flush=True)
        while len(left) < kills:
            before = {path.name for path in out.iterdir()}
            process = search(cube, out)
            if rng.integers(2):
                when = float(rng.uniform(0.0, seconds))
            else:
                wait_for_a_file(process, out, before)
                when = float(rng.uniform(0.0, 0.02))
            time.sleep(when)
            process.kill()
            if process.wait() >= 0:
                continue  # it was faster
            left.append(check(out, wanted))
            print(f"kill {len(left):3d}: {left[-1]}", flush=True)
        last = search(cube, out)
        if last.wait() != 0 or contents(out) != wanted or list(out.glob(".*.part")):
            raise AssertionError("the search after the kills differs from an undisturbed one")
    print(
        f"{kills} kills of discover: {left.count('a verdict')} left a whole verdict, {left.count('no index')} a "
        "folder without its index, none a mixture or half a file; the next search took the folder each time, "
        "and the last one wrote what an undisturbed one does",
        flush=True,
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--discover", type=int, default=20, help="kills of searches")
    parser.add_argument("--pipetask", type=int, default=50, help="kills of runs of the laboratory pipeline")
    parser.add_argument("--seed", type=int, default=None, help="by default a new one")
    arguments = parser.parse_args()
    seed = secrets.randbits(62) if arguments.seed is None else arguments.seed
    print(f"seed {seed}", flush=True)
    if arguments.discover:
        kill_searches(arguments.discover, np.random.default_rng(seed))
    if arguments.pipetask:
        program = ROOT / "tests" / "faults" / "kill_and_resume.py"
        subprocess.run(
            [sys.executable, str(program), "--kills", str(arguments.pipetask), "--seed", str(seed)],
            check=True,
        )


if __name__ == "__main__":
    main()
