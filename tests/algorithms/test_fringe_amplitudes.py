"""Amplitudes of frames against numpy's own statistics."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.fringe_amplitudes import fringe_amplitudes
from lsst.fringe_sim.errors import InputError


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (3, 5), (257, 301)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, ">f4"])
@pytest.mark.rng("they are numpys")
def test_they_are_numpys(rng: np.random.Generator, shape: tuple[int, int], dtype: str) -> None:
    image = rng.normal(2700.0, 40.0, shape).astype(dtype)
    exact = image.astype(float)
    found = fringe_amplitudes(image)
    low, high = np.percentile(exact, [1.0, 99.0])
    assert found.rms == pytest.approx(exact.std() / exact.mean(), rel=1e-12, abs=1e-15)
    assert found.half_peak_to_peak == pytest.approx(0.5 * np.ptp(exact) / exact.mean(), rel=1e-12, abs=1e-15)
    assert found.half_range_1_99 == pytest.approx(0.5 * (high - low) / exact.mean(), rel=1e-12, abs=1e-15)
    assert found.mean == pytest.approx(exact.mean(), rel=1e-12)


@pytest.mark.rng("pixels that are masked or no number do not count")
def test_pixels_that_are_masked_or_no_number_do_not_count(rng: np.random.Generator) -> None:
    image = rng.normal(100.0, 1.0, (40, 50)).astype(np.float32)
    mask = rng.random((40, 50)) < 0.2
    spoiled = np.where(mask, np.float32(1e9), image)
    spoiled[~mask & (rng.random((40, 50)) < 0.1)] = np.nan
    before = spoiled.copy()
    good = ~mask & np.isfinite(spoiled)
    assert fringe_amplitudes(spoiled, mask) == fringe_amplitudes(image[good])
    np.testing.assert_array_equal(spoiled, before)


@pytest.mark.parametrize("image", [np.full((4, 4), np.nan), np.zeros((4, 4)), np.full((2, 2), -1.0)])
def test_frames_without_light_are_refused(image: np.ndarray) -> None:
    with pytest.raises(InputError):
        fringe_amplitudes(image)
