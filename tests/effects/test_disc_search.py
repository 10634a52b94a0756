"""Where a disc is in which a model leaves something, and the same found by counting cell by cell."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from lsst.fringe_sim.effects import EFFECTS, ImageGeometry, Residuals
from lsst.fringe_sim.effects.disc_search import Discs, find_disc, find_step

WAVELENGTHS = np.linspace(880.0, 990.0, 12)


def residuals_of(rng: np.random.Generator, cell_px: int, inside: float) -> Residuals:
    """Noise, a part without data, and more noise in a disc about row 50, column 30, of radius 20 px."""
    place = cell_px * np.arange(96 // cell_px) + 0.5 * (cell_px - 1.0)
    geometry = ImageGeometry((96, 96), place, place, WAVELENGTHS, np.full(12, 20_000.0))
    value = 0.01 * rng.standard_normal((12, len(place), len(place)))
    on = np.hypot(place[:, np.newaxis] - 50.0, place - 30.0) < 20.0
    weight = np.full(value.shape, 0.01**-2.0)
    weight[:, 10:30, :12] = 0.0
    return Residuals(np.where(on, inside, 1.0) * value, weight, geometry)


@pytest.mark.rng("disc of residuals")
@pytest.mark.parametrize(("cell_px", "inside"), [(1, 1.3), (1, 5.0), (3, 2.0)])
def test_a_disc_is_found_where_it_is(rng: np.random.Generator, cell_px: int, inside: float) -> None:
    found = find_disc(residuals_of(rng, cell_px, inside))
    assert found is not None
    assert np.allclose(found, (50.0, 30.0, 20.0), atol=1.5 * cell_px)


@pytest.mark.rng("no disc of residuals")
def test_noise_has_no_disc(rng: np.random.Generator) -> None:
    found = [find_disc(residuals_of(rng, 2, 1.0)) for _ in range(10)]
    assert found == [None] * 10


@pytest.mark.rng("void in residuals")
def test_a_void_is_proposed_there(rng: np.random.Generator) -> None:
    (void,) = (effect for effect in EFFECTS if effect.name == "void")
    starts = void.propose(residuals_of(rng, 1, 3.0))
    assert np.allclose([start["centre_y"] for start in starts], 50.0, atol=1.5)
    sizes = [start["thickness"] for start in starts]
    assert sizes == sorted(sizes)
    assert 0.0 < sizes[0] < sizes[-1] <= 470.0
    assert void.propose(residuals_of(rng, 1, 1.0)) == ()


def discs_of(used: np.ndarray, ratio: float) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Radii from 2 cells to 0.35 of the shorter side, cells ``(N, ny, nx)`` of the disc about each, and if enough."""
    y, x = np.indices(used.shape)
    away = np.hypot(y - y.reshape(-1, 1, 1), x - x.reshape(-1, 1, 1))
    radius = 2.0
    while radius <= 0.35 * min(used.shape):
        inside = away <= radius
        yield radius, inside, (inside & used).sum(axis=(1, 2)) > 0.3 * math.pi * radius**2
        radius *= ratio


