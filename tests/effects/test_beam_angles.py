"""Tilted and widened beams."""

import math

import numpy as np
import pytest

from lsst.fringe_sim.effects.light import tilted, widened
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import Beam


@pytest.mark.parametrize("angle", [0.0, 0.03, 0.4])
def test_a_tilt_multiplies_the_mean_cosine(angle: float) -> None:
    """Mean direction of a symmetric beam: it turns as a whole."""
    beam = Beam.cone(1.8, 0.4, 12)
    mean = beam.weight @ np.cos(beam.theta)
    turned = tilted(beam, angle)
    assert turned.weight @ np.cos(turned.theta) == pytest.approx(mean * math.cos(angle), rel=1e-13)


def test_tilted_parallel_light_is_parallel_light() -> None:
    beam = tilted(Beam.collimated(), 0.2)
    np.testing.assert_allclose(beam.theta, 0.2, rtol=1e-12)


def test_a_source_and_a_lens_may_change_places() -> None:
    lens, source = Beam.cone(4.0, nodes=8), Beam.cone(9.0, nodes=8)
    one, other = widened(lens, source, 12), widened(source, lens, 12)
    for power in range(1, 5):
        moments = [beam.weight @ np.sin(beam.theta) ** (2 * power) for beam in (one, other)]
        assert moments[0] == pytest.approx(moments[1], rel=1e-9)
    # Independent directions: their cosines multiply.
    cosine = math.prod(beam.weight @ np.cos(beam.theta) for beam in (lens, source))
    assert one.weight @ np.cos(one.theta) == pytest.approx(cosine, rel=1e-12)


@pytest.mark.parametrize("aperture", [0.02, 0.2, 0.7])
def test_hardly_a_tilt_is_none(aperture: float) -> None:
    """Rays of all azimuths are one ray, and there are fewer of them than nodes."""
    wide = {"converging_beam.numerical_aperture": aperture}
    model, thickness = FringeModel.from_setup("ts8_e2v", wide), np.linspace(14.0, 14.6, 30)
    expected = model.response(thickness, [880.0, 960.0])
    for angle in (1e-16, 1e-13, 1e-9, 1e-6):
        hardly = model.with_effects({**wide, "tilt.angle": angle})
        assert hardly.system.beam.theta.max() < math.asin(aperture) + 1e-6
        np.testing.assert_allclose(hardly.response(thickness, [880.0, 960.0]), expected, atol=1e-8)


def test_tilt_and_converging_beam_together() -> None:
    """A tilt of a narrow cone is nearly that of parallel light; the cone lowers the contrast a little."""
    thickness = np.linspace(14.0, 14.6, 60)
    tilt = {"tilt.angle": 6.0}
    model = FringeModel.from_setup("ts8_e2v", tilt)
    parallel = model.response(thickness, [960.0])
    hardly = model.with_effects({**tilt, "converging_beam.numerical_aperture": 1e-4})
    np.testing.assert_allclose(hardly.response(thickness, [960.0]), parallel, atol=1e-6)
    clearly = model.with_effects({**tilt, "converging_beam.numerical_aperture": 0.1})
    assert np.ptp(clearly.response(thickness, [960.0])) < 0.97 * np.ptp(parallel)
