"""Round spots: how often noise makes one, what a few are worth, and gains that are fitted to them."""

from dataclasses import replace

import numpy as np
import pytest
from flat_cubes import TEN_NM, relative_flats
from lsst.fringe_sim.algorithms.discovery.basis import SplineBasis
from lsst.fringe_sim.algorithms.discovery.fit import Problem, fit_model
from lsst.fringe_sim.algorithms.discovery.forward import Forward
from lsst.fringe_sim.algorithms.discovery.selection import Selector
from scipy.special import logsumexp

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.discovery.cells import bin_cube
from lsst.fringe_sim.algorithms.discovery.channels import State, beside_thickness
from lsst.fringe_sim.algorithms.discovery.spots import DEPTHS, RADII, log_evidence_of_spots, spot_channel
from lsst.fringe_sim.challenge.sealed_cases import SealedCase, draw_case
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

SHAPE = (40, 48)


@pytest.fixture(scope="module")
def state() -> State:
    """A sensor of known thickness, fitted."""
    v, u = np.mgrid[-1.0 : 1.0 : SHAPE[0] * 1j, -1.0 : 1.0 : SHAPE[1] * 1j]
    truth = 15.0 + 0.5 * u - 0.4 * v + 0.3 * u * v
    model = FringeModel.from_setup("ts8_e2v")
    cells = bin_cube(relative_flats(truth, model, np.random.default_rng(5)), 1)
    forward = Forward.of_cells(model, EFFECTS, cells, (12.0, 18.0))
    basis = SplineBasis.of_grid(SHAPE, 4.0)
    problem = Problem(cells, forward, basis, np.eye(len(TEN_NM)))
    null = fit_model(problem, (), np.zeros(0), basis.fit(truth, np.ones(SHAPE)))
    return Selector(problem, EFFECTS[:1], null, np.full(len(TEN_NM), 1.6)).state(null)


def _round(y: float, x: float, radius: float) -> np.ndarray:
    rows, columns = np.indices(SHAPE)
    return np.exp(-0.5 * ((rows - y) ** 2 + (columns - x) ** 2) / radius**2)


def _with(state: State, response: np.ndarray, noise: np.ndarray) -> State:
    """The same fit to data in which cells have a response of their own."""
    return replace(state, residual=noise + state.whiten(state.value * response))


@pytest.mark.rng("noise makes spots as often as it is said to")
def test_noise_makes_spots_as_often_as_it_is_said_to(state: State, rng: np.random.Generator) -> None:
    """Hardly more often, and not next to never: the bound counts maxima of all sizes as if they were independent."""
    chances = [
        spot_channel(replace(state, residual=rng.standard_normal(state.residual.shape))).probability
        for _ in range(400)
    ]
    seen = sum(chance < 0.1 for chance in chances)
    assert 4 <= seen <= 40 + 3 * 6
    assert min(chances) > 1e-5


@pytest.mark.rng("spots of noise are worth little")
def test_spots_of_noise_are_worth_little(state: State, rng: np.random.Generator) -> None:
    worth = [
        log_evidence_of_spots(replace(state, residual=rng.standard_normal(state.residual.shape)))
        for _ in range(100)
    ]
    assert min(worth) == 0.0
    assert max(worth) < 6.0


@pytest.mark.parametrize(("y", "x", "radius"), [(20.0, 25.0, 5.0), (1.0, 46.0, 8.0)])
@pytest.mark.rng("a spot is seen and a misfit of the thickness is none")
def test_a_spot_is_seen_and_a_misfit_of_the_thickness_is_none(
    state: State, rng: np.random.Generator, y: float, x: float, radius: float
) -> None:
    noise = rng.standard_normal(state.residual.shape)
    stained = _with(state, -0.001 * _round(y, x, radius), noise)
    assert spot_channel(stained).probability < 1e-6
    bent = replace(state, residual=noise + state.design.slope * 0.01 * _round(y, x, radius))
    plain = spot_channel(replace(state, residual=noise))
    assert spot_channel(bent).statistic == pytest.approx(plain.statistic)


@pytest.mark.rng("light that all cells lack is no spot")
def test_light_that_all_cells_lack_is_no_spot(state: State, rng: np.random.Generator) -> None:
    noise = rng.standard_normal(state.residual.shape)
    plain = spot_channel(replace(state, residual=noise)).statistic
    assert spot_channel(_with(state, np.full(SHAPE, 0.01), noise)).statistic == pytest.approx(plain)


@pytest.mark.rng("correlated noise makes no spots")
def test_correlated_noise_makes_no_spots(state: State, rng: np.random.Generator) -> None:
    noise = rng.standard_normal(state.residual.shape)
    stained = _with(state, 5e-4 * _round(15.0, 20.0, 4.0), noise)
    assert spot_channel(stained, 0.1).statistic == pytest.approx(spot_channel(stained).statistic / 1.4)


@pytest.mark.rng("evidence is the integral over place size and depth")
def test_evidence_is_the_integral_over_place_size_and_depth(state: State, rng: np.random.Generator) -> None:
    """Summed on a grid; over the depth in closed form."""
    stained = _with(state, -0.0015 * _round(21.0, 26.0, 6.0), rng.standard_normal(state.residual.shape))
    level = beside_thickness(stained, stained.whiten(stained.value))
    seen = stained.residual - level * (stained.residual * level).sum() / (level**2).sum()
    places, logarithms = np.linspace(-2.0, 2.0, 13), np.log(6.0) + np.linspace(-0.4, 0.4, 13)
    logs = []
    for y in 21.0 + places:
        for x in 26.0 + places:
            for logarithm in logarithms:
                pattern = level * _round(y, x, float(np.exp(logarithm)))
                pattern = pattern - level * (pattern * level).sum() / (level**2).sum()
                square = float((pattern**2).sum())
                depth = float((seen * pattern).sum()) / square
                logs.append(0.5 * depth**2 * square - np.log(abs(depth)) + 0.5 * np.log(2.0 * np.pi / square))
    cell = (places[1] - places[0]) ** 2 * (logarithms[1] - logarithms[0])
    choices = SHAPE[0] * SHAPE[1] * np.log(RADII[-1] / RADII[0]) * 2.0 * DEPTHS
    expected = float(logsumexp(logs)) + np.log(cell / choices)
    assert expected > 20.0
    # A second spot in the noise may be worth a little.
    assert log_evidence_of_spots(stained) == pytest.approx(expected, abs=0.7)


@pytest.mark.rng("several spots are worth more than one")
def test_several_spots_are_worth_more_than_one(state: State, rng: np.random.Generator) -> None:
    noise = rng.standard_normal(state.residual.shape)
    places = [(10.0, 10.0, 5.0), (12.0, 19.0, 4.0), (30.0, 40.0, 7.0)]
    worth = [
        log_evidence_of_spots(_with(state, -0.0015 * sum(_round(*place) for place in places[:number]), noise))
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
