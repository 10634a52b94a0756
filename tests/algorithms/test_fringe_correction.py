"""Fringe correction of simulated exposures, with sources, and its measure of success."""

from __future__ import annotations

import numpy as np
import pytest
from product_makers import sky
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.fringe_correction import (
    CorrectionOptions,
    component_patterns,
    correct_fringes,
    measure_apertures,
    random_positions,
    residual_fringe,
)
from lsst.fringe_sim.algorithms.pca import fit_pca, fit_pca_from_thickness, fringe_templates, project
from lsst.fringe_sim.algorithms.sky_frame import simulate_sky_frame, sky_response
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.night import NightHistory, StochasticNight
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeFrame

NOW = "2026-11-21T00:00:00"
LEVEL = 2717.0


def as_template(image, mask=None):
    flat = (image - image.mean()).astype(np.float32)
    blank = np.zeros(image.shape, dtype=np.int32)
    return FringeFrame(flat, blank if mask is None else mask, np.zeros_like(flat), "y", NOW)


@pytest.fixture
def patterns():
    y, x = np.mgrid[:400, :500]
    return [np.sin(x / 12.0 + 1e-4 * y**2), np.sin(y / 9.0 - 2e-4 * x**2)]


def with_sources(image, rng, number=150):
    """Stars of 2 px width and up to 30 times the sky."""
    crowded = image.copy()
    offset = np.arange(-8, 9)
    star = np.exp(-0.5 * (offset[:, None] ** 2 + offset**2) / 4)
    for y, x in zip(rng.integers(8, 392, number), rng.integers(8, 492, number), strict=True):
        crowded[y - 8 : y + 9, x - 8 : x + 9] += rng.pareto(1.5) * 100 * star
    return crowded


@pytest.mark.parametrize("sources", first_is_quick([True, False]))
@pytest.mark.rng("scales are recovered within their errors")
def test_scales_are_recovered_within_their_errors(patterns, rng, sources):
    templates = [as_template(0.01 * pattern) for pattern in patterns]
    truth = LEVEL * np.array([1.3, -0.6])
    clean = LEVEL + sum(scale * template.image for scale, template in zip(truth, templates, strict=True))
    options = CorrectionOptions(positions=4000, small_px=3, large_px=30)
    pulls = []
    for _ in range(4):
        scene = with_sources(clean, rng) if sources else clean
        found = correct_fringes(rng.poisson(scene), templates, rng, options=options)
        assert found.solved
        pulls.append((found.scale - truth) / np.sqrt(np.diag(found.covariance)))
    # apertures overlap, so that errors are somewhat larger than those of independent positions
    assert np.abs(np.mean(pulls, axis=0)).max() < 1.6
    assert np.abs(pulls).max() < 6
    assert found.positions_used < 4000 if sources else found.positions_used > 3900


@pytest.mark.rng("fringes below the noise are not overcorrected")
def test_fringes_below_the_noise_are_not_overcorrected(patterns, rng):
    """A tenth of the noise of a pixel: medians of image and template would give scales 16 % too large."""
    template = as_template(0.002 * patterns[0])
    clean = LEVEL * (1 + template.image)
    options = CorrectionOptions(positions=10_000, small_px=3, large_px=50)
    scales = [
        correct_fringes(rng.poisson(clean), [template], rng, options=options).scale[0] / LEVEL
        for _ in range(4)
    ]
    assert np.mean(scales) == pytest.approx(1.0, abs=0.06)


@pytest.mark.rng("noiseless exposure is corrected exactly")
def test_noiseless_exposure_is_corrected_exactly(patterns, rng):
    template = as_template(0.01 * patterns[0])
    image = (LEVEL * (1 + 0.7 * template.image)).astype(np.float32)
    found = correct_fringes(image, [template], rng, options=CorrectionOptions(positions=500))
    assert found.scale[0] == pytest.approx(0.7 * LEVEL, rel=1e-4)
    np.testing.assert_allclose(found.image, LEVEL, rtol=1e-5)


@pytest.mark.rng("a corrected exposure is refused")
def test_a_corrected_exposure_is_refused(patterns, rng):
    template = as_template(0.01 * patterns[0])
    scene = LEVEL * (1 + template.image)
    options = CorrectionOptions(positions=2000, small_px=3, large_px=30)
    found = correct_fringes(scene, [template], rng, options=options, header={"FRINGRMS": 0.1})
    assert found.cards["FRINGCOR"] == 1
    assert found.cards["FRINGSC0"] == pytest.approx(LEVEL, rel=1e-4)
    with pytest.raises(InputError, match="FRINGCOR is 1; allowed: an exposure with its fringes"):
        correct_fringes(found.image, [template], rng, options=options, header=found.cards)
    frames = [sky((60, 60), number, metadata=cards) for number, cards in enumerate(({}, found.cards))]
    with pytest.raises(InputError, match="R22_S11: FRINGCOR"):
        fit_pca(frames)


