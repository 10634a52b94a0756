"""A repository with raw frames of small sensors, made once, and the real commands that work on it."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lsst.daf.butler import Butler
from made_once import made_once
from numpy.typing import NDArray
from task_commands import WAVELENGTHS_NM, Command, Outcome

from lsst.fringe_sim.middleware import LsstCamFringe, Ts8Fringe
from lsst.fringe_sim.mock.raw_frames import MockRun, write_mock_flats

SEED_CONFIG = "resource://lsst.fringe_sim/configs/butler.yaml"
ROWS, COLUMNS = 128, 256


def thickness_um(level: float) -> NDArray[np.float64]:
    """Smooth map that spans four fringe orders: enough for its mean to stand for the mean of a sensor."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return level + 0.35 * np.sin(x / 60.0) + 0.3 * np.cos(y / 50.0)


@pytest.fixture(scope="session")
def command() -> Command:
    """Run an installed command in a process of its own."""

    def run(*arguments: object) -> Outcome:
        program, *rest = (str(argument) for argument in arguments)
        done = subprocess.run(
            [str(Path(sys.executable).with_name(program)), *rest],
            capture_output=True,
            text=True,
            check=False,
            # One thread each: the sensors are tiny and the machine may be busy.
            env={**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        return Outcome(done.returncode, done.stdout + done.stderr)

    return run


@pytest.fixture(scope="session")
def raws(tmp_path_factory: pytest.TempPathFactory) -> dict[str, MockRun]:
    """Raw frames of two sensors, of two rafts of the test stand."""
    root = tmp_path_factory.mktemp("raws")
    return {
        name: write_mock_flats(
            root / name,
            setup="ts8_e2v",
            detector=name,
            thickness_um=thickness_um(level),
            wavelengths_nm=WAVELENGTHS_NM,
            rng=np.random.default_rng(number),
            size=f"{COLUMNS}x{ROWS}",
            n_bias=3,
        )
        for number, (name, level) in enumerate({"RTM-020_S01": 13.0, "RTM-006_S11": 15.1}.items())
    }


@pytest.fixture(scope="session")
def empty_repo(tmp_path_factory: pytest.TempPathFactory, command: Command) -> Path:
    """A repository with both instruments: for all modules, which work on copies of it."""

    def make(root: Path) -> None:
        assert command("butler", "create", root, "--seed-config", SEED_CONFIG).code == 0
        with Butler.from_config(str(root), writeable=True) as butler:
            for instrument in (LsstCamFringe, Ts8Fringe):
                instrument().register(butler.registry)

    return made_once(tmp_path_factory, "empty_repo", make)
