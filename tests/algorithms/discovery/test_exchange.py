"""One effect in the place of two, and two in the place of one."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import set_search as sets_module
from lsst.fringe_sim.algorithms.discovery.catalogue import Catalogue
from lsst.fringe_sim.algorithms.discovery.channels import Channel
from lsst.fringe_sim.algorithms.discovery.critics import is_out_of_reach
from lsst.fringe_sim.algorithms.discovery.naming import name_effects
from lsst.fringe_sim.algorithms.discovery.options import SearchOptions
from lsst.fringe_sim.algorithms.discovery.pairs import ScoredPair
from lsst.fringe_sim.algorithms.discovery.scores import Scored, Scorer, best_gain
from lsst.fringe_sim.algorithms.discovery.set_search import SetSearch
from lsst.fringe_sim.algorithms.inference import (
    CellShape,
    Data,
    Forward,
    Hypothesis,
    Point,
    Problem,
    fit,
    relaxed,
)
from lsst.fringe_sim.algorithms.inference.coordinates import SECANT
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.linspace(900.0, 985.0, 8)
FEW = ("epoxy_index", "bandwidth", "wavelength_offset", "contrast_loss")
NOISE = 2e-3


def search_of(rng: np.random.Generator, hidden: dict[str, float], map_um: float | None = None) -> SetSearch:
    """A search among a few effects on a few cells; ``map_um``: error of their thickness if it is known."""
    effects = [effect for effect in EFFECTS if effect.name in FEW]
    place = np.arange(12.0)
    thickness = 14.0 + 0.035 * place + 0.02 * place[:, np.newaxis]
    geometry = ImageGeometry((12, 12), place, place, WAVELENGTHS, np.full(8, 20_000.0))
    shape = CellShape.of_field(thickness, 1)
    forward = Forward(FringeModel.from_setup("ts8_e2v"), effects, geometry, shape, (13.2, 15.5))
    value = forward.predict(hidden, thickness.ravel())[0]
    value = value + NOISE * rng.standard_normal(value.shape)
    problem = Problem(Data(value, np.full(value.shape, NOISE**-2.0)), forward, thickness.ravel(), 1e-5)
    if map_um is not None:
        problem = replace(problem, thickness_sigma_um=np.full(thickness.size, map_um), known=True)
    null = fit((), (), relaxed(problem.at({}, np.ones(8), thickness.ravel()), rounds=6))
    return SetSearch(
        Catalogue.of(effects, null.point.problem),
        null,
        SearchOptions(),
        lambda text: None,
        lambda found: True,
    )


def fitted(search: SetSearch, *names: str) -> Hypothesis:
    """A set that the search knows."""
    items = tuple(item for name in names for item in search.catalogue.items[name])
    return search._keep(fit(names, items, search.null.point))


@pytest.mark.rng("promise of pairs")
def test_a_pair_promises_what_its_parameters_do_together(rng: np.random.Generator) -> None:
    search = search_of(rng, {"bandwidth.fwhm": 2.2, "wavelength_offset.offset": 0.3})
    scorer = Scorer(search.null.point, search.null.point.level_columns, SearchOptions().sizes)
    for name in FEW:
        scorer.score(name, search.catalogue.items[name])
    best = scorer.joint().best_pairs(best_gain, 0.0)[0]
    assert set(best.names) == {"bandwidth", "wavelength_offset"}
    items = tuple(item for name in best.names for item in search.catalogue.items[name])
    both = scorer._with_secant("both", items, SECANT)
    assert both is not None
    assert best.gain == pytest.approx(both.gain, rel=1e-6)
    assert best.step == pytest.approx(both.step, rel=1e-5)


@pytest.mark.rng("one in the place of two")
def test_one_effect_takes_the_place_of_two(rng: np.random.Generator) -> None:
    search = search_of(rng, {"wavelength_offset.offset": 0.6})
    two = fitted(search, "epoxy_index", "bandwidth")
    assert search.posterior(two) > search.posterior(search.null) + 10.0
    assert search._settled(two).effects == ("wavelength_offset",)


@pytest.mark.rng("two in the place of one")
def test_two_effects_take_the_place_of_one(rng: np.random.Generator) -> None:
    search = search_of(rng, {"bandwidth.fwhm": 2.6, "wavelength_offset.offset": 0.6})
    one = fitted(search, "epoxy_index")
    search._exchange_for_two(one, "epoxy_index")
    two = search.pool[frozenset({"bandwidth", "wavelength_offset"})]
    assert search._is_beaten(one)
    hidden = {"bandwidth.fwhm": 2.6, "wavelength_offset.offset": 0.6}
    away = two.values - [hidden[item.key] for item in two.items]
    assert (np.abs(away) < 4.0 * np.sqrt(np.diag(two.covariance))).all()


@pytest.mark.rng("pairs that are not worth it")
def test_two_effects_do_not_take_the_place_of_the_right_one(rng: np.random.Generator) -> None:
    search = search_of(rng, {"wavelength_offset.offset": 0.6})
    one = fitted(search, "wavelength_offset")
    search._exchange_for_two(one, "wavelength_offset")
    assert not search._is_beaten(one)
    assert not any("wavelength_offset" in names for names in search.pool if len(names) == 2)


@pytest.mark.rng("what is hoped for")
def test_an_effect_is_hoped_to_bring_the_part_of_its_promise_that_it_has_brought(
    rng: np.random.Generator,
) -> None:
    search = search_of(rng, {"wavelength_offset.offset": 0.6})
    scored = {one.name: one for one in search.scores(search.null)}
    before = search.hoped(scored["bandwidth"])
    assert before == pytest.approx(max(scored["bandwidth"].gain, 0.0) / SearchOptions().least_of_promise)
    brings = search._added(search.null, scored["bandwidth"]).log_evidence - search.null.log_evidence
    part = min(max(brings, 0.0) / scored["bandwidth"].gain, 1.0 / SearchOptions().least_of_promise)
    # Beside another effect it may promise more, and bring more.
    assert search.hoped(replace(scored["bandwidth"], gain=1e6)) == pytest.approx(1e6 * part)


@pytest.mark.rng("twins of an effect that is misled")
@pytest.mark.parametrize(
    ("twins", "brings", "fitted"),
    [((785.0,), (), 0), ((788.0,), (700.0,), 1), ((890.0, 880.0), (700.0, 880.0), 2),
     ((890.0, 700.0), (880.0, 690.0), 1), ((890.0, 860.0), (889.0, 870.0), 2)],
    ids=str,
)  # fmt: skip
def test_twins_of_an_effect_that_brings_less_than_it_promised_are_fitted_as_far_as_they_may_win(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch,
    twins: tuple[float, ...], brings: tuple[float, ...], fitted: int,
) -> None:  # fmt: skip
    """The first of them promises 900 and brings 700, and an effect of another kind brings 790 of its 800."""
    search, (first, *others, last) = search_of(rng, {}), FEW
    alike, apart = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    own = dict(zip(others, twins, strict=False))
    promised = {first: 900.0, **own, last: 800.0}
    scored = [
        Scored(name, gain, 1, np.ones(1), apart if name == last else alike) for name, gain in promised.items()
    ]
    brought = {first: 700.0, **dict(zip(others, brings, strict=False)), last: 790.0}
    tried = []

    def fitted_from(base: Hypothesis, one: Scored, names: tuple[str, ...], items: object) -> Hypothesis:
        tried.append(one.name)
        return replace(base, effects=names, log_evidence=base.log_evidence + brought[one.name])

    monkeypatch.setattr(search, "scores", lambda base: sorted(scored, key=lambda one: -one.gain))
    monkeypatch.setattr(search, "_fitted", fitted_from)
    search._grow(search.null)
    assert tried == [first, last, *others[:fitted]]
    best = search.best_of(1)[0]
    assert best.effects == (max(tried, key=brought.__getitem__),)


@pytest.mark.rng("what a wrong lead costs")
def test_no_effect_promises_what_a_thickness_led_astray_has_cost(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the fringes are as like an order beside the map, which has an error of 2 nm."""
    hidden = {"contrast_loss.factor": 0.7}
    straight, astray = (
        search_of(np.random.default_rng(rng.bit_generator.seed_seq), hidden, 0.002) for _ in "ab"
    )
    expected = {one.name: one for one in straight.scores(straight.null)}
    away = 0.31

    def led(point: Point) -> Point:
        return point.moved(point.levels, point.thickness_um + away)

    monkeypatch.setattr(sets_module, "led", led)
    found = {one.name: one for one in astray.scores(astray.null)}
    assert found["contrast_loss"].gain == pytest.approx(expected["contrast_loss"].gain)
    assert found["contrast_loss"].step[0] == pytest.approx(-0.3, rel=0.1)
    brings = fitted(astray, "contrast_loss").log_evidence - astray.null.log_evidence
    assert max(one.gain for one in found.values()) < 1.1 * brings
    best = max(
        (pair for joint in astray._joints[frozenset()] for pair in joint.best_pairs(best_gain, 0.0)),
        key=lambda one: one.gain,
    )
    assert best.gain < 1.1 * brings
    point = led(astray.null.point)
    alone = Scorer(point, point.level_columns, SearchOptions().sizes)
    assert alone.score("epoxy_index", astray.catalogue.items["epoxy_index"]).gain > 10.0 * brings


