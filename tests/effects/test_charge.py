"""Effects of the charge: crosstalk, brighter-fatter, and more than can be counted."""

import numpy as np
import pytest

from lsst.fringe_sim.effects import EFFECTS, BrighterFatter, ImageGeometry, activate_effects, apply_to_image
from lsst.fringe_sim.mock import HIDDEN_EFFECTS
from lsst.fringe_sim.model import FringeModel

LEVEL = 30_000.0


def _changed(image: np.ndarray, geometry: ImageGeometry, settings: dict[str, float]) -> np.ndarray:
    system = FringeModel.from_setup("ts8_e2v").base_system
    return apply_to_image(activate_effects(settings, EFFECTS), system, image, geometry)


def test_crosstalk_of_cells_is_the_mean_of_that_of_pixels() -> None:
    """Amplifiers of 20 pixels, cells of 4: five cells each."""
    y, x = np.mgrid[:16, :160]
    image = (1.0 + 0.2 * np.sin(0.08 * x + 0.05 * y))[np.newaxis]
    pixels = ImageGeometry.of_pixels((16, 160), np.array([960.0]), LEVEL)
    places = 4 * np.arange(40) + 1.5
    cells = ImageGeometry((16, 160), places[:4], places, np.array([960.0]), np.array([LEVEL]))

    def averaged(cube: np.ndarray) -> np.ndarray:
        return cube.reshape(1, 4, 4, 40, 4).mean(axis=(2, 4))

    settings = {"crosstalk.from_left": 0.01, "crosstalk.from_right": -0.004}
    fine, coarse = _changed(image, pixels, settings), _changed(averaged(image), cells, settings)
    np.testing.assert_allclose(coarse, averaged(fine), atol=1e-12)


def test_brighter_fatter_widens_and_keeps_the_charge() -> None:
    """Second moments of a spot on a dark sky grow by the variance its own charge stands for."""
    y, x = np.mgrid[-20:21, -20:21].astype(float)
    spot = np.exp(-0.5 * (x**2 + y**2) / 9.0)
    geometry = ImageGeometry.of_pixels((41, 41), np.array([960.0]), LEVEL)
    changed = _changed(spot[np.newaxis], geometry, {"brighter_fatter.variance": 0.2})[0]
    assert changed.sum() == pytest.approx(spot.sum(), rel=1e-12)
    before, after = ((x**2 * image).sum() / image.sum() for image in (spot, changed))
    # A quarter of the Laplacian of q²: x² gains half of the mean of q, weighted by q; a Gaussian's is half its peak.
    assert after - before == pytest.approx(0.5 * 0.2 * LEVEL / 1e5 * 0.5, rel=1e-3)


@pytest.mark.parametrize("cell_px", [1, 3])
@pytest.mark.rng("brighter fatter correlates the noise")
def test_brighter_fatter_correlates_the_noise(rng: np.random.Generator, cell_px: int) -> None:
    """As in photon noise whose charge moved by the mock's own differences of neighbours."""
    level, variance, side = 50_000.0, 0.08, 600
    (hidden,) = (effect for effect in HIDDEN_EFFECTS if effect.name == "brighter_fatter")
    assert hidden.on_charge is not None
    charge = hidden.on_charge(rng.poisson(level, (side, side)).astype(float), {"variance": variance})
    cells = charge.reshape(side // cell_px, cell_px, side // cell_px, cell_px).mean(axis=(1, 3))
    noise = cells - cells.mean()
    measured = 0.5 * sum(float((noise * np.roll(noise, 1, axis)).mean()) for axis in (0, 1)) / noise.var()
    middle = cell_px * np.arange(cells.shape[0]) + 0.5 * (cell_px - 1)
    geometry = ImageGeometry((side, side), middle, middle, np.array([960.0]), np.array([level]))
    expected = BrighterFatter().noise_correlation({"variance": variance}, geometry)
    assert measured == pytest.approx(expected, abs=4.0 / cells.shape[0], rel=0.1)
    assert expected > 0.01


def test_more_charge_than_can_be_counted_is_finite() -> None:
    image = np.ones((1, 4, 4))
    geometry = ImageGeometry.of_pixels((4, 4), np.array([960.0]), 200_000.0)
    assert np.isfinite(_changed(image, geometry, {"non_linearity.quadratic": 0.2})).all()
