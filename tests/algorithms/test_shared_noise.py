"""How many independent pixels smoothed noise has, from the correlation of all pairs of pixels."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.thickness_fit.cells import cell_independence, effective_number


def of_pairs(rows: int, columns: int, smoothed_px: float) -> float:
    """Pixels whose mean is as uncertain as that of the block: one over the mean correlation of its pairs."""
    y, x = (part.ravel() for part in np.indices((rows, columns)))
    square = np.subtract.outer(y, y) ** 2 + np.subtract.outer(x, x) ** 2
    return 1.0 / float(np.exp(-square / (4.0 * smoothed_px**2)).mean())


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (2, 2), (8, 8), (6, 11)])
@pytest.mark.parametrize("smoothed_px", [0.3, 1.0, 2.7])
def test_number_of_independent_pixels(shape: tuple[int, int], smoothed_px: float) -> None:
    assert effective_number(*shape, smoothed_px) == pytest.approx(of_pairs(*shape, smoothed_px), rel=1e-9)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (6, 11)])
def test_all_pixels_of_white_noise_are_independent(shape: tuple[int, int]) -> None:
    assert effective_number(*shape, 0.0) == shape[0] * shape[1]
    assert cell_independence(shape[0], 0.0) == 1.0


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("smoothed_px", [0.5, 1.3])
def test_cells_of_a_large_area_share_noise(size: int, smoothed_px: float) -> None:
    """Of a block that is 12 standard deviations of the kernel or 16 cells wide, which is a fifth from endless."""
    wide = max(16, int(12.0 * smoothed_px / size))
    many = of_pairs(wide * size, 1, smoothed_px) ** 2
    expected = many / (wide**2 * of_pairs(size, size, smoothed_px))
    found = cell_independence(size, smoothed_px)
    assert found == pytest.approx(expected, rel=1e-9)
    endless = size**2 / (4.0 * np.pi * smoothed_px**2) / of_pairs(size, size, smoothed_px)
    assert found == pytest.approx(min(endless, 1.0), rel=0.25)


def test_small_cells_of_a_wide_kernel_have_a_wider_block() -> None:
    many = of_pairs(48, 1, 4.0) ** 2
    assert cell_independence(1, 4.0) == pytest.approx(many / 48**2, rel=1e-9)
