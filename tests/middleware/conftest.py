"""Repositories for tests, copied from one that is made once."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import click.testing
import pytest
from lsst.daf.butler import Butler, Config
from lsst.daf.butler.cli.butler import cli
from lsst.daf.butler.cli.utils import LogCliRunner
from made_once import made_once
from toy_repository import Invoke

from lsst.fringe_sim.middleware import HscFringe, LsstCamFringe, MonoCamFringe, Ts8Fringe

SEED_CONFIG = "resource://lsst.fringe_sim/configs/butler.yaml"


@pytest.fixture(scope="session")
def repo_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository with all instruments; not to be changed."""

    def make(root: Path) -> None:
        Butler.makeRepo(str(root), config=Config(SEED_CONFIG))
        with Butler.from_config(str(root), writeable=True) as butler:
            for instrument in (LsstCamFringe, Ts8Fringe, MonoCamFringe, HscFringe):
                instrument().register(butler.registry)

    return made_once(tmp_path_factory, "repo_template", make)


@pytest.fixture
def repo(repo_template: Path, tmp_path: Path) -> Path:
    """A repository of its own for each test."""
    return Path(shutil.copytree(repo_template, tmp_path / "repo"))


@pytest.fixture
def butler(repo: Path) -> Iterator[Butler]:
    """A writeable butler."""
    with Butler.from_config(str(repo), writeable=True) as butler:
        yield butler


@pytest.fixture
def invoke() -> Invoke:
    """Run a ``butler`` subcommand in this process."""

    def run(*arguments: object) -> click.testing.Result:
        return LogCliRunner().invoke(cli, [str(argument) for argument in arguments])

    return run
