"""Principal components against scikit-learn, and the templates against their purpose."""

import dataclasses

import numpy as np
import pytest
from sklearn.decomposition import PCA

from lsst.fringe_sim.algorithms.pca import (
    decompose_thickness,
    fit_pca,
    fit_pca_from_thickness,
    fringe_templates,
    noise_eigenvalue,
    project,
    significant_components,
)
from lsst.fringe_sim.algorithms.sky_frame import simulate_night, sky_response
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.night import NightHistory
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel, Setup
from lsst.fringe_sim.products import mask_bits

NOW = "2026-11-21T00:00:00"


@pytest.fixture
def frames(rng):
    """Nine frames of three smooth patterns and a little noise."""
    y, x = np.mgrid[:60, :47]
    patterns = np.stack([np.sin(0.3 * x), np.cos(0.2 * y), np.sin(0.1 * x * y / 20)])
    weights = rng.standard_normal((9, 3)) * np.array([3.0, 1.0, 0.3])
    return np.tensordot(weights, patterns, axes=1) + 5.0 + 0.01 * rng.standard_normal((9, 60, 47))


@pytest.fixture(scope="module")
def thickness():
    return e2v_321()[::24, ::24].astype(np.float64)


@pytest.fixture(scope="module")
def model():
    """The sensor with the silicon of the paper."""
    return FringeModel.from_setup(Setup.from_name("lsst_e2v").with_silicon("Si_green2008"))


@pytest.fixture(scope="module")
def response(model):
    return sky_response(model, SkySpectrum.dark(), thickness_range_um=(13.9, 22.5))


@pytest.fixture(scope="module")
def night(thickness, model, response):
    return list(simulate_night(thickness, model, response, NightHistory.guo2022(), physical_filter="y"))


@pytest.mark.parametrize("tile_bytes", [1, 16 * 9 * 47 * 7, 2**26])
@pytest.mark.rng("equals the full svd of scikit learn")
def test_equals_the_full_svd_of_scikit_learn(frames, tile_bytes):
    expected = PCA(svd_solver="full").fit(frames.reshape(9, -1))
    found = fit_pca(list(frames), n_components=8, tile_bytes=tile_bytes)
    np.testing.assert_allclose(found.explained_variance, expected.explained_variance_[:8], rtol=1e-9)
    np.testing.assert_allclose(
        found.explained_variance_ratio, expected.explained_variance_ratio_[:8], rtol=1e-9
    )
    np.testing.assert_allclose(found.mean.ravel(), expected.mean_, rtol=1e-6)
    np.testing.assert_allclose(found.components.reshape(8, -1), expected.components_[:8], atol=1e-6)
    np.testing.assert_allclose(found.scores, expected.transform(frames.reshape(9, -1))[:, :8], atol=1e-6)


@pytest.mark.rng("a small pattern on a large level is not lost")
def test_a_small_pattern_on_a_large_level_is_not_lost(rng):
    """Fractions of 1e-3 in single-precision frames of 3000 electrons: the sums must be made in double precision."""
    pattern = rng.standard_normal((40, 50))
    frames = (3000 * (1 + 1e-3 * np.arange(6)[:, None, None] * pattern)).astype(np.float32)
    expected = PCA(svd_solver="full").fit(frames.reshape(6, -1).astype(np.float64))
    found = fit_pca(frames, n_components=5)
    np.testing.assert_allclose(
        found.explained_variance_ratio, expected.explained_variance_ratio_[:5], atol=1e-12
    )


@pytest.mark.parametrize("count", [64, 65, 230])
@pytest.mark.rng("many frames equal the full svd of scikit learn")
def test_many_frames_equal_the_full_svd_of_scikit_learn(count, rng):
    """On both sides of the number from which products of a tile are in single precision."""
    patterns = rng.standard_normal((5, 1500))
    weights = rng.standard_normal((count, 5)) * np.array([30.0, 10.0, 3.0, 1.0, 0.3])
    frames = (weights @ patterns + 7.0 + 0.05 * rng.standard_normal((count, 1500))).astype(np.float32)
    frames[3, 700] = np.nan
    good = np.arange(1500) != 700
    expected = PCA(svd_solver="full").fit(frames[:, good].astype(np.float64))
    found = fit_pca(list(frames.reshape(count, 50, 30)), n_components=5, tile_bytes=2**17)
    np.testing.assert_allclose(
        found.explained_variance_ratio, expected.explained_variance_ratio_[:5], atol=1e-7, rtol=1e-5
    )
    components = found.components.reshape(5, -1)
    np.testing.assert_allclose(components[:, good], expected.components_[:5], atol=2e-6)
    np.testing.assert_allclose(found.mean.ravel()[good], expected.mean_, atol=2e-5)
    assert not components[:, 700].any()


