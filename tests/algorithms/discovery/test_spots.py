"""Round spots: how often noise makes one, what a few are worth, and gains that are fitted to them."""

from dataclasses import replace

import numpy as np
import pytest
from flat_cubes import TEN_NM, relative_flats
from scipy.special import logsumexp

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.discovery.cells import bin_cube
from lsst.fringe_sim.algorithms.discovery.critics import spot_scores
from lsst.fringe_sim.algorithms.discovery.preparation import data_of
from lsst.fringe_sim.algorithms.discovery.spots import DEPTHS, RADII, SpotScores
from lsst.fringe_sim.algorithms.inference import CellShape, Data, Forward, Hypothesis, Problem, fit
from lsst.fringe_sim.challenge.sealed_cases import SealedCase, draw_case
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

SHAPE = (40, 48)
NOISE = 0.002


@pytest.fixture(scope="module")
def null() -> Hypothesis:
    """A sensor of known thickness, fitted."""
    v, u = np.mgrid[-1.0 : 1.0 : SHAPE[0] * 1j, -1.0 : 1.0 : SHAPE[1] * 1j]
    truth = 15.0 + 0.5 * u - 0.4 * v + 0.3 * u * v
    model = FringeModel.from_setup("ts8_e2v")
    cells = bin_cube(relative_flats(truth, model, np.random.default_rng(5), NOISE), 1)
    forward = Forward(model, EFFECTS, cells.geometry, CellShape.of_field(truth, 1, area=False), (12.0, 18.0))
    problem = Problem(data_of(cells), forward, truth.ravel(), 1e-6)
    return fit((), (), problem.at({}, np.ones(len(TEN_NM)), truth.ravel()))


def _round(y: float, x: float, radius: float) -> np.ndarray:
    rows, columns = np.indices(SHAPE)
    return np.exp(-0.5 * ((rows - y) ** 2 + (columns - x) ** 2) / radius**2)


def _noise(rng: np.random.Generator) -> np.ndarray:
    return NOISE * rng.standard_normal((len(TEN_NM), SHAPE[0] * SHAPE[1]))


def _scores(null: Hypothesis, noise: np.ndarray, response: np.ndarray | float = 0.0) -> SpotScores:
    """The same fit to data in which cells have a response of their own."""
    point = null.point
    value = point.levels[:, np.newaxis] * point.value * (1.0 + np.ravel(response)) + noise
    return spot_scores(replace(null, point=point.problem_with(Data(value, point.problem.data.weight))))


@pytest.mark.rng("noise makes spots as often as it is said to")
def test_noise_makes_spots_as_often_as_it_is_said_to(null: Hypothesis, rng: np.random.Generator) -> None:
    """Hardly more often, and not next to never: the bound counts maxima of all sizes as if they were independent."""
    chances = [_scores(null, _noise(rng)).channel().probability for _ in range(400)]
    seen = sum(chance < 0.1 for chance in chances)
    assert 4 <= seen <= 40 + 3 * 6
    assert min(chances) > 1e-5


@pytest.mark.rng("spots of noise are worth little")
def test_spots_of_noise_are_worth_little(null: Hypothesis, rng: np.random.Generator) -> None:
    worth = [_scores(null, _noise(rng)).evidence() for _ in range(100)]
    assert min(worth) == 0.0
    assert max(worth) < 6.0


@pytest.mark.parametrize(("y", "x", "radius"), [(20.0, 25.0, 5.0), (1.0, 46.0, 8.0)])
@pytest.mark.rng("a spot is seen and a misfit of the thickness is none")
def test_a_spot_is_seen_and_a_misfit_of_the_thickness_is_none(
    null: Hypothesis, rng: np.random.Generator, y: float, x: float, radius: float
) -> None:
    noise, spot = _noise(rng), _round(y, x, radius)
    assert _scores(null, noise, -0.001 * spot).channel().probability < 1e-6
    bent = null.point.levels[:, np.newaxis] * null.point.slope * 0.01 * spot.ravel()
    plain = _scores(null, noise).channel()
    assert _scores(null, noise + bent).channel().statistic == pytest.approx(plain.statistic, rel=1e-4)


