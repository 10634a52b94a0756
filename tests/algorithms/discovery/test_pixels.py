"""Pixels are areas: they average the fringes over themselves, unless the data are sharper than that."""

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.basis import SplineBasis
from lsst.fringe_sim.algorithms.discovery.fit import Problem, coordinates_of, fit_model
from lsst.fringe_sim.algorithms.discovery.forward import Forward
from scipy.ndimage import map_coordinates
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.discovery import discover, preparation
from lsst.fringe_sim.algorithms.discovery.cells import bin_cube
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


@pytest.mark.parametrize("cell_px", first_is_quick([2, 1]))
def test_the_fringes_are_averaged_over_the_area_of_a_cell(cell_px: int) -> None:
    """Of a plane whose fringes are four cells wide, inside, where the gradient is that of the plane."""
    size = 32
    y, x = np.indices((size, size))
    thickness = 15.0 + (0.06 * x + 0.04 * y) / cell_px
    light = _light(thickness, points=False)
    cube = FringeCube(
        light.astype(np.float32),
        np.ones(light.shape, np.float32),
        np.zeros(light.shape, np.int32),
        FlatExposures(WAVELENGTHS, np.array(2.0), np.array(183.15)),
        "relative",
    )
    cells = bin_cube(cube, cell_px)
    centres = thickness.reshape(size // cell_px, cell_px, size // cell_px, cell_px).mean(axis=(1, 3))
    limits = (float(thickness.min()) - 0.5, float(thickness.max()) + 0.5)
    inside = (slice(None), slice(4, -4), slice(4, -4))
    errors = {}
    for points in (False, True):
        forward = Forward.of_cells(MODEL, EFFECTS, cells, limits).with_places(int(points))
        value = forward.predict({}, centres).value[inside]
        # Flats are over the mean of the sensor, tables over that of all thicknesses.
        scale = (cells.value[inside] * value).sum(axis=(1, 2)) / (value**2).sum(axis=(1, 2))
        miss = cells.value[inside] - scale[:, np.newaxis, np.newaxis] * value
        errors[points] = float(miss.std() / cells.value[inside].std())
    assert errors[False] < 2e-3
    assert errors[True] > 10.0 * errors[False]


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
@pytest.mark.parametrize(
    ("places", "blur", "taken"),
    [
        (3, {"charge_diffusion.sigma": 0.2}, True),
        *first_is_quick(
            [
                (3, {"charge_diffusion.sigma": 0.0927}, False),
                (2, {"brighter_fatter.variance": 0.07}, False),  # 0.021 px² behind 30 000 electrons
                (2, {"charge_diffusion.sigma": 0.05}, True),
                (0, {"charge_diffusion.sigma": 0.0927}, True),
            ]
        ),
    ],
)
def test_places_beside_the_blur_that_they_lack_are_areas(places: int, blur: dict, taken: bool) -> None:
    """Nine places in a pixel and 0.096 px of diffusion are an area: no effect, and not to be named as one."""
    thickness = random_field((48, 48), np.random.default_rng(43), mean=15.0, span=1.5)
    cells = bin_cube(_cube(thickness, np.random.default_rng(44), points=False), 1)
    forward = Forward.of_cells(MODEL, EFFECTS, cells, (14.0, 16.0)).with_places(places)
    settings = {"epoxy_index.cauchy": -0.005, **blur}
    kept = preparation._without_rest_of_area(settings, forward)
    assert kept == (settings if taken else {"epoxy_index.cauchy": -0.005})


@pytest.mark.slow
@pytest.mark.parametrize(("points", "places"), first_is_quick([(False, 2), (True, 1)]))
def test_a_blur_that_makes_areas_of_few_places_is_none(points: bool, places: int) -> None:
    """Areas taken as four places each need a blur, and explain as much as areas without; real points do not."""
    rng = np.random.default_rng(47)
    thickness = random_field((48, 48), rng, mean=15.0, span=3.0)
    cells = bin_cube(_cube(thickness, rng, points=points), 1)
    forward = Forward.of_cells(MODEL, EFFECTS, cells, (11.0, 19.0)).with_places(places)
    basis = SplineBasis.of_grid((48, 48), 2.0)
    problem = Problem(cells, forward, basis, np.eye(len(cells.wavelength_nm)))
    field = basis.fit(thickness, np.ones(thickness.shape))
    (blur,) = (effect for effect in EFFECTS if effect.name == "charge_diffusion")
    coordinates = coordinates_of(blur, forward, thickness)
    first = np.array([coordinates[0].coordinate(0.14)])
    fit = fit_model(problem, coordinates, first, field)
    assert preparation.sees_areas(problem, fit) != points
    found = fit.settings["charge_diffusion.sigma"]
    assert (found == pytest.approx(preparation.PIXEL_RMS / 2.0, rel=0.15)) != points


@pytest.mark.slow
def test_fringes_hardly_wider_than_a_cell_do_not_make_pixels_sharp() -> None:
    """Where they are three pixels wide, cells of two were a little off, pixels were taken as 3 by 3 points, and what
    these lack of an area was a disagreement.
    """
    case = draw_case("none", np.random.default_rng([20411125, 0, 119]).spawn(2)[0])
    prepared = preparation.prepare(case.cube, FringeModel.from_setup(case.setup), EFFECTS, 20_000)
    assert prepared.problem.forward.places == 0
    assert prepared.problem.cells.cell_px == 1
