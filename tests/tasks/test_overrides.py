"""Overrides of single rafts and sensors through the real commands: a wrong name stops before a graph is built."""

import shutil
from pathlib import Path

import pytest
from lsst.daf.butler import Butler
from task_commands import Command

pytestmark = pytest.mark.middleware

HEAD = "from lsst.fringe_sim.tasks import RaftConfig, SensorConfig\n"


@pytest.fixture(scope="module")
def repo(empty_repo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository in which there is nothing to be done."""
    root = Path(shutil.copytree(empty_repo, tmp_path_factory.mktemp("overrides") / "repo"))
    with Butler.from_config(str(root), writeable=True) as butler:
        butler.collections.register("LSST-TS8/raw/all")
    return root


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "task", "override", "message"),
    [
        (
            "run",
            "epoxyFit",
            "config.rafts['R11'] = RaftConfig()",
            "ts8: raft is 'R11'; allowed: RTM-020, its name",
        ),
        ("qgraph", "isrFlatPrep", "config.raft_setups['RTM-20'] = 'ts8_itl'", "did you mean RTM-020"),
        (
            "qgraph",
            "epoxyFit",
            "config.sensors['RTM-020_S3'] = SensorConfig(effects={'tilt.deg': 1.0})",
            "detector is 'RTM-020_S3'; allowed: did you mean RTM-020_S",
        ),
        (
            "qgraph",
            "epoxyFit",
            "config.rafts['RTM-020'] = RaftConfig(effects={'bandwith.fwhm': 2.0})",
            "raft RTM-020: effect is 'bandwith'; allowed: did you mean bandwidth",
        ),
    ],
)
def test_a_wrong_name_is_refused_before_the_graph(
    command: Command, repo: Path, tmp_path: Path, verb: str, task: str, override: str, message: str
) -> None:
    file, graph = tmp_path / "own.py", tmp_path / "graph.qgraph"
    file.write_text(HEAD + override + "\n")
    outcome = command(
        *("pipetask", verb, "-b", repo, "-i", "LSST-TS8/raw/all", "-o", "u/wrong"),
        *("-p", "resource://lsst.fringe_sim/pipelines/ts8/labFlats.yaml", "-C", f"{task}:{file}"),
        *("-d", "instrument='LSST-TS8'", "--save-qgraph", graph),
    )
    assert outcome.code != 0
    assert message in outcome.text, outcome.text[-2000:]
    assert not graph.exists()
    with Butler.from_config(str(repo)) as butler:
        assert not butler.collections.query("u/wrong*")
