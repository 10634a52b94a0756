"""Noise of cells, fringe orders of the first thickness, and neighbouring minima."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.basis import SplineBasis
from lsst.fringe_sim.algorithms.discovery.fit import FEWEST_ITERATIONS, Problem, coordinates_of, fit_model
from lsst.fringe_sim.algorithms.discovery.forward import Forward
from lsst.fringe_sim.algorithms.discovery.selection import PRECISION, Selector, chance_of
from slow_cases import first_is_quick

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.discovery.cells import CellData, bin_cube, finest_useful_cell
from lsst.fringe_sim.algorithms.discovery.channels import Channel, State, echo_channel, measure_channels
from lsst.fringe_sim.algorithms.discovery.preparation import prepare, prepare_again
from lsst.fringe_sim.algorithms.discovery.start import _mend_patches, mended_thickness, starting_thickness
from lsst.fringe_sim.challenge import sealed_cases
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects import AMPLIFIERS, EFFECTS, ImageGeometry
from lsst.fringe_sim.mock.thickness import PixelArea, random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products.fringe_cube import FlatExposures, FringeCube
from lsst.fringe_sim.products.mask import mask_bits

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
ORDER_UM = 0.30


def _smooth_field(rows: int, columns: int) -> np.ndarray:
    v, u = np.mgrid[-1.0 : 1.0 : rows * 1j, -1.0 : 1.0 : columns * 1j]
    field: np.ndarray = 15.0 + 0.9 * u - 0.7 * v + 0.5 * u * v + 0.3 * np.sin(3.0 * u)
    return field


def _light(thickness: np.ndarray, settings: dict[str, float]) -> np.ndarray:
    """Relative flats, averaged over the pixels."""
    model = FringeModel.from_setup("ts8_e2v", settings)
    light = PixelArea.of(thickness).average(lambda each: model.response(each, WAVELENGTHS))
    return np.asarray(light / light.mean(axis=(1, 2), keepdims=True))


def _cube(thickness: np.ndarray, settings: dict[str, float], level: float, seed: int) -> FringeCube:
    light = level * _light(thickness, settings)
    counts = np.random.default_rng(seed).poisson(light).astype(np.float32)
    exposures = FlatExposures(WAVELENGTHS, np.array(2.0), np.array(183.15))
    return FringeCube(
        counts, np.maximum(counts, 1.0), np.zeros(counts.shape, np.int32), exposures, "electron"
    )


def _problem(cells: CellData, truth: np.ndarray) -> tuple[Problem, np.ndarray]:
    """A fit of some cells with a spline of four cells, and the coefficients of their true thickness."""
    forward = Forward.of_cells(FringeModel.from_setup("ts8_e2v"), EFFECTS, cells, (12.0, 18.0))
    basis = SplineBasis.of_grid(truth.shape, 4.0)
    return Problem(cells, forward, basis, np.eye(len(WAVELENGTHS))), basis.fit(truth, np.ones(truth.shape))


def test_variance_from_the_counts_no_longer_draws_a_mean_down() -> None:
    """Few electrons: weights from the counts themselves put a weighted mean one electron low."""
    level, shape = 60.0, (3, 200, 200)
    counts = np.random.default_rng(8).poisson(level, shape).astype(float)
    geometry = ImageGeometry.of_pixels(shape[1:], np.array([900.0, 930.0, 960.0]), level)
    cells = CellData(counts / level, level**2 / np.maximum(counts, 1.0), geometry, 1)
    even = cells.with_noise_of(np.ones(shape))

    def bias(data: CellData) -> float:
        return level * (float((data.weight * data.value).sum() / data.weight.sum()) - 1.0)

    assert bias(cells) == pytest.approx(-1.0, abs=0.15)
    assert abs(bias(even)) < 0.15
    assert 1.0 / even.weight.mean() == pytest.approx(1.0 / level, rel=0.03)


def test_variance_that_does_not_follow_the_counts_stays() -> None:
    shape = (2, 60, 60)
    rng = np.random.default_rng(3)
    variance = np.broadcast_to(np.linspace(0.5e-4, 2e-4, 60), shape)
    geometry = ImageGeometry.of_pixels(shape[1:], np.array([900.0, 960.0]), 1e4)
    cells = CellData(1.0 + np.sqrt(variance) * rng.standard_normal(shape), 1.0 / variance, geometry, 1)
    np.testing.assert_allclose(cells.with_noise_of(np.ones(shape)).weight, cells.weight, rtol=0.2)


def test_cells_without_data_stay_without() -> None:
    cells = bin_cube(_cube(_smooth_field(16, 16), {}, 2e4, 1), 1)
    holes = cells.restricted(np.arange(16) % 5 != 0)
    np.testing.assert_array_equal(holes.with_noise_of(holes.value).weight == 0.0, holes.weight == 0.0)


def test_patches_in_a_wrong_order_are_taken_back() -> None:
    """An edge, a corner, an island and single cells, by one order and by two."""
    truth = _smooth_field(48, 40)
    cells = bin_cube(_cube(truth, {}, 2e4, 5), 1)
    spoiled = truth.copy()
    spoiled[:4, 10:26] += ORDER_UM
    spoiled[:3, 13:20] += ORDER_UM
    spoiled[-5:, -6:] -= ORDER_UM
    spoiled[20:25, 18:22] -= ORDER_UM
    spoiled[33, 7] += ORDER_UM
    mended = mended_thickness(FringeModel.from_setup("ts8_e2v"), cells, spoiled)
    assert np.abs(mended - truth).max() < 0.5 * ORDER_UM


@pytest.mark.rng("halves of the same size are two patches")
def test_halves_of_the_same_size_are_two_patches(rng: np.random.Generator) -> None:
    """Neither is larger than the other, and neither small enough to be taken back."""
    steps = np.full((12, 20), 30)
    steps[:, 10:] += 29
    score = rng.random((steps.size, 100)).astype(np.float32)
    mended = _mend_patches(score, steps.ravel(), np.ones((12, 20), bool), 29.0)
    np.testing.assert_array_equal(mended, steps.ravel())


def test_a_patch_at_the_rim_of_the_data_hangs_on_nothing_beyond_it() -> None:
    """Below the rim a field without data comes down from the patch slowly, to where its surroundings are."""
    shape, order = (30, 40), 29
    seen = np.zeros(shape, bool)
    seen[4:-6, 4:-4] = True
    away = np.abs(np.arange(shape[1]) - 16)
    steps = np.full(shape, 30)
    steps[16:24, 14:19] += order
    steps[24:] += np.clip(order - 4 * (away - 2), 0, order)
    score = np.zeros((steps.size, 100), np.float32)
    score[:, 30], score[:, 30 + order] = 1.0, 0.99
    mended = _mend_patches(score, steps.ravel(), seen, float(order)).reshape(shape)
    assert (mended[seen] == 30).all()


@pytest.mark.rng("ragged patches are taken back by the surface around them")
def test_ragged_patches_are_taken_back_by_the_surface_around_them(rng: np.random.Generator) -> None:
    """Two of five cells of an area in the wrong order, without a border."""
    truth = _smooth_field(48, 48)
    cells = bin_cube(_cube(truth, {}, 5e4, 5), 1)
    wrong = np.zeros(truth.shape, dtype=bool)
    wrong[20:34, 22:40] = rng.random((14, 18)) < 0.4
    started = truth - 0.297 * wrong  # about an order
    mended = mended_thickness(FringeModel.from_setup("ts8_e2v"), cells, started)
    assert (np.abs(mended - truth) > 0.15).mean() < 0.002


@pytest.mark.parametrize("seed", first_is_quick(range(5)))
def test_a_sensor_of_less_than_a_fringe_has_levels_of_its_own(seed: int) -> None:
    """Its flats are not relative to the mean of a fringe, as those of a hundred pixels of a real sensor are not."""
    rng = np.random.default_rng(seed)
    truth = random_field(
        (64, 64), rng, mean=float(rng.uniform(12.5, 20.0)), span=float(rng.uniform(0.15, 0.3))
    )
    cells = bin_cube(_cube(truth, {}, 3e4, seed), 2)
    centres = truth.reshape(32, 2, 32, 2).mean(axis=(1, 3))
    found = starting_thickness(FringeModel.from_setup("ts8_e2v"), cells)
    assert (np.abs(found - centres) < 0.5 * ORDER_UM).mean() > 0.99


@pytest.mark.slow
def test_a_slope_of_a_fringe_in_four_cells_is_followed_upwards() -> None:
    """It grew downwards in half of this sensor, by nineteen orders, and the search called the rest unexplained."""
    part = np.random.default_rng([20261122, 0, 7]).spawn(2)[0]
    case = draw_case("none", part)
    assert np.hypot(*np.gradient(case.thickness_um)).max() > 0.085
    cells = bin_cube(case.cube, 1)
    found = starting_thickness(FringeModel.from_setup(case.setup), cells)
    assert (np.abs(found - case.thickness_um) < 0.15).mean() > 0.999


@pytest.mark.slow
def test_fringes_that_diffusion_takes_away_in_places_do_not_hide_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the fringes is left where the thickness is steep: without diffusion no field is right there."""

    def diffusion(rng: np.random.Generator) -> dict[str, float]:
        return {"charge_diffusion.sigma": 10.0 ** rng.uniform(-0.7, 0.5)}

    # A case of a challenge that went wrong, which drew from so many effects.
    monkeypatch.setattr(sealed_cases, "SIZES", {str(number): diffusion for number in range(37)})
    streams = np.random.default_rng([20270405, 1, 3]).spawn(2)
    case = draw_case("one", streams[0])
    assert case.values["charge_diffusion.sigma"] == pytest.approx(1.446, abs=1e-3)
    verdict = discover(case.cube, case.setup, rng=streams[1])
    assert [effect.name for effect in verdict.effects] == ["charge_diffusion"]
    (sigma,) = verdict.effects[0].parameters.values()
    assert abs(sigma.value - 1.4462) < 5.0 * sigma.sigma


