"""A repository made once, and what an undisturbed run makes of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fault_chain import Chain, Undisturbed, make_template


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_template(tmp_path_factory.mktemp("faults") / "template")


@pytest.fixture(scope="session")
def undisturbed(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    chain = Chain(template, tmp_path_factory.mktemp("undisturbed"))
    ended = chain.run()
    assert ended.code == 0, ended.text
    return Undisturbed(chain.results(), ended.seconds)


@pytest.fixture
def new_chain(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Chain]:
    return lambda: Chain(template, tmp_path_factory.mktemp("chain"))


@pytest.fixture
def chain(new_chain: Callable[[], Chain]) -> Chain:
    return new_chain()
