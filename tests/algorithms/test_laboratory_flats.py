"""Flats that are not as the model has them, from another simulator: right by default, or said not to be."""

from dataclasses import replace

import numpy as np
import pytest
from flat_cubes import relative_flats
from hard_maps import HARD_MAPS
from laboratory_flats import ROWS, draw_map, fit_one, judge, make_flats

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit import Nuisances, SiliconSearch
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube, ThicknessMap

SHAPE = (160, 192)  # Amplifiers of 80 by 24 pixels


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


def case(name: str, rng: np.random.Generator, span: float = 2.0) -> tuple[np.ndarray, FringeCube]:
    """A map and its flats."""
    truth = random_field(SHAPE, rng, mean=rng.uniform(11.0, 17.0), span=span)
    return truth, make_flats(ROWS[name], truth, rng)


def check(fitted: ThicknessMap, truth: np.ndarray, widest: float = 1.15) -> None:
    """Next to nothing is wrong, next to nothing masked, and the uncertainties are what they say."""
    result = judge(fitted, truth)
    assert result.wrong < 1e-3, str(result)
    assert result.masked < 0.05, str(result)
    assert 0.85 < result.pull < widest, str(result)


@pytest.mark.parametrize("name", ["contrast 0.13", "contrast 0.13, gains 1 %"])
@pytest.mark.rng("laboratory weak fringes are fitted by default")
def test_weak_fringes_are_fitted_by_default(name, model, rng) -> None:
    truth, cube = case(name, rng)
    fitted = fit_thickness(cube, model)
    check(fitted, truth)
    np.testing.assert_allclose(fitted.contrast, 0.13, rtol=0.1)
    assert np.all(np.abs(fitted.contrast - 0.13) < 6.0 * fitted.contrast_sigma)


@pytest.mark.parametrize("seed", [117, 122])
def test_a_sensor_of_few_pixels_is_solved_on_enough_cells(seed, model) -> None:
    """16 by 16 pixels of little more than one order, which 16 cells fit as well with a wrong model and relief."""
    rng = np.random.default_rng(seed)
    truth = random_field((16, 16), rng, mean=rng.uniform(10.0, 18.0), span=rng.uniform(0.3, 0.5))
    result = judge(fit_thickness(make_flats(ROWS["contrast 0.25"], truth, rng), model), truth)
    assert result.masked > 0.99 or (result.wrong < 1e-3 and result.own < 1.5), str(result)


def test_fringes_of_few_orders_are_not_taken_for_light(model) -> None:
    """Light that each wavelength has of its own follows weak fringes that are as smooth as itself."""
    laboratory = replace(ROWS["contrast 0.05"], electrons=20_000.0)
    result = fit_one(laboratory, 41_001, model, 128)[1]
    assert result.wrong < 1e-3, str(result)
    assert result.masked < 0.05, str(result)
    assert 0.8 < result.own < 1.15, str(result)


def test_an_order_that_the_search_came_upon_is_a_rival(model) -> None:
    """Fringes of a hundredth of the model's: two orders are about as likely, and neither is said to be sure."""
    laboratory = replace(ROWS["roughness 80 nm, gradient 3 %"], contrast=0.05)
    result = fit_one(laboratory, 41_061, model, 128)[1]
    assert result.masked > 0.99 or result.wrong < 1e-3, str(result)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "as the model",
        "contrast 0.25",
        "roughness 80 nm, gradient 3 %",
        "contrast 0.3, gradient 2 %",
        "gains 1 %",
        "line of 6 nm",
    ],
)
@pytest.mark.rng("laboratory right by default")
def test_right_by_default(name, model, rng) -> None:
    truth, cube = case(name, rng)
    check(fit_thickness(cube, model), truth)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["epoxy k 0.005"])
