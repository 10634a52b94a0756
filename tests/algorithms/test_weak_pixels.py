"""Pixels that do not tell their thickness by themselves lean on the cells around them, as far as the flats allow."""

from dataclasses import replace

import numpy as np
import pytest
from laboratory_flats import ROWS, judge, make_flats

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit import FlatTemplates
from lsst.fringe_sim.algorithms.thickness_fit.cells import Cells
from lsst.fringe_sim.algorithms.thickness_fit.leaning import Leanings, local_variance
from lsst.fringe_sim.algorithms.thickness_fit.local_surface import local_surface
from lsst.fringe_sim.algorithms.thickness_fit.pixels import CellSurface
from lsst.fringe_sim.algorithms.thickness_fit.posterior import nodes_about, share_apart
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel

ORDER_UM = 0.3


def chi2_of(measured_um: np.ndarray, noise_um: float) -> np.ndarray:
    """Chi-square of pixels at the nodes, of a measured thickness about the surface."""
    return ((nodes_about(ORDER_UM) - measured_um[:, np.newaxis]) / noise_um) ** 2


@pytest.mark.rng("weak pixels that lie apart")
def test_share_of_pixels_that_lie_apart_is_learned(rng) -> None:
    number, noise, width = 20_000, 0.01, 0.004
    away = np.where(
        rng.random(number) < 0.1, rng.uniform(-0.15, 0.15, number), width * rng.standard_normal(number)
    )
    seen = away + noise * rng.standard_normal(number)
    found = share_apart(chi2_of(seen, noise), np.full(number, width), ORDER_UM)
    assert found == pytest.approx(0.1, abs=0.02)
    on_it = width * rng.standard_normal(number) + noise * rng.standard_normal(number)
    assert share_apart(chi2_of(on_it, noise), np.full(number, width), ORDER_UM) < 1e-3


