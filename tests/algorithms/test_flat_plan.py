"""Forecasts of flats: against brute force, against fits of noisy pixels, and what they recommend."""

import numpy as np
import pytest
from scipy.stats import norm

from lsst.fringe_sim.algorithms.flat_plan import (
    FEWEST_FLATS,
    PlannedFlat,
    forecast_flats,
    rank_flats,
    recommend_flats,
)
from lsst.fringe_sim.algorithms.thickness_fit.cells import Cells
from lsst.fringe_sim.algorithms.thickness_fit.evidence import order_evidence
from lsst.fringe_sim.algorithms.thickness_fit.fit import make_templates
from lsst.fringe_sim.algorithms.thickness_fit.templates import pad_wavelengths
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import FringeModel, Setup

TEN_NM = tuple(np.arange(880.0, 991.0, 10.0))
RANGE_UM = (7.0, 12.0)
SEARCH_UM = (6.0, 14.0)
READ_NOISE_E = 7.0


def flats_at(wavelengths, electrons: float = 20_000.0) -> list[PlannedFlat]:
    return [PlannedFlat(float(value), electrons) for value in wavelengths]


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


@pytest.fixture(scope="module")
def weak() -> FringeModel:
    """Contrast as real sensors have it, with the silicon for which the numbers below were chosen."""
    setup = Setup.from_name("ts8_e2v").with_silicon("Si_green2008")
    return FringeModel.from_setup(setup, {"contrast_loss.factor": 0.15})


def amplitude(model: FringeModel, thickness_um: np.ndarray, wavelengths) -> np.ndarray:
    """Response over its mean over `RANGE_UM`, less one."""
    return model.response(thickness_um, wavelengths) / mean_response(model, wavelengths) - 1.0


def mean_response(model: FringeModel, wavelengths) -> np.ndarray:
    low, high = RANGE_UM
    return model.response_on_grid(wavelengths, low, 1e-3 * (high - low), 1001).mean(axis=1, keepdims=True)


@pytest.mark.parametrize("setting", [{}, {"contrast_loss.factor": 0.15}, {"bandwidth.fwhm": 4.0}])
def test_uncertainty_and_nearest_rival_against_brute_force(setting) -> None:
    model = FringeModel.from_setup("ts8_e2v", setting)
    electrons = 20_000.0
    forecast = forecast_flats(
        model, flats_at(TEN_NM, electrons), RANGE_UM, search_um=SEARCH_UM, read_noise_e=READ_NOISE_E
    )
    fine = np.arange(*SEARCH_UM, 1e-4)
    curve = model.response_on_grid(TEN_NM, fine[0], 1e-4, len(fine)) / mean_response(model, TEN_NM) - 1.0
    for place in np.linspace(0, len(forecast.thickness_um) - 1, 7).astype(int):
        truth = forecast.thickness_um[place]
        own = amplitude(model, np.array([truth - 1e-5, truth, truth + 1e-5]), TEN_NM)
        weight = electrons**2 / (electrons * (1.0 + own[:, 1]) + READ_NOISE_E**2)
        slope = (own[:, 2] - own[:, 0]) / 2e-5
        assert forecast.sigma_um[place] == pytest.approx((weight * slope**2).sum() ** -0.5, rel=2e-3)
        chi2 = (weight[:, None] * (own[:, 1:2] - curve) ** 2).sum(axis=0)
        chi2[np.abs(fine - truth) < 0.25 * forecast.order_um] = np.inf
        assert forecast.separation[place] == pytest.approx(chi2.min(), rel=0.01, abs=0.02)
        assert forecast.rival_um[place] == pytest.approx(fine[np.argmin(chi2)], abs=2e-3)


