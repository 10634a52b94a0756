"""Cells that noise put on a phase of their own are found where their neighbours have them; steps stay."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.thickness_fit import FlatTemplates
from lsst.fringe_sim.algorithms.thickness_fit.between_orders import Rises, join_neighbours
from lsst.fringe_sim.algorithms.thickness_fit.cells import Cells
from lsst.fringe_sim.algorithms.thickness_fit.misfit import Misfit

ORDER_UM = 0.3
RANGE_UM = (11.0, 17.0)


def joined(truth: np.ndarray, start: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Cells with fringes at three wavelengths that turn at different rates, asked from a start."""
    grid = 10.0 + 0.001 * np.arange(8000)
    phase = 2.0 * np.pi * np.outer(grid, [1.05, 1.0, 0.95]) / ORDER_UM
    templates = FlatTemplates(1.0 + 0.1 * np.cos(phase), 10.0, 0.001, np.array([890.0, 930.0, 975.0]))
    edges = 8 * np.arange(len(truth) + 1)
    value, weight = (np.zeros((*truth.shape, 8), np.float32) for _ in range(2))
    amplitude = templates.amplitude_at(truth.ravel()).T.reshape(*truth.shape, 3)
    value[..., :3] = amplitude + noise * rng.standard_normal(amplitude.shape)
    weight[..., :3] = noise**-2.0
    cells = Cells(value, weight, np.zeros_like(value), np.zeros_like(value), edges, edges)
    rises = Rises(
        np.gradient(truth, axis=0).astype(np.float32), np.gradient(truth, axis=1).astype(np.float32)
    )
    return join_neighbours(
        cells, templates, start.astype(np.float32), rises, ORDER_UM,
        range_um=RANGE_UM, temper=1.0, misfit=Misfit(1.0, 1024.0, 2.0), threads=1,
    )  # fmt: skip


def surface(step_um: float = 0.0) -> np.ndarray:
    """A tilted layer, 16 by 16 cells, with a step in the middle."""
    y, x = np.indices((16, 16))
    return 13.8 + 0.012 * x + 0.007 * y + step_um * (x > 7)


@pytest.mark.parametrize("away", [0.4, -0.45, 3.4, -6.45])
@pytest.mark.rng("cells between the orders of their neighbours")
def test_cells_between_orders_are_found_again(away, rng) -> None:
    """A lone cell, two beside each other, and one that is masked in the middle of good ones."""
    truth = surface()
    start = truth.copy()
    start[[3, 9, 9], [5, 10, 11]] += away * ORDER_UM
    start[12, 3] = np.nan
    found = joined(truth, start, 0.02, rng)
    known = np.isfinite(start)
    assert np.array_equal(np.isfinite(found), known)
    assert np.abs(found - truth)[known].max() < 0.15 * ORDER_UM


@pytest.mark.rng("cells between orders by the layer itself")
def test_cells_that_lie_between_orders_stay(rng) -> None:
    """A step of 0.4 orders and a pit of one cell, which the flats tell: only noise moves cells."""
    truth = surface(0.4 * ORDER_UM)
    truth[4, 3] -= 0.4 * ORDER_UM
    found = joined(truth, truth, 0.002, rng)
    noise_um = 0.002 * ORDER_UM / (2.0 * np.pi * 0.1)
    assert np.abs(found - truth).max() < 4.0 * noise_um


@pytest.mark.rng("cells between orders at the end of the range")
def test_no_cell_leaves_the_range(rng) -> None:
    """Neighbours have a cell where no thickness is possible."""
    truth = surface() + RANGE_UM[0] - surface()[4, 3] - 0.01
    start = truth.copy()
    start[4, 3] += 0.45 * ORDER_UM
    assert joined(truth, start, 0.02, rng)[4, 3] == np.float32(start[4, 3])
