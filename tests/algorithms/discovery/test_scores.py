"""What effects promise before they are fitted."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.options import SearchOptions
from lsst.fringe_sim.algorithms.discovery.scores import Scorer
from lsst.fringe_sim.algorithms.inference import CellShape, Data, Forward, Problem, coordinates_of, relaxed
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.linspace(900.0, 985.0, 8)
HIDDEN_UM = 1.5


def scorer_of(hidden: dict[str, float]) -> Scorer:
    """Scores beside the unchanged model of noiseless flats that have an effect."""
    place = np.arange(10.0)
    thickness = 14.0 + 0.035 * place + 0.02 * place[:, np.newaxis]
    geometry = ImageGeometry((10, 10), place, place, WAVELENGTHS, np.full(8, 20_000.0))
    shape = CellShape.of_field(thickness, 1)
    forward = Forward(FringeModel.from_setup("ts8_e2v"), EFFECTS, geometry, shape, (13.2, 15.3))
    value = forward.predict(hidden, thickness.ravel())[0]
    data = Data(value, np.full(value.shape, 1e-3**-2.0))
    point = relaxed(Problem(data, forward, thickness.ravel(), 1e-5).at({}, np.ones(8), thickness.ravel()))
    return Scorer(point, point.level_columns, SearchOptions().sizes)


def test_an_effect_that_repeats_promises_by_secants_what_its_derivative_does_not_see() -> None:
    (silicon,) = (effect for effect in EFFECTS if effect.name == "silicon_thickness")
    scorer = scorer_of({"silicon_thickness.offset": HIDDEN_UM})
    forward = scorer.point.problem.forward
    (item,) = coordinates_of(silicon, forward)
    far = scorer.score(silicon.name, (item,))
    near = scorer.score(silicon.name, (replace(item, repeat=0.0),))
    assert far is not None
    assert near is not None
    assert near.gain < 0.0 < far.gain
    assert abs(far.step[0] - HIDDEN_UM) < 0.3 * HIDDEN_UM


@pytest.mark.parametrize("size_nm", [18.0, 50.0, 80.0])
def test_a_gap_that_shifts_the_fringes_by_a_radian_promises_what_its_thickness_leaves(size_nm: float) -> None:
    (gap,) = (effect for effect in EFFECTS if effect.name == "air_gap")
    scorer = scorer_of({"air_gap.thickness": size_nm})
    promised = scorer.score(gap.name, coordinates_of(gap, scorer.point.problem.forward))
    assert promised is not None
    brings = 0.5 * float((scorer.point.projected(scorer.point.residual) ** 2).sum())
    assert promised.gain == pytest.approx(brings, rel=0.25)
    assert promised.step[0] == pytest.approx(size_nm, rel=0.5)
