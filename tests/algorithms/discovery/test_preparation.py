"""What a search begins with, what it finds, and what the part held out may not do."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import SearchOptions, Verdict, discover
from lsst.fringe_sim.algorithms.discovery.neighbour_order import in_order_of_neighbours
from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, _in_parts, prepare
from lsst.fringe_sim.algorithms.inference import CellShape
from lsst.fringe_sim.effects import known_effects
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

WAVELENGTHS = np.linspace(880.0, 990.0, 8)
SIDE = 32
ELECTRONS = 20_000.0


def cube_of(
    rng: np.random.Generator, effects: dict[str, float], side: int = SIDE, places: int = 1
) -> FringeCube:
    """Flats of a small sensor with photon noise; the optics are the package's own.

    Pixels see so many by so many places of their area.
    """
    y, x = (np.mgrid[: side * places, : side * places] + 0.5 - 0.5 * places) / (SIDE * places)
    thickness = 15.0 + 0.5 * x + 0.3 * y**2 - 0.2 * x * y
    model = FringeModel.from_setup("ts8_e2v", effects)
    light = model.system.flat_fields(WAVELENGTHS, 0.1)
    flats = model.respond(light, thickness, WAVELENGTHS)
    flats = flats.reshape(8, side, places, side, places).mean(axis=(2, 4))
    flats *= ELECTRONS / flats.mean(axis=(1, 2), keepdims=True)
    image = rng.poisson(flats).astype(np.float32)
    setup = model.setup
    rows = FlatExposures(
        WAVELENGTHS, np.full(8, setup.bandwidth_fwhm_nm), np.full(8, model.base_system.temperature_k)
    )
    return FringeCube(image, np.maximum(image, 1.0), np.zeros(image.shape, np.int32), rows, "electron")


def verdict_of(cube: FringeCube) -> Verdict:
    """What the search says of it."""
    return discover(cube, "ts8_e2v", rng=np.random.default_rng(5))


@pytest.mark.slow
@pytest.mark.rng("marginal null")
def test_nothing_is_found_where_nothing_is(rng: np.random.Generator) -> None:
    verdict = verdict_of(cube_of(rng, {}))
    assert verdict.verdict == "no_discrepancy"
    assert verdict.global_probability > 1e-3
    assert Verdict.from_json(verdict.to_json()).verdict == "no_discrepancy"


@pytest.mark.slow
@pytest.mark.parametrize("draw", ["marginal single ", *"abc"])
def test_an_effect_is_named(draw: str) -> None:
    rng = np.random.default_rng(list(draw.encode()))
    verdict = verdict_of(cube_of(rng, {"wavelength_offset.offset": 1.5}))
    assert verdict.verdict == "named"
    (found,) = verdict.effects
    assert "wavelength_offset" in (found.name, *found.ambiguous_with)


@pytest.mark.rng("marginal held out")
def test_selection_does_not_see_the_part_held_out(rng: np.random.Generator) -> None:
    cube = cube_of(rng, {})
    model = FringeModel.from_setup("ts8_e2v")
    effects = [effect for effect in known_effects(None) if not effect.sky_only]

    def prepared(cube: FringeCube):  # type: ignore[no-untyped-def]
        return prepare(cube, model, effects, SearchOptions(), np.random.default_rng(5))

    first = prepared(cube)
    held = first.unseen.seen
    assert 0.1 < held.mean() < 0.4
    assert not (held & first.cells.seen).any()
    planted = np.where(held, cube.image * (1.0 + 0.3 * rng.standard_normal(held.shape)), cube.image)
    second = prepared(replace(cube, image=planted.astype(np.float32)))
    assert np.array_equal(first.null.point.thickness_um, second.null.point.thickness_um)
    assert first.null.log_evidence == second.null.log_evidence


@pytest.mark.rng("weak fringes")
def test_cells_suit_a_contrast_that_is_not_known(rng: np.random.Generator) -> None:
    model = FringeModel.from_setup("ts8_e2v")
    effects = [effect for effect in known_effects(None) if not effect.sky_only]

    def prepared(contrast: float) -> Prepared:
        cube = cube_of(rng, {"contrast_loss.factor": contrast}, 64)
        return prepare(cube, model, effects, SearchOptions(), np.random.default_rng(5))

    plain, weak = prepared(1.0), prepared(0.1)
    assert plain.cells.cell_px == 1
    assert weak.cells.cell_px > 1
    for own, contrast in ((plain, 1.0), (weak, 0.1)):
        assert own.free.problem.forward.contrast == pytest.approx(contrast, rel=0.05)
        assert own.noise_factor == pytest.approx(1.0, abs=0.1)
        assert own.problem.forward.contrast == 1.0  # what is searched believes the model


@pytest.mark.rng("pixels")
@pytest.mark.parametrize("places", [1, 3])
def test_pixels_see_a_point_or_their_area_by_the_likelihood(places: int, rng: np.random.Generator) -> None:
    cube = cube_of(rng, {"contrast_loss.factor": 0.8}, 64, places)
    effects = [effect for effect in known_effects(None) if not effect.sky_only]
    model = FringeModel.from_setup("ts8_e2v")
    found = prepare(cube, model, effects, SearchOptions(), np.random.default_rng(5))
    assert found.problem.forward.shape.area == (places > 1)
    assert found.free.problem.forward.contrast == pytest.approx(0.8, abs=0.01)


def test_the_thickness_of_larger_cells_is_continued_within_them() -> None:
    """A surface of second degree is the same in cells of two pixels as in those of six."""

    def surface(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        return 14.0 + 0.03 * y - 0.02 * x + 1e-3 * y**2 + 3e-3 * y * x - 2e-3 * x**2

    large, small, parts = (4, 3), (13, 10), 3
    y, x = ((6.0 * places + 2.5).ravel() for places in np.indices(large))
    slope = np.stack([0.03 + 2e-3 * y + 3e-3 * x, -0.02 + 3e-3 * y - 4e-3 * x])
    bent = np.repeat([[2e-3], [3e-3], [-4e-3]], y.size, axis=1)
    seen = np.ones(large, dtype=bool)
    seen[1, 2] = False
    forward = SimpleNamespace(shape=CellShape(slope, bent, 6))
    point = SimpleNamespace(problem=SimpleNamespace(forward=forward), thickness_um=surface(y, x))
    larger = SimpleNamespace(free=point, cells=SimpleNamespace(cell_px=6, shape=(8, *large), seen=seen))
    smaller = SimpleNamespace(cells=SimpleNamespace(cell_px=2, shape=(8, *small)))
    thickness, shape, inside = _in_parts(larger, smaller)  # type: ignore[arg-type]
    expected = np.zeros(small, dtype=bool)
    expected[: 3 * large[0], : 3 * large[1]] = np.kron(seen, np.ones((parts, parts))) > 0.0
    np.testing.assert_array_equal(inside, expected.ravel())
    y, x = ((2.0 * places + 0.5).ravel()[inside] for places in np.indices(small))
    np.testing.assert_allclose(thickness[inside], surface(y, x), atol=1e-12)
    np.testing.assert_allclose(shape.gradient[0, inside], 0.03 + 2e-3 * y + 3e-3 * x, atol=1e-12)
    np.testing.assert_allclose(shape.gradient[1, inside], -0.02 + 3e-3 * y - 4e-3 * x, atol=1e-12)
    np.testing.assert_array_equal(shape.hessian[:, inside], bent[:, : inside.sum()][:, :1] + 0.0 * y)
    assert (shape.cell_px, shape.area) == (2, True)


@pytest.mark.parametrize("per_cell", [0.0, 0.3, 0.45])
def test_cells_at_a_rim_in_another_order_do_not_steepen_it(per_cell: float) -> None:
    """A sensor that is as steep as that, or not, keeps its thickness; cells beside a block without data come back."""
    order_um = 0.3
    y, x = np.mgrid[:16, :16]
    field = 15.0 + order_um * per_cell * (0.8 * y + 0.6 * x)
    seen = ~((y >= 8) & (x < 8))
    wrong = field.copy()
    wrong[9:12, 8] += order_um
    wrong[10, 9] += order_um
    found = in_order_of_neighbours(wrong, seen, order_um)
    np.testing.assert_allclose(found[seen], field[seen], atol=1e-9)


@pytest.mark.rng("a part of a sensor in another order")
@pytest.mark.parametrize("per_cell", [0.1, 0.35])
def test_a_part_of_a_sensor_in_another_order_comes_back(per_cell: float, rng: np.random.Generator) -> None:
    """Beside cells that have no data, with noise, and single cells in other orders; the rest stays."""
    order_um = 0.3
    y, x = np.mgrid[:24, :24]
    field = 15.0 + order_um * (per_cell * x + 0.004 * (y - 12) ** 2 + 0.05 * rng.standard_normal(x.shape))
    seen = ~((y >= 12) & (x < 8))
    wrong = field.copy()
    wrong[4:11, 9:16] += order_um
    wrong[20, 20] -= 2.0 * order_um
    wrong[2, 3] += order_um
    found = in_order_of_neighbours(wrong, seen, order_um)
    np.testing.assert_allclose(found[seen], field[seen], atol=1e-9)
    np.testing.assert_array_equal(found[~seen], field[~seen])


def test_half_an_order_on_an_island_is_kept() -> None:
    """What a thin gap does to the thickness is no other order."""
    order_um = 0.3
    y, x = np.mgrid[:16, :16]
    field = 15.0 + 0.4 * order_um * (np.hypot(y - 8, x - 8) < 3)
    everywhere = np.ones(field.shape, dtype=bool)
    found = in_order_of_neighbours(field, everywhere, order_um)
    np.testing.assert_array_equal(found, field)