@pytest.mark.rng("laboratory contrast that falls with the thickness")
def test_contrast_that_falls_with_the_thickness(name, model, rng) -> None:
    truth, cube = case(name, rng)
    check(fit_thickness(cube, model), truth, widest=1.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "electrons", "seed"),
    [
        ("roughness 80 nm", 20_000, 41_016),
        ("one flat 2 nm off", 5_000, 41_105),
    ],
)
def test_fringes_that_no_pixel_shows_are_not_taken_for_those_of_a_flat_sensor(
    name, electrons, seed, model
) -> None:
    """What cells see, and single pixels do not: most of the map was wrong, with an uncertainty of 1 to 3 nm."""
    faint = replace(ROWS[name], contrast=0.05, electrons=electrons)
    result = fit_one(faint, seed, model, 128)[1]
    if result.masked < 1.0:
        assert result.wrong < 2.0 * result.foretold, str(result)
        assert result.own < 1.3, str(result)
        assert abs(result.common) < 4.0, str(result)


@pytest.mark.slow
def test_levels_of_amplifiers_do_not_take_the_fringes_of_an_edge(model) -> None:
    """Fringes of 1 % of the model's that hardly turn along an edge: its middle was off by up to 180 nm, unmasked."""
    faint = replace(ROWS["roughness 80 nm"], contrast=0.05, electrons=20_000)
    fitted, result = fit_one(faint, 41_016, model, 128)
    error = fitted.value - draw_map(np.random.default_rng(41_016), 128)
    medians = np.median(error[:, :16].reshape(8, 16, 16), axis=(1, 2))
    sigma = np.median(fitted.sigma[:, :16].reshape(8, 16, 16), axis=(1, 2))
    assert np.all(np.abs(medians) < 3.0 * sigma), f"{medians} {sigma}"
    assert result.wrong < result.foretold, str(result)
    assert result.masked < 0.05, str(result)


@pytest.mark.slow
@pytest.mark.rng("laboratory a step under an unknown contrast")
def test_a_step_in_the_layer_under_an_unknown_contrast(model, rng) -> None:
    """Two halves, neither of which can borrow its order from the other."""
    truth = HARD_MAPS["two_halves"](SHAPE)
    weak = model.with_effects({"contrast_loss.factor": 0.4})
    check(fit_thickness(relative_flats(truth, weak, rng), model), truth)


@pytest.mark.slow
@pytest.mark.rng("laboratory a flat with a wrong label is named")
def test_a_flat_with_a_wrong_label_is_named(model, rng) -> None:
    truth, cube = case("one flat 2 nm off", rng)
    fitted = fit_thickness(cube, model)
    check(fitted, truth)
    assert fitted.metadata["WORSTFLT"] == cube.wavelength_nm[6]


@pytest.mark.slow
@pytest.mark.rng("laboratory a flat with a wrong label is named")
def test_the_offset_of_a_wrong_label_is_right(model, rng) -> None:
    _, cube = case("one flat 2 nm off", rng)
    flats = fit_thickness(cube, model).flats
    assert flats is not None
    assert flats.offset_nm[6] == pytest.approx(2.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.rng("laboratory wavelengths that are off")
def test_wavelengths_that_are_off(model, rng) -> None:
    """All pixels share one error, which is as large as stated; about it they scatter as stated."""
    truth, cube = case("wavelengths 0.6 nm", rng)
    result = judge(fit_thickness(cube, model), truth)
    assert result.wrong < 1e-3, str(result)
    assert 0.85 < result.own < 1.15, str(result)
    assert abs(result.common) < 4.0, str(result)


@pytest.mark.slow
@pytest.mark.rng("laboratory the walk and the silicon take the default")
def test_the_walk_and_the_silicon_take_the_default(model, rng) -> None:
    truth, cube = case("contrast 0.13", rng)
    walk = fit_thickness(cube, model, "guo2022")
    assert walk.contrast is None
    joint = fit_thickness(cube, model, silicon=SiliconSearch())
    check(joint, truth)
    assert not joint.metadata["SIFIT"]
    assert "contrast" in joint.metadata["SIWHY"]


@pytest.mark.rng("laboratory a model that is held says that it does not fit")
def test_a_model_that_is_held_says_that_it_does_not_fit(model, rng) -> None:
    """Nothing free, fringes of an eighth: wrong, but not quietly."""
    _, cube = case("contrast 0.13", rng)
    assert fit_thickness(cube, model, nuisances=Nuisances()).metadata["MISFIT"] > 1.2
