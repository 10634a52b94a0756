"""Fringes that a blur takes away, and fields that are continued where there are none."""

import numpy as np
import pytest
from recorded_cases import recorded_case

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.discovery.continuation import continued
from lsst.fringe_sim.effects import EFFECTS

BLUR = "charge_diffusion"


def test_a_plane_is_continued_as_a_plane() -> None:
    y, x = np.indices((30, 40))
    plane = 14.0 + 0.02 * x - 0.03 * y
    known = (x - 20) ** 2 + (y - 15) ** 2 < 100
    np.testing.assert_allclose(continued(np.where(known, plane, np.nan), known), plane, atol=1e-3)


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True,
    reason="the slopes within cells are those of a thickness in wrong orders, and roughness is likelier",
)
def test_a_blur_that_takes_fringes_away_is_named_with_what_else_is_there() -> None:
    """With the thickness of the unchanged model, effects that weaken all fringes explain more than it does."""
    # A blur of 2.2 px leaves no fringes in a band, with a corner behind it.
    case, rng = recorded_case(20491128, "two", 3)
    assert set(case.names) == {BLUR, "bandwidth"}
    catalogue = [effect for effect in EFFECTS if effect.name in (BLUR, "bandwidth", "roughness")]
    verdict = discover(case.cube, case.setup, catalogue, rng=rng)
    assert verdict.verdict == "named"
    assert {effect.name for effect in verdict.effects} == {BLUR, "bandwidth"}
    for effect in verdict.effects:
        for name, found in effect.parameters.items():
            assert abs(found.value - case.values[f"{effect.name}.{name}"]) < 4.0 * found.sigma
