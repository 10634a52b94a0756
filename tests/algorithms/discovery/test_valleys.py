"""Effects whose fringes look nearly the same again after a repeat: which valley is named, and how sure that is."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import SearchOptions, discover
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("repeats", "beside", "seed"),
    [
        # The valley is a hundred repeats from where the derivative at null leads.
        ("support_index", "tilt", 3),
        # With a bandpass of 2 nm some valleys, which are 0.13 µm apart, are as good as the right one.
        ("silicon_thickness", "bandwidth", 0),
    ],
)
def test_a_parameter_that_repeats_is_found_within_its_error(repeats: str, beside: str, seed: int) -> None:
    case = draw_case("two", np.random.default_rng([91, seed]), size=(48, 48), only=[repeats, beside])
    catalogue = [effect for effect in EFFECTS if effect.name in (repeats, beside)]
    options = SearchOptions()
    verdict = discover(case.cube, case.setup, catalogue, rng=np.random.default_rng(0), options=options)
    found = {effect.name: effect for effect in verdict.effects}
    assert repeats in found, verdict.summary()
    value = found[repeats].parameters["offset"]
    truth = case.values[f"{repeats}.offset"]
    assert abs(value.value - truth) < 4.0 * value.sigma
    assert value.sigma < 0.03 * abs(truth) + 0.2
