"""Templates from observed frames, and what they leave in frames that they were not made of."""

from functools import partial

import numpy as np
import pytest
from foreign_sky import ForeignClutter, ForeignSky, foreign_map, foreign_night
from observed_night import observed_night

from lsst.fringe_sim.algorithms.correction import AmplifierGrid, BackgroundTerms, empirical, fit_scales
from lsst.fringe_sim.algorithms.correction.denoise import shrink_noise
from lsst.fringe_sim.algorithms.correction.empirical import TemplateOptions
from lsst.fringe_sim.algorithms.fringe_correction import CorrectionOptions
from lsst.fringe_sim.algorithms.observed_frames import correct_frame, make_templates, summary_table
from lsst.fringe_sim.errors import InputError, UndeterminedError
from lsst.fringe_sim.products import FringeFrame, FringeTemplates, ObservedFrame, mask_bits

NOW = "2026-11-21T00:00:00"
TWO = AmplifierGrid(1, 2)


def frame_of(image, mask=None, **names):
    blank = np.zeros(image.shape, dtype=np.int32)
    return ObservedFrame(image.astype(np.float32), blank if mask is None else mask, unit="electron", **names)


def templates_of(images, options, **more):
    return make_templates([partial(frame_of, image) for image in images], NOW, options, **more)


def part_left(fringes, corrected, amplifiers):
    """Standard deviation of the fringes that a correction leaves, over that of the fringes, beside the background."""
    background = BackgroundTerms(fringes[0].shape, amplifiers=amplifiers)
    even = np.ones(fringes[0].shape, dtype=np.float32)

    def beside(image):
        fit = fit_scales(image, even, [], background, clip_sigma=np.inf)
        return np.std(image - background.surface(fit.coefficient))

    return float(
        np.median([beside(f - each.fringes) / beside(f) for f, each in zip(fringes, corrected, strict=True)])
    )


@pytest.mark.slow
@pytest.mark.rng("templates take the fringes out of other frames")
def test_templates_take_the_fringes_out_of_other_frames(rng):
    night = observed_night(rng, 12)
    made = templates_of(night.images[:8], TemplateOptions(components=2, amplifiers=TWO))
    assert made.patterns.shape == (2, 96, 96)
    corrected = [
        correct_frame(frame_of(image), made.frames(), CorrectionOptions(amplifiers=TWO))
        for image in night.images[8:]
    ]
    assert part_left(night.fringes[8:], corrected, TWO) < 0.33
    assert all(each.proof.passed for each in corrected)
    assert all(each.proof.structure_after < 0.4 * each.proof.structure_before for each in corrected)


@pytest.mark.slow
@pytest.mark.rng("the number of templates is what predicts other frames")
def test_the_number_of_templates_is_what_predicts_other_frames(rng):
    bright = observed_night(rng, 10, strength=0.05)
    assert len(templates_of(bright.images, TemplateOptions(amplifiers=TWO)).patterns) == 2
    with pytest.raises(UndeterminedError, match="gain of a template"):
        templates_of([rng.poisson(2000.0, (96, 96)) for _ in range(6)], TemplateOptions())


@pytest.mark.rng("a pixel that few frames see is masked")
def test_a_pixel_that_few_frames_see_is_masked(rng):
    night = observed_night(rng, 5, stars=0)
    mask = np.zeros((96, 96), dtype=np.int32)
    mask[10:20, 30:50] = mask_bits("BAD")
    frames = [
        partial(frame_of, image, mask if number > 1 else None) for number, image in enumerate(night.images)
    ]
    made = make_templates(frames, NOW, TemplateOptions(components=1, amplifiers=TWO))
    assert (made.coverage[10:20, 30:50] <= 2).all()
    assert (made.mask[10:20, 30:50] == mask_bits("NO_DATA")).all()
    assert (made.mask[mask == 0] == 0).mean() > 0.99
    assert np.isfinite(made.patterns).all()
    done = correct_frame(frame_of(night.images[0]), made.frames())
    np.testing.assert_array_equal(done.frame.image[12:18, 32:48], night.images[0][12:18, 32:48])
    assert (done.frame.mask[12:18, 32:48] == mask_bits("SUSPECT")).all()