@pytest.mark.rng("inputs are left alone")
def test_inputs_are_left_alone(patterns, rng):
    image = rng.poisson(LEVEL * (1 + 0.01 * patterns[0])).astype(np.float32)
    mask = (rng.random(image.shape) < 0.1).astype(np.int32)
    template = as_template(0.01 * patterns[0], (rng.random(image.shape) < 0.1).astype(np.int32))
    copies = [array.copy() for array in (image, mask, template.image, template.mask)]
    correct_fringes(image, [template, as_template(patterns[1])], rng, mask, CorrectionOptions(positions=200))
    for array, copy in zip((image, mask, template.image, template.mask), copies, strict=True):
        np.testing.assert_array_equal(array, copy)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.rng("fully masked exposure is returned as it is")
def test_fully_masked_exposure_is_returned_as_it_is(patterns, rng, count):
    image = rng.poisson(LEVEL, (400, 500)).astype(np.float32)
    templates = [as_template(pattern) for pattern in patterns[:count]]
    found = correct_fringes(image, templates, rng, mask=np.ones(image.shape))
    assert not found.solved
    np.testing.assert_array_equal(found.image, image)
    np.testing.assert_array_equal(found.scale, np.zeros(count))
    assert np.isnan(found.covariance).all()


@pytest.mark.rng("identical templates decide nothing")
def test_identical_templates_decide_nothing(patterns, rng):
    image = rng.poisson(LEVEL * (1 + 0.01 * patterns[0])).astype(np.float32)
    template = as_template(patterns[0])
    found = correct_fringes(image, [template, template], rng, options=CorrectionOptions(positions=300))
    assert not found.solved


@pytest.mark.rng("masked pixels are not measured")
def test_masked_pixels_are_not_measured(patterns, rng):
    image = LEVEL * (1 + 0.01 * patterns[0])
    mask = np.zeros(image.shape, dtype=np.int32)
    mask[:, 200:260] = 1
    spoiled = image.copy()
    spoiled[:, 200:260] = 6e4
    spoiled[50, 50] = np.nan
    options = CorrectionOptions(positions=2000, small_px=2, large_px=20)
    template = as_template(0.01 * patterns[0])
    found = correct_fringes(spoiled, [template], rng, mask, options)
    assert found.scale[0] == pytest.approx(LEVEL, rel=1e-3)


@pytest.mark.rng("aperture levels are means of the good pixels")
def test_aperture_levels_are_means_of_the_good_pixels(rng):
    image = rng.normal(100.0, 1.0, (60, 60)).astype(np.float32)
    good = rng.random((60, 60)) > 0.2
    options = CorrectionOptions(positions=20, small_px=2, large_px=10, clip_sigma=50.0)
    places = random_positions(image.shape, options, rng)
    found = measure_apertures(image, [2 * image], good, places, options)
    for (y, x), level, template in zip(places, found.exposure, found.template[:, 0], strict=True):

        def mean(half, y=y, x=x):
            box = np.s_[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1]
            return image[box][good[box]].mean(dtype=float)

        assert level == pytest.approx(mean(2) - mean(10), abs=1e-4)
        assert template == pytest.approx(2 * level, abs=1e-4)


def test_residual_against_shot_noise():
    wave = np.broadcast_to(np.sin(2 * np.pi * np.arange(4000) / 500.0), (300, 4000))
    found = residual_fringe(5.0 * wave, LEVEL, 100, read_noise_e=5.0)
    assert found.rms == pytest.approx(5.0 / np.sqrt(2) / LEVEL, rel=1e-3)
    assert found.shot_noise == pytest.approx(np.sqrt(LEVEL + 25.0) / 100 / LEVEL)
    # averaging over 100 px takes sinc(100 / 500) = 0.935 of a wave of 500 px
    assert found.smoothed_rms == pytest.approx(0.935 * found.rms, rel=0.01)
    assert found.ratio == found.smoothed_rms / found.shot_noise
    masked = np.zeros(wave.shape, dtype=int)
    masked[:, 2000:] = 1
    again = residual_fringe(np.where(masked, np.nan, 5.0 * wave), LEVEL, 100, masked)
    assert again.smoothed_rms == pytest.approx(found.smoothed_rms, rel=0.03)


# The chain: templates from one night, exposures of another.


CELL = 4
"""Every fourth pixel stands for a cell of 16 with the light of 16, so that the whole sensor is small."""


@pytest.fixture(scope="module")
def sensor():
    thickness = e2v_321()[::CELL, ::CELL]
    model = FringeModel.from_setup("lsst_e2v")
    return thickness, model, sky_response(model, SkySpectrum.dark(), thickness_range_um=(13.9, 22.5))


def training(response, night):
    return [night.band_scale(time, response.bands) for time in range(len(night))]