def test_thickness_in_the_right_order_is_left_alone() -> None:
    truth = _smooth_field(40, 40)
    cells = bin_cube(_cube(truth, {}, 2e4, 6), 1)
    model = FringeModel.from_setup("ts8_e2v")
    np.testing.assert_array_equal(mended_thickness(model, cells, truth), truth)
    assert np.abs(starting_thickness(model, cells) - truth).max() < 0.5 * ORDER_UM


def test_a_surface_that_does_not_fit_a_small_sensor_takes_no_cell_out_of_its_order() -> None:
    """Its knots are as far apart as this sensor is wide; near its edges they are off by more than half an order."""
    truth = _smooth_field(16, 16)
    cells = bin_cube(_cube(truth, {}, 2e4, 5), 1)
    mended = mended_thickness(FringeModel.from_setup("ts8_e2v"), cells, truth)
    np.testing.assert_array_equal(mended, truth)


@pytest.mark.slow
def test_neighbouring_minima_are_in_the_uncertainty() -> None:
    """With a bandpass of 2 nm the silicon is known to 0.01 µm but for whole fringes of 0.13 µm."""
    case = draw_case("one", np.random.default_rng(5), size=(48, 48), only=["silicon_thickness"])
    model = FringeModel.from_setup(case.setup)
    catalogue = [effect for effect in EFFECTS if effect.name == "silicon_thickness"]
    cells = bin_cube(case.cube, 1).scaled_noise(math.sqrt(case.noise_factor), 0.0)
    truth = case.thickness_um
    basis = SplineBasis.of_grid(truth.shape, 4.0)
    forward = Forward.of_cells(model, catalogue, cells, (float(truth.min()) - 0.5, float(truth.max()) + 0.5))
    problem = Problem(cells, forward, basis, np.eye(len(cells.value)))
    start = basis.fit(truth, np.ones(truth.shape))
    null = fit_model(problem, (), np.zeros(0), start)
    selector = Selector(problem, catalogue, null, np.full(len(cells.value), 1.6))
    hidden = case.values["silicon_thickness.offset"]
    (coordinate,) = selector.coordinates["silicon_thickness"]
    fit = fit_model(problem, (coordinate,), np.array([hidden]), start, null.levels)
    first = replace(selector.null, names=("silicon_thickness",), fit=fit)
    settled = selector.settled(first)
    assert settled.fit.chi2 <= fit.chi2
    assert fit.sigma[0] < 0.05
    assert settled.fit.sigma[0] >= math.hypot(*fit.spread, 0.9 * fit.sigma[0])
    assert abs(settled.fit.position[0] - hidden) < 4.0 * settled.fit.sigma[0]


