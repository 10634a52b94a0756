"""The search of a few pixels, down to one: counts over the mean of their sensor."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import SearchOptions, Verdict, discover
from lsst.fringe_sim.algorithms.discovery.catalogue import Catalogue
from lsst.fringe_sim.algorithms.discovery.continuation import continued
from lsst.fringe_sim.algorithms.discovery.heldout import judge_unseen
from lsst.fringe_sim.algorithms.discovery.neighbour_order import in_order_of_neighbours
from lsst.fringe_sim.algorithms.discovery.next_flats import FlatForecast
from lsst.fringe_sim.algorithms.discovery.noise import STATED_UNCERTAINTY
from lsst.fringe_sim.algorithms.discovery.preparation import OPEN_ORDERS, Prepared, prepare
from lsst.fringe_sim.algorithms.discovery.set_search import SetSearch
from lsst.fringe_sim.algorithms.inference import Hypothesis, coordinates_of, fit, led, relaxed
from lsst.fringe_sim.effects import EFFECTS, Effect
from lsst.fringe_sim.effects.ring_search import find_rings
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

WAVELENGTHS = np.linspace(880.0, 990.0, 12)
ELECTRONS = 50_000.0
SENSOR_UM = np.linspace(12.5, 17.5, 2500)
"""Thickness of the sensor whose mean the counts are relative to."""

WHOLE = np.hanning(len(SENSOR_UM)) / np.hanning(len(SENSOR_UM)).sum()
FEW = (
    "bandwidth",
    "contrast_loss",
    "epoxy_index",
    "gate_thickness",
    "wavelength_offset",
    "wavelength_jitter",
)


def cube_of(
    rng: np.random.Generator,
    effects: dict[str, float],
    shape: tuple[int, int] = (1, 1),
    span_um: float = 0.3,
    stated: float = 1.0,
) -> FringeCube:
    """Some pixels; ``stated``: variance that is stated over that of the noise."""
    model = FringeModel.from_setup("ts8_e2v", effects)
    y, x = np.mgrid[: shape[0], : shape[1]] / max(shape)
    mean = model.response(SENSOR_UM[np.newaxis], WAVELENGTHS)[:, 0] @ WHOLE
    flats = model.response(14.83 + span_um * (x + 0.5 * y**2), WAVELENGTHS) / mean[:, np.newaxis, np.newaxis]
    image = (rng.poisson(ELECTRONS * flats) / ELECTRONS).astype(np.float32)
    width, kelvin = model.setup.bandwidth_fwhm_nm, model.base_system.temperature_k
    rows = FlatExposures(WAVELENGTHS, np.full(12, width), np.full(12, kelvin))
    variance = (stated * flats / ELECTRONS).astype(np.float32)
    return FringeCube(image, variance, np.zeros(image.shape, np.int32), rows, "relative")


def catalogue(names: tuple[str, ...] = FEW) -> list[Effect]:
    return [one for one in EFFECTS if one.name in names]


def prepared_of(cube: FringeCube) -> Prepared:
    model = FringeModel.from_setup("ts8_e2v")
    return prepare(cube, model, catalogue(), SearchOptions(), np.random.default_rng(5))


def fitted(prepared: Prepared, name: str) -> Hypothesis:
    """An effect, fitted to the data."""
    forward = prepared.problem.forward
    return fit((name,), coordinates_of(forward.effect_of(name), forward), prepared.point)


def search_of(prepared: Prepared, *, noise: bool) -> SetSearch:
    """``noise``: what is said of whatever a set leaves."""
    known = Catalogue.of(catalogue(), prepared.problem)
    return SetSearch(known, prepared.null, SearchOptions(), lambda text: None, lambda found: noise)


def verdict_of(cube: FringeCube, names: tuple[str, ...] = FEW) -> Verdict:
    return discover(cube, "ts8_e2v", catalogue(names), rng=np.random.default_rng(5))


# Preparation ------------------------------------------------------------------------------------------------


@pytest.mark.rng("one pixel")
def test_of_one_pixel_noise_and_levels_are_believed(rng: np.random.Generator) -> None:
    prepared = prepared_of(cube_of(rng, {}))
    np.testing.assert_array_equal(prepared.noise_factor, np.full(12, 1.0 + STATED_UNCERTAINTY))
    levels = prepared.point.levels
    np.testing.assert_allclose(levels, levels[0], rtol=1e-12)
    assert levels[0] == pytest.approx(1.0, abs=0.01)
    assert not prepared.unseen.seen.any()
    assert [note.partition(" taken")[0] for note in prepared.told] == ["noise", "flat levels"]
    assert "12 parameters" in Catalogue.of(catalogue(), prepared.problem).left_out["wavelength_jitter"]


@pytest.mark.rng("levels of strips")
@pytest.mark.parametrize(
    ("shape", "few", "measured"),
    [((2, 2), True, False), ((5, 99), True, True), ((5, 100), False, True), ((6, 6), False, False)],
)
def test_levels_are_free_as_soon_as_pixels_tell_them(
    shape: tuple[int, int], few: bool, measured: bool, rng: np.random.Generator
) -> None:
    prepared = prepared_of(cube_of(rng, {}, shape))
    assert (prepared.few, prepared.measured) == (few, measured)
    assert (np.ptp(prepared.point.levels) > 1e-9) != few
    assert prepared.problem.orders == (OPEN_ORDERS if few else 0)


@pytest.mark.rng("blocks of a small sensor")
@pytest.mark.parametrize(("side", "held"), [(12, False), (16, True)])
def test_blocks_are_held_out_where_the_others_tell_their_noise(
    side: int, held: bool, rng: np.random.Generator
) -> None:
    """Of the 12 x 12 pixels all serve, so that noise which is stated a fifth too low is seen."""
    prepared = prepared_of(cube_of(rng, {}, (side, side), 0.6, stated=0.64))
    assert prepared.unseen.seen.any() == held
    assert prepared.measured
    assert float(prepared.noise_factor.mean()) == pytest.approx(1.25, rel=0.15)


def test_a_field_of_one_row_goes_on() -> None:
    np.testing.assert_allclose(continued(np.full((1, 1), 3.0), np.ones((1, 1), bool)), 3.0)
    line = np.arange(9.0)[np.newaxis]
    known = np.ones((1, 9), bool)
    known[0, 3:5] = False
    np.testing.assert_allclose(continued(line, known), line, atol=1e-4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (2, 2)])
def test_cells_of_one_row_are_in_the_order_of_their_neighbours(shape: tuple[int, int]) -> None:
    field = 14.0 + 0.01 * np.arange(float(np.prod(shape))).reshape(shape)
    torn = field.copy()
    if field.size > 4:  # of fewer, no median tells which is torn
        torn[0, 1] += 0.3
    np.testing.assert_allclose(in_order_of_neighbours(torn, np.ones(shape, bool), 0.3), field, atol=1e-12)


@pytest.mark.rng("rings in two rows")
def test_no_rings_are_seen_in_two_rows(rng: np.random.Generator) -> None:
    places = np.arange(300.0)
    image = rng.standard_normal((2, 300))
    assert find_rings(image, np.ones((2, 300), bool), places[:2], places, np.array([2000.0, 2000.0])) is None


# Orders -----------------------------------------------------------------------------------------------------


@pytest.mark.rng("orders of one pixel")
def test_a_fit_finds_the_order_of_one_pixel(rng: np.random.Generator) -> None:
    prepared = prepared_of(cube_of(rng, {}))
    order_um, best = prepared.problem.forward.order_um, prepared.point
    for turn in (-3, 2):
        start = relaxed(best.moved(best.levels, best.thickness_um + turn * order_um))
        assert start.cost > best.cost + 5.0
        found = fit((), (), start).point
        np.testing.assert_allclose(found.thickness_um, best.thickness_um, atol=1e-3)


@pytest.mark.rng("scores of one pixel")
def test_an_effect_is_scored_in_the_order_that_suits_it(rng: np.random.Generator) -> None:
    """The unchanged model lies in another order, in which weaker fringes promise little."""
    prepared = prepared_of(cube_of(rng, {"contrast_loss.factor": 0.5}))
    sets = search_of(prepared, noise=False)
    (one,) = (each for each in sets.scores(prepared.null) if each.name == "contrast_loss")
    found = fitted(prepared, "contrast_loss")
    assert one.gain == pytest.approx(found.log_evidence - prepared.null.log_evidence, rel=0.2)
    if one.start is not None:
        np.testing.assert_allclose(one.start.thickness_um, found.point.thickness_um, atol=0.05)


@pytest.mark.rng("effects of one pixel")
@pytest.mark.parametrize("noise", [True, False])
def test_every_effect_is_fitted_where_no_noise_is_left(noise: bool, rng: np.random.Generator) -> None:
    """Derivatives promise nothing of a gate that shifts the fringes by orders."""
    prepared = prepared_of(cube_of(rng, {"contrast_loss.factor": 0.5}))
    sets = search_of(prepared, noise=noise)
    sets.larger(prepared.null)
    fitted_alone = {name for key in sets.pool if len(key) == 1 for name in key}
    promising = {one.name for one in sets.scores(prepared.null) if one.gain > 0.0}
    assert promising <= fitted_alone if not noise else "contrast_loss" in fitted_alone


@pytest.mark.rng("one pixel with a map")
def test_one_pixel_with_a_map_stays_where_it_is(rng: np.random.Generator) -> None:
    """Level and contrast of every exposure would follow one value wherever it is."""
    cube = replace(
        cube_of(rng, {}),
        thickness=np.full((1, 1), 14.83, np.float32),
        thickness_sigma=np.full((1, 1), 0.003, np.float32),
        layer="adhesive",
    )
    prepared = prepared_of(cube)
    assert prepared.problem.orders == 0
    assert led(prepared.point) is prepared.point
    assert verdict_of(cube).verdict == "no_discrepancy"


# Judgement --------------------------------------------------------------------------------------------------


@pytest.mark.rng("wavelengths left out one by one")
def test_wavelengths_are_left_out_one_by_one(rng: np.random.Generator) -> None:
    """Each is predicted by the others: a cause that is there better, and the unchanged model as well as itself."""
    prepared = prepared_of(cube_of(rng, {"contrast_loss.factor": 0.5}))
    found = fitted(prepared, "contrast_loss")
    unseen = judge_unseen(prepared, found)
    fall = 0.5 * (prepared.null.chi2 - found.chi2)
    assert unseen.gain is None
    assert unseen.waves_gain > 0.8 * fall > 10.0
    assert unseen.why_not(0.15) == ""
    assert unseen.after_rms < unseen.before_rms
    same = judge_unseen(prepared, prepared.null)
    assert same.waves_gain == 0.0
    assert "too few" in same.why_not(0.15)
    worse = replace(unseen, waves_gain=-0.1)
    assert "not predicted better" in worse.why_not(0.15)
    assert "of blocks" not in worse.text


@pytest.mark.rng("next flats of one pixel")
def test_of_one_pixel_more_are_a_measurement(rng: np.random.Generator) -> None:
    prepared = prepared_of(cube_of(rng, {"contrast_loss.factor": 0.5}))
    best, rival = fitted(prepared, "contrast_loss"), fitted(prepared, "bandwidth")
    forecast = FlatForecast(best, FringeModel.from_setup("ts8_e2v"), prepared.cells)
    ranked = forecast.ranked("contrast_loss", {"bandwidth": rival})
    assert [item.separation for item in ranked] == sorted((item.separation for item in ranked), reverse=True)
    (more,) = (item for item in ranked if item.measurement.name == "more_pixels")
    now = more.pairs[0].separation_now
    assert more.separation == pytest.approx(100.0 * now)
    # The others take as many flats again or better ones: none says less than those that are there.
    assert all(now < item.separation for item in ranked)
    assert now > 0.0


# Answers ----------------------------------------------------------------------------------------------------


@pytest.mark.rng("answers about few pixels")
@pytest.mark.parametrize(("shape", "stated"), [((1, 1), 0.64), ((1, 7), 0.64), ((3, 3), 1.0)])
def test_nothing_is_found_in_a_few_pixels(
    shape: tuple[int, int], stated: float, rng: np.random.Generator
) -> None:
    verdict = verdict_of(cube_of(rng, {}, shape, stated=stated))
    assert verdict.verdict == "no_discrepancy"
    assert verdict.size["of_counts"] < 0.01


@pytest.mark.rng("names from one pixel")
def test_what_one_pixel_shows_is_named(rng: np.random.Generator) -> None:
    verdict = verdict_of(cube_of(rng, {"contrast_loss.factor": 0.4}), ("contrast_loss", "wavelength_offset"))
    (found,) = verdict.effects
    assert found.name == "contrast_loss"
    value = found.parameters["factor"]
    assert value.value == pytest.approx(0.4, abs=4.0 * value.sigma)
    assert found.significance > 10.0
    assert any("flat levels taken as known" in note for note in verdict.notes)


@pytest.mark.rng("a strip")
@pytest.mark.parametrize("offset_nm", [0.0, 2.0])
def test_a_strip_of_eight_rows_is_searched(offset_nm: float, rng: np.random.Generator) -> None:
    effects = {"wavelength_offset.offset": offset_nm} if offset_nm else {}
    verdict = verdict_of(cube_of(rng, effects, (8, 160), 0.8))
    assert [one.name for one in verdict.effects] == (["wavelength_offset"] if offset_nm else [])
    for one in verdict.effects:
        value = one.parameters["offset"]
        assert value.value == pytest.approx(offset_nm, abs=4.0 * value.sigma)
    assert verdict.gap.heldout_before > 0.0
