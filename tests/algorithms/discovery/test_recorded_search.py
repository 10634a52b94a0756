"""A record of a whole search, for edits that are not meant to change it."""

from __future__ import annotations

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS

CATALOGUE = [one for one in EFFECTS if one.name in ("ghost_pedestal", "roughness", "vignetting")]


@pytest.mark.slow
def test_the_verdict_on_a_pedestal_is_as_recorded(recorded: Record) -> None:
    """Few effects and cells; other tests say whether verdicts are right."""
    case = draw_case("one", np.random.default_rng(31), size=(48, 64), only=["ghost_pedestal"])
    recorded(discover(case.cube, case.setup, CATALOGUE, rng=np.random.default_rng(0)))
