"""Field of the thickness: how fine it is made, and that it stays in its fringe orders."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import SearchOptions
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products.fringe_cube import FlatExposures, FringeCube

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
SIZE, PER_PIXEL = 128, 3
HALF_ORDER_UM = 0.15


def steep_map(rng: np.random.Generator) -> np.ndarray:
    """Thickness [µm], three places a pixel; fringes are five pixels wide where it is steepest."""
    span, low = rng.uniform(0.5, 1.2), rng.uniform(10.0, 18.0)
    length, side = rng.uniform(0.15, 0.4), SIZE * PER_PIXEL
    k = np.fft.fftfreq(side) * side
    spectrum = np.fft.fft2(rng.normal(size=(side, side)))
    smooth = np.fft.ifft2(spectrum * np.exp(-(k**2 + k[:, np.newaxis] ** 2) * length**2)).real
    return np.asarray(low + span * (smooth - smooth.min()) / np.ptp(smooth))


def binned(fine: np.ndarray, px: int) -> np.ndarray:
    ny, nx = fine.shape[-2] // px, fine.shape[-1] // px
    return np.asarray(fine.reshape(*fine.shape[:-2], ny, px, nx, px).mean(axis=(-3, -1)))


@pytest.mark.slow
def test_a_coarse_field_that_slips_does_not_take_the_finer_ones_along() -> None:
    """An adhesive that absorbs weakens the fringes; a coarse field without it loses its order in places."""
    rng = np.random.default_rng(103)
    fine = steep_map(rng)
    model = FringeModel.from_setup("ts8_e2v", {"epoxy_absorption.k": 0.003})
    grid = np.linspace(fine.min(), fine.max(), 401)
    light = np.array(
        [binned(np.interp(fine, grid, one), PER_PIXEL) for one in model.response(grid, WAVELENGTHS)]
    )
    expected = rng.uniform(2e4, 6e4) * light / light.mean(axis=(1, 2), keepdims=True)
    electrons = (rng.poisson(expected) + rng.normal(0.0, 6.0, light.shape)).astype(np.float32)
    rows = FlatExposures(WAVELENGTHS, np.full(12, 2.0), np.full(12, 183.15))
    cube = FringeCube(
        electrons, electrons + 36.0, np.zeros(light.shape, np.int32), rows, "electron", detector="x"
    )
    rng = np.random.default_rng(5)
    prepared = prepare(cube, FringeModel.from_setup("ts8_e2v"), EFFECTS[:2], SearchOptions(), rng)
    truth = binned(fine, PER_PIXEL * prepared.cells.cell_px)
    apart = prepared.point.thickness_um.reshape(truth.shape) - truth
    assert np.abs(apart)[prepared.cells.seen].max() < HALF_ORDER_UM
