"""How clearly effects are seen in sealed cases."""

import math

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.inference import Hypothesis
from lsst.fringe_sim.challenge import oracle
from lsst.fringe_sim.challenge.oracle import visibility
from lsst.fringe_sim.challenge.sealed_cases import CASE_KINDS, SealedCase, draw_case, expose
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.products import FringeCube


def sealed(seed: int = 3, **values: float) -> SealedCase:
    """A case with effects of given sizes; the same sensor and the same noise for each."""
    rng = np.random.default_rng(seed)
    thickness = random_field((48, 48), rng, mean=16.0, span=1.5)
    sizes = {key.replace("__", "."): value for key, value in values.items()}
    names = tuple(dict.fromkeys(key.partition(".")[0] for key in sizes))
    cube, _ = expose(thickness, sizes, rng)
    return SealedCase(cube, "ts8_e2v", "two", names, sizes, thickness, 1.0)


@pytest.mark.slow
def test_signal_to_noise_grows_with_the_effect() -> None:
    """A loss of contrast of a fifth is seen twice as clearly as one of a tenth."""
    small, large = (
        visibility(sealed(contrast_loss__factor=1.0 - loss)).each["contrast_loss"] for loss in (0.1, 0.2)
    )
    assert small > 3.0
    assert large / small == pytest.approx(2.0, rel=0.25)


@pytest.mark.slow
def test_an_effect_in_another_valley_is_seen() -> None:
    """An index of the support comes back after a fringe: a fit that begins without it may not find it."""
    seen = visibility(sealed(insulation__offset=0.022, support_index__offset=-0.06))
    assert min(seen.each.values()) > 10.0
    assert seen.all > max(seen.each.values())


@pytest.mark.slow
def test_what_takes_the_place_of_the_other_is_not_seen_beside_it() -> None:
    """Two pedestals that fill each other's part: one alone is plain, beside the other it is not."""
    alone = visibility(sealed(dark_pedestal__electrons=1500.0)).each["dark_pedestal"]
    both = visibility(sealed(dark_pedestal__electrons=1500.0, ghost_pedestal__fraction=0.05)).each
    assert both["dark_pedestal"] < 0.5 * alone


@pytest.mark.slow
def test_what_a_step_of_the_thickness_explains_is_not_seen() -> None:
    """A thin gap moves the fringes, and so does a thickness that steps at its rim."""
    place = {"void__centre_x": 22.0, "void__centre_y": 25.0, "void__radius": 8.0}
    thin, thick = (visibility(sealed(void__thickness=gap, **place)).each["void"] for gap in (6.0, 130.0))
    assert thin < 5.0
    assert thick > 100.0


@pytest.mark.slow
def test_what_another_valley_of_the_other_explains_is_not_seen() -> None:
    """An index of the support goes five minima away and does what a gap of 7 nm did."""
    streams = np.random.default_rng([20411125, CASE_KINDS.index("two"), 12]).spawn(2)
    case = draw_case("two", streams[0])
    assert set(case.names) == {"support_index", "air_gap"}
    assert visibility(case).each["air_gap"] < 5.0


@pytest.mark.parametrize(("valley", "wanted"), [(-8, 3.0), (-1, 3.0), (1, 3.0), (9, 10.0)])
def test_every_valley_of_the_other_effect_is_tried(
    valley: int, wanted: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight on either side of its true index. Without the insulation χ² is 100, and 9 in one of the valleys."""
    truth = {"insulation.offset": 0.02, "support_index.offset": -0.06}
    flat = FringeCube.from_arrays(np.full((2, 4, 4), 2e4), np.array([920.0, 960.0]))
    names = ("insulation", "support_index")
    case = SealedCase(flat, "ts8_e2v", "two", names, truth, np.full((4, 4), 15.0), 1.0)

    def fit_there(effects, items, start, *, aim=math.inf) -> Hypothesis:
        chi2 = {0: 400.0, 2: 0.0}.get(len(effects), 100.0)
        if effects == ("support_index",):
            (item,) = items
            away = start.settings[item.key] - (truth[item.key] + valley * item.repeat)
            chi2 = 9.0 if abs(away) < 0.1 * item.repeat else 100.0
        point = start.moved(start.levels, start.thickness_um)
        vars(point)["cost"] = 0.5 * chi2  # what the point would compute of itself
        return Hypothesis(effects, items, point, 0.0, np.eye(len(items)))

    monkeypatch.setattr(oracle, "fit", fit_there)
    assert visibility(case, most_cells=16).each["insulation"] == pytest.approx(wanted)
