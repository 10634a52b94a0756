"""Correlation functions against TreeCorr, and the laws of coadding."""

import numpy as np
import pytest
import treecorr
from scipy.ndimage import gaussian_filter, spline_filter

from lsst.fringe_sim.algorithms.image_correlation import (
    LogBins,
    coadd_correlation,
    coadd_model,
    correlation_function,
    random_cutout,
)
from lsst.fringe_sim.errors import InputError, OutOfRangeError


def treecorr_oracle(image, weight, bins, other=None):
    """Every pair, one by one."""
    good = weight > 0
    y, x = np.nonzero(good)

    def catalogue(values):
        return treecorr.Catalog(x=x.astype(float), y=y.astype(float), k=values[good], w=weight[good])

    found = treecorr.KKCorrelation(
        min_sep=bins.smallest_px, max_sep=bins.largest_px, nbins=bins.count, bin_slop=0, brute=True
    )
    found.process(catalogue(image), None if other is None else catalogue(other))
    return found


@pytest.mark.parametrize("shape", [(40, 33), (21, 64)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.rng("equals treecorr")
def test_equals_treecorr(rng, shape, masked):
    image = gaussian_filter(rng.standard_normal(shape), 1.5)
    weight = rng.uniform(0.5, 2.0, shape) * (rng.random(shape) > 0.2) if masked else np.ones(shape)
    bins = LogBins(1.0, 18.0, 9)
    expected = treecorr_oracle(image, weight, bins)
    found = correlation_function(image, weight, bins)
    np.testing.assert_allclose(found.xi, expected.xi, rtol=0, atol=1e-6 * image.var())
    # TreeCorr keeps weights in single precision
    np.testing.assert_allclose(found.weight, expected.weight, rtol=1e-7)
    np.testing.assert_allclose(found.separation_px, expected.meanr, rtol=1e-7)


@pytest.mark.rng("masked and missing pixels do not count")
def test_masked_and_missing_pixels_do_not_count(rng):
    image = rng.standard_normal((32, 32))
    weight = (rng.random((32, 32)) > 0.3).astype(float)
    bins = LogBins(1.0, 10.0, 5)
    spoiled = np.where(weight > 0, image, 1e9)
    missing = np.where(weight > 0, image, np.nan)
    expected = correlation_function(image, weight, bins).xi
    np.testing.assert_allclose(correlation_function(spoiled, weight, bins).xi, expected, rtol=1e-9)
    np.testing.assert_allclose(correlation_function(missing, None, bins).xi, expected, rtol=1e-9)


def test_correlation_of_a_wave_is_a_bessel_function():
    """Plane waves of all directions: xi(r) = sigma² J0(k r)."""
    from scipy.special import j0

    x = np.broadcast_to(np.arange(400.0), (400, 400))
    wave = np.sin(2 * np.pi * x / 40.0)
    found = correlation_function(wave, bins=LogBins(5.0, 40.0, 10))
    np.testing.assert_allclose(found.xi, 0.5 * j0(2 * np.pi * found.separation_px / 40.0), atol=0.02)


def test_empty_bins_are_not_numbers():
    found = correlation_function(np.ones((4, 4)), bins=LogBins(1.05, 1.3, 2))
    assert np.isnan(found.xi).all()
    assert not found.weight.any()


@pytest.mark.rng("cutout is a rotated piece of the pattern")
def test_cutout_is_a_rotated_piece_of_the_pattern(rng):
    y, x = np.mgrid[:200, :240]
    slope = 0.3 * x + 0.1 * y
    cut = random_cutout(spline_filter(slope), 50, rng)
    # rotation keeps the length of the gradient
    gradient = np.hypot(np.diff(cut, axis=0)[:, :-1], np.diff(cut, axis=1)[:-1])
    np.testing.assert_allclose(gradient, np.hypot(0.3, 0.1), rtol=1e-6)
    assert slope.min() <= cut.min() <= cut.max() <= slope.max()


@pytest.fixture(scope="module")
def patterns():
    y, x = np.mgrid[:300, :300]
    return [
        np.sin(2 * np.pi * (x * np.cos(a) + y * np.sin(a)) / (25 + 3 * a) + 1e-4 * (x - 150) ** 2)
        for a in (0.0, 1.0, 2.0)
    ]


@pytest.mark.rng("coadds average fringes away down to the floor")
def test_coadds_average_fringes_away_down_to_the_floor(patterns, rng):
    result = coadd_correlation(patterns, (1, 10, 100), 0.0, rng, region_px=100, bins=LogBins(2.0, 30.0, 6))
    assert result.single.xi[0] == pytest.approx(0.5, rel=0.15)
    assert abs(result.floor.xi[0]) < 0.03 * result.single.xi[0]
    for count, coadd, model in zip(result.counts, result.coadd, result.model, strict=True):
        # one realisation scatters by about as much as its mean
        assert 0.2 < coadd.xi[0] / model[0] < 5
        expected = result.single.xi / count + (1 - 1 / count) * result.floor.xi
        np.testing.assert_allclose(model, expected, rtol=1e-12)
    np.testing.assert_allclose(result.coadd[-1].xi, result.model[-1], atol=1e-12)


@pytest.mark.slow
@pytest.mark.rng("coadds of 2600 exposures of nine sensors")
def test_coadds_of_2600_exposures_of_nine_sensors(rng):
    """The largest coadds of the paper, beside as many exposures of noise, before and after a correction."""
    bins = LogBins(2.0, 12.0, 4)
    patterns = []
    for _ in range(9):
        field = gaussian_filter(rng.standard_normal((110, 110)), 12.0, mode="wrap")
        wave = np.sin(2.0 * np.pi * (0.4 * field / field.std() + np.arange(110) / 40.0))
        patterns.append(1.4e-3 * wave / wave.std())
    noise = 1.0 / np.sqrt(2893.0)
    counts = (1, 800, 2600)
    fringed = coadd_correlation(patterns, counts, noise, rng, region_px=64, bins=bins)
    assert fringed.single.xi[0] == pytest.approx(1.4e-3**2, rel=0.3)
    scatter = noise**2 / 2600 / np.sqrt(fringed.null[-1].weight)
    np.testing.assert_allclose(
        fringed.model[-1], fringed.single.xi / 2600 + (1.0 - 1.0 / 2600) * fringed.floor.xi, rtol=1e-12
    )
    assert np.all(np.abs(fringed.null[-1].xi) < 5 * scatter + noise**2 / 2600 / 64**2)
    assert np.all(np.abs(fringed.coadd[-1].xi - fringed.null[-1].xi - fringed.model[-1]) < 8 * scatter)
    # A correction that leaves a tenth of the pattern leaves a hundredth of its correlation.
    corrected = coadd_correlation(
        [0.1 * each for each in patterns], counts, 0.0, np.random.default_rng(8), region_px=64, bins=bins
    )
    assert corrected.single.xi[0] == pytest.approx(0.01 * fringed.single.xi[0], rel=0.1)
    assert abs(corrected.coadd[-1].xi[0]) < 0.1 * abs(fringed.single.xi[0]) / 100


@pytest.mark.rng("floor is what no rotation removes")
def test_floor_is_what_no_rotation_removes(rng):
    """A radial pattern that fills the region the same way each time does not average out."""
    y, x = np.mgrid[:145, :145] - 72.0
    result = coadd_correlation(
        [np.cos(np.hypot(x, y) / 12.0)], (2, 40), 0.0, rng, region_px=100, bins=LogBins(2.0, 10.0, 3)
    )
    np.testing.assert_allclose(result.floor.xi, result.single.xi, rtol=0.05)
    np.testing.assert_allclose(result.coadd[1].xi, result.single.xi, rtol=0.05)


@pytest.mark.rng("null is the noise of as many exposures")
def test_null_is_the_noise_of_as_many_exposures(patterns, rng):
    result = coadd_correlation(patterns, (1, 4, 16), 0.7, rng, region_px=64, bins=LogBins(1.0, 20.0, 8))
    for count, null in zip(result.counts, result.null, strict=True):
        scatter = 0.49 / count / np.sqrt(null.weight)
        # the mean that is subtracted makes it slightly negative
        assert np.all(np.abs(null.xi + 0.49 / count / 64**2) < 5 * scatter)


@pytest.mark.rng("fringes stand out of the null until they are corrected")
def test_fringes_stand_out_of_the_null_until_they_are_corrected(patterns, rng):
    bins = LogBins(2.0, 8.0, 3)
    fringed = coadd_correlation(
        [0.2 * pattern for pattern in patterns], (30,), 1.0, rng, region_px=128, bins=bins
    )
    corrected = coadd_correlation(
        [0.002 * pattern for pattern in patterns], (30,), 1.0, rng, region_px=128, bins=bins
    )
    scatter = 1.0 / 30 / np.sqrt(fringed.null[0].weight)
    assert np.all(fringed.coadd[0].xi > 5 * scatter)
    assert np.all(np.abs(corrected.coadd[0].xi - corrected.null[0].xi) < 5 * scatter)


def test_model_of_one_exposure_is_that_exposure():
    np.testing.assert_array_equal(coadd_model([1.0, 2.0], [0.5, 0.5], 1), [1.0, 2.0])
    np.testing.assert_allclose(coadd_model(1.0, 0.5, 10**9), 0.5)


def test_result_is_repeatable(patterns):
    runs = [
        coadd_correlation(patterns, (3,), 0.1, np.random.default_rng(seed), region_px=64).coadd[0].xi
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


@pytest.mark.rng("bad input is named")
def test_bad_input_is_named(patterns, rng):
    with pytest.raises(InputError, match="two axes"):
        correlation_function(np.ones(5))
    with pytest.raises(InputError, match="shape of the weights"):
        correlation_function(np.ones((5, 5)), np.ones((4, 4)))
    with pytest.raises(InputError, match="weights"):
        correlation_function(np.ones((5, 5)), -np.ones((5, 5)))
    with pytest.raises(InputError, match="good pixels"):
        correlation_function(np.full((5, 5), np.nan))
    with pytest.raises(OutOfRangeError, match="separations"):
        LogBins(5.0, 1.0)
    with pytest.raises(OutOfRangeError, match="number of bins"):
        LogBins(1.0, 5.0, 0)
    with pytest.raises(OutOfRangeError, match="exposures in a coadd"):
        coadd_model(1.0, 0.0, 0)
    with pytest.raises(InputError, match="ascending"):
        coadd_correlation(patterns, (10, 1), 0.0, rng)
    with pytest.raises(InputError, match="fringe patterns"):
        coadd_correlation([], (1,), 0.0, rng)
    with pytest.raises(InputError, match="every pixel finite"):
        coadd_correlation([np.full((300, 300), np.nan)], (1,), 0.0, rng)
    with pytest.raises(OutOfRangeError, match="noise rms"):
        coadd_correlation(patterns, (1,), -1.0, rng)
    with pytest.raises(OutOfRangeError, match="side of the region"):
        coadd_correlation(patterns, (1,), 0.0, rng, region_px=280)