@pytest.mark.rng("a model as prior mean helps few frames")
def test_a_model_as_prior_mean_helps_few_frames(rng):
    night = observed_night(rng, 4, strength=0.01, stars=0)
    y, x = np.mgrid[:96, :96]
    model = np.sin(x / 4.0 + 0.03 * y + 0.1).astype(np.float32)
    flat = np.zeros((96, 96))
    prior = FringeFrame(model - model.mean(dtype=float).astype(np.float32), flat.astype(int), flat, "y", NOW)
    options = TemplateOptions(components=1, amplifiers=TWO)
    truth = np.sin(x / 4.0 + 0.03 * y)
    alone, helped = (
        abs(
            np.corrcoef(templates_of(night.images, options, prior=given).patterns[0].ravel(), truth.ravel())[
                0, 1
            ]
        )
        for given in ((), (prior,))
    )
    # Of what the four frames alone miss, the model finds half.
    assert 1.0 - helped < 0.5 * (1.0 - alone)


@pytest.mark.rng("a template with noise or stars in it is refused")
def test_a_template_with_noise_or_stars_in_it_is_refused(rng):
    night = observed_night(rng, 2, strength=0.03)
    good = (night.fringes[0] - night.fringes[0].mean()) / 2000.0
    noise = rng.normal(0.0, 0.02, good.shape)
    spiked = good + 0.1 * (rng.random(good.shape) < 0.01)
    flat = np.zeros(good.shape)
    verdicts = []
    for pattern in (good, good + noise, spiked):
        template = FringeFrame(pattern - pattern.mean(), flat.astype(int), flat, "y", NOW)
        verdicts.append(correct_frame(frame_of(night.images[0]), [template]).proof.passed)
    assert verdicts == [True, False, False]


@pytest.mark.rng("frames that do not belong together are refused")
def test_frames_that_do_not_belong_together_are_refused(rng):
    images = observed_night(rng, 3, stars=0).images
    options = TemplateOptions(components=1)
    with pytest.raises(InputError, match="three or more"):
        templates_of(images[:2], options)
    with pytest.raises(InputError, match="shape of a frame"):
        templates_of([*images, images[0][:50]], options)
    named = [partial(frame_of, image, detector=name) for image, name in zip(images, "aab", strict=True)]
    with pytest.raises(InputError, match="detector of a frame"):
        make_templates(named, NOW, options)
    with pytest.raises(InputError, match="equal pixels in 0 and 3"):
        templates_of([*images, images[0]], options)
    with pytest.raises(InputError, match="noise of a pixel"):
        templates_of([1e-30 * image for image in images], options)
    done = [partial(frame_of, image, metadata={"FRINGCOR": 1}) for image in images]
    with pytest.raises(InputError, match="FRINGCOR"):
        make_templates(done, NOW, options)


@pytest.mark.rng("templates survive the disk")
def test_templates_survive_the_disk(rng, tmp_path):
    made = templates_of(observed_night(rng, 4).images, TemplateOptions(components=1))
    made.write_fits(tmp_path / "templates.fits")
    back = FringeTemplates.read_fits(tmp_path / "templates.fits")
    for name in ("patterns", "variance", "coverage", "scores", "mask"):
        np.testing.assert_array_equal(getattr(back, name), getattr(made, name))