def test_a_residual_of_known_size_is_not_called_noise_by_mistake() -> None:
    """What the description of an effect may be wrong by raises the chance of a residual, and nothing else."""
    cells = bin_cube(_cube(_smooth_field(20, 20), {"contrast_loss.factor": 0.97}, 2e4, 9), 1)
    problem, start = _problem(cells, _smooth_field(20, 20))
    null = fit_model(problem, (), np.zeros(0), start)
    selector = Selector(problem, EFFECTS[:1], null, np.full(len(WAVELENGTHS), 1.6))
    state = selector.state(null)
    strict, lenient = (
        {c.name: c.probability for c in measure_channels(state, cells.geometry, selector.index, size)}
        for size in (0.0, 1e5)
    )
    assert strict["thickness phase"] < 1e-6
    assert lenient.pop("thickness phase") > 0.99
    assert lenient == {name: chance for name, chance in strict.items() if name != "thickness phase"}


def test_a_fit_far_behind_gives_up_and_one_that_is_near_does_not() -> None:
    """Thicker silicon in place of a wide bandpass: hopeless beside the right effect, converged beside its own fit."""
    truth = _smooth_field(24, 24)
    cells = bin_cube(_cube(truth, {"bandwidth.fwhm": 4.0}, 2e5, 11), 1)
    problem, start = _problem(cells, truth)
    right, wrong = (
        coordinates_of(next(effect for effect in EFFECTS if effect.name == name), problem.forward, truth)
        for name in ("bandwidth", "silicon_thickness")
    )
    rival = fit_model(problem, right, np.array([0.1]), start).chi2
    free = fit_model(problem, wrong, np.array([0.6]), start)
    near = fit_model(problem, wrong, np.array([0.6]), start, rival=free.chi2 - 50.0)
    behind = fit_model(problem, wrong, np.array([0.6]), start, rival=rival)
    assert free.converged
    assert near.chi2 == free.chi2
    assert FEWEST_ITERATIONS <= behind.iterations < free.iterations
    assert not behind.converged
    assert free.chi2 <= behind.chi2 < free.chi2 + 0.05 * (free.chi2 - rival)


