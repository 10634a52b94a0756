"""Cells that maps are fitted to on the sky, and what of their misfit is noise, against sums over single pixels."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.map_on_sky import _cell_px
from lsst.fringe_sim.algorithms.range_cells import RangeCells
from lsst.fringe_sim.algorithms.sky_shift import _Night

ORDER_UM = 0.32


def plain(thickness_um: np.ndarray) -> np.ndarray:
    return 3.0 + np.cos(2.0 * np.pi * np.asarray(thickness_um) / ORDER_UM)


@pytest.mark.parametrize(
    ("size", "turns_per_px"), [(128, 0.001), (300, 0.001), (600, 0.009), (600, 0.021), (300, 0.07)]
)
def test_a_cell_on_the_sky_is_the_largest_on_which_the_fringes_turn_by_half_a_radian(
    size: int, turns_per_px: float
) -> None:
    known = 14.0 + turns_per_px * ORDER_UM * np.arange(float(size + 40)) * np.ones((size, 1))
    fit = [
        cell
        for cell in (1, 2, 4, 8, 16)
        if cell == 1 or (size / cell >= 64 and 2.0 * np.pi * turns_per_px * cell <= 0.5)
    ]
    assert _cell_px(known, ORDER_UM) == max(fit)


def test_cells_of_a_range_are_means_of_pixels_about_a_layer_in_the_middle_of_it(
    rng_of_cells: np.random.Generator,
) -> None:
    image, weight = rng_of_cells.normal(size=(2, 37, 41)) ** 2
    weight[:8, :9] = 0.0
    image[0, 0] = np.nan
    cells = RangeCells.of(image, weight, 4, (13.0, 13.9), plain, ORDER_UM)
    assert cells.shape == (9, 10)
    for number in range(90):
        y, x = divmod(number, 10)
        part = np.s_[4 * y : 4 * y + 4, 4 * x : 4 * x + 4]
        total = weight[part].sum()
        assert cells.weight[number] == pytest.approx(total)
        mean = np.average(image[part], weights=weight[part]) if total else 0.0
        assert cells.value[number] == pytest.approx(mean)
        place = (2 * y + 1) / 9 - 1.0, (2 * x + 1) / 10 - 1.0
        np.testing.assert_allclose(cells.place[number], place, atol=1e-12)
        np.testing.assert_allclose(
            sorted(cells.background[number]), sorted([1.0, *place, place[0] * place[1]]), atol=1e-12
        )
    np.testing.assert_allclose(cells.terms @ cells.middle, 13.45)
    # Terms of degree n in the order of Legendre polynomials down, then across; the spread falls as (1 + n)².
    degrees = np.array([down + across for down in range(9) for across in range(9 - down)])
    np.testing.assert_allclose(cells.prior, (1.0 + degrees) ** 4 / 0.9**2)
    np.testing.assert_allclose(cells.grid[[0, -1]], [12.36, 14.54], atol=ORDER_UM / 48)
    assert cells.light.mean() == pytest.approx(0.0, abs=1e-12)
    light = plain(cells.grid)
    np.testing.assert_allclose(cells.light, light / light.mean() - 1.0)
    slope = -2.0 * np.pi / ORDER_UM * np.sin(2.0 * np.pi * cells.grid / ORDER_UM) / light.mean()
    np.testing.assert_allclose(cells.slope[1:-1], slope[1:-1], atol=0.003 * np.abs(slope).max())


@pytest.fixture
def rng_of_cells() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize(
    ("shared", "slope", "side"), [(0.5, 0.02, 4), (0.2, 0.04, 2), (1.0, 0.0, 5), (0.0, 0.02, 4)]
)
def test_what_all_frames_miss_alike_is_no_noise(
    shared: float, slope: float, side: int, rng_of_cells: np.random.Generator
) -> None:
    """Squares of a quarter of a fringe, of which an image has eight or more along its side."""
    shape = (40, 44)
    layer = 14.0 + slope * np.arange(shape[1]) * np.ones((shape[0], 1))
    wide = np.kron(rng_of_cells.standard_normal((8, 9)), np.ones((5, 5)))[:, : shape[1]]
    residuals = [shared * wide + rng_of_cells.standard_normal(shape) for _ in range(4)]
    weights = [np.where(rng_of_cells.random(shape) < 0.1, 0.0, 1.0) for _ in residuals]
    for weight in weights:
        weight[:10, :10] = 0.0
    night = _Night(list(zip(residuals, weights, strict=True)), layer, plain, ORDER_UM, 0.1)
    squares = []
    for y in range(0, shape[0], side):
        for x in range(0, shape[1], side):
            part = np.s_[y : y + side, x : x + side]
            sums = [(w[part].sum(), (w * r)[part].sum()) for w, r in zip(weights, residuals, strict=True)]
            total, missed = np.sum(sums, axis=0)
            if total > 0.0:
                squares.append(missed**2 / total)
    expected = min(1.0, 1.0 / float(np.mean(squares)))
    assert night._noise_share(residuals) == pytest.approx(expected, rel=1e-6)
    assert (expected < 0.85) == (shared > 0.0)