@pytest.mark.rng("rounding is not taken for a component")
def test_rounding_is_not_taken_for_a_component(rng):
    """Two patterns without noise, in few frames and in many: none but the two stands above the rounding."""
    patterns = rng.standard_normal((2, 3000))
    for count in (20, 150):
        frames = (rng.standard_normal((count, 2)) @ patterns).astype(np.float32)
        assert len(fit_pca(list(frames.reshape(count, 60, 50))).components) == 2


@pytest.mark.rng("number formats of files are read")
def test_number_formats_of_files_are_read(frames):
    expected = fit_pca(list(frames.astype(np.float32)), n_components=3)
    for form in (">f4", ">f8", "f8"):
        found = fit_pca(list(frames.astype(np.float32).astype(form)), n_components=3)
        np.testing.assert_allclose(found.explained_variance, expected.explained_variance, rtol=1e-9)
        np.testing.assert_allclose(found.components, expected.components, atol=2e-6)
    whole = fit_pca(list(np.round(1000 * frames).astype(np.int32)), n_components=3)
    np.testing.assert_allclose(whole.explained_variance_ratio, expected.explained_variance_ratio, rtol=1e-3)


@pytest.mark.rng("levels of exposures do not hide their fringes")
def test_levels_of_exposures_do_not_hide_their_fringes(night, rng):
    """Exposures of very different length: their fringes in units of the common sky are what is decomposed."""
    scales = np.linspace(0.2, 5.0, len(night))
    exposures = [
        dataclasses.replace(frame, image=frame.image * np.float32(scale))
        for frame, scale in zip(night, scales, strict=True)
    ]
    found = fit_pca(exposures, n_components=2)
    images = np.stack([frame.image.astype(np.float64) for frame in exposures])
    level = images.mean(axis=(1, 2))
    expected = PCA(svd_solver="full").fit(
        ((images - level[:, None, None]) / level.mean()).reshape(len(night), -1)
    )
    np.testing.assert_allclose(
        found.explained_variance_ratio, expected.explained_variance_ratio_[:2], atol=1e-9
    )
    np.testing.assert_allclose(found.mean.ravel(), expected.mean_, atol=1e-9)


@pytest.mark.rng("masked pixels do not count")
def test_masked_pixels_do_not_count(frames, rng):
    mask = rng.random((60, 47)) < 0.2
    spoiled = frames.copy()
    spoiled[3, mask] = 1e6
    spoiled[5, 7, 8] = np.nan
    good = ~mask
    good[7, 8] = False
    found = fit_pca(list(spoiled), mask=mask, n_components=4)
    expected = PCA(svd_solver="full").fit(frames[:, good])
    np.testing.assert_allclose(
        found.explained_variance_ratio, expected.explained_variance_ratio_[:4], rtol=1e-9
    )
    np.testing.assert_allclose(found.components[:, good], expected.components_[:4], atol=1e-6)
    assert not found.components[:, ~good].any()
    assert not found.mean[~good].any()
    np.testing.assert_array_equal(found.mask != 0, ~good)
    assert set(np.unique(found.mask)) == {0, mask_bits("NO_DATA")}


@pytest.mark.rng("memory maps and streams give the same")
def test_memory_maps_and_streams_give_the_same(frames, tmp_path):
    paths = [tmp_path / f"{number}.npy" for number in range(9)]
    for path, frame in zip(paths, frames, strict=True):
        np.save(path, frame)
    mapped = fit_pca([np.load(path, mmap_mode="r") for path in paths], n_components=3)
    held = fit_pca(list(frames), n_components=3)
    np.testing.assert_array_equal(mapped.components, held.components)


@pytest.mark.rng("memory beside the inputs is bounded")
def test_memory_beside_the_inputs_is_bounded(rng):
    import tracemalloc

    frames = [rng.standard_normal((500, 400)).astype(np.float32) for _ in range(30)]
    tracemalloc.start()
    fit_pca(frames, n_components=1, tile_bytes=2**20)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # two images of 0.8 MB, masks, and the tile; the frames themselves are 24 MB
    assert peak < 6 * 2**20


def test_night_of_the_paper(night):
    """Section 5.4: two components, 98.9 and 1.03 per cent (98 and 2 in the paper)."""
    found = fit_pca(night, n_components=5)
    assert found.explained_variance_ratio[0] == pytest.approx(0.989, abs=0.003)
    assert found.explained_variance_ratio[1] == pytest.approx(0.0103, abs=0.003)
    # reconstruction: fringes of hour 3 in units of the mean sky
    sky = np.mean([frame.mean_electrons for frame in night])
    fringe = (night[3].image - night[3].image.mean(dtype=float)) / sky
    again = found.mean + np.tensordot(found.scores[3], found.components, axes=1)
    np.testing.assert_allclose(again, fringe, atol=5e-7)


