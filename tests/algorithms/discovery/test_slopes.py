"""Slopes of a field known at cells."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.slopes import Slopes

Y, X = np.indices((24, 31), dtype=float)


def slopes(field: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return Slopes(seen)(field)


def test_a_wave_of_ten_cells_is_as_steep_as_it_is() -> None:
    """Differences of neighbours alone are 6 % too small, and the area of a pixel would seem smaller by as much."""
    wave = 2.0 * np.pi / 10.0
    found = slopes(np.sin(wave * X), np.ones(X.shape, bool))
    np.testing.assert_allclose(found[1][:, 2:-2], (wave * np.cos(wave * X))[:, 2:-2], atol=0.006 * wave)
    np.testing.assert_allclose(found[0], 0.0, atol=1e-12)


def test_a_parabola_has_its_slopes_up_to_the_rim_and_beside_holes() -> None:
    field = 3.0 + X - 1.5 * Y + 0.01 * X**2 + 0.005 * X * Y - 0.01 * Y**2
    seen = np.ones(field.shape, bool)
    seen[5:9, 7:12] = seen[:, 20] = False
    found = slopes(np.where(seen, field, 1e6), seen)
    np.testing.assert_allclose(found[0][seen], (-1.5 + 0.005 * X - 0.02 * Y)[seen], atol=1e-9)
    np.testing.assert_allclose(found[1][seen], (1.0 + 0.02 * X + 0.005 * Y)[seen], atol=1e-9)
    assert not found[:, ~seen].any()


@pytest.mark.parametrize("hidden", [[1], [22], [28], [1, 3], [1, 29], [26, 28]])
def test_a_cell_that_a_bad_column_cuts_off_takes_those_beyond(hidden: list[int]) -> None:
    """Cells at the edge beside a bad column were flat, and their fringes had the full contrast."""
    field = 3.0 + X - 1.5 * Y + 0.01 * X**2
    seen = np.ones(field.shape, bool)
    seen[:, hidden] = False
    found = slopes(np.where(seen, field, 1e6), seen)
    np.testing.assert_allclose(found[1][seen], (1.0 + 0.02 * X)[seen], atol=0.021)
    np.testing.assert_allclose(found[0][seen], -1.5, atol=1e-9)


def test_behind_two_bad_columns_the_slope_is_that_across_them() -> None:
    seen = np.ones(X.shape, bool)
    seen[:, 1:3] = False
    np.testing.assert_allclose(slopes(np.where(seen, X, 1e6), seen)[1][:, 0], 1.0, atol=1e-9)


def test_a_cell_in_a_wrong_order_makes_no_slopes_two_cells_away() -> None:
    field = 0.05 * X
    field[12, 15] += 1.0
    found = slopes(field, np.ones(X.shape, bool))[1][12]
    assert np.abs(found[[13, 17]] - 0.05).max() < 0.011


@pytest.mark.parametrize(("cells", "expected"), [(1, [0.0]), (2, [4.0, 4.0]), (3, [4.0, 4.0, 4.0])])
def test_few_cells(cells: int, expected: list[float]) -> None:
    field = 4.0 * np.arange(cells, dtype=float)[:, None]
    found = slopes(field, np.ones(field.shape, bool))
    np.testing.assert_allclose(found[0][:, 0], expected, atol=1e-12)
    assert not found[1].any()
