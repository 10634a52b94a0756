"""Wide fringes that no template has yet are no objects, and objects among them are."""

from functools import partial

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.correction import BackgroundTerms, fit_scales
from lsst.fringe_sim.algorithms.correction.empirical import TemplateOptions
from lsst.fringe_sim.algorithms.correction.objects import find_objects
from lsst.fringe_sim.algorithms.observed_frames import make_templates
from lsst.fringe_sim.products import ObservedFrame

SIDE = 512


def chirped_fringes():
    """Fringes of 5 to 200 px, of different strength at different places, whose standard deviation is about 1."""
    y, x = np.mgrid[:SIDE, :SIDE] / 100.0
    u, v = x - 0.4 * SIDE / 100.0, y - 0.55 * SIDE / 100.0
    phase = 2.0 * np.pi * (2.1 * u + 1.3 * v + 1.1 * u * u - 0.8 * v * v + 0.6 * u * v + 0.25 * u**3)
    return np.sqrt(2.0) * np.cos(phase) * (1.0 + 0.3 * np.sin(x / 0.9))


def spot(width, peak, y, x):
    """Round light at a place of the sensor."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    return peak * np.exp(-0.5 * ((rows - y) ** 2 + (columns - x) ** 2) / width**2)


def beside_background(image):
    background = BackgroundTerms(image.shape)
    fit = fit_scales(image, np.ones(image.shape, dtype=np.float32), [], background, clip_sigma=np.inf)
    return image - background.surface(fit.coefficient)


@pytest.mark.rng("wide fringes are not taken for objects")
def test_wide_fringes_are_no_objects_and_stars_and_halos_among_them_are(rng):
    noise, good = rng.standard_normal((SIDE, SIDE)), np.ones((SIDE, SIDE), dtype=bool)
    fringes = 0.22 * chirped_fringes()
    places = [(y, x) for y in range(24, 500, 48) for x in range(24, 500, 48)]
    stars = sum(spot(2.0, 4.0, y, x) for y, x in places)
    halo = spot(30.0, 3.0, 200, 190)
    assert find_objects((noise + fringes).astype(np.float32), good).mean() < 0.005
    among = find_objects((noise + fringes + stars).astype(np.float32), good)
    assert np.mean([among[place] for place in places]) > 0.9
    wide = find_objects((noise + fringes + halo).astype(np.float32), good)
    assert wide[halo > 1.5].all()
    alone = find_objects((noise + stars).astype(np.float32), good)
    assert np.mean([alone[place] for place in places]) > 0.95


@pytest.mark.slow
@pytest.mark.rng("templates know wide fringes")
@pytest.mark.parametrize("star", [0.0, 200.0])
def test_templates_hold_wide_fringes_and_no_star_of_a_telescope_that_stood_still(rng, star):
    """A bright fringe lies at the same pixels of all frames, as does a star where nobody moved the telescope."""
    fringes, still = chirped_fringes(), spot(2.0, star, 150, 100)

    def frame():
        sky = rng.uniform(2500, 4000)
        image = rng.poisson(sky * (1.0 + 0.005 * fringes) + still).astype(np.float32)
        return ObservedFrame(image, np.zeros(image.shape, dtype=np.int32), unit="electron")

    frames = [frame() for _ in range(8)]
    made = make_templates(
        [partial(lambda each: each, each) for each in frames], "2026-01-01T00:00:00", TemplateOptions(1)
    )
    assert (made.mask != 0).mean() < 0.01
    if star:
        assert (made.mask[still > 20.0] != 0).all()
    pattern, truth = (beside_background(each)[made.mask == 0] for each in (made.patterns[0], fringes))
    factor = pattern @ truth / (truth @ truth)
    assert np.std(pattern - factor * truth) < 0.15 * np.std(factor * truth)