@pytest.mark.rng("frames in a file give the same templates")
def test_frames_in_a_file_give_the_same_templates(rng, monkeypatch):
    """Beyond a size the frames of a sensor lie on disk, and bands of rows are worked on."""
    images = observed_night(rng, 4).images
    options = TemplateOptions(components=1)
    first = templates_of(images, options)
    monkeypatch.setattr(empirical, "IN_MEMORY", 0)
    monkeypatch.setattr(empirical, "BAND_BYTES", 4 * 4 * 96 * 20)
    for rows in (empirical.JUDGED_ROWS, 20):  # all of it, and strips, tell how many templates there are
        monkeypatch.setattr(empirical, "JUDGED_ROWS", rows)
        second = templates_of(images, options)
        np.testing.assert_allclose(second.patterns, first.patterns, atol=1e-3 * first.patterns.std())


@pytest.mark.rng("one row per frame")
def test_one_row_per_frame(rng):
    night = observed_night(rng, 2)
    pattern = (night.fringes[0] - night.fringes[0].mean()) / 2000.0
    flat = np.zeros(pattern.shape)
    template = FringeFrame(pattern, flat.astype(int), flat, "y", NOW)
    records = [
        correct_frame(frame_of(image), [template]).record(str(n)) for n, image in enumerate(night.images)
    ]
    table = summary_table(records)
    assert list(table["name"]) == ["0", "1"]
    assert table["scale 0"][0] == pytest.approx(2000.0, rel=0.1)


@pytest.mark.parametrize("deviation", [0.2, 1.0, 3.0])
@pytest.mark.rng("noise is taken out of a template and fringes are not")
def test_noise_is_taken_out_of_a_template_and_fringes_are_not(rng, deviation):
    y, x = np.mgrid[:200, :170]
    wave = np.sin(x / 6.0 + 1e-4 * y**2)
    known = rng.random(wave.shape) > 0.1
    noisy = np.where(known, wave + deviation * rng.standard_normal(wave.shape), 1e6)
    cleaned, kept = shrink_noise(noisy, np.full(wave.shape, deviation**2), known)
    assert np.std(cleaned - wave) < 0.17 * deviation
    assert 0.0 < kept < 0.03


@pytest.mark.slow
@pytest.mark.rng("a night of foreign frames with stars")
def test_a_night_of_foreign_frames_with_stars(rng):
    """Frames of a simulator with another line list and silicon; templates are judged on others than their own.

    Nobody says which amplifiers there are.
    """
    sky, amplifiers = ForeignSky(f_number=2.25), AmplifierGrid(2, 8)
    clutter = ForeignClutter(stars=1.0, cosmic_rays=0.05, gradient=0.03, amplifier_steps=0.002, moon=0.2)
    night = foreign_night(sky, foreign_map(rng, (256, 256), 13.0, 14.6), rng, 16, clutter)
    made = templates_of([each.image for each in night[:12]], TemplateOptions())
    corrected = [correct_frame(frame_of(each.image), made.frames()) for each in night[12:]]
    assert part_left([each.fringes for each in night[12:]], corrected, amplifiers) < 0.2
    for each in corrected:
        assert each.proof.passed
        assert each.proof.structure_after < 0.35 * each.proof.structure_before
        assert each.proof.ubi_after < each.proof.ubi_before


@pytest.mark.parametrize("number", [2, 3])
def test_a_pixel_whose_frames_do_not_decide_it_has_a_large_variance(number):
    """Frames in which all patterns have the same proportion; not a number that spoils the median of all pixels."""
    scores = np.outer([1.0, 2.0, 3.0, 4.0], [0.3, 0.7, 0.2][:number]).astype(np.float32)
    pairs = [(k, m) for k in range(number) for m in range(k + 1)]
    normal = {(k, m): np.array([(scores[:, k] * scores[:, m]).sum(dtype=float), 0.0]) for k, m in pairs}
    moment = np.array([[5.0 * scores[:, k].sum(), 0.0] for k in range(number)])
    with np.errstate(all="raise"):
        solution, trace = empirical._solved(normal, moment, number)
    assert np.isfinite(solution).all()
    assert 1e4 < trace[0] < 1e12
    assert trace[1] > 1e100
