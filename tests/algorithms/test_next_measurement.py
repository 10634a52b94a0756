"""Forecasts of further measurements against exact derivatives, real fits and published numbers."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from recorded_numbers import Record
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from lsst.fringe_sim.algorithms import measurement_forecast as forecasts
from lsst.fringe_sim.algorithms.flat_series import LEVEL_E
from lsst.fringe_sim.algorithms.next_measurement import (
    FlatMeasurement,
    FlatSeries,
    RankedMeasurement,
    break_ambiguity,
    candidate_measurements,
    rank_measurements,
)
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.errors import InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.model import FringeModel, Setup

FLATS = tuple(float(nm) for nm in range(880, 1000, 10))
NARROW = FlatMeasurement("narrow", "0.5 nm", FlatSeries(FLATS, bandwidth_fwhm_nm=0.5))
BRIGHT = FlatMeasurement("level", "80 000 e", FlatSeries(FLATS, 80_000.0))
WIDE = FlatMeasurement("wide", "wider", FlatSeries((*np.linspace(800, 870, 8), *np.linspace(1000, 1050, 6))))
AGAIN = FlatMeasurement("again", "again", FlatSeries(FLATS))


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


@pytest.fixture
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecasts, "SAMPLES", (3, 10))


def forecast_of(model: FringeModel, **effects: dict[str, float]) -> Any:
    by_name = {effect.name: effect for effect in EFFECTS}
    tested = tuple(forecasts.Tested.of(by_name[name], values, model) for name, values in effects.items())
    return forecasts.Forecast(model, EFFECTS, tested, (), forecasts.Sample.of(model, None), FlatSeries(FLATS))


@pytest.mark.parametrize(
    ("effect", "value", "step"),
    [
        ("bandwidth", {"fwhm": 2.1}, 0.02),
        ("temperature", {"kelvin": 185.0}, 0.5),
        ("wavelength_offset", {"offset": 0.3}, 0.02),
        ("epoxy_index", {"offset": 0.0, "cauchy": 0.0}, 2e-4),
        ("silicon_thickness", {"offset": 0.2}, 1e-3),
        ("roughness", {"sigma": 40.0}, 1.0),
        ("thickness_spread", {"sigma": 20.0}, 0.5),
        ("epoxy_absorption", {"k": 1e-3}, 1e-5),
    ],
)
def test_slopes_are_the_derivatives(
    effect: str, value: dict[str, float], step: float, model: FringeModel, few_samples: None
) -> None:
    """Fourth-order differences of the model itself, place by place."""
    forecast = forecast_of(model, **{effect: value})
    series = FlatSeries((900.0, 965.0), bandwidth_fwhm_nm=1.0)
    item = forecast.tested[0]
    slope = forecast._slope(series, item, item.effect.parameters[0]) / item.effect.parameters[0].prior_scale
    waves = np.array(series.wavelength_nm)
    parameter = item.effect.parameters[0].name

    def flats(steps: float) -> NDArray:
        moved = {**value, parameter: value[parameter] + steps * step}
        changed = series.conditions(model.with_effects({effect: moved}))
        images = []
        for thickness, silicon in zip(forecast.sample.thickness_um, forecast.sample.silicon_um, strict=True):
            own = changed.system.stack.layers[changed.system.stack.position("detection")].thickness_um
            system = changed.system.with_layer("detection", thickness_um=own + silicon)
            light = system.flat_fields(waves, forecasts.LINE_STEP_NM)
            images.append(system.reduce(light).averaged(light.weight, thickness))
        image = np.stack(images, axis=1)
        return image / image.mean(axis=(1, 2), keepdims=True)

    near, far = flats(1.0) - flats(-1.0), flats(2.0) - flats(-2.0)
    expected = ((8.0 * near - far) / (12.0 * step)).reshape(len(waves), -1)
    np.testing.assert_allclose(slope, expected, atol=2e-4 * np.abs(expected).max())


def fit_of_flats(
    forecast: Any,
    series: list[FlatSeries],
    found: dict[str, dict[str, float]],
    at: Callable[[float], dict[str, dict[str, float]]],
) -> tuple[float, float]:
    """Size of another effect, and root of χ² of a sensor, of a fit of it and of every nuisance to noiseless flats."""
    truth = np.concatenate([forecast._observe(each, found) for each in series])
    flats, pixels = truth.shape
    sigma = np.sqrt(truth / LEVEL_E)
    sample = forecast.sample

    def misfit(p: NDArray) -> NDArray:
        shift, response, level = np.split(p[2:], [pixels, 2 * pixels])
        moved = sample.thickness_um + 1e-3 * shift.reshape(sample.thickness_um.shape)
        fitted = replace(forecast, sample=replace(sample, thickness_um=moved))
        image = [fitted._observe(each, at(p[0]), 0.0, 1e-3 * p[1]) for each in series]
        value = np.concatenate(image) * (1.0 + 1e-2 * level[:, None]) * (1.0 + 1e-2 * response)
        return np.concatenate([((value - truth) / sigma).ravel(), response])

    with threadpool_limits(limits=1, user_api="blas"):
        fit = least_squares(misfit, np.zeros(2 + 2 * pixels + flats), xtol=1e-12, ftol=1e-10)
    per_pixel = forecasts.SENSOR_PX[0] * forecasts.SENSOR_PX[1] / pixels
    return float(fit.x[0]), float(np.sqrt(2.0 * fit.cost * per_pixel))


PRESENT = FlatSeries((885.0, 910.0, 935.0, 960.0, 985.0))
THREE = FlatMeasurement("narrow", "", FlatSeries((935.0, 955.0, 975.0), bandwidth_fwhm_nm=0.7))


@pytest.mark.slow
def test_separation_is_the_misfit_of_a_real_fit(model: FringeModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noiseless flats with a little of one effect, fitted with the other and with every nuisance."""
    monkeypatch.setattr(forecasts, "SAMPLES", (2, 6))
    found = {"bandwidth": {"fwhm": 2.02}}
    (ranked,) = rank_measurements(model, {**found, "ar_coating": {}}, PRESENT, measurements=[THREE])
    forecast = forecast_of(model, bandwidth={}, ar_coating={})
    for series, expected in (
        ([PRESENT], ranked.pairs[0].separation_now),
        ([PRESENT, THREE.series], ranked.pairs[0].separation_after),
    ):
        _, misfit = fit_of_flats(forecast, series, found, lambda p: {"ar_coating": {"scale": 1.0 + 1e-2 * p}})
        assert misfit == pytest.approx(expected, rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("found", "other", "at", "factor"),
    [
        ({"bandwidth": {"fwhm": 3.0}}, "thickness_spread", lambda p: {"sigma": 20.0 + p}, 1.25),
        # The fringes of the silicon, which the narrow line shows, are far from linear in its thickness.
        (
            {"silicon_thickness": {"offset": -3.9}},
            "silicon_absorption",
            lambda p: {"scale": 0.96 + 0.01 * p},
            3.0,
        ),
        ({"contrast_loss": {"factor": 0.5}}, "roughness", lambda p: {"sigma": 60.0 + p}, 1.25),
    ],
    ids=["bandwidth", "silicon_thickness", "contrast_loss"],
)
def test_separation_of_strong_effects_is_that_of_fits(
    found: dict[str, dict[str, float]],
    other: str,
    at: Callable[[float], dict[str, float]],
    factor: float,
    model: FringeModel,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Both have been fitted to the present flats: what tells them apart there is what the fits leave."""
    monkeypatch.setattr(forecasts, "SAMPLES", (2, 6))
    (name,) = found
    forecast = forecast_of(model, **found, **{other: {}})
    size, misfit = fit_of_flats(forecast, [PRESENT], found, lambda p: {other: at(p)})
    (ranked,) = rank_measurements(model, {**found, other: at(size)}, PRESENT, measurements=[THREE])
    pair = ranked.pairs[0]
    assert (pair.effect, pair.other) == (name, other)
    assert pair.separation_now == pytest.approx(misfit, rel=0.1)
    _, misfit = fit_of_flats(forecast, [PRESENT, THREE.series], found, lambda p: {other: at(p)})
    assert 1.0 / factor < pair.separation_after / misfit < factor


PUBLISHED = [
    # pair, likeness with 12 flats, what is added, likeness with it
    ({"converging_beam": {}, "tilt": {"angle": 2.0}}, 0.999, None, None),
    ({"epoxy_index": {"cauchy": 1e-3}, "wavelength_scale": {"stretch": 1e-4}}, 0.999, NARROW, 0.33),
    ({"bandwidth": {}, "converging_beam": {}}, 0.99, None, None),
    ({"bandwidth": {}, "thickness_spread": {"sigma": 10.0}}, 0.98, NARROW, 0.10),
    ({"bandwidth": {}, "black_coating": {"thickness": 0.02}}, 0.95, NARROW, 0.22),
    ({"ar_coating": {}, "ghost_pedestal": {"fraction": 0.02}}, 0.94, NARROW, 0.26),
    ({"temperature": {}, "silicon_absorption": {}}, 0.985, NARROW, 0.19),
    ({"wavelength_offset": {}, "temperature": {}}, 0.86, WIDE, 0.58),
    ({"ghost_pedestal": {"fraction": 0.02}, "non_linearity": {}}, 0.98, BRIGHT, 0.91),
    ({"ghost_pedestal": {"fraction": 0.02}, "dark_pedestal": {}}, 0.97, BRIGHT, 0.65),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "now", "added", "after"), PUBLISHED, ids=[" ~ ".join(case[0]) for case in PUBLISHED]
)
def test_published_likenesses(
    effects: dict[str, dict[str, float]], now: float, added: FlatMeasurement | None, after: float | None
) -> None:
    """Cosines of shared/discovery.md, section 3, "Numbers": a prototype with samples and sizes of its own.

    It had the constants of silicon that the paper uses.

    How alike two effects are depends on their size, the more so once the likeness is broken; a table of two digits
    from other sizes is met to 0.03 before, and to 0.15 after.
    """
    published = FringeModel.from_setup(Setup.from_name("ts8_e2v").with_silicon("Si_green2008"))
    (ranked,) = rank_measurements(published, effects, measurements=[added or AGAIN])
    assert ranked.pairs[0].likeness_now == pytest.approx(now, abs=0.03)
    if after is not None:
        assert ranked.pairs[0].likeness_after == pytest.approx(after, abs=0.15)


def test_the_same_flats_again_bring_the_root_of_two(model: FringeModel, few_samples: None) -> None:
    (ranked,) = rank_measurements(
        model, {"epoxy_absorption": {}, "roughness": {}}, measurements=[AGAIN], significance=20.0
    )
    pair = ranked.pairs[0]
    assert pair.likeness_after == pytest.approx(pair.likeness_now, abs=1e-3)
    assert ranked.gain == pytest.approx(np.sqrt(2.0), rel=0.02)
    assert pair.separation_now == pytest.approx(20.0 * np.sqrt(1.0 - pair.likeness_now**2), rel=1e-9)


def test_further_unknowns_never_help(model: FringeModel, few_samples: None) -> None:
    effects = {"bandwidth": {"fwhm": 2.2}, "thickness_spread": {}}
    (alone,) = rank_measurements(model, effects, measurements=[NARROW])
    (among,) = rank_measurements(
        model, effects, measurements=[NARROW], nuisance_effects=["epoxy_absorption", "temperature"]
    )
    assert among.separation < alone.separation
    assert among.pairs[0].separation_now < alone.pairs[0].separation_now


def test_ranking_is_by_the_hardest_pair(model: FringeModel, few_samples: None, recorded: Record) -> None:
    """And its numbers are those of a record."""
    effects = {"ghost_pedestal": {"fraction": 0.02}, "non_linearity": {}, "dark_pedestal": {}}
    ranked = rank_measurements(model, effects, significance=30.0, measurements=[AGAIN, NARROW, BRIGHT])
    assert [item.separation for item in ranked] == sorted((item.separation for item in ranked), reverse=True)
    assert ranked[-1].measurement is AGAIN
    for item in ranked:
        assert {pair.other for pair in item.pairs} == {"non_linearity", "dark_pedestal"}
        assert item.separation == min(pair.separation_after for pair in item.pairs)
        assert all(pair.separation_after >= pair.separation_now for pair in item.pairs)
    assert ranked[0].decides
    assert not ranked[-1].decides
    assert len(ranked) == 3
    recorded(ranked)
    assert break_ambiguity(ranked) == ranked[0].text
    assert break_ambiguity(ranked[-1:]).startswith("no measurement that was tried decides")


def test_usual_candidates(model: FringeModel) -> None:
    found = {item.name: item.series for item in candidate_measurements(model)}
    assert set(found) == {"repeat", "temperature", "level", "narrow_bandpass", "f_number", "wide_range"}
    assert found["repeat"] == FlatSeries(FLATS)
    assert found["narrow_bandpass"].bandwidth_fwhm_nm == 0.5
    assert not set(found["wide_range"].wavelength_nm) & set(FLATS)
    narrow = FringeModel.from_setup("bnl_ts8_e2v")
    names = {item.name for item in candidate_measurements(narrow, (900.0, 950.0))}
    assert ("narrow_bandpass" in names) == (narrow.setup.bandwidth_fwhm_nm > 0.75)


def test_exposures_get_longer_with_more_light_and_a_narrower_line(model: FringeModel) -> None:
    seconds = tuple(np.linspace(10.0, 32.0, len(FLATS)))
    found = {item.name: item.series for item in candidate_measurements(model, FLATS, dark_time_s=seconds)}
    assert found["repeat"].dark_time_s == found["temperature"].dark_time_s == seconds
    assert found["level"].dark_time_s == pytest.approx([4.0 * time for time in seconds])
    assert found["narrow_bandpass"].dark_time_s == pytest.approx([4.0 * time for time in seconds])
    assert len(found["wide_range"].dark_time_s) == len(found["wide_range"].wavelength_nm)
    assert set(found["wide_range"].dark_time_s) == {10.0, 32.0}
    with pytest.raises(InputError, match="dark times"):
        FlatSeries(FLATS, dark_time_s=(10.0,))


@pytest.mark.slow
def test_a_level_that_grows_with_time_is_told_from_one_that_does_not(
    model: FringeModel, few_samples: None
) -> None:
    effects = {"dark_pedestal": {"electrons": 1000.0}, "dark_current": {"rate": 50.0}}
    flats = FlatSeries(FLATS, dark_time_s=(20.0,) * len(FLATS))
    ranked = rank_measurements(model, effects, flats)
    (pair,) = ranked[0].pairs
    assert pair.separation_now < 1e-3 * pair.separation_after
    assert ranked[0].measurement.name in {"level", "narrow_bandpass"}
    with pytest.raises(InputError, match="dark time"):
        rank_measurements(model, effects, FlatSeries(FLATS))


def test_what_cannot_be_forecast_is_left_out(model: FringeModel, few_samples: None) -> None:
    assert rank_measurements(model, {"charge_diffusion": {}, "thickness_spread": {}}) == ()
    assert break_ambiguity(()) == ""
    (ranked,) = rank_measurements(
        model, {"bandwidth": {}, "charge_diffusion": {}, "thickness_spread": {}}, measurements=[AGAIN]
    )
    assert [pair.other for pair in ranked.pairs] == ["thickness_spread"]


def test_a_rival_that_was_fitted_at_null_is_compared_at_its_usual_size(
    model: FringeModel, few_samples: None
) -> None:
    """At null a quadratic onset has no direction; the search may well leave a rival there."""
    at_null, unknown = (
        rank_measurements(model, {"bandwidth": {"fwhm": 2.3}, "roughness": values}, measurements=[AGAIN])
        for values in ({"sigma": 0.0}, {})
    )
    assert at_null[0].pairs == unknown[0].pairs


def test_the_silicon_may_be_the_layer_that_varies(few_samples: None) -> None:
    (ranked,) = rank_measurements(
        FringeModel.from_setup("ts8_itl"), {"bandwidth": {}, "converging_beam": {}}, measurements=[AGAIN]
    )
    assert isinstance(ranked, RankedMeasurement)
    assert ranked.separation > 0.0


@pytest.mark.slow
def test_a_layer_may_be_thinner_than_the_orders_that_are_tried(model: FringeModel, few_samples: None) -> None:
    effects = {"contrast_loss": {"factor": 0.5}, "roughness": {"sigma": 60.0}}
    (ranked,) = rank_measurements(model, effects, thickness_um=(0.5, 0.9), measurements=[AGAIN])
    assert ranked.separation > 0.0


def test_bad_requests_are_refused(model: FringeModel) -> None:
    with pytest.raises(InputError, match="monochromator"):
        rank_measurements(FringeModel.from_setup("lsst_e2v"), {"roughness": {}, "black_coating": {}})
    with pytest.raises(UnknownNameError, match="did you mean"):
        rank_measurements(model, {"roughnes": {}, "black_coating": {}})
    with pytest.raises(UnknownNameError, match="sigma"):
        rank_measurements(model, {"roughness": {"rms": 3.0}, "black_coating": {}})
    with pytest.raises(OutOfRangeError, match="0 to 300"):
        rank_measurements(model, {"roughness": {"sigma": -3.0}, "black_coating": {}})
    with pytest.raises(OutOfRangeError, match="thickness range"):
        rank_measurements(model, {"roughness": {}, "black_coating": {}}, thickness_um=(14.0, 13.0))
    with pytest.raises(InputError, match="wavelengths"):
        FlatSeries(())
    with pytest.raises(OutOfRangeError, match="level"):
        FlatSeries((900.0,), level_e=0.0)
