"""Where a disc is in which a model leaves something."""

from __future__ import annotations

import numpy as np
import pytest

from lsst.fringe_sim.effects import EFFECTS, ImageGeometry, Residuals
from lsst.fringe_sim.effects.disc_search import find_disc

WAVELENGTHS = np.linspace(880.0, 990.0, 12)


def residuals_of(rng: np.random.Generator, cell_px: int, inside: float) -> Residuals:
    """Noise, a part without data, and more noise in a disc about row 50, column 30, of radius 20 px."""
    place = cell_px * np.arange(96 // cell_px) + 0.5 * (cell_px - 1.0)
    geometry = ImageGeometry((96, 96), place, place, WAVELENGTHS, np.full(12, 20_000.0))
    value = 0.01 * rng.standard_normal((12, len(place), len(place)))
    on = np.hypot(place[:, np.newaxis] - 50.0, place - 30.0) < 20.0
    weight = np.full(value.shape, 0.01**-2.0)
    weight[:, 10:30, :12] = 0.0
    return Residuals(np.where(on, inside, 1.0) * value, weight, geometry)


@pytest.mark.rng("disc of residuals")
@pytest.mark.parametrize(("cell_px", "inside"), [(1, 1.3), (1, 5.0), (3, 2.0)])
def test_a_disc_is_found_where_it_is(rng: np.random.Generator, cell_px: int, inside: float) -> None:
    found = find_disc(residuals_of(rng, cell_px, inside))
    assert found is not None
    assert np.allclose(found, (50.0, 30.0, 20.0), atol=1.5 * cell_px)


@pytest.mark.rng("no disc of residuals")
def test_noise_has_no_disc(rng: np.random.Generator) -> None:
    found = [find_disc(residuals_of(rng, 2, 1.0)) for _ in range(10)]
    assert found == [None] * 10


@pytest.mark.rng("void in residuals")
def test_a_void_is_proposed_there(rng: np.random.Generator) -> None:
    (void,) = (effect for effect in EFFECTS if effect.name == "void")
    starts = void.propose(residuals_of(rng, 1, 3.0))
    assert np.allclose([start["centre_y"] for start in starts], 50.0, atol=1.5)
    sizes = [start["thickness"] for start in starts]
    assert sizes == sorted(sizes)
    assert 0.0 < sizes[0] < sizes[-1] <= 470.0
    assert void.propose(residuals_of(rng, 1, 1.0)) == ()
