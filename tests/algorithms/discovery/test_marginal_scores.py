"""What effects promise before they are fitted."""

from dataclasses import replace

import numpy as np

from lsst.fringe_sim.algorithms.discovery.marginal.rules import Rules
from lsst.fringe_sim.algorithms.discovery.marginal.scores import Scorer
from lsst.fringe_sim.algorithms.inference import CellShape, Data, Forward, Problem, coordinates_of, relaxed
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.linspace(900.0, 985.0, 8)
HIDDEN_UM = 1.5


def test_an_effect_that_repeats_promises_by_secants_what_its_derivative_does_not_see() -> None:
    (silicon,) = (effect for effect in EFFECTS if effect.name == "silicon_thickness")
    place = np.arange(10.0)
    thickness = 14.0 + 0.035 * place + 0.02 * place[:, np.newaxis]
    geometry = ImageGeometry((10, 10), place, place, WAVELENGTHS, np.full(8, 20_000.0))
    shape = CellShape.of_field(thickness, 1)
    forward = Forward(FringeModel.from_setup("ts8_e2v"), EFFECTS, geometry, shape, (13.2, 15.3))
    value = forward.predict({"silicon_thickness.offset": HIDDEN_UM}, thickness.ravel())[0]
    data = Data(value, np.full(value.shape, 1e-3**-2.0))
    point = relaxed(Problem(data, forward, thickness.ravel(), 1e-5).at({}, np.ones(8), thickness.ravel()))
    scorer = Scorer(point, point.level_columns, Rules().sizes)
    (item,) = coordinates_of(silicon, forward)
    far = scorer.score(silicon.name, (item,))
    near = scorer.score(silicon.name, (replace(item, repeat=0.0),))
    assert far is not None
    assert near is not None
    assert near.gain < 0.0 < far.gain
    assert abs(far.step[0] - HIDDEN_UM) < 0.3 * HIDDEN_UM
