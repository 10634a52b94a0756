"""Parts of a frame without noise count as pixels without a number."""

from functools import partial

import numpy as np
import pytest
from observed_night import observed_night

from lsst.fringe_sim.algorithms.correction.constant import without_constant_blocks
from lsst.fringe_sim.algorithms.correction.empirical import TemplateOptions
from lsst.fringe_sim.algorithms.fringe_correction import correct_fringes
from lsst.fringe_sim.algorithms.observed_frames import make_templates
from lsst.fringe_sim.products import ObservedFrame


@pytest.mark.parametrize("value", [0.0, 17.0, np.nan])
@pytest.mark.rng("a dead amplifier is no data")
def test_a_dead_amplifier_hides_no_fringes_of_the_others(rng, value):
    night = observed_night(rng, 5, side=144, strength=0.05)
    pattern = night.fringes[0] / 2000.0
    image = night.images[0].copy()
    image[:, :75] = value
    alone = correct_fringes(night.images[0][:, 75:], [pattern[:, 75:]])
    done = correct_fringes(image, [pattern])
    assert done.seen
    assert done.scale[0] == pytest.approx(alone.scale[0], abs=5.0 * alone.sigma[0])
    assert not (done.frame.fit.weight[:, :75] > 0).any()
    images = [*night.images[1:], image]
    frames = [
        partial(ObservedFrame, each, np.zeros(each.shape, np.int32), unit="electron") for each in images
    ]
    made = make_templates(frames, "2026-01-01T00:00:00", TemplateOptions(components=1))
    assert (made.mask == 0).mean() > 0.95
    assert made.coverage[:, :75].max() == 4


@pytest.mark.rng("rounded frames have noise")
def test_equal_pixels_by_chance_are_data(rng):
    """A frame in units of which noise is a quarter has equal pixels; a frame without noise has nothing else."""
    good = np.ones((256, 256), dtype=bool)
    rounded = np.rint(rng.normal(0.0, 0.15, good.shape))
    assert (rounded[:, 1:] == rounded[:, :-1]).mean() > 0.99
    assert without_constant_blocks(rounded, good).all()
    steps = np.repeat(np.arange(4.0), 64)[:, None] * np.ones(256)
    assert without_constant_blocks(steps, good).all()
    rounded = np.rint(rng.normal(0.0, 0.5, good.shape))
    rounded[:100] = 3.0
    kept = without_constant_blocks(rounded, good)
    assert not kept[:100].any()
    assert kept[116:].all()
