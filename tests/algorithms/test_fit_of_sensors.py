"""Thickness fits of whole sensors: hard maps, real maps, noise, missing data, and the walk of the paper beside it."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from flat_cubes import TEN_NM, relative_flats
from hard_maps import HARD_MAPS
from slow_cases import first_is_quick
from threadpoolctl import threadpool_limits

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube, ThicknessMap, mask_bits

HALF_ORDER_UM = 0.15
SHAPE = (160, 200)


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


def slipped(value: np.ndarray, truth: np.ndarray, good: np.ndarray) -> float:
    """Share of the good pixels that are off by more than half an order."""
    return float(np.mean(np.abs(value - truth)[good] > HALF_ORDER_UM))


@pytest.mark.parametrize("name", first_is_quick(sorted(HARD_MAPS)))
@pytest.mark.rng("hard maps without a slip")
def test_hard_maps_without_a_slip(name, model, rng) -> None:
    truth = HARD_MAPS[name](SHAPE)
    known = np.isfinite(truth)
    cube = relative_flats(np.where(known, truth, 17.0), model, rng)
    mask = np.where(known, 0, mask_bits("BAD")).astype(np.int16)
    masked = FringeCube(
        cube.image, cube.variance, np.broadcast_to(mask, cube.shape).copy(), cube.exposures, "relative"
    )
    fitted = fit_thickness(masked, model)
    good = (fitted.mask == 0) & known
    assert good[known].mean() > 0.97
    assert slipped(fitted.value, truth, good) == 0.0


@pytest.mark.rng("uncertainty holds")
def test_uncertainty_holds(model, rng) -> None:
    truth = random_field(SHAPE, rng, mean=17.0, span=4.0)
    fitted = fit_thickness(relative_flats(truth, model, rng), model)
    good = fitted.mask == 0
    pull = (fitted.value - truth)[good] / fitted.sigma[good]
    assert abs(pull.mean()) < 0.05
    assert pull.std() == pytest.approx(1.0, abs=0.1)
    assert np.median(fitted.chi2[good]) == pytest.approx(0.94, abs=0.1)


@pytest.mark.slow
@pytest.mark.rng("noise at which single pixels slip")
def test_noise_at_which_single_pixels_slip(model, rng) -> None:
    """Contrast lowered to that of real sensors, noise at which a lone pixel goes wrong every third time."""
    weak = model.with_effects({"contrast_loss.factor": 0.15})
    truth = random_field(SHAPE, rng, mean=17.0, span=4.0)
    cube = relative_flats(truth, weak, rng, noise=0.004)
    together = fit_thickness(cube, weak)
    good = together.mask == 0
    assert good.mean() > 0.9
    assert slipped(together.value, truth, good) == 0.0


@pytest.mark.slow
@pytest.mark.rng("walk of the paper fails where the path is broken")
def test_walk_of_the_paper_fails_where_the_path_is_broken(model, rng) -> None:
    """A wall of one and a half orders: the walk carries the error on, the global fit does not."""
    truth = random_field(SHAPE, rng, mean=17.0, span=2.0)
    truth[:, 120:] += 0.47
    cube = relative_flats(truth, model, rng)
    walk = fit_thickness(cube, model, method="guo2022", start_pixel=(80, 40))
    whole = fit_thickness(cube, model)
    good = whole.mask == 0
    assert good.mean() > 0.97
    assert slipped(whole.value, truth, good) < 1e-3
    assert slipped(walk.value, truth, np.isfinite(walk.value)) > 0.1


@pytest.mark.rng("walk of the paper is right on a smooth map")
def test_walk_of_the_paper_is_right_on_a_smooth_map(model, rng) -> None:
    truth = random_field(SHAPE, rng, mean=17.0, span=4.0)
    cube = relative_flats(truth, model, rng)
    for start in ((80, 100), (0, 0), (159, 10)):
        walk = fit_thickness(cube, model, method="guo2022", start_pixel=start)
        assert slipped(walk.value, truth, walk.mask == 0) == 0.0


@pytest.mark.slow
@pytest.mark.rng("any order of wavelengths")
def test_any_order_of_wavelengths(model, rng) -> None:
    truth = random_field(SHAPE, rng, mean=16.0, span=3.0)
    cube = relative_flats(truth, model, rng)
    mixed = cube.take(rng.permutation(len(TEN_NM)))
    np.testing.assert_allclose(
        fit_thickness(mixed, model).value, fit_thickness(cube, model).value, rtol=0.0, atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.rng("missing wavelengths cost certainty")
def test_missing_wavelengths_cost_certainty(model, rng) -> None:
    truth = random_field(SHAPE, rng, mean=16.0, span=3.0)
    cube = relative_flats(truth, model, rng)
    few = fit_thickness(cube.take([0, 2, 3, 5, 8, 10, 11]), model)
    many = fit_thickness(cube, model)
    good = (few.mask == 0) & (many.mask == 0)
    assert np.median(few.sigma[good]) > np.median(many.sigma[good])
    assert slipped(few.value, truth, good) < 1e-3
    assert np.all(few.n_wavelengths[good] == 7)


@pytest.mark.rng("bad columns and missing pixels")
def test_bad_columns_and_missing_pixels(model, rng) -> None:
    truth = random_field(SHAPE, rng, mean=17.0, span=4.0)
    cube = relative_flats(truth, model, rng)
    image, mask = cube.image.copy(), cube.mask.copy()
    image[:, :, 77] = 0.1
    mask[:, :, 77] = mask_bits("BAD")
    mask[3, 20:60, 20:60] = mask_bits("SAT")
    mask[:, 100:110, 150:160] = mask_bits("NO_DATA")
    spoilt = FringeCube(image, cube.variance, mask, cube.exposures, "relative")
    fitted = fit_thickness(spoilt, model)
    good = fitted.mask == 0
    assert not good[100:110, 150:160].any()
    assert not good[:, 77].any()
    assert good[20:60, 20:60].mean() > 0.95
    assert slipped(fitted.value, truth, good) == 0.0


@pytest.mark.rng("threads do not change the result")
def test_threads_do_not_change_the_result(model, rng) -> None:
    cube = relative_flats(random_field(SHAPE, rng, mean=17.0, span=4.0), model, rng)

    def fitted(threads: int) -> ThicknessMap:
        with threadpool_limits(limits=threads, user_api="blas"):
            return fit_thickness(cube, model, threads=threads)

    one, two = fitted(1), fitted(2)
    np.testing.assert_array_equal(one.value, two.value)
    np.testing.assert_array_equal(one.sigma, two.sigma)
    np.testing.assert_array_equal(one.flats.contrast, two.flats.contrast)


@pytest.mark.rng("bad requests")
def test_bad_requests(model, rng) -> None:
    cube = relative_flats(np.full((20, 20), 17.0), model, rng)
    with pytest.raises(UnknownNameError, match="global"):
        fit_thickness(cube, model, method="globl")
    with pytest.raises(InputError):
        fit_thickness(cube, model, method="guo2022", start_pixel=(500, 3))
    nothing = FringeCube(
        cube.image, cube.variance, np.full(cube.shape, mask_bits("BAD"), np.int16), cube.exposures, "relative"
    )
    with pytest.raises(InputError):
        fit_thickness(nothing, model)


def repaired(path: Path) -> np.ndarray:
    """Published map of a sensor with its row jumps of whole orders taken out [µm above its minimum]."""
    with fits.open(path) as hdus:
        fine = np.asarray(hdus["FINE"].data, dtype=float)
    steps = np.median(np.diff(fine, axis=0), axis=1)
    jumps = 0.3 * np.round(steps / 0.3)
    return fine - np.concatenate([[0.0], np.cumsum(jumps)])[:, None]


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize(
    "sensor", ["S00_E2V-319", "S01_E2V-321", "S02_E2V-359", "S20_E2V-350", "S22_E2V-361"]
)
@pytest.mark.rng("real maps of the raft")
def test_real_maps_of_the_raft(sensor, shared_dir, model, rng) -> None:
    """Maps of RTM-020 at a sixteenth of their pixels, the absolute thickness drawn anew."""
    relief = repaired(shared_dir / "measured" / f"RTM-020_{sensor}_epoxy_map.fits")
    relief = np.nan_to_num(relief, nan=float(np.nanmedian(relief)))
    truth = relief - relief.min() + rng.uniform(9.0, 13.0)
    fitted = fit_thickness(relative_flats(truth, model, rng, noise=0.001), model)
    good = fitted.mask == 0
    assert good.mean() > 0.9
    assert slipped(fitted.value, truth, good) < 2e-3
