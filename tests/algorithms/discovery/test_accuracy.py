"""A disagreement that the tables of the model may make is said to be within its accuracy; no other is."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.accuracy import told_accuracy
from lsst.fringe_sim.algorithms.discovery.critics import judge, total_chance
from lsst.fringe_sim.algorithms.discovery.options import MODEL_ACCURACY, SearchOptions
from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, prepare
from lsst.fringe_sim.algorithms.discovery.telling import size_of
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.errors import OutOfRangeError
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import Medium
from lsst.fringe_sim.products.fringe_cube import FlatExposures, FringeCube

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
ELECTRONS = 3e7
RULES = SearchOptions()
OWN = [effect for effect in EFFECTS if not effect.sky_only]


def straight(medium: Medium) -> Medium:
    """Silicon whose constants run in straight lines between the entries of its table."""
    known = medium._index
    return replace(
        medium,
        _index=replace(
            known,
            n=lambda at: np.interp(at, known.n.x, known.n(known.n.x)),
            log_k=lambda at: np.interp(at, known.log_k.x, known.log_k(known.log_k.x)),
        ),
    )


def prepared_of(cube: FringeCube, setup: str) -> Prepared:
    return prepare(cube, FringeModel.from_setup(setup), OWN, RULES, np.random.default_rng(5))


def index_of(prepared: Prepared) -> np.ndarray:
    """Index of the layer that varies."""
    system, wavelength = prepared.problem.forward.model.system, prepared.cells.wavelength_nm
    medium = system.stack.layers[system.stack.position(system.varying)].medium
    return np.asarray(np.real(medium.index(wavelength, system.temperature_k)))


def chance_within(prepared: Prepared, accuracy: float) -> float:
    """Chance of what the unchanged model leaves where it may be wrong by so much."""
    null = prepared.null
    return float(told_accuracy(null, null, index_of(prepared), RULES, accuracy, 0.0)["chance"])


def of_straight_lines() -> Prepared:
    """Frames of thirty million electrons of a sensor whose silicon runs in straight lines between entries."""
    model = FringeModel.from_setup("ts8_e2v")
    system = model.base_system
    for layer in system.stack.layers:
        if layer.medium.is_silicon:
            system = system.with_layer(layer.name, medium=straight(layer.medium))
    rng = np.random.default_rng(3)
    thickness = random_field((48, 48), rng, mean=15.0, span=2.0)
    geometry = ImageGeometry.of_pixels((48, 48), WAVELENGTHS, ELECTRONS)
    image = ELECTRONS * replace(model, base_system=system).flat_image(thickness, geometry)
    difference = image / ELECTRONS - model.flat_image(thickness, geometry)
    assert np.sqrt((difference**2).mean()) == pytest.approx(7.5e-5, rel=0.1)
    noisy = (image + np.sqrt(image) * rng.standard_normal(image.shape)).astype(np.float32)
    twelve = np.ones(len(WAVELENGTHS))
    cube = FringeCube(
        noisy, image.astype(np.float32), np.zeros(image.shape, np.int16),
        FlatExposures(WAVELENGTHS, 2.0 * twelve, 183.15 * twelve), "electron",
    )  # fmt: skip
    return prepared_of(cube, "ts8_e2v")


@pytest.mark.slow
def test_straight_lines_between_entries_are_within_the_accuracy() -> None:
    """Beyond all noise, and a thousandth of the fringes."""
    prepared = of_straight_lines()
    assert total_chance(judge(prepared.null, prepared.null, index_of(prepared), RULES)) < 1e-9
    assert chance_within(prepared, MODEL_ACCURACY) > RULES.significance
    assert chance_within(prepared, 1e-6) < 1e-9


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True, reason="misfit of fringes of a few pixels is measured as noise, and nothing is left"
)
def test_the_size_of_what_straight_lines_leave_is_told() -> None:
    assert size_of(of_straight_lines())["of_fringes"] == pytest.approx(1.1e-3, rel=0.2)


@pytest.mark.slow
def test_what_is_no_error_of_a_table_is_not_within_it() -> None:
    for seed in range(1000):
        case = draw_case("outsider", np.random.default_rng(seed), size=(48, 48), only=["wandering_light"])
        if case.values["wandering_light.size"] > 0.004:
            break
    assert chance_within(prepared_of(case.cube, case.setup), MODEL_ACCURACY) < RULES.significance


def test_a_part_of_the_fringes_is_below_one() -> None:
    with pytest.raises(OutOfRangeError, match="model accuracy"):
        SearchOptions(model_accuracy=1.0)
