"""Sealed cases of recorded challenges."""

from collections.abc import Sequence

import numpy as np

from lsst.fringe_sim.challenge.result import CASE_KINDS
from lsst.fringe_sim.challenge.sealed_cases import SIZES, SealedCase, draw_case


def recorded_case(
    seed: int, kind: str, number: int, without: Sequence[str] = ()
) -> tuple[SealedCase, np.random.Generator]:
    """A case as `fringe-sim challenge` draws it, or drew it without some effects, and the generator of its search."""
    parts = np.random.default_rng([seed, CASE_KINDS.index(kind), number]).spawn(2)
    return draw_case(kind, parts[0], only=[name for name in SIZES if name not in without]), parts[1]