def test_components_from_the_histogram_of_thickness(thickness, model, response, night):
    history = NightHistory.guo2022()
    scales = [history.band_scale(hour, response.bands) for hour in range(11)]
    from_images = fit_pca(night, n_components=3)
    shortcut = fit_pca_from_thickness(thickness, response, scales, n_components=3)
    np.testing.assert_allclose(
        shortcut.explained_variance_ratio, from_images.explained_variance_ratio, atol=1e-6
    )
    np.testing.assert_allclose(shortcut.explained_variance, from_images.explained_variance, rtol=2e-3)
    np.testing.assert_allclose(shortcut.mean, from_images.mean, atol=1e-6)
    assert shortcut.metadata["MEANSKY"] == pytest.approx(
        from_images.metadata["MEANSKY"] / (30 * 32.40 * 0.04), rel=1e-5
    )
    for number in range(2):
        one, two = shortcut.components[number].ravel(), from_images.components[number].ravel()
        assert abs(one @ two) / np.linalg.norm(one) / np.linalg.norm(two) > 1 - 1e-5


def test_histogram_of_thickness_needs_no_images(thickness, response):
    """Variance fractions and scores without an image are those of the frames, each pixel taken by itself."""
    history = NightHistory.guo2022()
    scales = [history.band_scale(hour, response.bands) for hour in range(11)]
    spoiled = thickness.copy()
    spoiled[3, 4] = np.nan
    found = decompose_thickness(spoiled, response, scales, n_components=3)
    levels = np.stack([response.sky(scale).lookup(spoiled[np.isfinite(spoiled)])[0] for scale in scales])
    levels -= levels.mean(axis=1, keepdims=True)
    expected = PCA(svd_solver="full").fit(levels)
    np.testing.assert_allclose(
        found.explained_variance_ratio, expected.explained_variance_ratio_[:3], atol=1e-6
    )
    images = found.images(spoiled)
    assert images.mask[3, 4] == mask_bits("NO_DATA")
    assert images.components[:, 3, 4].tolist() == [0.0, 0.0, 0.0]
    # Components that are functions of thickness are orthonormal over the pixels.
    product = np.einsum("iyx,jyx->ij", images.components.astype(float), images.components.astype(float))
    np.testing.assert_allclose(product[:2, :2], np.eye(2), atol=2e-3)


def test_thickness_outside_the_response_is_named(thickness, response):
    scales = [{}, {"8-4": 2.0}]
    thick = thickness.copy()
    thick[5, 6] = 22.6
    with pytest.raises(OutOfRangeError, match=r"thickness \[um\] is 22.6"):
        decompose_thickness(thick, response, scales)
    with pytest.raises(InputError, match="pixels with a thickness"):
        decompose_thickness(np.full((5, 5), np.nan), response, scales)
    ends = np.array([[response.table.start_um, response.table.stop_um], [15.0, 16.0]])
    assert np.isfinite(decompose_thickness(ends, response, scales).explained_variance).all()


@pytest.mark.rng("number of components is chosen against the noise")
def test_number_of_components_is_chosen_against_the_noise(frames, rng):
    clean = np.tensordot(rng.standard_normal((12, 2)), frames[:2] - 5.0, axes=1)
    for sigma, expected in ((0.01, 2), (1000.0, 1)):
        noisy = clean + sigma * rng.standard_normal(clean.shape)
        assert len(fit_pca(list(noisy), noise_variance=sigma**2).components) == expected


@pytest.mark.rng("noise edge holds for pure noise")
def test_noise_edge_holds_for_pure_noise(rng):
    frames, pixels = 20, 4000
    edge = noise_eigenvalue(frames, pixels, 1.0)
    for _ in range(10):
        noise = rng.standard_normal((frames, pixels))
        noise -= noise.mean(axis=0)
        values = np.linalg.eigvalsh(noise @ noise.T)[::-1]
        assert values[0] < edge + 5 * np.sqrt(2 * pixels)
        assert values[0] > 0.9 * edge
        assert significant_components(values, pixels, 1.0) == 1


def test_noise_of_simulated_exposures_is_known(thickness, model, response):
    noisy = list(simulate_night(thickness, model, response, NightHistory.guo2022(), seed=4, read_noise_e=6.0))
    found = fit_pca(noisy, n_components=1)
    electrons = np.mean([frame.mean_electrons for frame in noisy])
    assert found.metadata["NOISEVAR"] == pytest.approx((electrons + 36.0) / electrons**2, rel=1e-4)


