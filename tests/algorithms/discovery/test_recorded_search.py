"""Records of whole searches, for edits that are not meant to change them."""

from __future__ import annotations

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS, Effect


def catalogue(*names: str) -> list[Effect]:
    return [one for one in EFFECTS if one.name in names]


@pytest.mark.parametrize(
    ("names", "size"),
    [
        (("ghost_pedestal", "roughness", "vignetting"), (48, 64)),
        (("tilt", "ghost_pedestal", "bandwidth"), (48, 40)),
    ],
    ids=["named", "outside"],
)
def test_a_verdict_is_as_recorded(names: tuple[str, ...], size: tuple[int, int], recorded: Record) -> None:
    """Few effects and cells; other tests say whether verdicts are right."""
    case = draw_case("one", np.random.default_rng(31), size=size, only=[names[0]])
    hidden = names[0] if names[0] == "tilt" else ""
    known = catalogue(*(name for name in names if name != hidden))
    found = discover(case.cube, case.setup, known, rng=np.random.default_rng(0))
    recorded(found)
