"""A repository whose last writer was killed in the middle of a transaction."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from lsst.daf.butler import Butler, Config
from sqlalchemy.exc import OperationalError
from toy_repository import Invoke

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.middleware.repository import open_repository, prepare_repository, recover_repository

pytestmark = pytest.mark.middleware

KILLED = """
import os, signal, sqlite3, sys
connection = sqlite3.connect(sys.argv[1])
connection.execute("PRAGMA cache_size = 1")
connection.execute("PRAGMA cache_spill = 1")
connection.execute("BEGIN IMMEDIATE")
connection.execute("CREATE TABLE half_done (text TEXT)")
connection.executemany("INSERT INTO half_done VALUES (?)", [("x" * 4000,)] * 200)
os.kill(os.getpid(), signal.SIGKILL)
"""
"""A writer that has begun to change the file itself, with a journal of what was there."""


@pytest.fixture
def killed(repo: Path) -> Path:
    done = subprocess.run([sys.executable, "-c", KILLED, str(repo / "gen3.sqlite3")], check=False)
    assert done.returncode == -signal.SIGKILL
    assert (repo / "gen3.sqlite3-journal").stat().st_size > 0
    with pytest.raises(OperationalError, match="readonly database"):
        Butler.from_config(str(repo))
    return repo


def instruments(repo: Path) -> set[str]:
    with Butler.from_config(str(repo)) as butler:
        return {record.name for record in butler.query_dimension_records("instrument")}


def test_recovered_by_one_command(killed: Path, repo_template: Path, invoke: Invoke) -> None:
    for _ in range(2):
        assert invoke("recover-fringe-repo", killed).exit_code == 0
        assert instruments(killed) == instruments(repo_template)
    assert not (killed / "gen3.sqlite3-journal").exists()


def test_commands_of_the_package_read_it_nevertheless(
    killed: Path, invoke: Invoke, capsys: pytest.CaptureFixture[str]
) -> None:
    second = Path(shutil.copytree(killed, killed.parent / "second"))
    assert (
        "collection is 'none'" in invoke("write-fringe-handoff", killed, "none", killed.parent / "out").output
    )
    assert run(["provenance", str(second), "--dataset-type", "fringe"]) == 1
    assert "fringe-sim: datasets is" in capsys.readouterr().err


def test_what_cannot_be_recovered_is_refused_in_one_line(tmp_path: Path, repo: Path, invoke: Invoke) -> None:
    for function in (recover_repository, lambda path: open_repository(path).__enter__()):
        with pytest.raises(InputError, match="a butler repository"):
            function(str(tmp_path / "nowhere"))
    (repo / "gen3.sqlite3").write_bytes(os.urandom(5000))
    result = invoke("recover-fringe-repo", repo)
    assert result.exit_code == 1
    assert "registry is" in result.output
    assert "not a database" in result.output


def test_a_repository_that_is_prepared_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One without files of its own, and one whose configuration is no local file, are refused and not changed."""
    memory = "lsst.daf.butler.datastores.inMemoryDatastore.InMemoryDatastore"
    Butler.makeRepo(str(tmp_path / "memory"), config=Config({"datastore": {"cls": memory}}))
    Butler.makeRepo(str(tmp_path / "in_a_package"))
    (tmp_path / "in_a_package" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    files = [tmp_path / name / "butler.yaml" for name in ("memory", "in_a_package")]
    before = [file.read_bytes() for file in files]
    for repo in (str(tmp_path / "memory"), "resource://in_a_package/butler.yaml"):
        with pytest.raises(InputError, match="one with a file datastore and a local configuration"):
            prepare_repository(repo)
    assert [file.read_bytes() for file in files] == before
