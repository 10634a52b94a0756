"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

# A busy machine is no failure: examples are bounded in number, not in time.
settings.register_profile("fringe_sim", deadline=None)
settings.load_profile("fringe_sim")

CHECKOUT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder of published measurements beside a development checkout; skips where it is absent."""
    path = Path(os.environ.get("FRINGE_SIM_SHARED", CHECKOUT.parent / "shared"))
    if not (path / "measured").is_dir():
        pytest.skip(f"the published measurements are not at {path}")
    return path


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Generator seeded from the name of the test: repeatable, and different for every test."""
    return np.random.default_rng(list(request.node.nodeid.encode()))