@pytest.mark.slow
def test_cells_of_a_large_sensor_are_found_plane_by_plane() -> None:
    """The size of the cells and the memory that finding it takes: a few planes, not the whole cube again."""
    rows, columns = 512, 480
    v, u = np.mgrid[-1.0 : 1.0 : rows * 1j, -1.0 : 1.0 : columns * 1j]
    cube = _cube(15.0 + 0.9 * u - 0.7 * v, {}, 2e4, 3)
    plane = 8 * rows * columns
    tracemalloc.start()
    try:
        size = finest_useful_cell(cube, most_cells=20_000)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert size == 8
    assert peak < 12 * plane
    cells = bin_cube(cube, size)
    expected = cube.image[3].astype(float).reshape(rows // 8, 8, columns // 8, 8).mean(axis=(1, 3))
    np.testing.assert_allclose(cells.value[3], expected / cube.image[3].mean(dtype=float), rtol=1e-12)


def test_an_offset_is_a_part_of_flats_that_another_effect_has_made_weaker() -> None:
    """A warm sensor detects more at 990 nm; an offset is then less of the light, but as much of the data."""
    truth, level = _smooth_field(64, 64), 2e4
    settings = {"temperature.kelvin": 204.0, "amplifier_offset.C03": 400.0, "amplifier_offset.C12": -600.0}
    cube = _cube(truth, {}, level, 1)
    cells = bin_cube(cube, 1)
    model = FringeModel.from_setup("ts8_e2v")
    forward = Forward.of_cells(model, EFFECTS, cells, (float(truth.min()) - 0.5, float(truth.max()) + 0.5))
    counts = level * _light(truth, {"temperature.kelvin": 204.0})
    amplifier = cells.geometry.amplifier
    counts += 400.0 * (amplifier == AMPLIFIERS.index("C03")) - 600.0 * (amplifier == AMPLIFIERS.index("C12"))
    forward.predict({}, truth)  # the search begins with the unchanged model
    ratio = counts / forward.predict(settings, truth).value
    ratio /= ratio.mean(axis=(1, 2), keepdims=True)
    edge = (
        slice(None),
        slice(2, -2),
        slice(2, -2),
    )  # the thickness within a cell is taken from its neighbours
    assert np.abs(ratio[edge] - 1.0).max() < 0.03 * 600.0 / level


@pytest.mark.slow
def test_the_second_judgement_starts_where_the_first_ended() -> None:
    """An index 5 % off moves the thickness by two orders; the unchanged model is not left in the wrong one."""
    truth = _smooth_field(48, 48)
    cube = _cube(truth, {"epoxy_index.offset": -0.073}, 5e4, 5)
    catalogue = [effect for effect in EFFECTS if effect.name == "epoxy_index"]
    first = prepare(cube, FringeModel.from_setup("ts8_e2v"), catalogue, 20_000)
    selector = Selector(
        first.problem, catalogue, first.null, first.index, first_field=first.undistorted_field
    )
    found = selector.hypothesis(("epoxy_index",)).fit
    assert found.settings["epoxy_index.offset"] == pytest.approx(-0.073, abs=0.01)
    stated = replace(first, noise=replace(first.noise, factor=1.1 * first.noise.factor))
    second, mended = prepare_again(stated, found, first.problem.basis.expand(found.field))
    assert second is not None
    assert mended == 0
    assert second.null.chi2 < 1.05 * first.null.chi2
    assert second.guess == found.settings
    again = Selector(
        second.problem, catalogue, second.null, second.index, first_field=second.undistorted_field,
        guess=second.guess,
    ).hypothesis(("epoxy_index",)).fit  # fmt: skip
    assert again.settings["epoxy_index.offset"] == pytest.approx(-0.073, abs=0.003)


def test_cells_beside_cells_without_data_do_not_lean_on_them() -> None:
    """The thickness of cells without data is anything; frames of real sensors have a rim of them."""
    truth = _smooth_field(24, 24)
    cube = _cube(np.kron(truth, np.ones((2, 2))), {}, 2e4, 2)
    mask = np.zeros(cube.shape, np.int32)
    mask[:, :4] = mask_bits("EDGE")
    cells = bin_cube(replace(cube, mask=mask), 2)
    forward = Forward.of_cells(FringeModel.from_setup("ts8_e2v"), EFFECTS, cells, (12.0, 19.0))
    wild = truth.copy()
    wild[:2] = 1e30
    tame, other = (forward.predict({}, field).value[:, 2:] for field in (truth, wild))
    np.testing.assert_array_equal(tame, other)


def test_what_the_description_lacks_counts_on_whole_sensors_alone() -> None:
    """A gain of 23 in χ² is a discovery of a weak effect in a small image, and none where fringes have S/N 90 000."""
    assert chance_of(23.0, 1, 0.05) < 1e-5
    assert chance_of(23.0, 1, PRECISION**2 * 9e4**2) > 0.3
    assert chance_of(23.0, 1, 0.0) == pytest.approx(1.6e-6, rel=0.1)
    cells = bin_cube(_cube(_smooth_field(32, 32), {}, 2e4, 4), 1)
    start = _smooth_field(32, 32)
    forward = Forward.of_cells(FringeModel.from_setup("ts8_e2v"), EFFECTS[:3], cells, (12.0, 18.0))
    basis = SplineBasis.of_grid(start.shape, 4.0)
    problem = Problem(cells, forward, basis, np.eye(len(WAVELENGTHS)))
    null = fit_model(problem, (), np.zeros(0), basis.fit(start, np.ones(start.shape)))
    selector = Selector(problem, EFFECTS[:3], null, np.full(len(WAVELENGTHS), 1.6))
    fringes = cells.value - cells.value.mean(axis=(1, 2), keepdims=True)
    energy = float((cells.weight * fringes**2).sum())
    optical = next(name for name in selector.coordinates if not forward.is_image_effect(name))
    assert selector.undescribed(optical) == pytest.approx(PRECISION**2 * energy, rel=0.2)
    assert selector.undescribed(optical) < 0.5


def test_a_table_of_moved_wavelengths_is_that_of_a_fresh_model() -> None:
    """Rows of exposures that stay where they are may come from before."""
    model = FringeModel.from_setup("ts8_e2v")
    geometry = ImageGeometry.of_pixels((4, 4), WAVELENGTHS, 20_000.0)
    forward = Forward(model, EFFECTS, geometry, 1, (14.0, 16.0))
    forward.table({"temperature.kelvin": 190.0})
    settings = {"temperature.kelvin": 190.0, "wavelength_jitter.at_930": 0.4}
    moved = forward.table(settings)
    fresh = Forward(model, EFFECTS, geometry, 1, (14.0, 16.0)).table(settings)
    np.testing.assert_allclose(moved, fresh, rtol=0.0, atol=1e-9)


@pytest.mark.rng("changes are differences of predictions")
def test_changes_are_differences_of_predictions(rng: np.random.Generator) -> None:
    """Whatever was asked before: another thickness, pixels that are lost, a map known less well."""
    centroid = 0.2 * rng.standard_normal((2, len(WAVELENGTHS), 12, 16))
    geometry = ImageGeometry.of_pixels((12, 16), WAVELENGTHS, 20_000.0)
    forward = Forward(FringeModel.from_setup("ts8_e2v"), EFFECTS, geometry, 1, (14.0, 16.0), centroid)
    first, second = 15.0 + 0.3 * _smooth_field(12, 16) / 15.0, 14.8 + 0.02 * rng.standard_normal((12, 16))
    gain, offset = {"amplifier_gain.C03": 0.01}, {"amplifier_offset.C11": 40.0}
    beam = {**gain, "tilt.angle": 12.0}
    void = {"void.thickness": 200.0, "void.centre_x": 8.3, "void.centre_y": 5.1, "void.radius": 3.7}
    for thickness, scatter in (
        (first, None),
        (second, None),
        (second, np.full((12, 16), 2e-4)),
        (first, None),
    ):
        forward.scatter_um2 = scatter
        for before, after in (
            ({}, gain),
            (gain, beam),
            (beam, offset),
            (gain, offset),
            (void, {**void, **gain}),
            ({**void, **beam}, {**void, **offset}),
            ({**void, **gain}, {**void, "void.centre_x": 8.9, **gain}),
            (void, {**void, "void.thickness": 100.0}),
            (gain, {**void, **gain}),
        ):
            seen = [forward.predict(settings, thickness).value for settings in (before, after)]
            changed = forward.change(before, after, thickness)
            np.testing.assert_allclose(changed, seen[1] - seen[0], rtol=0.0, atol=1e-13)
            assert np.abs(changed).max() > 1e-4
    forward.cover(first + 2.0)  # other tables
    seen = [forward.predict(settings, first).value for settings in (void, {**void, **gain})]
    np.testing.assert_array_equal(forward.change(void, {**void, **gain}, first), seen[1] - seen[0])


def test_only_parameters_of_exposures_that_there_are_are_free() -> None:
    effect = next(effect for effect in EFFECTS if effect.name == "wavelength_jitter")
    thickness = np.full((4, 4), 15.0)
    for waves, names in (
        ([890.0, 930.0], ["at_890", "at_930"]),
        ([884.0], ["at_880", "at_890"]),
        ([780.0, 1100.0], ["at_800", "at_1050"]),
    ):
        geometry = ImageGeometry.of_pixels((4, 4), np.array(waves), 20_000.0)
        forward = Forward(FringeModel.from_setup("ts8_e2v"), EFFECTS, geometry, 1, (14.0, 16.0))
        assert [item.parameter for item in coordinates_of(effect, forward, thickness)] == names


def _state_without_effects() -> State:
    truth = _smooth_field(32, 32)
    cells = bin_cube(_cube(truth, {}, 2e4, 5), 1)
    problem, start = _problem(cells, truth)
    null = fit_model(problem, (), np.zeros(0), start)
    return Selector(problem, EFFECTS[:1], null, np.full(len(WAVELENGTHS), 1.6)).state(null)


def test_a_misfit_of_the_field_is_no_echo() -> None:
    """What a thickness can do leaves the test for copies as it is; a faint mirrored copy is seen all the same."""
    state = _state_without_effects()
    plain = echo_channel(state)
    assert plain.probability > 1e-3
    bumps = 0.02 * np.cos(np.arange(32) / 3.0) * np.ones((32, 1))
    bent = replace(state, residual=state.residual + state.design.slope * bumps)
    assert echo_channel(bent).statistic == pytest.approx(plain.statistic)
    copy = 0.1 * state.whiten(state.value - 1.0)[:, ::-1, ::-1]  # type: ignore[operator]
    assert echo_channel(replace(state, residual=state.residual + copy)).probability < 1e-6


def test_a_faint_copy_mirrored_about_the_middle_is_an_echo() -> None:
    """Of the same χ², a copy where reflections along the axis fall is seen, and one moved aside is not."""
    state = _state_without_effects()
    pattern = state.value - state.value.mean(axis=(1, 2), keepdims=True)

    def channel_of(copy: np.ndarray) -> Channel:
        one = replace(state, residual=state.whiten(copy))
        faint = np.sqrt(22.0 / echo_channel(one).statistic)
        return echo_channel(replace(state, residual=faint * one.residual))

    mirrored, aside = (
        channel_of(copy) for copy in (pattern[:, ::-1, ::-1], np.roll(pattern[:, ::-1, ::-1], 9, axis=1))
    )
    assert mirrored.statistic == pytest.approx(22.0) == aside.statistic
    assert mirrored.probability < 1e-4 < 1e-3 < aside.probability


@pytest.mark.rng("a window keeps places and levels")
def test_a_window_keeps_places_and_levels(rng: np.random.Generator) -> None:
    """A part of a sensor is seen where it lies: the same amplifiers, the same distance from the middle."""
    case = draw_case("none", rng, size=(96, 128))
    cells = bin_cube(case.cube, 2)
    part = cells.window(slice(10, 40), slice(20, 60))
    assert part.shape == (cells.shape[0], 30, 40)
    np.testing.assert_array_equal(part.value, cells.value[:, 10:40, 20:60])
    np.testing.assert_array_equal(part.geometry.u, cells.geometry.u[:, 20:60])
    np.testing.assert_array_equal(part.geometry.v, cells.geometry.v[10:40])
    np.testing.assert_array_equal(part.geometry.amplifier, cells.geometry.amplifier[10:40, 20:60])
    np.testing.assert_array_equal(part.geometry.level_e, cells.geometry.level_e)


@pytest.mark.slow
def test_where_fringes_are_narrow_a_part_is_searched_and_that_is_said() -> None:
    """Fringes of six pixels forbid larger cells, and a search of them all would take too long."""
    v, u = np.mgrid[-1.0 : 1.0 : 100 * 1j, -1.0 : 1.0 : 200 * 1j]
    thickness = 15.0 + 4.5 * u + 0.3 * v
    cube, model = _cube(thickness, {}, 30_000.0, 5), FringeModel.from_setup("ts8_e2v")
    prepared = prepare(cube, model, EFFECTS[:3], 4000)
    assert prepared.stated.cell_px == 1
    assert prepared.stated.shape == (12, 96, 83)
    assert any("searched in rows 2 to 97 and columns 58 to 140" in note for note in prepared.notes)
    found = prepared.problem.basis.expand(prepared.null.field)
    np.testing.assert_allclose(found, thickness[2:98, 58:141], atol=0.02)
    assert prepare(cube, model, EFFECTS[:3], 20_000).stated.shape == (12, 100, 200)


@pytest.mark.parametrize("far_um", [(-1.3, 0.0), (0.0, 2.1), (-0.7, 0.9), (-5.0, 0.0)])
def test_what_is_predicted_does_not_depend_on_what_was_asked_before(far_um: tuple[float, float]) -> None:
    """Tables that grow for another fit keep levels and fringes; so do copies with pixels of another kind."""
    model = FringeModel.from_setup("ts8_e2v")
    geometry = ImageGeometry.of_pixels((4, 5), np.array([900.0, 960.0]), 20_000.0)
    settings = {"bandwidth.fwhm": 2.4, "ghost_pedestal.fraction": 0.02}
    field = np.linspace(14.2, 15.7, 20).reshape(4, 5)
    fresh, asked = (Forward(model, EFFECTS, geometry, 1, (14.0, 16.0)) for _ in range(2))
    asked.cover(np.array([14.0 + far_um[0], 16.0 + far_um[1]]))
    before = fresh.predict(settings, field)
    for forward in (asked, asked.with_places(1).with_places(0)):
        after = forward.predict(settings, field)
        np.testing.assert_allclose(after.value, before.value, rtol=1e-8)
        np.testing.assert_allclose(after.slope, before.slope, rtol=1e-6, atol=1e-6)
    tables = asked.range_um
    asked.cover(np.array([14.0 + far_um[0], 16.0 + far_um[1]]))
    assert asked.range_um == tables
