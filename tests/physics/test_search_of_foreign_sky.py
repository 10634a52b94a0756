"""The search on frames of a sky that shares no code, no lines and no constants with the model that it corrects."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_sky import ForeignSky, foreign_map, foreign_night

from lsst.fringe_sim.algorithms.discovery import Verdict, discover_sky
from lsst.fringe_sim.algorithms.discovery.sky_search import SKY_SEARCH
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.products import SkyFringe

SIDE, PLACES = 32, 3
ELECTRONS = 6e4
MAP_SIGMA_UM = 0.002
CATALOGUE = (
    "contrast_loss",
    "epoxy_temperature",
    "oh_bands",
    "rotational_temperature",
    "sensor_temperature",
    "silicon_constants",
    "silicon_thickness",
    "sky_continuum",
)
TABLES = {"silicon_constants", "oh_bands"}
"""What differs between the two without anything hidden: the table of silicon, and the list of lines."""


def searched(rng: np.random.Generator, silicon: str = "Si", **hidden: float) -> Verdict:
    """One frame at f/4, 1024 cells, of a sensor whose map is known to 2 nm; ``silicon``: table of the model."""
    sky = ForeignSky(**{"kelvin": 153.15, "f_number": 4.0, "obscuration": 0.0, **hidden})
    truth = foreign_map(rng, (PLACES * SIDE, PLACES * SIDE), 13.0, 15.5)
    (seen,) = foreign_night(sky, truth, rng, 1, electrons=ELECTRONS, places=PLACES, steady=True)
    known = truth.reshape(SIDE, PLACES, SIDE, PLACES).mean(axis=(1, 3))
    known = known + MAP_SIGMA_UM * rng.standard_normal(known.shape)
    frame = SkyFringe(
        seen.image.astype(np.float32), np.zeros(known.shape, np.int32), "electron", float(seen.image.mean()),
        30.0, 1.2, 24.0, None, 0.0, {"RDNOISE": 6.0},
    )  # fmt: skip
    catalogue = [effect for effect in EFFECTS if effect.name in CATALOGUE]
    options = replace(SKY_SEARCH, refits=3)
    verdict = discover_sky(
        [frame],
        known,
        MAP_SIGMA_UM,
        Setup.from_name("monocam").with_silicon(silicon),
        catalogue,
        rng=rng,
        scales=({},),
        options=options,
    )
    print(verdict.summary(), verdict.unexplained.get("partial"))
    return verdict


def names_nothing_wrong(verdict: Verdict, there: set[str]) -> bool:
    """Whether every class that is named holds something that is there."""
    return all({effect.name, *effect.ambiguous_with} & there for effect in verdict.effects)


NOT_YET = pytest.mark.xfail(
    run=False,
    reason="silicon_thickness stands in the valley beside the right table, and pairs with it take minutes",
)


@pytest.mark.slow
@NOT_YET
@pytest.mark.rng("a foreign sky with nothing hidden")
def test_tables_that_differ_are_named_and_nothing_else(rng) -> None:
    """Its silicon is Franta's, cold as measured; a thickness that is wrong by two fringes imitates that nearly."""
    verdict = searched(rng)
    assert verdict.verdict == "named"
    assert names_nothing_wrong(verdict, TABLES)
    found = {effect.name: effect for effect in verdict.effects}
    assert found["silicon_constants"].parameters["franta"].value == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
@NOT_YET
@pytest.mark.rng("a foreign sky with half the fringes")
def test_a_loss_beside_other_lines(rng) -> None:
    """The model has the right table of silicon; lines, filter and coatings are still others."""
    verdict = searched(rng, "Si_franta2017", coherence=0.5)
    assert verdict.verdict == "named"
    assert names_nothing_wrong(verdict, {"contrast_loss", "oh_bands"})
    assert any("contrast_loss" in (effect.name, *effect.ambiguous_with) for effect in verdict.effects)
