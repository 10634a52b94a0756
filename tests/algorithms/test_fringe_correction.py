"""Fringe correction of simulated exposures, with sources, and its measure of success."""

import numpy as np
import pytest
from product_makers import sky
from residual_fringe import residual_fringe
from scipy.ndimage import gaussian_filter
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.correction import AmplifierGrid
from lsst.fringe_sim.algorithms.correction.detection import log_evidence
from lsst.fringe_sim.algorithms.correction.scales import steady_weight
from lsst.fringe_sim.algorithms.fringe_correction import (
    CorrectionOptions,
    component_patterns,
    correct_fringes,
    undo_correction,
)
from lsst.fringe_sim.algorithms.pca import fit_pca, fit_pca_from_thickness, fringe_templates, project
from lsst.fringe_sim.algorithms.sky_frame import simulate_sky_frame, sky_response
from lsst.fringe_sim.errors import InputError, OutOfRangeError, UndeterminedError
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


def noisy(clean, rng):
    return rng.poisson(clean).astype(np.float32)


def small_scene(side, rng):
    """Two patterns in a sloping sky with a step between two amplifiers, and what their scales are."""
    y, x = np.mgrid[:side, :side]
    templates = np.array([np.sin(x / 6.0 + 0.02 * y), np.sin(y / 5.0 - x / 17.0)], dtype=np.float32)
    truth = np.array([3.0, -2.0])
    sky = 1000.0 + 40.0 * x / side + 15.0 * (x >= side // 2)
    return noisy(sky + np.tensordot(truth, templates, axes=1), rng), templates, truth


@pytest.mark.parametrize(("side", "draws"), first_is_quick([(40, 150), (128, 80), (512, 30)]))
@pytest.mark.parametrize("stated", first_is_quick([True, False]), ids=["variance", "no variance"])
@pytest.mark.rng("the errors of the scales hold")
def test_the_errors_of_the_scales_hold(rng, side, draws, stated):
    options = CorrectionOptions(amplifiers=AmplifierGrid(1, 2))
    pulls = []
    for _ in range(draws):
        image, templates, truth = small_scene(side, rng)
        mask = rng.random(image.shape) < 0.1
        found = correct_fringes(
            image, templates, variance=image if stated else None, mask=mask, options=options
        )
        pulls.append((found.scale - truth) / found.sigma)
    # 2 x draws independent pulls: their scatter is known to 1 / sqrt(4 draws).
    assert np.std(pulls) == pytest.approx(1.0, abs=0.1 + 2.0 / np.sqrt(4 * draws))
    assert abs(np.mean(pulls)) < 4.0 / np.sqrt(2 * draws)


def stepped(shape, rms, amplifiers, rng):
    """Levels of amplifiers of equal size."""
    rows, columns = (np.arange(side) * number // side for side, number in zip(shape, amplifiers, strict=True))
    return rms * rng.standard_normal(amplifiers)[rows[:, None], columns]


@pytest.mark.parametrize(
    ("rms", "amplifiers", "length"),
    first_is_quick([(15.0, (2, 8), 25.0), (0.0, (2, 8), 80.0), (3.0, (2, 8), 80.0), (10.0, (1, 2), 40.0)]),
)
@pytest.mark.rng("steps between amplifiers need not be named")
def test_steps_between_amplifiers_need_not_be_named(rng, rms, amplifiers, length):
    """Errors hold, fringes that are not there are not seen, and without steps as much is told as if it was known."""
    y, x = np.mgrid[:128, :128]
    waves = [
        np.sin(2.0 * np.pi * (x * np.cos(a) + y * np.sin(a)) / lam + 1e-4 * x**2).astype(np.float32)
        for a, lam in ((0.4, length), (1.9, 1.3 * length))
    ]
    none = CorrectionOptions(amplifiers=AmplifierGrid(), find_objects=False)
    pulls, ratios, seen = [], [], 0
    for _ in range(40):
        sky = 1000.0 + 0.3 * x + stepped(x.shape, rms, amplifiers, rng) + 32.0 * rng.standard_normal(x.shape)
        image = (sky + 5.0 * (waves[0] - waves[1])).astype(np.float32)
        found = correct_fringes(image, waves, options=CorrectionOptions(find_objects=False))
        pulls.append((found.scale - [5.0, -5.0]) / found.sigma)
        seen += correct_fringes(sky, waves, options=CorrectionOptions(find_objects=False)).seen
        if rms == 0.0:
            ratios.append(found.sigma / correct_fringes(image, waves, options=none).sigma)
    # 80 pulls know their scatter to 0.08; noise is seen in 0.1 to 3 % of the frames.
    assert np.std(pulls) == pytest.approx(1.0, abs=0.1 + 2.0 * 0.08)
    assert seen <= 4
    assert not ratios or np.median(ratios) < 1.05


@pytest.mark.slow
@pytest.mark.rng("errors hold for templates that change slowly")
def test_errors_hold_for_templates_that_change_slowly(rng):
    """Background and levels of amplifiers take a part of the noise of each block, which such templates see."""
    y, x = np.mgrid[:256, :256]
    angles, lengths = rng.uniform(0.0, np.pi, 4), (60.0, 75.0, 90.0, 110.0)
    waves = [
        np.sin(2.0 * np.pi * (x * np.cos(a) + y * np.sin(a)) / length + 1e-4 * x**2).astype(np.float32)
        for a, length in zip(angles, lengths, strict=True)
    ]
    options = CorrectionOptions(amplifiers=AmplifierGrid(2, 8), find_objects=False)
    pulls = []
    for _ in range(80):
        image = (1000.0 + 5.0 * sum(waves) + 30.0 * rng.standard_normal(x.shape)).astype(np.float32)
        found = correct_fringes(image, waves, variance=np.full(x.shape, 900.0), options=options)
        pulls.append((found.scale - 5.0) / found.sigma)
    # Known to 0.04.
    assert np.std(pulls) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.rng("errors hold for noise that is correlated")
def test_errors_hold_for_noise_that_is_correlated(rng):
    """As in an image that was resampled: the variance of a pixel does not tell its correlation with neighbours."""
    pulls = []
    for _ in range(60):
        white, templates, truth = small_scene(256, rng)
        noise = white - 1000.0 - np.tensordot(truth, templates, axes=1)
        image = 1000.0 + np.tensordot(truth, templates, axes=1) + gaussian_filter(noise, 1.5)
        options = CorrectionOptions(amplifiers=AmplifierGrid(1, 2), find_objects=False)
        found = correct_fringes(image, templates, options=options)
        pulls.append((found.scale - truth) / found.sigma)
    assert np.std(pulls) == pytest.approx(1.0, abs=0.25)


@pytest.mark.rng("stars do not move the scales")
def test_stars_do_not_move_the_scales(patterns, rng):
    templates = [as_template(0.01 * pattern) for pattern in patterns]
    truth = LEVEL * np.array([1.3, -0.6])
    clean = LEVEL + sum(scale * template.image for scale, template in zip(truth, templates, strict=True))
    pulls = []
    for _ in range(6):
        found = correct_fringes(noisy(with_sources(clean, rng), rng), templates)
        pulls.append((found.scale - truth) / found.sigma)
    assert np.sqrt(np.mean(np.square(pulls))) < 1.6
    assert np.abs(pulls).max() < 4.0


@pytest.mark.rng("a pattern that the exposure does not have is not subtracted")
def test_a_pattern_that_the_exposure_does_not_have_is_not_subtracted(patterns, rng):
    """Fringes of another pattern, on which the scales are noise."""
    y, x = np.mgrid[:400, :500]
    clean = LEVEL * (1.0 + 0.01 * patterns[0])
    foreign = [0.01 * np.sin((x + y) / 8.0), 0.01 * np.sin((x - 2.0 * y) / 14.0)]
    seen = 0
    for _ in range(4):
        image = noisy(with_sources(clean, rng), rng)
        found = correct_fringes(image, foreign)
        assert correct_fringes(image, patterns).seen
        if found.seen:
            seen += 1
            continue
        np.testing.assert_array_equal(found.image, image)
        assert found.cards["FRINGCOR"] == 0
        np.testing.assert_array_equal(undo_correction(found.image, foreign, found.cards), image)
        correct_fringes(found.image, patterns, header=found.cards)
    assert seen <= 1


@pytest.mark.parametrize("number", [1, 4])
@pytest.mark.rng("noise is not seen and scales of five sigma are")
def test_noise_is_not_seen_and_scales_of_five_sigma_are(rng, number):
    """At even odds the rate of scales of noise that are seen falls with the root of the number of blocks."""
    root = rng.standard_normal((number, number + 2))
    covariance = root @ root.T
    draws = rng.multivariate_normal(np.zeros(number), covariance, 4000)
    seen = np.mean([log_evidence(scale, covariance, 256) > 0.0 for scale in draws])
    assert 0.001 < seen < 0.03
    first = np.zeros(number)
    first[0] = 5.0 / np.sqrt(np.linalg.inv(covariance)[0, 0])
    assert log_evidence(first, covariance, 256) > 4.0
    assert log_evidence(first, covariance, 256) > log_evidence(first, covariance, 25)


@pytest.mark.rng("an exposure that was negated is refused")
def test_an_exposure_that_was_negated_is_refused(patterns, rng):
    image = noisy(LEVEL * (1.0 + 0.01 * patterns[0]), rng)
    with pytest.raises(OutOfRangeError, match="sky of the frame"):
        correct_fringes(-image, patterns)
    assert correct_fringes(image - np.float32(LEVEL), patterns).seen


@pytest.mark.rng("fringes are not taken for objects")
def test_fringes_are_not_taken_for_objects(patterns, rng):
    """Of twice the noise of a pixel: what stands above the threshold before they are known does not after."""
    template = as_template(0.04 * patterns[0])
    found = correct_fringes(noisy(LEVEL * (1.0 + template.image), rng), [template])
    assert found.frame.objects.mean() < 0.01
    assert found.scale[0] == pytest.approx(LEVEL, rel=0.01)


def test_noiseless_exposure_is_corrected_exactly(patterns):
    template = as_template(0.01 * patterns[0])
    image = (LEVEL * (1 + 0.7 * template.image)).astype(np.float32)
    found = correct_fringes(image, [template])
    assert found.scale[0] == pytest.approx(0.7 * LEVEL, rel=1e-4)
    np.testing.assert_allclose(found.image, LEVEL, rtol=1e-5)


@pytest.mark.rng("a pedestal in a template is not subtracted from the sky")
def test_a_pedestal_in_a_template_changes_nothing_but_the_level(patterns, rng):
    pattern = (0.01 * patterns[0]).astype(np.float32)
    image = noisy(LEVEL * (1.0 + pattern), rng)
    plain, raised = (correct_fringes(image, [pattern + np.float32(offset)]) for offset in (0.0, 0.5))
    assert raised.scale[0] == pytest.approx(plain.scale[0], rel=1e-3)
    assert raised.image.mean(dtype=float) == pytest.approx(plain.image.mean(dtype=float), rel=1e-6)


@pytest.mark.rng("a corrected exposure is refused")
def test_a_corrected_exposure_is_refused(patterns, rng):
    template = as_template(0.01 * patterns[0])
    scene = noisy(LEVEL * (1 + template.image), rng)
    found = correct_fringes(scene, [template], header={"FRINGRMS": 0.1})
    assert found.cards["FRINGCOR"] == 1
    assert found.cards["FRINGSC0"] == pytest.approx(LEVEL, rel=0.05)
    with pytest.raises(InputError, match="FRINGCOR is 1; allowed: an exposure with its fringes"):
        correct_fringes(found.image, [template], header=found.cards)
    frames = [sky((60, 60), number, metadata=cards) for number, cards in enumerate(({}, found.cards))]
    with pytest.raises(InputError, match="R22_S11: FRINGCOR"):
        fit_pca(frames)


@pytest.mark.parametrize(
    "header",
    [
        {"FRINGE": "DECam_Master_zfringe.fits", "FRGSCALE": 1.2},
        {"FRGFLAG": "Y", "SKYFSUB": "sky.fits"},
        {"FRNGMDL": "fringe_pca.c01_q1.model"},
    ],
    ids=["DECam", "Mosaic-3", "ZTF"],
)
def test_a_correction_by_others_is_seen(patterns, header):
    with pytest.raises(InputError, match="an exposure with its fringes"):
        correct_fringes(LEVEL + patterns[0], [patterns[0]], header=header)


def test_a_header_that_says_no_is_believed(patterns):
    header = {"FRGFLAG": "N", "SKYFSUB": "", "FRINGE": None}
    assert correct_fringes(LEVEL + patterns[0], [patterns[0]], header=header).scale[0] == pytest.approx(1.0)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.rng("a correction can be undone")
def test_a_correction_can_be_undone(patterns, rng, kind):
    templates = [as_template(0.01 * pattern) for pattern in patterns]
    image = rng.poisson(LEVEL * (1.0 + templates[0].image)).astype(kind)
    found = correct_fringes(image, templates)
    restored = undo_correction(found.image, templates, found.cards)
    assert restored.dtype == kind
    np.testing.assert_allclose(restored, image, rtol=2 * np.finfo(kind).eps)
    with pytest.raises(InputError, match="FRINGTID"):
        undo_correction(found.image, templates[:1], found.cards)
    with pytest.raises(InputError, match="FRINGCOR"):
        undo_correction(image, templates, {})


@pytest.mark.rng("inputs are left alone")
def test_inputs_are_left_alone(patterns, rng):
    image = rng.poisson(LEVEL * (1 + 0.01 * patterns[0])).astype(np.float32)
    mask = (rng.random(image.shape) < 0.1).astype(np.int32)
    template = as_template(0.01 * patterns[0], (rng.random(image.shape) < 0.1).astype(np.int32))
    copies = [array.copy() for array in (image, mask, template.image, template.mask)]
    correct_fringes(image, [template, as_template(patterns[1])], variance=image, mask=mask)
    for array, copy in zip((image, mask, template.image, template.mask), copies, strict=True):
        np.testing.assert_array_equal(array, copy)


@pytest.mark.rng("where a template has no value the exposure is kept")
def test_where_a_template_has_no_value_the_exposure_is_kept(patterns, rng):
    pattern = (0.01 * patterns[0]).astype(np.float32)
    pattern[100:120, 50:90] = np.nan
    image = noisy(LEVEL * (1.0 + 0.01 * patterns[0]), rng)
    found = correct_fringes(image, [pattern])
    np.testing.assert_array_equal(found.uncorrected, np.isnan(pattern))
    np.testing.assert_array_equal(found.image[found.uncorrected], image[found.uncorrected])
    assert np.isfinite(found.image).all()


@pytest.mark.rng("what pixels do not decide is refused")
def test_what_pixels_do_not_decide_is_refused(patterns, rng):
    image = rng.poisson(LEVEL, (400, 500)).astype(np.float32)
    pattern = patterns[0].astype(np.float32)
    with pytest.raises(UndeterminedError, match="pixels"):
        correct_fringes(image, [pattern], mask=np.ones(image.shape))
    with pytest.raises(UndeterminedError, match="pixels"):
        correct_fringes(image[:15, :15], [pattern[:15, :15]])
    with pytest.raises(UndeterminedError, match="independence"):
        correct_fringes(image, [pattern, pattern])
    with pytest.raises(UndeterminedError, match="beside the background"):
        correct_fringes(image, [np.ones(image.shape, dtype=np.float32)])


@pytest.mark.rng("masked pixels are not measured")
def test_masked_pixels_are_not_measured_but_corrected(patterns, rng):
    image = LEVEL * (1 + 0.01 * patterns[0])
    mask = np.zeros(image.shape, dtype=np.int32)
    mask[:, 200:260] = 1
    spoiled = image.copy()
    spoiled[:, 200:260] += 6e4
    spoiled[50, 50] = np.nan
    found = correct_fringes(spoiled, [as_template(0.01 * patterns[0])], mask=mask)
    assert found.scale[0] == pytest.approx(LEVEL, rel=1e-3)
    np.testing.assert_allclose(found.image[:, 200:260], 6e4 + LEVEL, rtol=1e-4)


def test_residual_against_shot_noise():
    wave = np.broadcast_to(np.sin(2 * np.pi * np.arange(4000) / 500.0), (300, 4000))
    found = residual_fringe(5.0 * wave, LEVEL, 100, read_noise_e=5.0)
    assert found.rms == pytest.approx(5.0 / np.sqrt(2) / LEVEL, rel=1e-3)
    assert found.shot_noise == pytest.approx(np.sqrt(LEVEL + 25.0) / 100 / LEVEL)
    # averaging over 100 px takes sinc(100 / 500) = 0.935 of a wave of 500 px
    assert found.smoothed_rms == pytest.approx(0.935 * found.rms, rel=0.01)
    assert found.ratio == found.smoothed_rms / found.shot_noise


# The chain: templates from one night, exposures of another.


CELL = 4  # Every fourth pixel stands for a cell of 16 with the light of 16, so that the whole sensor is small


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
    """With a constant beside the templates in every exposure, with a background in the mean square of a night."""
    thickness, model, response = sensor
    components = fit_pca_from_thickness(thickness, response, training(response, NightHistory.guo2022()))
    templates = fringe_templates(components, NOW)
    assert len(templates) == 2
    basis = np.stack([template.image for template in templates])
    night = StochasticNight().draw(np.arange(0.0, 8.0, 2.0), rng)
    level, arcsec20 = CELL**2 * LEVEL, 100 // CELL
    options = CorrectionOptions(find_objects=False)
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
        applied = correct_fringes(noisy.image, templates, options=options)
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


def test_bad_input_is_named(patterns):
    image = np.ones((400, 500))
    with pytest.raises(InputError, match="templates"):
        correct_fringes(image, [])
    with pytest.raises(InputError, match="shape of the frame"):
        correct_fringes(image, [np.ones((3, 3))])
    with pytest.raises(InputError, match="shape of the mask"):
        correct_fringes(image, [patterns[0]], mask=np.ones((2, 2)))
    with pytest.raises(InputError, match="shape of the exposure"):
        correct_fringes(np.ones(5), [patterns[0]])
    with pytest.raises(OutOfRangeError, match="spacing"):
        correct_fringes(image, [patterns[0]], options=CorrectionOptions(spacing_px=0.0))
    with pytest.raises(OutOfRangeError, match="amplifiers"):
        AmplifierGrid(0, 2)
    with pytest.raises(InputError, match="thickness map"):
        component_patterns(np.full((2, 2), np.nan), None)


@pytest.mark.parametrize(
    ("noise", "is_refused"), [(0.97e-15, True), (1.03e-15, False), (0.97e15, False), (1.03e15, True)]
)
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.rng("noise in odd units")
def test_noise_whose_squares_single_precision_does_not_hold_is_refused(noise, is_refused, known, rng) -> None:
    image = noise * rng.normal(size=(512, 512))
    # What neighbours scatter about each other is known to half a percent.
    variance = np.full(image.shape, noise**2) if known else None
    good = np.ones(image.shape, dtype=bool)
    if is_refused:
        with pytest.raises(OutOfRangeError, match="noise of a pixel"):
            steady_weight(good, variance, image)
    else:
        np.testing.assert_allclose(steady_weight(good, variance, image), noise**-2, rtol=0.02)
