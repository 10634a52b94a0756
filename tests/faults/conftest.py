"""A repository made once, and what an undisturbed run makes of it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from fault_chain import Chain, Undisturbed, make_template
from made_once import made_once


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "fault_template", make_template)


@pytest.fixture(scope="session")
def undisturbed(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    def make(folder: Path) -> None:
        chain = Chain(template, folder)
        ended = chain.run()
        assert ended.code == 0, ended.text
        (folder / "said.json").write_text(json.dumps([chain.results(), ended.seconds]))

    made = made_once(tmp_path_factory, "fault_undisturbed", make)
    return Undisturbed(made / "repo", *json.loads((made / "said.json").read_text()))


@pytest.fixture
def new_chain(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Chain]:
    return lambda: Chain(template, tmp_path_factory.mktemp("chain"))


@pytest.fixture
def chain(new_chain: Callable[[], Chain]) -> Chain:
    return new_chain()