@pytest.mark.rng("light that all cells lack is no spot")
def test_light_that_all_cells_lack_is_no_spot(null: Hypothesis, rng: np.random.Generator) -> None:
    noise = _noise(rng)
    plain = _scores(null, noise).channel().statistic
    assert _scores(null, noise, 0.01).channel().statistic == pytest.approx(plain, rel=1e-4)


@pytest.mark.rng("correlated noise makes no spots")
def test_correlated_noise_makes_no_spots(null: Hypothesis, rng: np.random.Generator) -> None:
    stained = _scores(null, _noise(rng), 5e-4 * _round(15.0, 20.0, 4.0))
    correlated = SpotScores.beside_level(stained.score, stained.information, 0.1)
    assert correlated.channel().statistic == pytest.approx(stained.channel().statistic / 1.4)


@pytest.mark.rng("evidence is the integral over place size and depth")
def test_evidence_is_the_integral_over_place_size_and_depth(
    null: Hypothesis, rng: np.random.Generator
) -> None:
    """Summed on a grid; over the depth in closed form."""
    stained = _scores(null, _noise(rng), -0.0015 * _round(21.0, 26.0, 6.0))
    score, information = stained.score, stained.information
    places, logarithms = np.linspace(-2.0, 2.0, 13), np.log(6.0) + np.linspace(-0.4, 0.4, 13)
    logs = []
    for y in 21.0 + places:
        for x in 26.0 + places:
            for logarithm in logarithms:
                pattern = _round(y, x, float(np.exp(logarithm)))
                pattern = pattern - (pattern * information).sum() / information.sum()
                square = float((pattern**2 * information).sum())
                depth = float((score * pattern).sum()) / square
                logs.append(0.5 * depth**2 * square - np.log(abs(depth)) + 0.5 * np.log(2.0 * np.pi / square))
    cell = (places[1] - places[0]) ** 2 * (logarithms[1] - logarithms[0])
    choices = SHAPE[0] * SHAPE[1] * np.log(RADII[-1] / RADII[0]) * 2.0 * DEPTHS
    expected = float(logsumexp(logs)) + np.log(cell / choices)
    assert expected > 20.0
    # A second spot in the noise may be worth a little.
    assert stained.evidence() == pytest.approx(expected, abs=0.7)


@pytest.mark.rng("several spots are worth more than one")
def test_several_spots_are_worth_more_than_one(null: Hypothesis, rng: np.random.Generator) -> None:
    noise = _noise(rng)
    places = [(10.0, 10.0, 5.0), (12.0, 19.0, 4.0), (30.0, 40.0, 7.0)]
    worth = [
        _scores(null, noise, -0.0015 * sum(_round(*place) for place in places[:number])).evidence()
        for number in range(4)
    ]
    assert np.diff(worth).min() > 10.0


@pytest.mark.slow
def test_stains_are_not_named_as_gains_and_gains_are() -> None:
    """Stains of 0.2 % in a few amplifiers: gains explain them to the noise, and spots explain them better."""
    hidden, search = np.random.default_rng([20351123, 3, 8]).spawn(2)
    case = draw_case("outsider", hidden)
    assert case.names == ("stains",)
    assert discover(case.cube, case.setup, rng=search).verdict == "unexplained"


@pytest.mark.slow
@pytest.mark.rng("one wrong gain is no stain")
def test_one_wrong_gain_is_no_stain(rng: np.random.Generator) -> None:
    case = _with_gain(rng, 0.006)
    verdict = discover(case.cube, case.setup, rng=np.random.default_rng(1))
    assert verdict.verdict == "named", verdict.summary()
    assert {effect.name for effect in verdict.effects} == {"amplifier_gain"}


def _with_gain(rng: np.random.Generator, size: float) -> SealedCase:
    """A sensor without an effect, one amplifier of which is then read with another gain."""
    case = draw_case("none", rng)
    rows, columns = case.cube.shape[1] // 2, case.cube.shape[2] // 8
    factor = np.ones(case.cube.shape[1:])
    factor[:rows, 3 * columns : 4 * columns] += size
    cube = replace(
        case.cube,
        image=(case.cube.image * factor).astype(np.float32),
        variance=(case.cube.variance * factor**2).astype(np.float32),
    )
    return replace(case, cube=cube)
