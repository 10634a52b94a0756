"""The same chain with its registry in PostgreSQL, on a server that the tests start themselves."""

import itertools
import secrets
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from fault_chain import OUT, QUANTA, Chain, Undisturbed, make_template
from lsst.daf.butler import Butler, Config
from postgres_server import PostgresServer, UnavailableError, postgres_server

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.middleware import Ts8Fringe

sys.path.insert(0, str(Path(__file__).parent))
from kill_and_resume import check, kill_and_resume

pytestmark = pytest.mark.middleware

KILLS = 2

TEMPLATE = "template_repo"

SEED_CONFIG = """\
includeConfigs: resource://lsst.fringe_sim/configs/butler.yaml
registry:
  db: {url}
  namespace: fringe
"""


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    try:
        with postgres_server() as server:
            yield server
    except UnavailableError as reason:
        pytest.skip(str(reason))


def seed_config(folder: Path, url: str) -> str:
    path = folder / "postgresql.yaml"
    path.write_text(SEED_CONFIG.format(url=url))
    return str(path)


@pytest.fixture(scope="module")
def template_here(server: PostgresServer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Repository with raw frames and its registry in PostgreSQL; not to be changed."""
    folder = tmp_path_factory.mktemp("postgresql")
    return make_template(folder / "template", seed_config(folder, server.new_database(TEMPLATE)))


@pytest.fixture
def new_chain(
    server: PostgresServer, template_here: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[], Chain]:
    numbers = itertools.count()

    def make() -> Chain:
        root = tmp_path_factory.mktemp("chain")
        chain = Chain(template_here, root)
        url = server.copy_database(TEMPLATE, f"{root.name}_{next(numbers)}")
        config = chain.repo / "butler.yaml"
        config.write_text(config.read_text().replace(server.url(TEMPLATE), url))
        return chain

    return make


@pytest.fixture
def chain(new_chain: Callable[[], Chain]) -> Chain:
    return new_chain()


def test_the_same_comes_out(chain: Chain, undisturbed: Undisturbed) -> None:
    assert not list(chain.repo.rglob("*.sqlite3"))
    ended = chain.run()
    assert ended.code == 0, ended.text
    assert f"Executed {QUANTA} quanta successfully, 0 failed and 0 remain" in ended.text
    chain.visible()
    assert chain.results() == undisturbed.results


@pytest.mark.slow
def test_two_writers_at_once(chain: Chain, undisturbed: Undisturbed) -> None:
    """Two processes fill one repository, and register the same dataset types in it, at the same time."""
    ended = chain.at_once("u/one", "u/two")
    assert [item.code for item in ended] == [0, 0], ended[0].text[-2000:] + ended[1].text[-2000:]
    chain.visible()
    assert chain.results("u/one") == chain.results("u/two") == undisturbed.results


@pytest.mark.slow
def test_two_processes_ingest_the_same_frames(
    server: PostgresServer, template_here: Path, tmp_path: Path
) -> None:
    """Each frame is there once in the end, whoever came first."""
    config = Config(seed_config(tmp_path, server.new_database("two_ingests")))
    Butler.makeRepo(str(tmp_path / "repo"), config=config)
    chain = Chain.at(tmp_path / "repo", root=tmp_path)
    with Butler.from_config(str(chain.repo), writeable=True) as butler:
        Ts8Fringe().register(butler.registry)
    command = ("butler", "ingest-fringe-raws", chain.repo, template_here / "raw", "--transfer", "copy")
    with ThreadPoolExecutor(2) as pool:
        ended = list(pool.map(lambda _: chain.command(*command), range(2)))
    assert not any("Traceback" in item.text for item in ended), ended[0].text + ended[1].text
    assert chain.command(*command).code == 0
    assert chain.number("raw", "*") == QUANTA
    chain.visible()


@pytest.mark.slow
def test_killed_at_random_moments(new_chain: Callable[[], Chain], undisturbed: Undisturbed) -> None:
    """The server undoes what a killed client has begun; more kills: ``kill_and_resume.py``."""
    seed = secrets.randbits(63)
    print(f"seed {seed}")
    report = kill_and_resume(
        new_chain,
        undisturbed.results,
        {True: undisturbed.seconds, False: 0.5 * undisturbed.seconds},
        KILLS,
        np.random.default_rng(seed),
        lambda line: print(line),
    )
    assert report.kills >= KILLS


@pytest.mark.slow
def test_server_that_dies_in_the_middle_of_a_run(
    server: PostgresServer, chain: Chain, undisturbed: Undisturbed
) -> None:
    """The run fails; when the server is back, the rest is made."""
    ended = []
    thread = threading.Thread(target=lambda: ended.append(chain.run()))
    thread.start()
    try:
        while thread.is_alive() and len(list((chain.repo / "u").rglob("fringeFlat_*.fits"))) < 2:
            time.sleep(0.005)
        server.stop(crash=True)
    finally:
        thread.join()
        server.start()
    assert ended[0].code != 0, ended[0].text
    before = chain.visible()
    missing = QUANTA - chain.complete_quanta()
    assert missing > 0
    again = chain.run()
    assert again.code == 0, again.text
    assert f"Executed {missing} quanta successfully, 0 failed and 0 remain" in again.text
    check(chain, before, "server back")
    assert chain.results() == undisturbed.results


@pytest.mark.slow
def test_server_that_is_not_there(
    server: PostgresServer, chain: Chain, capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands of this package say so in one line."""
    config = chain.repo / "butler.yaml"
    config.write_text(config.read_text().replace(str(server.folder), str(server.folder / "elsewhere")))
    recovered = chain.command("butler", "recover-fringe-repo", chain.repo)
    assert recovered.code == 1
    assert "registry is" in recovered.text
    assert "Traceback" not in recovered.text
    assert run(["provenance", str(chain.repo), "--dataset-type", "raw", "--collections", OUT]) == 1
    said = capsys.readouterr().err
    assert "registry is" in said
    assert "Traceback" not in said


@pytest.mark.slow
def test_no_server_stays_behind() -> None:
    """Nor a folder; the server of the other tests has a folder of its own."""
    try:
        with postgres_server() as server:
            folder = server.folder
    except UnavailableError as reason:
        pytest.skip(str(reason))
    assert not folder.exists()
    assert server.process.returncode is not None