@pytest.mark.rng("a lead that is right")
def test_an_effect_promises_with_the_thickness_that_it_is_led_to(rng: np.random.Generator) -> None:
    """An adhesive with another index, which moves the fringes by a third of an order beside the map."""
    search = search_of(rng, {"epoxy_index.offset": 0.01}, 0.002)
    promised = {one.name: one for one in search.scores(search.null)}["epoxy_index"]
    brings = fitted(search, "epoxy_index").log_evidence - search.null.log_evidence
    assert promised.step[0] == pytest.approx(0.01, rel=0.2)
    assert promised.gain == pytest.approx(brings, rel=0.2)


@pytest.mark.rng("twins of a pair")
@pytest.mark.parametrize("better", [True, False])
def test_a_pair_with_a_twin_in_the_place_of_one_effect_is_fitted_where_the_pair_is_better(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, better: bool
) -> None:
    """Pairs of which noise decides the order, and what they bring is not what they promise."""
    search = search_of(rng, {})
    names = ("epoxy_index", "bandwidth", "wavelength_offset")
    ends = {"epoxy_index": [1.0, 0.0], "bandwidth": [0.0, 1.0], "wavelength_offset": [0.1, 0.99]}
    scored = [Scored(name, 500.0, 1, np.ones(1), np.array(ends[name])) for name in names]
    pairs = [
        ("epoxy_index", "bandwidth"),
        ("bandwidth", "wavelength_offset"),
        ("epoxy_index", "wavelength_offset"),
    ]
    promised = [ScoredPair(pair, 900.0 - rank, np.ones(2)) for rank, pair in enumerate(pairs)]
    one = replace(search.null, effects=("contrast_loss",), log_evidence=search.null.log_evidence + 800.0)
    search._keep(one)
    tried = []

    def added(base: Hypothesis, pair: ScoredPair, effects: tuple[str, ...]) -> Hypothesis:
        tried.append(pair.names)
        brings = 850.0 if better and pair.names == pairs[0] else 790.0
        return replace(base, effects=effects, log_evidence=base.log_evidence + brings)

    monkeypatch.setattr(search, "scores", lambda base: scored)
    monkeypatch.setattr(search, "_pair_added", added)
    joint = SimpleNamespace(best_pairs=lambda gain_of, least, without: promised)
    search._joints[frozenset()] = [joint]  # type: ignore[list-item]
    search._exchange_for_two(one, "contrast_loss")
    assert tried == (pairs if better else pairs[:2])


