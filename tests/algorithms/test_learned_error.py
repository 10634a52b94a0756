"""What an error of light and contrast does to the thickness: to a pixel by itself, and to a surface through cells."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.thickness_fit import FlatTemplates, Nuisances
from lsst.fringe_sim.algorithms.thickness_fit.cells import Cells
from lsst.fringe_sim.algorithms.thickness_fit.evidence import refine_row
from lsst.fringe_sim.algorithms.thickness_fit.learned_error import learned_sigma
from lsst.fringe_sim.algorithms.thickness_fit.learning import moves_of
from lsst.fringe_sim.algorithms.thickness_fit.learning_cells import LearningCells
from lsst.fringe_sim.algorithms.thickness_fit.local_surface import shares_of_middle
from lsst.fringe_sim.algorithms.thickness_fit.nuisances import NuisanceFit
from lsst.fringe_sim.algorithms.thickness_fit.pixels import SAME_SURFACE, CellSurface

ORDER_UM, STEP_UM = 0.3, 0.001
WAVELENGTHS = np.array([900.0, 930.0, 960.0])
FREE = Nuisances(contrast="common")


@pytest.fixture(scope="module")
def templates() -> FlatTemplates:
    """Fringes of one order for 930 nm, over 4 µm."""
    grid = 13.0 + STEP_UM * np.arange(4000)
    fringes = 0.2 * np.cos(2.0 * np.pi * np.outer(grid, 930.0 / WAVELENGTHS) / ORDER_UM)
    return FlatTemplates(1.0 + fringes, grid[0], STEP_UM, WAVELENGTHS, mean_response=np.ones(3))


def padded(values: np.ndarray) -> np.ndarray:
    """Wavelengths as the compiled loops take them."""
    out = np.zeros((*values.shape[:-1], 8), np.float32)
    out[..., : values.shape[-1]] = values
    return out


def learned(templates: FlatTemplates, sigma: float) -> NuisanceFit:
    """Everything as the model has it, the contrast known to ``sigma``."""
    known = replace(NuisanceFit.none(3), mean_response=templates.mean_response, middle_um=15.0)
    return replace(known, covariance=np.array([[sigma**2]]))


def test_moves_are_those_of_a_fit_with_a_wrong_contrast(templates) -> None:
    thickness = np.linspace(14.0, 15.0, 40).astype(np.float32)
    amplitude = templates.amplitude_at(thickness).T
    weight = padded(np.broadcast_to([3.0, 2.0, 1.0], amplitude.shape))
    cells = LearningCells(padded(amplitude), weight, thickness, np.zeros((40, 0)), 0, 1.0, ORDER_UM)
    moves, _ = moves_of(cells, templates, FREE, learned(templates, 0.0))
    found = np.full_like(thickness, np.nan)
    wrong = padded(1.01 * amplitude)
    refine_row(wrong, weight, templates.table(), templates.start_um, STEP_UM, thickness, found)
    clear = np.abs(moves[0]) < 0.05  # elsewhere all fringes are at a crest, and a per cent is no small change
    assert clear.sum() > 30
    np.testing.assert_allclose((found - thickness)[clear], 0.01 * moves[0][clear], atol=5e-5)


def test_a_surface_is_moved_less_than_its_pixels(templates) -> None:
    """A layer of an order in 40 pixels: the cells about each have all phases, and are moved up and down."""
    edges = 8 * np.arange(17)
    y, x = np.meshgrid(0.5 * (edges[:-1] + edges[1:]), 0.5 * (edges[:-1] + edges[1:]), indexing="ij")
    thickness = (14.3 + ORDER_UM / 40.0 * (0.9 * x + 0.1 * y)).astype(np.float32)
    value = padded(np.moveaxis(templates.amplitude_at(thickness), 0, -1))
    weight = padded(np.full((16, 16, 3), 1e4))
    cells = Cells(value, weight, np.zeros_like(value), np.zeros_like(value), edges, edges)
    flat, every = np.zeros((16, 16), np.float32), np.ones((16, 16), bool)
    surface = CellSurface(
        thickness, flat, flat, cells.y_centre, cells.x_centre, every, every, flat + np.float32(0.002)
    )
    leaning = np.zeros((128, 128), bool)
    leaning[:, :64] = True
    sigma = learned_sigma(cells, surface, leaning, templates, FREE, learned(templates, 0.02), ORDER_UM)
    assert sigma.shape == (128, 128)
    assert np.ptp(sigma[:, 64:]) == 0.0
    assert sigma[0, 64] > 1e-4
    assert np.median(sigma[32:96, 24:64]) < 0.5 * sigma[0, 64]


def test_nothing_learned_is_no_error(templates) -> None:
    edges = 8 * np.arange(3)
    empty = np.zeros((2, 2, 8), np.float32)
    cells = Cells(empty, empty, empty, empty, edges, edges)
    flat = np.full((2, 2), 14.0, np.float32)
    none = np.zeros((2, 2), bool)
    surface = CellSurface(flat, 0 * flat, 0 * flat, cells.y_centre, cells.x_centre, ~none, none, flat)
    for fit in (NuisanceFit.none(3), learned(templates, 0.1)):
        found = learned_sigma(cells, surface, np.zeros((16, 16), bool), templates, FREE, fit, ORDER_UM)
        assert not found.any()


@pytest.mark.parametrize("size", [1, 2, 8])
def test_the_share_of_a_cell_is_that_of_a_fit_by_least_squares(size: int) -> None:
    """Slopes of an order from cell to cell, and bends of what breaks a surface, also of single pixels."""
    noise = 0.5 * ORDER_UM * np.linspace(0.5, 1.5, 25).reshape(5, 5)
    flat, every, at = np.zeros((5, 5), np.float32), np.ones((5, 5), bool), size * np.arange(5.0)
    surface = CellSurface(flat, flat, flat, at, at, every, every, noise.astype(np.float32))
    middle = np.array([2])
    b, a, share = shares_of_middle(surface, noise**-2.0, middle, middle, ORDER_UM)
    up, over = b[0] - 2.0, a[0] - 2.0
    terms = np.stack([np.ones(25), up, over, up**2, up * over, over**2], axis=1) / noise[b[0], a[0], None]
    prior = np.diag(1.0 / (ORDER_UM * np.array([1.0, 1.0, 1.0, *[SAME_SURFACE] * 3])))
    # A unit of each cell, everything else nothing: what the fit makes of it in the middle.
    data = np.vstack([np.diag(1.0 / noise[b[0], a[0]]), np.zeros((6, 25))])
    expected = np.linalg.lstsq(np.vstack([terms, prior]), data)[0][0]
    np.testing.assert_allclose(share[0], expected, atol=1e-9)


def test_the_grid_of_templates_ends_at_its_last_thickness(templates) -> None:
    """4000 steps from 13 µm."""
    assert templates.stop_um == pytest.approx(13.0 + 3999 * STEP_UM, abs=1e-9)
    assert templates.thickness_um[-1] == pytest.approx(templates.stop_um, abs=1e-9)