@pytest.mark.parametrize("shape", [(5, 9), (6, 9), (17, 20), (20, 17)])
def test_sums_over_discs_are_those_of_their_cells(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(61)
    values, seen = rng.standard_normal(shape), rng.random(shape) > 0.3
    seen[:, :4] = False
    discs = Discs.of(seen)
    each = list(discs_of(seen, 1.2))
    assert discs.radii == pytest.approx([radius for radius, _, _ in each])
    assert len(discs.usable) == len(each) == {5: 0, 6: 1}.get(min(shape), 6)
    for (_, inside, enough), usable, sums in zip(each, discs.usable, discs.sums(values), strict=True):
        np.testing.assert_allclose(sums.ravel(), (inside * values).sum(axis=(1, 2)), atol=1e-12)
        np.testing.assert_array_equal(usable.ravel(), enough)


def few_cells(rng: np.random.Generator) -> ImageGeometry:
    y, x = 4.0 * np.arange(16.0) + 1.5, 9.0 * np.arange(18.0) + 4.0
    return ImageGeometry((64, 162), y, x, WAVELENGTHS, np.full(12, 20_000.0))


def placed(number: int, radius: float, geometry: ImageGeometry) -> tuple[float, float, float]:
    """Row, column and radius [px] of a disc about a cell, whose area is that of a square of as many pixels."""
    row, column = np.unravel_index(number, geometry.sample_shape)
    return 1.5 + 4.0 * row, 4.0 + 9.0 * column, 6.0 * radius


@pytest.mark.rng("few cells of residuals")
def test_the_excess_of_a_disc_is_compared_with_its_scatter(rng: np.random.Generator) -> None:
    """Of all sizes from none to plain: found, and where, as counted cell by cell."""
    geometry = few_cells(rng)
    weight = rng.uniform(0.5, 2.0, (12, 16, 18))
    weight[6:, :, 16:] = 0.0
    weight[:, 5:8, :7] = 0.0
    noise = rng.standard_normal(weight.shape) / np.sqrt(np.where(weight > 0.0, weight, 1.0))
    noise[:, 12, 5] *= 30.0  # one cell inside does not make a disc
    number = (weight > 0.0).sum(axis=0)
    on = np.hypot(*(np.indices(number.shape) - np.array([9.0, 11.0])[:, None, None])) < 4.5
    each = list(discs_of(number > 0, 1.05))
    by_chance = 2.0 * math.log((number > 0).sum() * len(each))
    seen = []
    for factor in np.linspace(1.0, 1.4, 41):
        value = np.where(on, factor, 1.0) * noise
        power = (weight * value**2).sum(axis=0)[number > 0] / number[number > 0]
        excess = np.zeros(number.shape)
        excess[number > 0] = np.clip(
            power / np.median(power) * (1.0 - 2.0 / (9.0 * 12)) ** 3 - 1.0, -1.0, 4.0
        )
        best, where = by_chance, None
        for radius, inside, enough in each:
            amount, cells = (inside * excess).sum(axis=(1, 2)), (inside & (number > 0)).sum(axis=(1, 2))
            strength = np.where(enough & (amount > 0.0), amount**2 / (2.0 / 12) / np.maximum(cells, 1), 0.0)
            if strength.max() > best:
                best, where = strength.max(), placed(int(strength.argmax()), radius, geometry)
        found = find_disc(Residuals(value, weight, geometry))
        assert found == (None if where is None else pytest.approx(where))
        seen.append(where is not None)
    assert 2 < sum(seen) < 39
    assert find_disc(Residuals(value, np.zeros_like(weight), geometry)) is None
    short = ImageGeometry((20, 162), geometry.y_px[:5], geometry.x_px, WAVELENGTHS, np.full(12, 20_000.0))
    assert find_disc(Residuals(value[:, 8:13], weight[:, 8:13], short)) is None  # no disc has room


@pytest.mark.rng("few cells of a step")
def test_a_step_of_the_thickness_is_compared_with_the_quiet_quarter(rng: np.random.Generator) -> None:
    """Found, and where, as counted cell by cell; and what a void proposes there."""
    geometry = few_cells(rng)
    information = rng.uniform(1e4, 2e4, (16, 18))
    information[5:8, :7] = 0.0
    score = np.sqrt(information) * rng.standard_normal(information.shape)
    on = np.hypot(*(np.indices(score.shape) - np.array([9.0, 11.0])[:, None, None])) < 4.5
    each = [one for one in discs_of(information > 0.0, 1.2) if one[0] >= 2.8]
    assert len(each) == 4
    by_chance = 2.0 * math.log((information > 0.0).sum() * 6 / 1e-3)
    (void,) = (effect for effect in EFFECTS if effect.name == "void")
    quiet = np.ones((12, 16, 18))
    seen = []
    for step_um in np.linspace(0.0, 0.02, 41):
        scored = score + np.where(on, step_um * information, 0.0)
        best, where = by_chance, None
        for radius, inside, enough in each:
            size = (inside * scored).sum(axis=(1, 2))[enough]
            size /= np.sqrt((inside * information).sum(axis=(1, 2))[enough])
            strength = np.zeros(len(enough))
            strength[enough] = (size / (np.quantile(np.abs(size), 0.25) / 0.3186)) ** 2
            if strength.max() > best:
                best, where = strength.max(), placed(int(strength.argmax()), radius, geometry)
        residuals = Residuals(quiet, quiet, geometry, scored, information)
        assert find_step(residuals) == (None if where is None else pytest.approx(where))
        starts = [tuple(start.values()) for start in void.propose(residuals)]
        thin = () if where is None else (4.7, 9.4, 18.8, 37.6)
        assert starts == [pytest.approx((gap, where[1], where[0], where[2])) for gap in thin]  # type: ignore[index]
        seen.append(where is not None)
    assert 2 < sum(seen) < 39
    assert find_step(Residuals(quiet, quiet, geometry, score, None)) is None
    assert find_step(Residuals(quiet, quiet, geometry, None, information)) is None
    assert find_step(Residuals(quiet, quiet, geometry, score, np.zeros_like(score))) is None


@pytest.mark.rng("void of all gaps")
def test_gaps_of_a_void_are_tried_until_the_fringes_come_back(rng: np.random.Generator) -> None:
    (void,) = (effect for effect in EFFECTS if effect.name == "void")
    sizes = [start["thickness"] for start in void.propose(residuals_of(rng, 2, 3.0))]
    assert sizes == pytest.approx([470.0 * number / 12 for number in range(1, 13)])