@pytest.mark.rng("orders of a set")
def test_a_set_whose_cells_lie_an_order_off_is_found_in_the_right_one(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is fitted where its cells are likeliest, and an order on either side, unless it leaves noise as it is."""
    search = search_of(rng, {})
    names, items = ("wavelength_offset",), search.catalogue.items["wavelength_offset"]
    right = replace(search.null, effects=names, items=items)
    order_um = right.point.problem.forward.order_um
    starts: list[float] = []

    def fitted_from(effects: tuple[str, ...], coordinates: object, point: Point) -> Hypothesis:
        assert (effects, coordinates) == (names, items)
        away = np.median(point.thickness_um - right.point.thickness_um) / order_um
        starts.append(round(float(away)))
        return right if starts[-1] == 0 else replace(right, point=point, log_evidence=-1e6)

    monkeypatch.setattr(search, "_fit", fitted_from)
    for off, tried in ((0, [-1, 1]), (1, [0, 0, 2]), (-1, [0, -2, 0])):
        moved = right.point.moved(right.point.levels, right.point.thickness_um + off * order_um)
        wrong = replace(right, point=moved, log_evidence=right.log_evidence - abs(off))
        search.pool = {frozenset(): search.null, frozenset(names): wrong}
        search.leaves_noise = lambda found: True
        assert search._in_orders(1) == [wrong]
        assert starts == []
        search.leaves_noise = lambda found: False
        assert search._in_orders(1) == [right if off else wrong]
        assert starts == tried
        starts.clear()


@pytest.mark.parametrize(
    ("name", "fall", "out"),
    [("thickness phase", 0.0, True), ("thickness phase", 300.0, True), ("thickness phase", 420.0, False),
     ("amplifiers", 0.0, True), ("texture", 0.0, False)],
)  # fmt: skip
def test_what_is_left_is_out_of_reach_where_no_effects_take_it_off(name: str, fall: float, out: bool) -> None:
    found = cast(Hypothesis, SimpleNamespace(point=SimpleNamespace(response=np.ones((2, 3))), chi2=0.0))
    assert is_out_of_reach([Channel(name, 500.0, 100.0, 0.0)], found, found, fall, SearchOptions()) == out


@pytest.mark.parametrize(("number", "named"), [(1, True), (2, True), (3, False)])
def test_one_cause_outside_the_catalogue_in_the_place_of_three_effects_leaves_them_without_a_name(
    number: int, named: bool
) -> None:
    names = FEW[:number]
    point = SimpleNamespace(
        problem=SimpleNamespace(forward=SimpleNamespace(effect_of=lambda name: EFFECTS[0]))
    )

    def found(effects: tuple[str, ...], chi2: float) -> SimpleNamespace:
        return SimpleNamespace(
            effects=effects, chi2=chi2, log_evidence=-0.5 * chi2, items=(), values=np.zeros(0),
            covariance=np.zeros((0, 0)), point=point,
        )  # fmt: skip

    best = found(names, 0.0)
    sets = SimpleNamespace(
        pool={frozenset(names): best},
        posterior=lambda one: one.log_evidence,
        without=lambda one, name: found(tuple(n for n in one.effects if n != name), 1e5),
        options=SearchOptions(),
    )
    naming = name_effects(sets, best, 1e6, 0.5)  # type: ignore[arg-type]
    assert len(naming.effects) == number
    assert (not naming.doubts) == named
