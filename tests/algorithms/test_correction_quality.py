"""Measures of structure in a frame, where the answer is known."""

from functools import partial

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lsst.fringe_sim.algorithms.correction import BackgroundTerms, fit_scales
from lsst.fringe_sim.algorithms.correction.quality import excess_structure, uniform_background_indicator
from lsst.fringe_sim.algorithms.fringe_correction import TemplateSet
from lsst.fringe_sim.algorithms.observed_frames import correct_frame, make_templates
from lsst.fringe_sim.products import ObservedFrame

SIDE, NOISE, APERTURE = 400, 3.0, 20


@pytest.fixture
def white(rng):
    return NOISE * rng.standard_normal((SIDE, SIDE))


@pytest.mark.rng("structure is a fraction of the noise of an aperture")
def test_structure_is_a_fraction_of_the_noise_of_an_aperture(white, rng):
    """A wave averaged over the aperture, against the noise of a pixel divided by the side of the aperture."""
    good = (rng.random(white.shape) > 0.2).astype(float)
    assert excess_structure(white, good, APERTURE) < 0.35
    wave = np.sin(2.0 * np.pi * np.arange(SIDE) / 100.0)
    kept = np.sinc(APERTURE / 100.0) / np.sqrt(2.0)
    expected = kept / (NOISE / APERTURE / np.sqrt(0.8))
    assert excess_structure(white + wave, good, APERTURE) == pytest.approx(expected, rel=0.1)


@pytest.mark.rng("the uniform background indicator of white noise")
def test_the_uniform_background_indicator(white):
    """Weights of pixels at the rim are parts, of which the squares count: sqrt(Σw² / Σw) + 1 / Σw over the disc."""
    good = np.ones(white.shape, dtype=bool)
    assert uniform_background_indicator(white, good) == pytest.approx(0.98, abs=0.02)
    waves = white + NOISE * np.sin(np.arange(SIDE) / 20.0)
    assert uniform_background_indicator(waves, good) > 2.0
    assert np.isnan(uniform_background_indicator(white, ~good))


def frame_with_fringes(rng, amplitude, phase_error):
    """A frame with faint stars whose fringes are elsewhere than those of the template, the fringes, the template."""
    y, x = np.mgrid[:SIDE, :SIDE]
    phase = 0.22 * x + 0.15 * y + 2e-4 * (x - 180) ** 2
    wrong = gaussian_filter(rng.standard_normal(x.shape), 40)
    fringes = amplitude * np.sin(phase + wrong * phase_error / wrong.std())
    offset = np.arange(-6, 7)
    star = np.exp(-0.5 * (offset[:, None] ** 2 + offset**2) / 2.5)
    sky = 2000.0 + fringes
    for cy, cx in rng.integers(6, SIDE - 6, (300, 2)):
        sky[cy - 6 : cy + 7, cx - 6 : cx + 7] += rng.pareto(1.0) * 10.0 * star
    image = rng.poisson(sky).astype(np.float32)
    frame = ObservedFrame(image, np.zeros(image.shape, dtype=np.int32), unit="electron")
    return frame, fringes, np.sin(phase).astype(np.float32)


@pytest.mark.parametrize("phase_error", [0.0, 0.4, 0.8])
@pytest.mark.rng("what is left of the fringes is told")
def test_what_is_left_of_the_fringes_is_told(rng, phase_error):
    """From a map that is wrong by much less than the residual shows to the eye, with stars below detection."""
    frame, fringes, pattern = frame_with_fringes(rng, 12.0, phase_error)
    done = correct_frame(frame, TemplateSet.of([pattern]))
    left = np.std(fringes - done.fringes) / np.std(done.fringes)
    proof = done.proof
    assert proof.part_left_sigma < 0.15
    assert proof.part_left**2 == pytest.approx(
        left**2, abs=3.0 * ((left + proof.part_left_sigma) ** 2 - left**2)
    )
    ratio = proof.fringes_left / proof.part_left if proof.part_left else 0.0
    assert ratio == pytest.approx(proof.structure_before, rel=0.3) or ratio == 0.0


@pytest.mark.slow
@pytest.mark.rng("what templates of observed frames leave is not stated too low")
def test_what_templates_of_observed_frames_leave_is_not_stated_too_low(rng):
    """Of forty frames that the templates do not know, at most two have more left than the limit of two errors."""
    side = 256
    y, x = np.mgrid[:side, :side] / 100.0
    u, v = x - 1.0, y - 1.4
    phase = 2.0 * np.pi * (2.1 * u + 1.3 * v + 1.1 * u * u - 0.8 * v * v + 0.6 * u * v)
    patterns = np.array([np.cos(phase), np.cos(1.07 * phase + 0.8)])
    background = BackgroundTerms((side, side))

    def frame():
        sky = rng.uniform(2200.0, 4200.0)
        fringes = (
            0.007 * sky * np.tensordot([rng.uniform(0.6, 1.4), rng.uniform(-0.3, 0.3)], patterns, axes=1)
        )
        image = rng.poisson(sky + fringes).astype(np.float32)
        return ObservedFrame(image, np.zeros(image.shape, dtype=np.int32), unit="electron"), fringes

    def beside_background(image):
        even = np.ones(image.shape, dtype=np.float32)
        fit = fit_scales(image, even, [], background, clip_sigma=np.inf)
        return np.std(image - background.surface(fit.coefficient))

    frames = [frame() for _ in range(50)]
    made = make_templates(
        [partial(lambda each: each, image) for image, _ in frames[:10]], "2026-01-01T00:00:00"
    )
    known, exceeding, parts = TemplateSet.of(made.frames()), 0, []
    for image, fringes in frames[10:]:
        done = correct_frame(image, known)
        left = beside_background(fringes - done.fringes) / beside_background(fringes)
        square = done.proof.part_left**2
        error = (done.proof.part_left + done.proof.part_left_sigma) ** 2 - square
        exceeding += left**2 > square + 2.0 * error
        parts.append((left, done.proof.part_left))
    assert exceeding <= 2
    true, stated = np.median(parts, axis=0)
    assert stated == pytest.approx(true, rel=0.3)
