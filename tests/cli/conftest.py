"""Raw frames that several tests of the commands look at."""

import shutil
from pathlib import Path

import pytest
from made_once import made_once

from lsst.fringe_sim.cli.main import run


@pytest.fixture(scope="session")
def small_raws(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flats and two bias frames of 64 x 64 pixels; not to be changed."""

    def make(folder: Path) -> None:
        size = ("--size", "64x64", "--wavelengths", "900,950", "--bias-frames", "2", "--seed", "1")
        assert run(["mock-flats", str(folder / "raws"), *size]) == 0

    return made_once(tmp_path_factory, "small_raws", make) / "raws"


@pytest.fixture
def raws(small_raws: Path, tmp_path: Path) -> Path:
    """The same in a folder that a test may change."""
    return Path(shutil.copytree(small_raws, tmp_path / "raws"))
