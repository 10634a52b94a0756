"""Pixels are areas: they average the fringes over themselves, unless the data are sharper than that."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from lsst.fringe_sim.algorithms.discovery import SearchOptions, discover
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.mock import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products.fringe_cube import FlatExposures, FringeCube

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
MODEL = FringeModel.from_setup("ts8_e2v")
SUBPIXELS = (np.arange(9) - 4.0) / 9.0


def _light(thickness: np.ndarray, *, points: bool) -> np.ndarray:
    """Relative flats of a map, at the centres of the pixels or as the mean of 81 places in each."""
    if points:
        light = MODEL.response(thickness, WAVELENGTHS)
    else:
        y, x = np.indices(thickness.shape)
        light = np.mean(
            [
                MODEL.response(
                    map_coordinates(thickness, [y + up, x + along], order=3, mode="mirror"), WAVELENGTHS
                )
                for up in SUBPIXELS
                for along in SUBPIXELS
            ],
            axis=0,
        )
    return np.asarray(light / light.mean(axis=(1, 2), keepdims=True))


def _cube(thickness: np.ndarray, rng: np.random.Generator, *, points: bool) -> FringeCube:
    counts = rng.poisson(3e4 * _light(thickness, points=points)).astype(np.float32)
    exposures = FlatExposures(WAVELENGTHS, np.array(2.0), np.array(183.15))
    return FringeCube(counts, counts, np.zeros(counts.shape, np.int32), exposures, "electron")


@pytest.mark.slow
@pytest.mark.parametrize("points", [True, False])
def test_a_sensor_without_an_effect_is_taken_for_what_it_is(points: bool) -> None:
    """Steep fringes show whether pixels are areas; either way nothing is missing, and points are told."""
    rng = np.random.default_rng(41)
    thickness = random_field((64, 64), rng, mean=15.0, span=2.5)
    verdict = discover(_cube(thickness, rng, points=points), "ts8_e2v", rng=rng)
    assert verdict.verdict == "no_discrepancy"
    assert any("taken as a point" in note for note in verdict.notes) == points


@pytest.mark.slow
def test_fringes_hardly_wider_than_a_cell_do_not_make_pixels_sharp() -> None:
    """Where they are three pixels wide, cells of two were a little off, pixels were taken as 3 by 3 points, and what
    these lack of an area was a disagreement.
    """
    case = draw_case("none", np.random.default_rng([20411125, 0, 119]).spawn(2)[0])
    rng = np.random.default_rng(5)
    prepared = prepare(case.cube, FringeModel.from_setup(case.setup), EFFECTS, SearchOptions(), rng)
    assert prepared.problem.forward.shape.area
    assert prepared.cells.cell_px == 1
