"""The log marginal likelihood against a dense calculation, against pixels, and its gradient against differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from lsst.fringe_sim.algorithms.inference import (
    CellShape,
    Coordinate,
    Data,
    Forward,
    Point,
    Problem,
    coordinates_of,
    effect_columns,
    fit,
    in_best_orders,
    in_whole_orders,
    jumped,
    relaxed,
    with_free_contrast,
)
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.array([900.0, 930.0, 955.0, 970.0, 985.0])
SIDE = 10
BY_NAME = {effect.name: effect for effect in EFFECTS}


def field(y: np.ndarray, x: np.ndarray, part: float = 1.0) -> np.ndarray:
    """A curved thickness [µm] at places in pixels, or in units of so many pixels."""
    y, x = part * y, part * x
    return 14.0 + 0.035 * x + 0.02 * y + 0.0008 * x**2 - 0.0005 * x * y + 0.0004 * y**2


def forward_of(cell_px: int = 1, side: int = SIDE, part: float = 1.0) -> tuple[Forward, np.ndarray]:
    """Forward model of cells, and their thickness."""
    y = cell_px * np.arange(side) + 0.5 * (cell_px - 1.0)
    thickness = field(*np.meshgrid(y, y, indexing="ij"), part)
    geometry = ImageGeometry(
        (cell_px * side, cell_px * side), y, y, WAVELENGTHS, np.full(len(WAVELENGTHS), 20_000.0)
    )
    limits = (float(thickness.min()) - 0.3, float(thickness.max()) + 0.3)
    shape = CellShape.of_field(thickness, cell_px)
    return Forward(FringeModel.from_setup("ts8_e2v"), EFFECTS, geometry, shape, limits), thickness.ravel()


def point_of(rng: np.random.Generator, settings: dict[str, float], response: float = 0.003) -> Point:
    """A point near the best of noisy data that have the settings."""
    forward, thickness = forward_of()
    value = forward.predict(settings, thickness)[0]
    sigma = 0.005 * np.sqrt(value)
    data = Data(value + sigma * rng.standard_normal(value.shape), sigma**-2.0)
    problem = Problem(data, forward, thickness, response)
    return relaxed(problem.at({}, np.ones(len(WAVELENGTHS)), thickness))


LINE = np.stack([np.ones(len(WAVELENGTHS)), np.linspace(-1.0, 1.0, len(WAVELENGTHS))], axis=1)


@pytest.mark.rng("evidence of cells")
@pytest.mark.parametrize("shapes", [None, LINE[:, :1], LINE], ids=["free", "one factor", "a line"])
def test_evidence_is_that_of_a_dense_calculation(shapes: np.ndarray | None, rng: np.random.Generator) -> None:
    """Of levels that are free, and of levels that are known but for some shapes over the exposures."""
    point = point_of(rng, {})
    point = replace(point, problem=replace(point.problem, level_shapes=shapes))
    problem, waves, cells = point.problem, *point.value.shape
    columns = point.level_columns
    information, score = point.information(columns, columns), point.score(columns)
    ours = -point.linear_cost + 0.5 * score @ np.linalg.solve(information, score)
    ours -= 0.5 * np.linalg.slogdet(information)[1]
    # All levels, responses and thicknesses in one matrix.
    dense = np.zeros((waves * cells, waves + 2 * cells))
    for w in range(waves):
        for c in range(cells):
            row = w * cells + c
            root = np.sqrt(problem.data.weight[w, c])
            dense[row, w] = root * point.value[w, c]
            dense[row, waves + c] = root * point.levels[w] * point.value[w, c]
            dense[row, waves + cells + c] = root * point.levels[w] * point.slope[w, c]
    if shapes is not None:
        dense = np.hstack([dense[:, :waves] @ shapes, dense[:, waves:]])
        waves = shapes.shape[1]
    prior, pull = np.zeros(dense.shape[1]), np.zeros(dense.shape[1])
    prior[waves : waves + cells] = problem.response_sigma**-2
    prior[waves + cells : waves + 2 * cells] = problem.thickness_sigma_um**-2
    away = problem.thickness_um - point.thickness_um
    pull[waves + cells : waves + 2 * cells] = problem.thickness_sigma_um**-2 * away
    residual = point.residual.ravel()
    precision = dense.T @ dense + np.diag(prior)
    gradient = dense.T @ residual + pull
    energy = 0.5 * (residual @ residual + (away**2).sum() / problem.thickness_sigma_um**2)
    expected = -energy + 0.5 * gradient @ np.linalg.solve(precision, gradient)
    expected -= 0.5 * np.linalg.slogdet(precision)[1]
    expected -= cells * np.log(problem.response_sigma * problem.thickness_sigma_um)
    assert ours == pytest.approx(expected, rel=1e-8)


def with_best_cells(point: Point, settings: dict[str, float], levels: np.ndarray) -> Point:
    """The same levels and effects with the thickness of every cell at its best."""
    at = point.moved(levels, point.thickness_um, {**point.settings, **settings})
    for _ in range(12):
        columns = at.level_columns
        moved = at.followed_um(np.zeros(len(levels)), columns)
        at = at.moved(levels, at.thickness_um + moved)
    return at


@pytest.mark.rng("gradient of evidence")
@pytest.mark.parametrize(
    "key", ["bandwidth.fwhm", "wavelength_offset.offset", "illumination.gradient_x", "roughness.sigma"]
)
def test_gradients_are_differences(key: str, rng: np.random.Generator) -> None:
    # Gauss and Newton neglect the product of response and derivative.
    point = point_of(rng, {}, response=1e-5)
    name, _, parameter = key.partition(".")
    items = [
        item for item in coordinates_of(BY_NAME[name], point.problem.forward) if item.parameter == parameter
    ]
    (item,) = items
    start = item.null + 0.2 * item.scale
    at = with_best_cells(point, {key: start}, point.levels)
    columns = effect_columns(at, items)
    gradient = -(at.score(columns) - columns.log_det)[0]
    step = 0.01 * item.scale
    costs = [with_best_cells(at, {key: start + sign * step}, at.levels).cost for sign in (1.0, -1.0)]
    assert gradient == pytest.approx((costs[0] - costs[1]) / (2.0 * step), rel=2e-3, abs=0.02 / item.scale)


def offset_of_index(point: Point) -> Coordinate:
    """The index of the adhesive: with a lower one cells are thicker, and fringes nearly the same."""
    items = coordinates_of(BY_NAME["epoxy_index"], point.problem.forward)
    return next(item for item in items if item.parameter == "offset")


@pytest.mark.rng("index of the adhesive")
def test_thicker_cells_of_a_lower_index_are_no_likelier(rng: np.random.Generator) -> None:
    point = point_of(rng, {}, response=1e-5)
    item = offset_of_index(point)
    both = [
        with_best_cells(point, {item.key: sign * 0.02 * item.scale}, point.levels) for sign in (-1.0, 1.0)
    ]
    phase, amplitude, beside_energy = (
        np.diff([told(one) for one in both])[0]
        for told in (
            lambda one: one.problem.forward.log_phase(one.settings),
            lambda one: np.log(one.value.std(axis=1)).mean(),
            lambda one: one.cost - one.cell_energy.sum(),
        )
    )
    half = 0.5 * point.thickness_um.size
    assert phase > 0.0
    assert beside_energy == pytest.approx(half * amplitude, abs=0.15 * half * phase)


@pytest.mark.rng("derivative of the index")
def test_a_shift_of_the_phase_is_no_loss_of_contrast(rng: np.random.Generator) -> None:
    point = point_of(rng, {}, response=1e-5)
    item = offset_of_index(point)
    step = item.difference(item.null)
    up, down = (
        point.problem.forward.predict({item.key: sign * step}, point.thickness_um)[0] for sign in (1.0, -1.0)
    )
    # What the thickness does not follow is a thousandth of the column.
    expected = point.projected(point.whitened((up - down) / (2.0 * step)))
    found = point.projected(effect_columns(point, [item]).value[0])
    assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected)


@pytest.mark.rng("gradient of levels")
def test_gradients_of_levels_are_differences(rng: np.random.Generator) -> None:
    point = point_of(rng, {}, response=1e-5)
    at = with_best_cells(point, {}, point.levels + 0.001)
    gradient = -(at.score(at.level_columns) - at.level_columns.log_det)
    for wave, step in enumerate(2e-4 * np.eye(len(at.levels))):
        costs = [with_best_cells(at, {}, at.levels + sign * step).cost for sign in (1.0, -1.0)]
        assert gradient[wave] == pytest.approx((costs[0] - costs[1]) / 4e-4, rel=1e-3, abs=0.5)


@pytest.mark.rng("a fit finds it")
def test_fit_finds_what_is_there(rng: np.random.Generator) -> None:
    point = point_of(rng, {"bandwidth.fwhm": 2.9})
    items = coordinates_of(BY_NAME["bandwidth"], point.problem.forward)
    found, null = fit(("bandwidth",), items, point), fit((), (), point)
    assert abs(found.values[0] - 2.9) < 4.0 * np.sqrt(found.covariance[0, 0])
    assert np.sqrt(found.covariance[0, 0]) < 0.3
    assert found.log_evidence > null.log_evidence


def test_answer_does_not_depend_on_what_was_asked_before() -> None:
    forward, thickness = forward_of()
    first = forward.predict({"bandwidth.fwhm": 2.5}, thickness)[0]
    forward.predict({"wavelength_offset.offset": 3.0}, thickness + 0.25)
    fresh = forward_of()[0].predict({"bandwidth.fwhm": 2.5}, thickness)[0]
    assert np.array_equal(first, forward.predict({"bandwidth.fwhm": 2.5}, thickness)[0])
    assert np.array_equal(first, fresh)


@pytest.mark.parametrize("cell_px", [1, 2, 4])
def test_averages_in_cells_are_those_of_pixels(cell_px: int) -> None:
    # A cell sees an eighth of a fringe order, whatever its size.
    forward, thickness = forward_of(cell_px, 8, 1.0 / cell_px)
    value = forward.predict({}, thickness)[0]
    nodes, weights = np.polynomial.legendre.leggauss(6)
    centre = cell_px * (np.arange(8) + 0.5) - 0.5
    place = (centre[:, np.newaxis] + 0.5 * cell_px * nodes).ravel()
    fine = field(*np.meshgrid(place, place, indexing="ij"), 1.0 / cell_px)
    light = forward.model.system.flat_fields(WAVELENGTHS, 0.1)
    exact = forward.model.respond(light, fine, WAVELENGTHS).reshape(len(WAVELENGTHS), 8, 6, 8, 6)
    exact = np.einsum("wyaxb,a,b->wyx", exact, 0.5 * weights, 0.5 * weights).reshape(value.shape)
    level = (value * exact).sum(axis=1, keepdims=True) / (exact**2).sum(axis=1, keepdims=True)
    wrong = (value / level - exact) / exact.std(axis=1, keepdims=True)
    assert wrong.std() < 1e-4


@pytest.mark.parametrize(
    ("gap_nm", "blur_px", "most"),
    [(12.0, 0.0, 2e-3), (120.0, 0.0, 8e-3), (120.0, 0.1, 6e-3), (120.0, 0.5, 0.04)],
)
def test_cells_under_the_rim_of_an_island_are_those_of_pixels(
    gap_nm: float, blur_px: float, most: float
) -> None:
    # Each stack is seen at the thickness of its own part of the cell; at that of the whole cell both gaps err by
    # 0.02 and 0.14. A blur brings light over the rim.
    forward, thickness = forward_of(1, 24)
    settings = {"void.thickness": gap_nm, "void.centre_x": 11.3, "void.centre_y": 12.1, "void.radius": 5.6}
    value = forward.predict({**settings, "charge_diffusion.sigma": blur_px}, thickness)[0]
    parts = 40
    place = (np.arange(24 * parts) + 0.5) / parts - 0.5
    y, x = np.meshgrid(place, place, indexing="ij")
    inside = np.hypot(y - 12.1, x - 11.3) < 5.6
    ((_, void),) = forward.model.with_effects(settings, EFFECTS).islands
    exact = []
    for model in (forward.model, void):
        table = np.linspace(*forward.range_um, 1500)
        light = model.system.flat_fields(WAVELENGTHS, 0.1)
        response = model.respond(light, table, WAVELENGTHS)
        exact.append(np.stack([CubicSpline(table, own)(field(y, x)) for own in response]))
    mixed = np.where(inside, exact[1], exact[0])
    if blur_px:
        mixed = gaussian_filter(mixed, (0.0, blur_px * parts, blur_px * parts), mode="reflect")
    mixed = mixed.reshape(len(WAVELENGTHS), 24, parts, 24, parts).mean(axis=(2, 4)).reshape(value.shape)
    share = inside.reshape(24, parts, 24, parts).mean(axis=(1, 3)).ravel()
    reach = 1 + 2 * math.ceil(2.0 * blur_px)
    most_of, least_of = (
        each(share.reshape(24, 24), reach).ravel() for each in (maximum_filter, minimum_filter)
    )
    rim = (most_of > 0.0) & (least_of < 1.0)
    # A blur errs at edges.
    away = ~rim & np.pad(np.ones((18, 18), dtype=bool), 3, constant_values=not blur_px).ravel()
    level = (value * mixed)[:, away].sum(axis=1) / (mixed**2)[:, away].sum(axis=1)
    wrong = (value / level[:, np.newaxis] - mixed) / mixed.std(axis=1, keepdims=True)
    assert wrong[:, away].std() < (4e-3 if blur_px else 5e-4)
    assert wrong[:, rim].std() < most


@pytest.mark.parametrize(("blur_px", "side", "edge", "most"), [(0.8, SIDE, 3, 0.03), (2.0, 32, 8, 0.08)])
def test_a_blur_over_some_pixels_is_that_of_pixels(blur_px: float, side: int, edge: int, most: float) -> None:
    # The blur reaches over an eighth of an order, or most of one, and is mirrored at the edges of the sensor.
    forward, thickness = forward_of(1, side)
    value = forward.predict({"charge_diffusion.sigma": blur_px}, thickness)[0]
    parts = 9
    place = (np.arange(parts * side) + 0.5) / parts - 0.5
    light = forward.model.system.flat_fields(WAVELENGTHS, 0.1)
    fine = forward.model.respond(light, field(*np.meshgrid(place, place, indexing="ij")), WAVELENGTHS)
    fine = gaussian_filter(fine, (0.0, blur_px * parts, blur_px * parts), mode="reflect")
    exact = fine.reshape(len(WAVELENGTHS), side, parts, side, parts).mean(axis=(2, 4)).reshape(value.shape)
    level = (value * exact).sum(axis=1, keepdims=True) / (exact**2).sum(axis=1, keepdims=True)
    wrong = (value / level - exact) / exact.std(axis=1, keepdims=True)
    middle = wrong.reshape(-1, side, side)[:, edge:-edge, edge:-edge]
    assert wrong.std() < most
    assert middle.std() < 0.1 * most


@pytest.mark.rng("scores of noise")
def test_noise_of_the_thickness_imitates_no_contrast(rng: np.random.Generator) -> None:
    forward, thickness = forward_of()
    value, levels, sigma = forward.predict({}, thickness)[0], np.ones(len(WAVELENGTHS)), 0.02
    scores = []
    for _ in range(60):
        data = Data(value + sigma * rng.standard_normal(value.shape), np.full(value.shape, sigma**-2.0))
        point = with_best_cells(Problem(data, forward, thickness, 1e-5).at({}, levels, thickness), {}, levels)
        fringes = point.whitened(point.value - point.value.mean(axis=1, keepdims=True))
        column = point.columns(fringes[np.newaxis], np.zeros((1, *value.shape)))
        error = np.sqrt(point.information(column, column)[0, 0])
        scores.append([point.score(column)[0] / error, point.unbiased_score(column)[0] / error])
    plain, unbiased = np.mean(scores, axis=0) * np.sqrt(len(scores))
    assert plain > 3.0
    assert abs(unbiased) < 2.5


def test_thickness_follows_to_another_order() -> None:
    forward, thickness = forward_of()
    hidden = {"black_coating.thickness": 0.3}
    value = forward.predict(hidden, thickness)[0]
    data = Data(value, np.full(value.shape, 1e-3**-2.0))
    items = coordinates_of(BY_NAME["black_coating"], forward)
    problem = Problem(data, forward, thickness, 1e-5)
    # Without the coating, fringes of another order are the most like its own.
    start = relaxed(problem.at({}, np.ones(len(WAVELENGTHS)), thickness + 0.28), rounds=8)
    found = jumped(start, items, [0.3])
    assert np.abs(start.thickness_um - thickness).mean() > 0.2
    assert np.abs(found.thickness_um - thickness).max() < 1e-3


def test_cells_find_the_best_of_an_order() -> None:
    forward, thickness = forward_of()
    value = forward.predict({}, thickness)[0]
    problem = Problem(Data(value, np.full(value.shape, 1e-3**-2.0)), forward, thickness, 1e-5)
    away = 0.4 * forward.order_um * np.where(np.arange(thickness.size) % 2, 1.0, -1.0)
    point = problem.at({}, np.ones(len(WAVELENGTHS)), thickness + away)
    assert np.abs(in_best_orders(point).thickness_um - thickness).max() < 1e-4
    some = np.arange(thickness.size) < 30
    only = in_best_orders(point, some).thickness_um
    assert np.abs(only - thickness)[some].max() < 1e-4
    assert np.array_equal(only[~some], point.thickness_um[~some])


@pytest.mark.rng("contrast that is free")
def test_contrast_is_found_with_the_thickness(rng: np.random.Generator) -> None:
    forward, thickness = forward_of()
    value = replace(forward, contrast=0.2).predict({}, thickness)[0]
    data = Data(value + 1e-3 * rng.standard_normal(value.shape), np.full(value.shape, 1e-3**-2.0))
    first = thickness + 0.01 * rng.standard_normal(thickness.size)
    problem = Problem(data, forward, first, 1e-5)
    free = with_free_contrast(problem.at({}, np.ones(len(WAVELENGTHS)), first))
    plain = relaxed(problem.at({}, np.ones(len(WAVELENGTHS)), first), rounds=12)
    assert free.problem.forward.contrast == pytest.approx(0.2, rel=0.02)
    assert np.abs(free.thickness_um - thickness).std() < 0.004
    # With the contrast of the model the thickness goes to where the model has the weakest fringes.
    assert np.abs(plain.thickness_um - thickness).std() > 0.02


@pytest.mark.rng("cells that go back")
def test_cells_return_to_the_first_thickness(rng: np.random.Generator) -> None:
    forward, thickness = forward_of()
    value = forward.predict({}, thickness)[0]
    problem = Problem(Data(value, np.full(value.shape, 2e-3**-2.0)), forward, thickness, 1e-5)
    lost = thickness + forward.order_um * (rng.random(thickness.size) < 0.2)
    found = fit((), (), problem.at({}, np.ones(len(WAVELENGTHS)), lost))
    assert np.abs(found.point.thickness_um - thickness).max() < 1e-3


@pytest.mark.rng("a rough field")
@pytest.mark.parametrize("stated", [0.004, 0.008, 0.012, 0.03])
def test_slopes_of_a_rough_field_do_not_swing(stated: float, rng: np.random.Generator) -> None:
    y, x = np.mgrid[:32, :32] * 2.0
    smooth = 17.0 + 0.03 * x - 0.02 * y + 0.3 * np.cos(0.08 * x + 0.05 * y)
    rough = smooth + 0.012 * rng.standard_normal(smooth.shape)
    shape, exact = CellShape.of_field(rough, 2, stated), CellShape.of_field(smooth, 2)
    # The straight difference of two neighbours errs by 0.0085.
    assert (shape.gradient - exact.gradient).std() < 0.0085
    assert np.abs(shape.gradient).max() < 0.12


@pytest.mark.rng("whole orders")
@pytest.mark.parametrize("turns", ["none", "all", "parts"])
def test_all_and_parts_of_a_sensor_are_moved_by_whole_orders(turns: str, rng: np.random.Generator) -> None:
    forward, thickness = forward_of(side=24, part=0.5)
    value = forward.predict({}, thickness)[0]
    data = Data(value + 3e-3 * rng.standard_normal(value.shape), np.full(value.shape, 3e-3**-2.0))
    y, x = np.mgrid[:24, :24]
    parts = np.where((y < 7) & (x < 9), -1.0, 0.0)
    parts[12, 12] = 1.0
    wrong = {"none": np.zeros((24, 24)), "all": np.ones((24, 24)), "parts": parts}[turns].ravel()
    start = thickness + wrong * forward.order_um
    point = relaxed(Problem(data, forward, thickness, 1e-5).at({}, np.ones(len(WAVELENGTHS)), start))
    found = relaxed(in_whole_orders(point, 5.0))
    # Of single cells not all are sure.
    assert (np.abs(found.thickness_um - thickness) > 0.02).mean() < (0.005 if turns == "parts" else 1e-9)
    assert (found.cost < point.cost - 100.0) == (turns != "none")


@pytest.mark.rng("cells in false minima")
def test_a_cell_in_a_false_minimum_goes_where_its_neighbours_are(rng: np.random.Generator) -> None:
    """It is no whole order off, so that no move by orders leads it back; some lie at an edge or beside a mask."""
    few, thickness = forward_of(side=24, part=0.5)
    own, waves = few.geometry, np.arange(880.0, 991.0, 10.0)
    geometry = ImageGeometry(own.shape, own.y_px, own.x_px, waves, np.full(len(waves), 20_000.0))
    forward = Forward(few.model, EFFECTS, geometry, few.shape, (few.range_um[0] - 1.0, few.range_um[1] + 1.0))
    value = forward.predict({}, thickness)[0]
    weight = np.full((24, 24), 1e-3**-2.0)
    weight[9, 7:10] = 0.0
    data = Data(value + 1e-3 * rng.standard_normal(value.shape), np.tile(weight.ravel(), (len(waves), 1)))
    away = np.zeros((24, 24))
    away[::4, ::3] = -0.45 * forward.order_um
    start = thickness + away.ravel()
    point = Problem(data, forward, start, 1e-5).at({}, np.ones(len(waves)), start)
    for _ in range(12):
        point = point.moved(point.levels, point.thickness_um + np.clip(point.wanted_um, -0.05, 0.05))

    def orders_off(found: Point) -> np.ndarray:
        return (found.thickness_um - thickness)[data.seen] / forward.order_um

    between = np.abs(orders_off(point) - np.rint(orders_off(point))) > 0.2
    assert 5 < between.sum() < 40
    assert np.abs(orders_off(in_whole_orders(point, 5.0))).max() < 0.05
    known = replace(point, problem=replace(point.problem, known=True))
    assert in_whole_orders(known, 5.0) is known


@pytest.mark.parametrize(("exposures", "known", "left"), [(1, True, 99), (3, True, 197), (3, False, 97)])
def test_what_one_exposure_leaves_is_free(exposures: int, known: bool, left: int) -> None:
    """Its response cannot be told from its noise, so that a single frame of the sky tells of effects."""
    forward, thickness = forward_of(side=10)
    data = Data(np.ones((exposures, 100)), np.ones((exposures, 100)))
    assert Problem(data, forward, thickness, 1e-3, known=known).freedom == left
