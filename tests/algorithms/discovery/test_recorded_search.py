"""Records of whole searches, for edits that are not meant to change them."""

from dataclasses import replace

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS, Effect
from lsst.fringe_sim.products import FringeCube


def catalogue(*names: str) -> list[Effect]:
    return [one for one in EFFECTS if one.name in names]


def halved(cube: FringeCube) -> FringeCube:
    """Every second flat, which takes half the time."""
    return cube.take(np.arange(0, len(cube.image), 2))


@pytest.mark.parametrize(
    ("hidden", "names", "size"),
    [
        pytest.param(
            ["ghost_pedestal"], ("ghost_pedestal", "roughness", "vignetting"), (48, 64),
            marks=pytest.mark.slow, id="named",
        ),
        pytest.param(["tilt"], ("ghost_pedestal", "bandwidth"), (36, 32), id="outside"),
        pytest.param(
            ["roughness", "ghost_pedestal"], ("roughness", "ghost_pedestal", "tilt", "vignetting"), (28, 32),
            id="two",
        ),
    ],
)  # fmt: skip
def test_a_verdict_is_as_recorded(
    hidden: list[str], names: tuple[str, ...], size: tuple[int, int], recorded: Record
) -> None:
    """Few effects and cells; other tests say whether verdicts are right."""
    kind = "two" if len(hidden) == 2 else "one"
    case = draw_case(kind, np.random.default_rng(31), size=size, only=hidden)
    cube = case.cube if max(size) > 40 else halved(case.cube)
    recorded(discover(cube, case.setup, catalogue(*names), rng=np.random.default_rng(0)))


def test_a_search_where_the_thickness_is_known_is_as_recorded(recorded: Record) -> None:
    rng = np.random.default_rng(32)
    case = draw_case("one", rng, size=(32, 40), only=["roughness"])
    thickness = (case.thickness_um + 0.01 * rng.standard_normal(case.thickness_um.shape)).astype(np.float32)
    sigma = np.full(thickness.shape, 0.01, np.float32)
    cube = replace(case.cube, thickness=thickness, thickness_sigma=sigma, layer="adhesive")
    recorded(discover(cube, case.setup, catalogue("roughness", "tilt"), rng=np.random.default_rng(0)))


def test_a_search_of_all_flats_is_as_recorded(recorded: Record) -> None:
    case = draw_case("one", np.random.default_rng(31), size=(24, 28), only=["ghost_pedestal"])
    known = catalogue("ghost_pedestal", "roughness")
    recorded(discover(case.cube, case.setup, known, rng=np.random.default_rng(0)))