def leanings(away: np.ndarray, noise: float) -> Leanings:
    """Sums over cells of 8 by 8 pixels that were measured ``away`` from the surface, with that noise."""
    shape = (away.shape[0] // 8, 8, away.shape[1] // 8, 8)
    number, known = np.full(shape[::2], 64.0), np.full(shape[::2], 64.0 / noise**2)
    blocks = away.reshape(shape)
    return Leanings(
        number, blocks.sum(axis=(1, 3)) / noise**2, known, (blocks**2).sum(axis=(1, 3)) / noise**2
    )


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.rng("weak pixels that leave the surface in one place")
def test_width_is_that_of_the_place(together, rng) -> None:
    """A quarter of the sensor leaves the surface by 12, its cells or its pixels by themselves; noise is 11."""
    noise, width = 11.0, 12.0
    each = (
        np.kron(rng.standard_normal((16, 16)), np.ones((8, 8)))
        if together
        else rng.standard_normal((128, 128))
    )
    layer = np.zeros((128, 128))
    layer[:64, :64] = width * each[:64, :64]
    seen = leanings(layer + noise * rng.standard_normal(layer.shape), noise)
    found = np.sqrt(local_variance(seen, np.zeros((16, 16)), (0.7, 150.0)))
    assert np.sqrt(np.mean(found[:8, :8] ** 2)) == pytest.approx(width, rel=0.25)
    assert np.sqrt(np.mean(found[9:, 9:] ** 2)) < 1.5


@pytest.mark.rng("weak pixels whose scatter noise hides")
def test_scatter_that_noise_hides_is_no_width(rng) -> None:
    """Pixels of 256 cells might scatter by 4 beyond a noise of 90, which neither shows nor excludes it."""
    away = 90.0 * rng.standard_normal((128, 128))
    away -= np.kron(away.reshape(16, 8, 16, 8).mean(axis=(1, 3)), np.ones((8, 8)))
    found = np.sqrt(local_variance(leanings(away, 90.0), np.zeros((16, 16)), (0.7, 150.0)))
    assert np.sqrt(np.mean(found**2)) < 2.0


@pytest.mark.rng("weak pixels noise of the surface")
def test_noise_of_the_surface_is_no_width(rng) -> None:
    """Cells are off by as much as the noise of their surface says."""
    noise, surface = 11.0, 4.0
    away = np.kron(surface * rng.standard_normal((32, 32)), np.ones((8, 8))) + noise * rng.standard_normal(
        (256, 256)
    )
    told, untold = (
        np.sqrt(np.mean(local_variance(leanings(away, noise), np.full((32, 32), known**2), (0.7, 150.0))))
        for known in (surface, 0.0)
    )
    assert told < 1.5
    assert untold == pytest.approx(surface, rel=0.2)


@pytest.mark.rng("weak pixels of smoothed noise")
def test_noise_that_neighbours_share_is_no_width(rng) -> None:
    """Noise that is the same in blocks of 4 by 4 pixels."""
    noise = 11.0
    away = noise * np.kron(rng.standard_normal((64, 64)), np.ones((4, 4)))
    ignored, known = (
        np.sqrt(
            np.mean(local_variance(leanings(away, noise), np.zeros((32, 32)), (0.7, 150.0), independence))
        )
        for independence in (1.0, 1.0 / 16.0)
    )
    assert known < 2.0
    assert ignored > 1.5 * known


@pytest.mark.rng("weak pixels cells beyond a crest")
def test_cells_beyond_a_crest_come_back(rng) -> None:
    """Cells whose mean amplitudes are alike at two thicknesses, a chain of them solved on the other side."""
    step, order, noise = 0.001, 0.3, 0.02
    grid = 14.0 + step * np.arange(1500)
    wavelength = np.array([930.0, 931.0, 932.0])
    fringes = 0.1 * np.cos(2.0 * np.pi * np.outer(grid, 930.0 / wavelength) / order)
    templates = FlatTemplates(1.0 + fringes, grid[0], step, wavelength)
    y, x = np.indices((16, 16))
    truth = 14.6 + 0.02 * (x - 7.5) + 0.004 * y
    crest = order * np.rint(truth / order)
    solved = np.where(np.abs(truth - crest) < 0.02, 2.0 * crest - truth, truth)
    edges = 8 * np.arange(17)
    value, weight = (np.zeros((16, 16, 8), np.float32) for _ in range(2))
    sigma = noise / 8.0
    amplitude = templates.amplitude_at(truth.ravel()).T.reshape(16, 16, 3)
    value[..., :3] = amplitude + sigma * rng.standard_normal(amplitude.shape)
    weight[..., :3] = sigma**-2.0
    cells = Cells(value, weight, np.zeros_like(value), np.zeros_like(value), edges, edges)
    flat, every = np.zeros((16, 16), np.float32), np.ones((16, 16), bool)
    surface = CellSurface(
        solved.astype(np.float32),
        flat,
        flat,
        cells.y_centre,
        cells.x_centre,
        every,
        every,
        flat + np.float32(0.002),
    )
    found = local_surface(surface, cells, templates, every, order)
    assert np.abs(solved - truth).max() > 0.03
    assert np.abs(found.terms[..., 0] - truth).max() < 0.006
    pull = (found.terms[..., 0] - truth) / found.sigma_um
    assert 0.5 < np.sqrt(np.mean(pull**2)) < 1.5


def cells_of(truth: np.ndarray, noise: float, rng: np.random.Generator) -> tuple[Cells, FlatTemplates]:
    """Cells of 8 by 8 pixels with fringes at three wavelengths that never have their crests together."""
    grid = 14.0 + 0.001 * np.arange(1500)
    phase = 2.0 * np.pi * grid[:, None] / ORDER_UM + np.array([0.0, 2.0, 4.0])
    templates = FlatTemplates(1.0 + 0.1 * np.cos(phase), 14.0, 0.001, np.array([930.0, 931.0, 932.0]))
    edges = 8 * np.arange(len(truth) + 1)
    value, weight = (np.zeros((*truth.shape, 8), np.float32) for _ in range(2))
    amplitude = templates.amplitude_at(truth.ravel()).T.reshape(*truth.shape, 3)
    value[..., :3] = amplitude + noise * rng.standard_normal(amplitude.shape)
    weight[..., :3] = noise**-2.0
    return Cells(value, weight, np.zeros_like(value), np.zeros_like(value), edges, edges), templates


@pytest.mark.parametrize("step_um", [0.0, 0.045])
@pytest.mark.rng("weak pixels surface across a step")
def test_a_surface_across_a_step_is_believed_less(step_um, rng) -> None:
    """A step of 0.15 orders, as large as six times what noise does to a cell, and none."""
    y, x = np.indices((24, 24))
    beside = np.abs(x - 11.5) < 1.0
    truth = 14.6 + 0.004 * y + step_um * (x > 11.5)
    cells, templates = cells_of(truth, 0.02, rng)
    flat, every = np.zeros(truth.shape, np.float32), np.ones(truth.shape, bool)
    known = flat + np.float32(0.0075)
    at = (cells.y_centre, cells.x_centre)
    surface = CellSurface(truth.astype(np.float32), flat, flat, *at, every, every, known)
    found = local_surface(surface, cells, templates, every, ORDER_UM)
    error, inside = found.terms[..., 0] - truth, (y > 1) & (y < 22)
    pulls = [np.sqrt(np.mean((error / found.sigma_um)[part & inside] ** 2)) for part in (beside, ~beside)]
    assert 0.6 < pulls[0] < 1.5
    assert 0.8 < pulls[1] < 1.3
    assert (np.median(found.sigma_um[beside]) > 2.0 * np.median(found.sigma_um[x < 8])) == (step_um > 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("ridge", [False, True])
@pytest.mark.rng("weak pixels about a step or a ridge")
def test_weak_pixels_about_a_step(ridge, rng) -> None:
    """Flats of the other simulator at a contrast of 0.13 and 6,000 electrons: a step of 0.15 orders, and a ridge."""
    y, x = np.indices((160, 160))
    across = (x + 0.35 * y - 104.0) / np.hypot(1.0, 0.35)
    rise = 0.06 * np.exp(-0.5 * (across / 3.0) ** 2) if ridge else 0.045 * (across > 0.0)
    truth = random_field((160, 160), rng, mean=14.0, span=1.5) + rise
    cube = make_flats(replace(ROWS["contrast 0.13"], electrons=6_000.0), truth, rng)
    fitted = fit_thickness(cube, FringeModel.from_setup("ts8_e2v"))
    good, near = fitted.mask == 0, np.abs(across) < 5.0
    assert good.mean() > 0.9
    assert np.mean(np.abs(fitted.value - truth)[good] > 0.5 * ORDER_UM) < 1e-3
    good &= np.abs(fitted.value - truth) < 0.5 * ORDER_UM
    shared = fitted.metadata["SCALESIG"] * fitted.value
    error = fitted.value - truth - np.mean((fitted.value - truth)[good])
    pull = error / np.sqrt(fitted.sigma**2 - shared**2)
    assert np.sqrt(np.mean(pull[good & near] ** 2)) < 1.3
    assert 0.8 < np.sqrt(np.mean(pull[good & ~near] ** 2)) < 1.15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("contrast", "electrons", "part"), [(0.13, 5_000.0, 0.5), (0.25, 5_000.0, 0.9), (0.13, 20_000.0, 0.9)]
)
@pytest.mark.rng("weak pixels of another simulator")
def test_weak_fringes_are_better_than_pixels_by_themselves(contrast, electrons, part, rng) -> None:
    """Flats of the other simulator: errors below the Cramer-Rao bound of a pixel alone, and as large as stated."""
    model = FringeModel.from_setup("ts8_e2v")
    truth = random_field((192, 192), rng, mean=15.0, span=1.5)
    laboratory = replace(ROWS["as the model"], contrast=contrast, electrons=electrons)
    cube = make_flats(laboratory, truth, rng)
    fitted = fit_thickness(cube, model)
    result, good = judge(fitted, truth), fitted.mask == 0
    ahead, behind = (model.response(truth + side, cube.wavelength_nm) for side in (0.001, -0.001))
    mean = 0.5 * (ahead + behind).mean(axis=(1, 2), keepdims=True)
    slope = contrast * (ahead - behind) / 0.002 / mean
    alone = 1.0 / np.sqrt((slope**2 / cube.variance).sum(axis=0))
    error = (fitted.value - truth)[good]
    assert result.wrong < 1e-3
    assert np.std(error) < part * np.sqrt(np.mean(alone[good] ** 2))
    assert 0.75 < result.own < 1.25
    assert result.pull < 1.35


@pytest.mark.slow
@pytest.mark.rng("weak pixels keep a structure smaller than a cell")
def test_structure_smaller_than_a_cell_is_kept(rng) -> None:
    """Bumps of a third of an order, three pixels wide, in flats of a contrast of 0.13.

    The layer is one at which the wavelengths do not have their crests together: there a pixel and its mirror image on
    the
    other side are alike, and nothing tells a bump from none.
    """
    y, x = np.indices((128, 128))
    near = np.minimum.reduce([(y - a) ** 2 + (x - b) ** 2 for a in (20, 60, 100) for b in (25, 65, 105)])
    bump = 0.1 * np.exp(-0.5 * near / 1.5**2)
    truth = random_field((128, 128), rng, mean=14.3, span=0.8) + bump
    cube = make_flats(replace(ROWS["as the model"], contrast=0.13), truth, rng)
    fitted = fit_thickness(cube, FringeModel.from_setup("ts8_e2v"))
    good = fitted.mask == 0
    error = fitted.value - truth
    error -= np.mean(error[good & (bump < 0.001)])
    inside = good & (bump > 0.05)
    assert inside.sum() > 0.8 * (bump > 0.05).sum()
    assert np.sqrt(np.mean((error / fitted.sigma)[inside] ** 2)) < 1.3