@pytest.mark.slow
@pytest.mark.rng("night not used for training is corrected below a tenth of the shot noise")
def test_night_not_used_for_training_is_corrected_below_a_tenth_of_the_shot_noise(sensor, rng):
    """A projection in every exposure, small minus large apertures in the mean square of a night."""
    thickness, model, response = sensor
    components = fit_pca_from_thickness(thickness, response, training(response, NightHistory.guo2022()))
    templates = fringe_templates(components, NOW)
    assert len(templates) == 2
    basis = np.stack([template.image for template in templates])
    night = StochasticNight().draw(np.arange(0.0, 8.0, 2.0), rng)
    level, arcsec20 = CELL**2 * LEVEL, 100 // CELL
    options = CorrectionOptions(positions=30_000, small_px=2, large_px=12)
    ratios = []
    for time, scale in enumerate(training(response, night)):
        clean = simulate_sky_frame(thickness, model, response=response, scale=scale, mean_electrons=level)
        noisy = simulate_sky_frame(
            thickness,
            model,
            response=response,
            scale=scale,
            mean_electrons=level,
            read_noise_e=24.0,
            seed=time,
        )
        before = residual_fringe(clean.image, level, arcsec20)
        fitted = project(noisy.image, basis, level + 576.0)
        residual = clean.image - np.tensordot(fitted.coefficient, basis, axes=1)
        assert before.ratio > 1.5
        assert residual_fringe(residual, level, arcsec20).ratio < 0.1
        applied = correct_fringes(noisy.image, templates, rng, options=options)
        left = clean.image - np.tensordot(applied.scale, basis, axes=1)
        ratios.append(residual_fringe(left, level, arcsec20).ratio)
    assert np.sqrt(np.mean(np.square(ratios))) < 0.1


def test_physical_patterns_hold_every_night_but_two_components_are_found_better(sensor):
    """Without noise the patterns of the sky's components leave nothing; with it, fewer templates leave less."""
    thickness, model, response = sensor
    level, arcsec20 = CELL**2 * LEVEL, 100 // CELL
    nights = StochasticNight()
    past = [
        scale
        for seed in range(20)
        for scale in training(response, nights.draw(np.arange(0.0, 9.0, 3.0), np.random.default_rng(seed)))
    ]
    templates = fringe_templates(fit_pca_from_thickness(thickness, response, past), NOW, most=2)
    bases = {
        "components": np.stack([template.image for template in templates]),
        "physics": component_patterns(thickness, response),
    }
    left = {(name, noise): [] for name in bases for noise in (False, True)}
    for time, scale in enumerate(training(response, nights.draw(np.arange(3.0), np.random.default_rng(999)))):
        clean, noisy = (
            simulate_sky_frame(
                thickness, model, response=response, scale=scale, mean_electrons=level, seed=seed
            ).image
            for seed in (None, time)
        )
        for name, basis in bases.items():
            for noise in (False, True):
                fitted = project(noisy if noise else clean, basis, level)
                residual = clean - np.tensordot(fitted.coefficient, basis, axes=1)
                left[name, noise].append(residual_fringe(residual, level, arcsec20).ratio)
    mean = {key: np.mean(values) for key, values in left.items()}
    assert mean["physics", False] < 1e-3
    assert mean["physics", False] < mean["components", False] < 0.05
    assert mean["components", True] < mean["physics", True] < 0.1


def test_component_patterns_are_zero_mean_shares_of_the_fringe(sensor):
    thickness, model, response = sensor
    patterns = component_patterns(thickness, response)
    fringe = simulate_sky_frame(thickness, model, response=response).fraction()
    np.testing.assert_allclose(patterns.sum(axis=0), fringe, atol=1e-6)
    assert np.abs(patterns.mean(axis=(1, 2), dtype=float)).max() < 1e-9


@pytest.mark.rng("bad input is named")
def test_bad_input_is_named(patterns, rng):
    image = np.ones((400, 500))
    with pytest.raises(InputError, match="templates"):
        correct_fringes(image, [], rng)
    with pytest.raises(InputError, match="shape of a template"):
        correct_fringes(image, [np.ones((3, 3))], rng)
    with pytest.raises(InputError, match="shape of the mask"):
        correct_fringes(image, [patterns[0]], rng, mask=np.ones((2, 2)))
    with pytest.raises(InputError, match="shape of the exposure"):
        correct_fringes(np.ones(5), [patterns[0]], rng)
    with pytest.raises(InputError, match="more than"):
        correct_fringes(np.ones((5, 5)), [np.ones((5, 5))], rng)
    for wrong in (
        {"positions": 0},
        {"small_px": 10, "large_px": 5},
        {"least_good": 0.0},
        {"clip_sigma": -1.0},
        {"rounds": 0},
    ):
        with pytest.raises(OutOfRangeError):
            CorrectionOptions(**wrong)
    with pytest.raises(InputError, match="good pixels"):
        residual_fringe(np.full((3, 3), np.nan), 1.0, 1)
    with pytest.raises(OutOfRangeError, match="positive"):
        residual_fringe(image, 0.0, 10)
    with pytest.raises(InputError, match="thickness map"):
        component_patterns(np.full((2, 2), np.nan), None)
