"""Photon and read noise: distributions, moments, seeds, threads."""

import numpy as np
import pytest
from scipy import stats

from lsst.fringe_sim.algorithms.image_noise import add_exposure_noise
from lsst.fringe_sim.compiled import limit_threads
from lsst.fringe_sim.errors import InputError, OutOfRangeError

SHAPE = (700, 900)


@pytest.mark.parametrize("mean", [3.0, 50.0, 63.7, 1000.0, 2717.3, 90_000.0])
def test_photons_are_poisson(mean):
    """Chi-square over all counts that are expected ten times or more."""
    noisy = add_exposure_noise(np.full(SHAPE, mean), np.random.default_rng(7)).ravel()
    counts, edges = (
        np.unique(noisy, return_counts=False),
        np.arange(np.floor(stats.poisson.ppf(1e-4, mean)), np.ceil(stats.poisson.ppf(1 - 1e-4, mean)) + 1),
    )
    assert np.array_equal(counts, np.round(counts))
    below = stats.poisson.cdf(edges[0] - 1, mean)
    expected = np.concatenate([[below], stats.poisson.pmf(edges, mean), [stats.poisson.sf(edges[-1], mean)]])
    place = np.clip(noisy - edges[0] + 1, 0, edges.size + 1).astype(int)
    found = np.bincount(place, minlength=expected.size)
    # Neighbours are joined until each is expected a hundred times.
    group = np.floor(np.cumsum(expected * noisy.size) / 100.0).astype(int)
    group = np.minimum(group, noisy.size // 100 - 2)
    group[0] = group[1]  # nothing may be expected below the first count
    _, group = np.unique(group, return_inverse=True)
    joined = [np.bincount(group, item) for item in (found, expected * noisy.size)]
    chi2 = float(((joined[0] - joined[1]) ** 2 / joined[1]).sum())
    assert stats.chi2.sf(chi2, joined[0].size - 1) > 1e-4


def test_read_noise_is_normal():
    """So much of it that the photons hardly matter."""
    mean, read = 50.0, 400.0
    noisy = add_exposure_noise(np.full(SHAPE, mean), np.random.default_rng(3), read).ravel().astype(float)
    total = np.hypot(read, np.sqrt(mean))
    standard = (noisy - mean) / total
    # At this ratio the sum is normal within 1e-5 (its skewness is 1e-6).
    assert stats.kstest(standard, "norm").pvalue > 1e-4
    assert abs(standard.mean()) < 5 / np.sqrt(standard.size)
    assert standard.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * standard.size))
    tail = np.mean(np.abs(standard) > 3.7)
    expected = 2 * stats.norm.sf(3.7)
    assert tail == pytest.approx(expected, abs=5 * np.sqrt(expected / standard.size))


def test_means_follow_the_image():
    image = np.linspace(20.0, 3000.0, 500)[:, None] * np.ones(2000)
    noisy = add_exposure_noise(image, np.random.default_rng(5), 6.0)
    pull = (noisy.mean(axis=1, dtype=float) - image[:, 0]) / np.sqrt((image[:, 0] + 36.0) / 2000)
    assert stats.kstest(pull, "norm").pvalue > 1e-4
    spread = noisy.var(axis=1, dtype=float) / (image[:, 0] + 36.0)
    assert spread.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / 2000 / 500))


def test_neighbours_and_rows_are_independent():
    noisy = add_exposure_noise(np.full(SHAPE, 900.0), np.random.default_rng(11), 5.0).astype(float)
    noisy -= noisy.mean()
    for one, two in ((noisy[1:], noisy[:-1]), (noisy[:, 1:], noisy[:, :-1])):
        assert abs(np.corrcoef(one.ravel(), two.ravel())[0, 1]) < 5 / np.sqrt(one.size)


def test_seed_decides_and_threads_do_not():
    image = np.full((150, 80), 500.0)
    image[:3] = 10.0
    made = [add_exposure_noise(image, np.random.default_rng(seed), 4.0) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(made[0], made[1])
    assert not np.array_equal(made[0], made[2])
    for threads in (1, 3):
        limit_threads(threads)
        alone = add_exposure_noise(image, np.random.default_rng(1), 4.0)
        np.testing.assert_array_equal(alone, made[0])
    limit_threads(None)


def test_no_electrons_no_photons():
    noisy = add_exposure_noise(np.zeros((4, 5)), np.random.default_rng(1))
    np.testing.assert_array_equal(noisy, 0.0)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_what_is_refused(bad):
    image = np.full((3, 3), 100.0)
    image[1, 1] = bad
    with pytest.raises(InputError, match="expected electrons"):
        add_exposure_noise(image, np.random.default_rng(1))
    with pytest.raises(InputError, match="two axes"):
        add_exposure_noise(np.ones(3), np.random.default_rng(1))
    with pytest.raises(OutOfRangeError, match="read noise"):
        add_exposure_noise(np.ones((2, 2)), np.random.default_rng(1), -1.0)