def wrong_orders(
    model: FringeModel, wavelengths, electrons: float, pixels: int, count: int, rng: np.random.Generator
) -> float:
    """Share of independent regions whose order the fit of cells gets wrong, on count statistics."""
    truth = rng.uniform(*RANGE_UM, count)
    templates = make_templates(model, np.array(wavelengths), SEARCH_UM)
    templates = templates.normalised_to(np.linspace(*RANGE_UM, 20_001))
    clean = amplitude(model, truth, wavelengths)
    variance = (electrons * (1.0 + clean) + READ_NOISE_E**2) / electrons**2 / pixels
    noisy = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)
    value, weight = pad_wavelengths(noisy.T[None]), pad_wavelengths(1.0 / variance.T[None])
    none = np.zeros_like(value)
    cells = Cells(value, weight, none, none, np.arange(2), np.arange(count + 1))
    order = templates.order_um()
    found = order_evidence(cells, templates, order, range_um=SEARCH_UM)
    return float(np.mean(np.abs(found.best_um[0] - truth) > 0.25 * order))


@pytest.mark.parametrize(
    ("wavelengths", "electrons", "pixels"),
    [(TEN_NM, 20_000.0, 1), (TEN_NM[::2], 20_000.0, 1), (TEN_NM[::3], 40_000.0, 4)],
)
@pytest.mark.rng("forecast of slips is what fits find")
def test_forecast_of_slips_is_what_fits_find(model, rng, wavelengths, electrons, pixels) -> None:
    forecast = forecast_flats(
        model,
        flats_at(wavelengths, electrons),
        RANGE_UM,
        search_um=SEARCH_UM,
        read_noise_e=READ_NOISE_E,
        region_px=pixels,
    )
    said = float(forecast.region_slip.mean())
    count = 20_000
    found = wrong_orders(model, wavelengths, electrons, pixels, count, rng)
    assert 0.003 < said < 0.5
    assert found == pytest.approx(said, rel=0.2, abs=5.0 * np.sqrt(said / count))


@pytest.mark.rng("safe plans do not slip and ambiguous ones do")
def test_safe_plans_do_not_slip_and_ambiguous_ones_do(weak, rng) -> None:
    limits = {"search_um": SEARCH_UM, "read_noise_e": READ_NOISE_E}
    safe = forecast_flats(weak, flats_at(TEN_NM), RANGE_UM, region_px=400, **limits)
    poor = forecast_flats(weak, flats_at(TEN_NM[::3]), RANGE_UM, region_px=400, **limits)
    assert safe.safe(1e-5)
    assert not poor.safe(1e-3)
    assert wrong_orders(weak, TEN_NM, 20_000.0, 400, 5000, rng) == 0.0
    assert wrong_orders(weak, TEN_NM[::3], 20_000.0, 400, 5000, rng) > 0.2 * poor.region_slip.mean() > 0.0


def test_steps_below_the_nyquist_rate_bring_mirror_images() -> None:
    """With steps of 30 nm the phase turns by more than half a turn from flat to flat: rivals are orders away."""
    model = FringeModel.from_setup("ts8_e2v")
    dense = forecast_flats(model, flats_at(TEN_NM), (5.0, 30.0))
    sparse = forecast_flats(model, flats_at(TEN_NM[::3]), (5.0, 30.0))
    far = np.abs(sparse.rival_um - sparse.thickness_um) > 3.0 * sparse.order_um
    assert far.mean() > 0.3
    assert np.mean(np.abs(dense.rival_um - dense.thickness_um) > 3.0 * dense.order_um) < 0.01


def test_more_light_and_more_flats_never_hurt(model) -> None:
    few = forecast_flats(model, flats_at(TEN_NM[::2]), RANGE_UM)
    more = forecast_flats(model, flats_at(TEN_NM[::2]) + flats_at([975.0]), RANGE_UM)
    bright = forecast_flats(model, flats_at(TEN_NM[::2], 40_000.0), RANGE_UM)
    assert np.all(more.sigma_um[: len(few.sigma_um)].mean() < few.sigma_um.mean())
    assert np.all(bright.sigma_um < few.sigma_um)
    assert np.all(bright.separation > few.separation)


