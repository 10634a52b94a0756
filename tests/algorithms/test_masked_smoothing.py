"""Masked smoothing against brute force, and its noise against Monte Carlo."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lsst.fringe_sim.algorithms.masked_smoothing import smooth_masked
from lsst.fringe_sim.errors import InputError, OutOfRangeError


def brute_force(
    image: np.ndarray, variance: np.ndarray, good: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Double loop over pixels and kernel: value, variance and the part of the kernel on good pixels."""
    reach = max(1, int(np.ceil(4.0 * sigma)))
    line = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    line /= line.sum()
    ny, nx = image.shape
    value, noise, weight = (np.zeros(image.shape) for _ in range(3))
    for y in range(ny):
        for x in range(nx):
            for dy in range(-reach, reach + 1):
                for dx in range(-reach, reach + 1):
                    yy, xx = y + dy, x + dx
                    if 0 <= yy < ny and 0 <= xx < nx and good[yy, xx]:
                        k = line[dy + reach] * line[dx + reach]
                        value[y, x] += k * image[yy, xx]
                        noise[y, x] += k * k * variance[yy, xx]
                        weight[y, x] += k
    with np.errstate(invalid="ignore", divide="ignore"):
        return value / weight, noise / weight**2, weight


@settings(max_examples=15, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 14), st.integers(1, 14)),
    sigma=st.sampled_from([0.4, 1.0, 1.7, 3.0]),
    bad=st.sampled_from([0.0, 0.1, 0.6]),
    seed=st.integers(0, 2**31),
)
def test_agrees_with_brute_force(shape: tuple[int, int], sigma: float, bad: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.normal(100.0, 10.0, shape).astype(np.float32)
    variance = rng.uniform(1.0, 5.0, shape).astype(np.float32)
    good = rng.random(shape) >= bad
    # What is masked must not matter, whatever it is; what is not a number counts as masked.
    image[~good] = rng.choice([np.nan, np.inf, 1e30], np.count_nonzero(~good))
    poisoned = rng.random(shape) < 0.05
    image[poisoned] = np.nan
    usable = good & ~poisoned
    expected, noise, weight = brute_force(np.nan_to_num(image), variance, usable, sigma)
    value, spread = smooth_masked(image, variance, good, sigma)
    np.testing.assert_allclose(value[usable], expected[usable], rtol=2e-6)
    np.testing.assert_allclose(spread[usable], noise[usable], rtol=1e-5)
    filled = ~usable & (weight > 0.0201)
    np.testing.assert_allclose(value[filled], expected[filled], rtol=2e-5)
    assert np.all(np.isnan(value[~usable & (weight < 0.0199)]))


@pytest.mark.rng("constant image stays constant")
def test_constant_image_stays_constant(rng: np.random.Generator) -> None:
    good = rng.random((40, 50)) > 0.3
    value, _ = smooth_masked(np.full((40, 50), 7.0), np.ones((40, 50)), good, 3.0)
    np.testing.assert_allclose(value[good], 7.0, rtol=1e-6)


@pytest.mark.rng("variance is that of many noisy images")
def test_variance_is_that_of_many_noisy_images(rng: np.random.Generator) -> None:
    good = rng.random((24, 30)) > 0.15
    good[8:14, 10:20] = False
    variance = rng.uniform(1.0, 9.0, good.shape).astype(np.float32)
    trials = 3000
    total, squares = np.zeros(good.shape), np.zeros(good.shape)
    for _ in range(trials):
        noise = np.sqrt(variance) * rng.standard_normal(good.shape, dtype=np.float32)
        value, stated = smooth_masked(noise, variance, good, 1.5)
        total += value
        squares += value.astype(float) ** 2
    measured = squares / trials - (total / trials) ** 2
    ratio = (measured / stated)[good]
    # The scatter of a variance from n trials is sqrt(2 / n) = 2.6 %.
    assert ratio.mean() == pytest.approx(1.0, abs=0.005)
    assert np.abs(ratio - 1.0).max() < 5.0 * np.sqrt(2.0 / trials)


@pytest.mark.rng("noise is reduced and correlated as stated")
def test_noise_is_reduced_and_correlated_as_stated(rng: np.random.Generator) -> None:
    """White noise: variance / (4 pi sigma²), correlation exp(-lag² / (2 (sqrt(2) sigma)²))."""
    sigma = 3.0
    shape = (700, 700)
    noise = rng.standard_normal(shape, dtype=np.float32)
    value, stated = smooth_masked(noise, np.ones(shape, np.float32), np.ones(shape, bool), sigma)
    inner = value[20:-20, 20:-20]
    assert stated[300, 300] == pytest.approx(1.0 / (4.0 * np.pi * sigma**2), rel=2e-3)
    assert inner.var() == pytest.approx(stated[300, 300], rel=0.05)
    for lag in (2, 4, 6):
        measured = np.mean(inner[:, lag:] * inner[:, :-lag]) / inner.var()
        assert measured == pytest.approx(np.exp(-(lag**2) / (4.0 * sigma**2)), abs=0.05)


@pytest.mark.rng("no smoothing leaves good pixels alone")
def test_no_smoothing_leaves_good_pixels_alone(rng: np.random.Generator) -> None:
    image = rng.normal(size=(5, 6)).astype(np.float32)
    good = rng.random((5, 6)) > 0.3
    value, variance = smooth_masked(image, np.ones((5, 6)), good, 0.0)
    np.testing.assert_array_equal(value[good], image[good])
    assert np.all(np.isnan(value[~good]))
    np.testing.assert_array_equal(variance[good], 1.0)


def test_impossible_requests_are_refused() -> None:
    image = np.zeros((4, 4), np.float32)
    good = np.ones((4, 4), bool)
    with pytest.raises(InputError, match="shape"):
        smooth_masked(image, image[:3], good, 1.0)
    with pytest.raises(OutOfRangeError, match="sigma"):
        smooth_masked(image, image, good, -1.0)
