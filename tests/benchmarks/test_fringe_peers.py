"""The peers of the fringe correction, and the configuration with which the algorithm of ip_isr works."""

import numpy as np
import pytest
from benchmarks.fringe_peers import aperture_scale

from lsst.fringe_sim.middleware.handoff import APERTURES, isr_override

LEVEL, SIDE = 2700.0, 512


def scene(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A template without noise, and an exposure in which its fringes are far below the noise of a pixel."""
    y, x = np.mgrid[:SIDE, :SIDE]
    template = 0.002 * np.sin(x / 9.0 + 1e-4 * y**2)
    return template, rng.poisson(LEVEL * (1.0 + template)) + 9.0 * rng.standard_normal(template.shape)


@pytest.mark.slow
@pytest.mark.rng("means of apertures give the scale")
def test_means_of_apertures_give_the_scale_that_ip_isr_should_find(rng: np.random.Generator) -> None:
    template, image = scene(rng)
    scale = aperture_scale(image, template, rng, np.mean, APERTURES)
    assert scale / LEVEL == pytest.approx(1.0, abs=0.1)


def test_the_override_says_what_works_and_is_python() -> None:
    text = isr_override(["y_10"])
    compile(text, "isr_fringe.py", "exec")
    assert "config.fringe.filters = ['y_10']" in text
    assert "config.fringe.stats.stat = int(MEAN)" in text
    assert f"config.fringe.num = {APERTURES}" in text