def test_templates_are_orthogonal_zero_mean_fractions(night):
    templates = fringe_templates(fit_pca(night), NOW, least_rms=1e-6)
    assert len(templates) >= 2
    sky = np.mean([frame.mean_electrons for frame in night])
    mean = np.mean([frame.image - frame.image.mean(dtype=float) for frame in night], axis=0) / sky
    np.testing.assert_allclose(templates[0].image, mean, atol=2e-6)
    for number, one in enumerate(templates):
        assert abs(one.image.mean(dtype=float)) < 1e-9
        assert one.metadata["TEMPLATE"] == number
        for two in templates[:number]:
            cosine = np.vdot(one.image, two.image) / np.linalg.norm(one.image) / np.linalg.norm(two.image)
            assert abs(cosine) < 1e-3
    assert templates[0].physical_filter == "unknown"


def test_templates_describe_every_frame_of_the_night(night):
    templates = fringe_templates(fit_pca(night), NOW, least_rms=1e-6)
    basis = np.stack([template.image for template in templates])
    for frame in night:
        fraction = frame.fraction()
        fitted = project(fraction, basis, 1.0)
        rest = fraction - fitted.background - np.tensordot(fitted.coefficient, basis, axes=1)
        assert rest.std() < 0.01 * fraction.std()


def test_faint_templates_are_left_out(night):
    components = fit_pca(night)
    assert len(fringe_templates(components, NOW, least_rms=1.0)) == 1
    assert len(fringe_templates(components, NOW, least_rms=1e-7, most=2)) == 2


@pytest.mark.rng("projection recovers coefficients with their covariance")
def test_projection_recovers_coefficients_with_their_covariance(rng):
    basis = rng.standard_normal((2, 30, 40))
    basis[1] += 0.7 * basis[0]
    mask = np.zeros((30, 40), dtype=int)
    mask[:, :5] = 1
    pulls = []
    for _ in range(300):
        frame = 2.0 * basis[0] - 0.5 * basis[1] + 7.0 + 0.3 * rng.standard_normal((30, 40))
        frame[:, :5] = 1e9
        found = project(frame, basis, 0.09, mask)
        pulls.append(np.linalg.solve(np.linalg.cholesky(found.covariance), found.coefficient - [2.0, -0.5]))
    pulls = np.array(pulls)
    assert np.abs(pulls.mean(axis=0)).max() < 4 / np.sqrt(300)
    np.testing.assert_allclose(np.cov(pulls.T), np.eye(2), atol=0.25)
    assert found.background == pytest.approx(7.0, abs=0.05)
    assert found.chi2_per_pixel == pytest.approx(1.0, abs=0.15)


@pytest.mark.rng("bad input is named")
def test_bad_input_is_named(frames, response, thickness):
    with pytest.raises(InputError, match="number of frames"):
        fit_pca([frames[0]])
    with pytest.raises(InputError, match="shape of frame 1"):
        fit_pca([frames[0], frames[1][:5]])
    with pytest.raises(InputError, match="shape of the mask"):
        fit_pca(list(frames), mask=np.zeros((3, 3)))
    with pytest.raises(InputError, match="good pixels"):
        fit_pca(list(frames), mask=np.ones((60, 47)))
    with pytest.raises(InputError, match="frames that vary"):
        fit_pca([frames[0], frames[0]])
    with pytest.raises(OutOfRangeError, match="number of components"):
        fit_pca(list(frames), n_components=10)
    with pytest.raises(OutOfRangeError, match="noise variance"):
        fit_pca(list(frames), noise_variance=-1.0)
    with pytest.raises(InputError, match="two or more frames"):
        fit_pca_from_thickness(thickness, response, [{}])
    with pytest.raises(InputError, match="frames that vary"):
        fit_pca_from_thickness(thickness, response, [{}, {}])
    with pytest.raises(InputError, match="shape of the basis"):
        project(frames[0], frames[0], 1.0)
    with pytest.raises(InputError, match="independent"):
        project(frames[0], np.stack([frames[1], frames[1]]), 1.0)
    with pytest.raises(InputError, match="good pixels"):
        project(frames[0], frames[1:3], 1.0, np.ones((60, 47)))


@pytest.mark.rng("rank")
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_no_more_components_than_the_rank(rng, kind) -> None:
    a, b, c = rng.standard_normal((3, 40, 50)).astype(kind)
    frames = [a, b, c, a]
    for number in (3, 4):
        with pytest.raises(OutOfRangeError, match="1 to 2, the rank"):
            fit_pca(frames, n_components=number)
    found = fit_pca(frames, n_components=2)
    for component in found.components:
        assert np.linalg.norm(component) == pytest.approx(1.0, rel=1e-5)
    small = list(rng.standard_normal((20, 3, 3)).astype(kind))
    with pytest.raises(OutOfRangeError, match="1 to 9, the rank"):
        fit_pca(small, n_components=12)
    assert fit_pca(small, n_components=9).n_components == 9
