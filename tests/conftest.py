"""Fixtures shared by all tests."""

import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from recorded_numbers import Record
from suite_shares import Share, group_of

# A busy machine is no failure: examples are bounded in number, not in time.
settings.register_profile("fringe_sim", deadline=None)
settings.load_profile("fringe_sim")

CHECKOUT = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--share",
        type=Share.parse,
        default=Share(1, 1),
        metavar="K/N",
        help="run the K-th of N parts of the suite",
    )
    parser.addoption("--backwards", action="store_true", help="run the last test first")
    parser.addoption("--record-numbers", action="store_true", help="write tests/records anew")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    share: Share = config.getoption("--share")
    left_out = [item for item in items if not share.has(group_of(item))]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if share.has(group_of(item))]
    if config.getoption("--backwards"):
        items.reverse()


LEVEL = logging.getLogger().level


@pytest.fixture(autouse=True)
def _log_of_a_new_process() -> Iterator[None]:
    """A command sets the level and the stream of the log for its process: not for the tests that come after it."""
    _forget_log()
    yield
    _forget_log()


def _forget_log() -> None:
    root = logging.getLogger()
    root.setLevel(LEVEL)
    for handler in [item for item in root.handlers if type(item) is logging.StreamHandler]:
        root.removeHandler(handler)


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder of published measurements beside a development checkout; skips where it is absent."""
    path = Path(os.environ.get("FRINGE_SIM_SHARED", CHECKOUT.parent / "shared"))
    if not (path / "measured").is_dir():
        pytest.skip(f"the published measurements are not at {path}")
    return path


@pytest.fixture(scope="session")
def trials(shared_dir: Path) -> Path:
    """Folder of small inputs that broke something once, beside a development checkout; skips where it is absent."""
    if not (shared_dir / "trials").is_dir():
        pytest.skip(f"no trials in {shared_dir}")
    return shared_dir / "trials"


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Generator seeded by the name in the test's ``@pytest.mark.rng("name")`` and by the values it is run with."""
    marker = request.node.get_closest_marker("rng")
    if marker is None:
        pytest.fail('a test that draws numbers names its draw: @pytest.mark.rng("a name")')
    case = request.node.callspec.id if hasattr(request.node, "callspec") else ""
    return np.random.default_rng(list(f"{marker.args[0]} {case}".encode()))


@pytest.fixture
def recorded(request: pytest.FixtureRequest) -> Record:
    """Compare all numbers of a result, a file or a folder with those that were recorded of this test."""
    name = re.sub(r"\W+", "_", request.node.name).strip("_")
    file = CHECKOUT / "tests" / "records" / request.path.stem / f"{name}.json"
    return Record(file, request.config.getoption("--record-numbers"))
