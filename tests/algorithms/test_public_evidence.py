"""All public data together: likelihoods against direct integrals, and what each kind of data says by itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad

from lsst.fringe_sim.algorithms.public_evidence.joint import JointFit, Predictor, log_likelihood, parse_set
from lsst.fringe_sim.algorithms.public_evidence.kinds import (
    SHIFT_UM,
    FlatContrast,
    FlatShape,
    PixelFlats,
    PublishedMap,
    sky_amplitude,
)
from lsst.fringe_sim.algorithms.public_evidence.models import models_with
from lsst.fringe_sim.algorithms.public_evidence.verdict import CLASS_WIDTH, PAPER_SILICON, Comparison, compare
from lsst.fringe_sim.errors import InputError, UnknownNameError


class Thermometer:
    """A stand-in: three readings of the contrast factor, each to 0.05."""

    name, setup, on_the_bench, size = "thermometer", "ts8_e2v", True, 3
    sigma = 0.05

    def __init__(self, readings: list[float], name: str = "thermometer") -> None:
        self.values, self.name = np.array(readings), name

    def predict(self, models) -> np.ndarray:
        settings = models(self.setup).effect_settings
        factor = settings.get("contrast_loss.factor", 1.0) - 1e-4 * settings.get("bandwidth.fwhm", 2.0)
        return np.full((3, 1), factor + 2e-4)

    def chi2(self, prediction: np.ndarray) -> np.ndarray:
        return (((self.values[:, None] - prediction) / self.sigma) ** 2).sum(axis=-2)

    def misfit(self, prediction: np.ndarray) -> np.ndarray:
        return np.sqrt(((self.values[:, None] - prediction) ** 2).mean(axis=-2))


def likelihood(readings: np.ndarray, factor: float) -> float:
    """Direct integral over the scale of the uncertainty, from 1 on."""
    chi2 = (((readings - factor) / Thermometer.sigma) ** 2).sum()
    return quad(lambda s: s**-4.0 * np.exp(-0.5 * chi2 / s**2), 1.0, np.inf, epsabs=0.0)[0]


@pytest.mark.parametrize("factor", [0.3, 0.5, 0.9])
def test_the_scale_of_an_uncertainty_is_integrated_out(factor) -> None:
    kind = Thermometer([0.28, 0.31, 0.33])
    found = log_likelihood(kind, np.full((3, 1), factor))
    assert found[0] == pytest.approx(np.log(likelihood(kind.values, factor)), abs=1e-6)


def test_evidence_and_posterior_are_those_of_a_direct_integral() -> None:
    kind = Thermometer([0.28, 0.31, 0.33])
    fit = JointFit(parse_set(["contrast_loss"]), Predictor([kind]))
    (axis,) = fit.axes
    scale, (low, high) = axis.parameter.prior_scale, axis.parameter.bounds
    norm = scale * (np.arctan((high - 1.0) / scale) - np.arctan((low - 1.0) / scale))

    def weighted(power: int) -> float:
        return quad(
            lambda x: x**power * likelihood(kind.values, x) / norm / (1.0 + ((x - 1.0) / scale) ** 2),
            low, high, points=(0.2, 0.31, 0.4), limit=200,
        )[0]  # fmt: skip

    assert fit.log_evidence == pytest.approx(np.log(weighted(0)), abs=0.03)
    mean, _ = fit.values["contrast_loss.factor"]
    assert mean == pytest.approx(weighted(1) / weighted(0), abs=0.003)


def test_a_kind_is_foretold_from_the_others_only() -> None:
    """Two instruments that disagree: each is foretold where the other is, not where it is itself."""
    cold, warm = Thermometer([0.2, 0.2, 0.2], "cold"), Thermometer([0.6, 0.6, 0.6], "warm")
    fit = JointFit(parse_set(["contrast_loss"]), Predictor([cold, warm]))
    np.testing.assert_allclose(fit.foretold(cold), 0.6, atol=0.03)
    np.testing.assert_allclose(fit.foretold(warm), 0.2, atol=0.03)
    alone = JointFit(parse_set(["contrast_loss"]), Predictor([cold]))
    assert fit.log_predictive(warm) == pytest.approx(fit.log_evidence - alone.log_evidence, abs=0.05)


def test_a_set_that_is_needed_wins_and_one_that_is_not_loses() -> None:
    needed = compare([["contrast_loss"]], [Thermometer([0.2, 0.2, 0.2])])
    assert [fit.name for fit in needed.fits] == ["contrast_loss", "none"]
    absent = compare([["contrast_loss"]], [Thermometer([1.0, 1.0, 1.0])])
    assert [fit.name for fit in absent.fits] == ["none", "contrast_loss"]
    assert absent.probabilities.sum() == pytest.approx(1.0)


def test_effects_of_the_bench_are_told_from_those_of_the_sensor() -> None:
    both = compare([["contrast_loss", "bandwidth"]], [Thermometer([0.2, 0.2, 0.2])])
    fit = next(fit for fit in both.fits if fit.axes)
    assert both.goes_to_the_sky(fit) == {"contrast_loss": True, "bandwidth": False}
    on_sky = models_with({"contrast_loss.factor": 0.2, "bandwidth.fwhm": 7.0})("monocam")
    assert on_sky.effect_settings == {"contrast_loss.factor": 0.2}


@pytest.mark.parametrize(
    ("names", "error"),
    [
        (["no_such_effect"], UnknownNameError),
        (["bandwidth.width"], UnknownNameError),
        (["wavelength_jitter"], InputError),
        (["bandwidth", "bandwidth.fwhm"], InputError),
    ],
)
def test_sets_are_checked(names, error) -> None:
    with pytest.raises(error):
        parse_set(names)


@pytest.mark.rng("pixel of a known contrast")
def test_contrast_and_shift_of_a_pixel_are_found(rng) -> None:
    """Amplitudes of the model with a contrast, an offset and noise; the map is 0.2 µm off."""
    kind = PixelFlats.published()
    truth = {"contrast_loss.factor": 0.2}
    shift = int(np.argmin(np.abs(SHIFT_UM - 0.2)))
    amplitude = kind.amplitudes(models_with(truth)("ts8_e2v"))[:, shift]
    made = replace(kind, values=amplitude - 0.006 + 7e-4 * rng.standard_normal(kind.size))
    fit = JointFit(parse_set(["contrast_loss"]), Predictor([made, PublishedMap.published()]))
    mean, sigma = fit.values["contrast_loss.factor"]
    assert abs(mean - 0.2) < 4.0 * sigma + 0.002
    assert fit.shift_um()[0] == pytest.approx(0.2, abs=0.01)
    foretold = fit.foretold_wavelengths(made)
    assert np.sqrt(((foretold - made.values) ** 2).mean()) < 4.0 * 7e-4


def test_contrast_of_the_real_flat_falls_with_thickness() -> None:
    """By 8 % per µm, as a line of 7 nm would have it: coherence of a Gaussian line, path there and back.

    The waves that interfere are reflected at the silicon and at the support: oxide, gates and insulation lie between.
    """
    kind = FlatContrast.published()
    measured = np.polyfit(kind.thickness_um, kind.values, 1)[0]
    assert measured == pytest.approx(-0.083, abs=0.004)
    sigma_nm, layer = 7.0 / 2.3548, kind.thickness_um
    path_nm = 2e3 * (1.6 * layer + 1.45 * 1.1 + 3.56 * 0.3)
    own = np.polyfit(layer, -0.5 * (2.0 * np.pi * path_nm * sigma_nm / 960.0**2) ** 2, 1)[0]
    assert kind.slope(kind.predict(models_with({"bandwidth.fwhm": 7.0}))) == pytest.approx(own, rel=0.03)
    assert own == pytest.approx(measured, abs=0.01)


def test_shape_of_the_real_fringe_is_that_of_the_detection_layer() -> None:
    """Its minima are the sharper ones; 1 - R - T, which the paper fitted, has sharper maxima."""
    kind = FlatShape.published()
    detection = kind.predict(models_with({}))[0, 0]
    total = kind.predict(models_with({}, of_flats="total"))[0, 0]
    assert kind.values[0] < -5.0 * 0.0042, "standard error of the mean of the blocks"
    assert detection < 0.0 < total


def test_a_parameter_that_no_data_feel_is_refused() -> None:
    """Its parameter would come back as its prior, and the set be judged as good as none."""
    with pytest.raises(InputError, match=r"rotational_temperature\.offset"):
        compare([("rotational_temperature",)], kinds=(PixelFlats.published(),))
    with pytest.raises(InputError, match="dark_current"):
        compare([("dark_current",)], kinds=(PixelFlats.published(),))


@pytest.mark.slow
def test_the_run_of_the_level_with_thickness_is_no_fringe() -> None:
    """An adhesive that absorbs takes light from thick places; its fringes on the sky of the LSST are weaker by it."""
    plain, absorbing = (
        sky_amplitude(models_with(settings), "lsst_e2v", "rms")
        for settings in ({}, {"epoxy_absorption.k": 0.0044})
    )
    assert plain == pytest.approx(0.086, abs=0.005)
    assert absorbing < 0.5 * plain


def test_members_of_the_class_are_the_sets_that_are_hardly_less_likely() -> None:
    behind = np.array([0.0, CLASS_WIDTH - 1e-6, CLASS_WIDTH + 1e-6, 9.0])
    fits = tuple(SimpleNamespace(log_evidence=-3.0 - each) for each in behind)
    found = Comparison(fits)  # type: ignore[arg-type]
    assert found.best is fits[0]
    assert found.members == fits[:2]
    assert found.probabilities == pytest.approx(np.exp(-behind) / np.exp(-behind).sum())


def test_the_rows_of_a_comparison_say_how_far_each_kind_is_off() -> None:
    """A thermometer that reads what a set foretells from another one, and what plane layers do not."""
    kinds = [Thermometer([0.19, 0.2, 0.24]), Thermometer([0.2, 0.2, 0.2], "other")]
    found = compare([["contrast_loss"]], kinds)
    row, other = found.rows
    assert (row.name, other.name) == ("thermometer", "other")
    assert row.plane == pytest.approx(np.sqrt(np.mean((kinds[0].values - 1.0) ** 2)), abs=1e-3)
    assert row.paper == pytest.approx(row.plane, abs=1e-3)
    assert row.foretold == pytest.approx(np.sqrt(np.mean((kinds[0].values - 0.2) ** 2)), abs=0.01)
    assert row.factor == pytest.approx(row.paper / row.foretold)
    assert row.log_probability > 5.0
    best, none = found.fits
    assert [one.name for one in found.fits] == ["contrast_loss", "none"]
    assert found.goes_to_the_sky(best) == {"contrast_loss": True}
    assert found.goes_to_the_sky(none) == {}


def test_a_wavelength_is_foretold_with_the_thickness_that_fits_the_others_best() -> None:
    pixel = PixelFlats.published()
    found = Comparison((JointFit([], Predictor([pixel])),)).wavelengths
    assert set(found) == {"paper, as published", "paper, offset and slope free", "none"}
    amplitudes = pixel.amplitudes(models_with({}, PAPER_SILICON, "total")(pixel.setup), absolute=True)
    errors = []
    for left in range(pixel.size):
        others = [number for number in range(pixel.size) if number != left]
        misfit = [sum((pixel.values[k] - column[k]) ** 2 for k in others) for column in amplitudes.T]
        errors.append(pixel.values[left] - amplitudes[left, int(np.argmin(misfit))])
    assert found["paper, as published"] == pytest.approx(np.sqrt(np.mean(np.square(errors))))
    assert found["paper, offset and slope free"] != pytest.approx(found["paper, as published"], rel=0.01)
