"""The part of a sensor that the search on one likelihood takes where fringes are too narrow for larger cells."""

from __future__ import annotations

import numpy as np
import pytest
from flat_cubes import relative_flats

from lsst.fringe_sim.algorithms.discovery.options import SearchOptions
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.algorithms.discovery.sensor_part import (
    FEWEST_ROWS,
    LARGEST_SEARCH,
    SensorPart,
    with_edges_of_sensor,
)
from lsst.fringe_sim.algorithms.inference import CellShape
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

SHAPE = (256, 320)
MOST = 6000


@pytest.mark.parametrize(("shape", "cell_px"), [((4004, 4096), 4), ((1024, 1000), 1), ((200, 4000), 1)])
def test_a_part_has_few_cells_about_the_middle(shape: tuple[int, int], cell_px: int) -> None:
    part = SensorPart.of(shape, cell_px, MOST)
    high, wide = (own.stop - own.start for own in (part.rows, part.columns))
    assert high * wide <= LARGEST_SEARCH * MOST * cell_px**2
    assert high >= FEWEST_ROWS // 2 * cell_px
    for own, size in zip((part.rows, part.columns), shape, strict=True):
        assert abs(own.start - (size - own.stop)) < 128
    assert SensorPart.of(shape, cell_px, shape[0] * shape[1]).inside(shape).all()


@pytest.mark.slow
@pytest.mark.rng("a part of a sensor of narrow fringes")
def test_narrow_fringes_are_searched_in_a_part(rng: np.random.Generator) -> None:
    """With the thickness that is there, a part held out within it, and no edges but those of the sensor."""
    y, x = np.indices(SHAPE, dtype=float)
    truth = 13.0 + 0.028 * x + 2e-5 * y**2
    model = FringeModel.from_setup("ts8_e2v")
    cube = relative_flats(truth, model, rng)
    prepared = prepare(cube, model, EFFECTS[:2], SearchOptions(most_cells=MOST), np.random.default_rng(5))
    cells = prepared.cells
    rows, columns = (place.astype(int) for place in (cells.geometry.y_px, cells.geometry.x_px))
    assert cells.cell_px == 1
    assert cells.geometry.shape == SHAPE
    assert len(rows) * len(columns) <= LARGEST_SEARCH * MOST
    assert 0.1 < prepared.unseen.seen.mean() < 0.4
    assert not (prepared.unseen.seen & cells.seen).any()
    found = prepared.point.thickness_um.reshape(cells.shape[1:])[cells.seen]
    expected = truth[np.ix_(rows, columns)][cells.seen]
    assert np.median(np.abs(found - expected)) < 0.01
    (told,) = prepared.told
    assert f"rows {rows[0]} to {rows[-1]} and columns {columns[0]} to {columns[-1]}" in told
    edge = with_edges_of_sensor(CellShape.of_field(truth[np.ix_(rows, columns)], 1), cells).edge_px
    assert edge is not None
    whole = CellShape.of_field(truth, 1).edge_px
    assert whole is not None
    own = whole.reshape(2, *SHAPE)[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    np.testing.assert_array_equal(np.abs(edge), np.abs(own.reshape(2, -1)))