def test_pairwise_error_of_a_lone_rival(model) -> None:
    """Where one rival dwarfs the others, the slip is that of two points with Gaussian noise between them."""
    forecast = forecast_flats(model, flats_at(TEN_NM), RANGE_UM)
    bound = norm.sf(0.5 * np.sqrt(forecast.separation))
    assert np.all(forecast.pixel_slip >= bound * (1.0 - 1e-9))
    assert np.any(forecast.pixel_slip < 1.05 * bound)


def test_ranking_and_recommendation(weak) -> None:
    pool = [PlannedFlat(value, 20_000.0, width) for value in TEN_NM for width in (1.0, 4.0)]
    limits = {"search_um": SEARCH_UM, "region_px": 400}
    present = flats_at(TEN_NM[::3])
    before = forecast_flats(weak, present, RANGE_UM, **limits)
    ranked = rank_flats(weak, present, pool, RANGE_UM, **limits)
    assert len(ranked) == len(pool)
    with_best = forecast_flats(weak, [*present, ranked[0].flat], RANGE_UM, **limits)
    with_worst = forecast_flats(weak, [*present, ranked[-1].flat], RANGE_UM, **limits)
    assert with_best.region_slip.mean() < with_worst.region_slip.mean() < before.region_slip.mean() * 1.01
    assert ranked[0].sigma_um == pytest.approx(np.sqrt(np.mean(with_best.sigma_um**2)), rel=0.03)
    short = recommend_flats(weak, pool, RANGE_UM, slip_limit=1e-4, **limits)
    assert short.safe(1e-4)
    assert FEWEST_FLATS <= len(short.flats) < len(TEN_NM)
    plain = recommend_flats(weak, flats_at(np.arange(880.0, 991.0, 5.0)), RANGE_UM, slip_limit=1e-4, **limits)
    assert plain.safe(1e-4)
    assert wrong_orders_of(weak, plain) <= 1e-3
    sharper = recommend_flats(weak, pool, RANGE_UM, slip_limit=1e-4, sigma_um=0.0075, **limits)
    assert np.sqrt(np.mean(sharper.sigma_um**2)) < 0.0077
    assert len(sharper.flats) > len(short.flats)


def wrong_orders_of(model: FringeModel, plan) -> float:
    """Share of wrong orders in fits of a plan whose flats have the bandwidth of the set-up."""
    wavelengths = [flat.wavelength_nm for flat in plan.flats]
    return wrong_orders(model, wavelengths, 20_000.0, plan.region_px, 3000, np.random.default_rng(3))


def test_silicon_as_the_varying_layer() -> None:
    model = FringeModel.from_setup("ts8_itl")
    wide = forecast_flats(model, [PlannedFlat(w, 20_000.0, 1.0) for w in TEN_NM], (98.0, 102.0))
    narrow = forecast_flats(model, [PlannedFlat(w, 20_000.0, 0.2) for w in TEN_NM], (98.0, 102.0))
    assert narrow.sigma_um.max() < 0.5 * wide.sigma_um.min()
    assert narrow.separation.min() > 10.0 > wide.separation.min()


def test_bad_input(model) -> None:
    with pytest.raises(InputError, match="flats"):
        forecast_flats(model, [], RANGE_UM)
    with pytest.raises(InputError, match=r"candidate flats.*0.*one or more"):
        rank_flats(model, flats_at(TEN_NM), [], RANGE_UM)
    with pytest.raises(OutOfRangeError, match="thickness range"):
        forecast_flats(model, flats_at(TEN_NM), (12.0, 7.0))
    with pytest.raises(OutOfRangeError, match="searched"):
        forecast_flats(model, flats_at(TEN_NM), RANGE_UM, search_um=(8.0, 9.0))
    with pytest.raises(OutOfRangeError, match="wavelength"):
        PlannedFlat(-1.0)
    with pytest.raises(OutOfRangeError, match="region"):
        forecast_flats(model, flats_at(TEN_NM), RANGE_UM, region_px=0)
    with pytest.raises(InputError, match="candidate"):
        recommend_flats(model, flats_at(TEN_NM[:3]), RANGE_UM)
