"""Thicknesses that step like islands."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import Verdict, discover
from lsst.fringe_sim.challenge.sealed_cases import expose
from lsst.fringe_sim.mock.thickness import random_field


def searched(thickness: np.ndarray, rng: np.random.Generator) -> Verdict:
    cube, _ = expose(thickness, {}, rng)
    return discover(cube, "ts8_e2v", rng=np.random.default_rng(1))


@pytest.mark.slow
@pytest.mark.parametrize(("height_um", "width_px", "told"), [(0.012, 0.3, True), (0.02, 5.0, False)])
def test_a_thickness_that_steps_is_no_effect(height_um: float, width_px: float, told: bool) -> None:
    """An island of 12 nm more adhesive looks like a void, and the verdict says so; a hill does not."""
    rng = np.random.default_rng(5)
    y, x = np.indices((96, 96))
    away = np.hypot(y - 40.3, x - 55.2) - 12.0
    thickness = random_field((96, 96), rng, mean=15.0, span=2.0)
    verdict = searched(thickness + height_um / (1.0 + np.exp(away / width_px)), rng)
    assert verdict.verdict == "no_discrepancy", verdict.summary()
    assert any("steps on an island as void" in note for note in verdict.notes) == told, verdict.notes
