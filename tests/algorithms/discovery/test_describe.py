"""Places that fit worse than the rest of a sensor, in residuals made by hand."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.describe import places_apart
from lsst.fringe_sim.effects import ImageGeometry

CELL_PX = 4.0


def geometry_of(shape: tuple[int, int], waves: int) -> ImageGeometry:
    rows, columns = (CELL_PX * (np.arange(size) + 0.5) - 0.5 for size in shape)
    full = (int(CELL_PX * shape[0]), int(CELL_PX * shape[1]))
    return ImageGeometry(full, rows, columns, 880.0 + 10.0 * np.arange(waves), np.full(waves, 2e4))


@pytest.mark.parametrize("waves", [1, 3, 12])
@pytest.mark.rng("noise has no places")
def test_noise_has_no_places(waves: int, rng: np.random.Generator) -> None:
    noise = rng.standard_normal((waves, 300, 200))
    noise[:, rng.random((300, 200)) < 0.01] = 0.0
    noise[:, :, 40:60] = 0.0
    assert places_apart(noise, geometry_of((300, 200), waves)) == []


@pytest.mark.parametrize("elsewhere", [1.0, 1.4])
@pytest.mark.rng("places are found where they are")
def test_places_are_found_where_they_are(elsewhere: float, rng: np.random.Generator) -> None:
    """Also where the model fits nowhere as well as the noise would let it."""
    shape = (96, 80)
    residual = elsewhere * rng.standard_normal((12, *shape))
    y, x = np.indices(shape)
    for row, column, radius, factor in ((30, 50, 6, 3.0), (70, 20, 4, 2.5)):
        residual[:, np.hypot(y - row, x - column) <= radius] *= factor
    residual[:, 45:, 60:] = 0.0
    first, second = places_apart(residual, geometry_of(shape, 12))
    for place, row, column, radius in ((first, 30, 50, 6), (second, 70, 20, 4)):
        assert place["y_px"] == pytest.approx(CELL_PX * (row + 0.5) - 0.5, abs=CELL_PX)
        assert place["x_px"] == pytest.approx(CELL_PX * (column + 0.5) - 0.5, abs=CELL_PX)
        assert 0.8 < place["diameter_px"] / (2.0 * radius * CELL_PX) < 1.8
    assert first["excess_share"] > second["excess_share"] > 0.05
    assert first["excess_share"] + second["excess_share"] == pytest.approx(1.0)


@pytest.mark.rng("a place behind lost pixels is one place")
def test_a_place_behind_lost_pixels_is_one_place(rng: np.random.Generator) -> None:
    """Neither a bad column cuts it in two, nor is a sound cell beside it a place of its own."""
    shape = (64, 64)
    y, x = np.indices(shape)
    for _ in range(30):
        residual = rng.standard_normal((12, *shape))
        residual[:, np.hypot(y - 30, x - 30) <= 3] *= rng.uniform(2.0, 5.0)
        residual[:, :, rng.integers(28, 36)] = 0.0
        residual[:, rng.random(shape) < 0.1] = 0.0
        places = places_apart(residual, geometry_of(shape, 12))
        assert len(places) == 1
        assert places[0]["excess_share"] == 1.0
        assert abs(places[0]["y_px"] / CELL_PX - 30.5) < 2.0
        assert np.isfinite(list(places[0].values())).all()


@pytest.mark.rng("a misfit everywhere has no place")
def test_a_misfit_everywhere_has_no_place(rng: np.random.Generator) -> None:
    wave = np.sin(np.arange(90) / 5.0)[np.newaxis, np.newaxis, :]
    residual = rng.standard_normal((12, 64, 90)) + 3.0 * wave
    assert places_apart(residual, geometry_of((64, 90), 12)) == []
    assert places_apart(np.full((12, 8, 8), 3.0), geometry_of((8, 8), 12)) == []
    assert places_apart(np.zeros((12, 64, 64)), geometry_of((64, 64), 12)) == []
