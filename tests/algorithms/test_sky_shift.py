"""A map that is wrong by a smooth error is moved to where the frames of a night are; one that is right stays."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.sky_shift import SkyShift, fit_sky_shift
from lsst.fringe_sim.errors import InputError

ORDER_UM, NOISE, FRAMES = 0.32, 0.004, 6
SHAPE = (96, 80)
Y, X = np.indices(SHAPE)
MAP_UM = 14.0 + 2.2 * X / SHAPE[1] + 1.4 * (Y / SHAPE[0]) ** 2
BANDS = (1.0, 1.06, 0.97)


def predict(thickness_um: np.ndarray) -> np.ndarray:
    """Bands of their own phase and light; not of the package's optics."""
    phase = 2.0 * np.pi * np.asarray(thickness_um) / ORDER_UM
    return np.stack(
        [share * (1.0 + 0.008 * np.cos(k * phase)) for k, share in zip(BANDS, (0.3, 0.2, 0.1), strict=True)]
    )


def fitted(
    error: np.ndarray | float,
    rng: np.random.Generator,
    contrast: float = 1.0,
    frames: int = FRAMES,
    unknown: float = 0.0,
    turned: float = 0.0,
) -> SkyShift:
    """Bands that change from frame to frame, below a gradient of the sky, with noise of an unknown size."""
    values, weights = [], []
    for _ in range(frames):
        scale = contrast * rng.uniform(0.6, 1.4, len(BANDS))
        bands = predict(MAP_UM + error)
        sky = turned * np.sin(2.0 * np.pi * (MAP_UM + error) / ORDER_UM) * (MAP_UM - MAP_UM.mean())
        sky += np.tensordot(scale, bands - bands.mean(axis=(1, 2), keepdims=True), axes=1)
        sky += unknown * np.cos(2.0 * np.pi * 1.31 * MAP_UM / ORDER_UM)
        sky += 0.01 * X / SHAPE[1] + NOISE * rng.standard_normal(SHAPE)
        values.append(sky - sky.mean())
        weights.append(np.where(rng.random(SHAPE) < 0.05, 0.0, 2.0 / NOISE**2))
    return fit_sky_shift(values, weights, MAP_UM, predict, ORDER_UM)


@pytest.mark.rng("a map that is right stays where it is")
def test_a_map_that_is_right_stays_where_it_is(rng: np.random.Generator) -> None:
    found = fitted(0.0, rng)
    assert found.chance_unmoved > 0.5
    assert (np.abs(found.shift_um) <= 4 * found.sigma_um + 1e-9).all()
    assert np.abs(found.shift_um).max() < 0.02 * ORDER_UM
    assert found.chance_other_order < 0.01
    assert found.strength == pytest.approx(1.0, abs=0.2)


@pytest.mark.rng("a smooth error is found")
@pytest.mark.parametrize("contrast", [1.0, 0.5])
def test_a_smooth_error_is_found_with_its_uncertainty(rng: np.random.Generator, contrast: float) -> None:
    """Also with less contrast than the model's."""
    error = 0.05 * np.sin(2 * np.pi * Y / SHAPE[0]) + 0.03
    found = fitted(error, rng, contrast)
    left = found.shift_um - error
    assert found.chance_unmoved < 1e-6
    assert np.std(left) < 0.3 * np.std(error)
    assert np.sqrt(np.mean((left / found.sigma_um) ** 2)) < 2.0
    assert found.residual > 1.0


@pytest.mark.rng("a third of an order")
def test_a_map_that_is_a_third_of_an_order_away(rng: np.random.Generator) -> None:
    found = fitted(0.3 * ORDER_UM, rng)
    assert found.shift_um.mean() == pytest.approx(0.3 * ORDER_UM, abs=5 * float(found.sigma_um.mean()))
    assert found.spans == 0


@pytest.mark.slow
@pytest.mark.rng("pulls of one error and of smooth ones")
def test_pulls(rng: np.random.Generator) -> None:
    """Many sensors with an error of their own: what is stated is what scatters."""
    mean, local = [], []
    for _ in range(20):
        a, b, c = 0.02 * rng.standard_normal(3)
        error = a + b * np.cos(np.pi * X / SHAPE[1]) + c * np.sin(np.pi * Y / SHAPE[0])
        found = fitted(error, rng)
        place = tuple(rng.integers(0, side) for side in SHAPE)
        local.append((found.shift_um - error)[place] / found.sigma_um[place])
        common = fitted(a, rng)
        mean.append(float((common.shift_um - a).mean() / common.sigma_um.mean()))
    # Twenty normal numbers have an rms of 0.65 to 1.4 in 99 of 100 draws.
    assert 0.65 < np.sqrt(np.mean(np.square(mean))) < 1.4
    assert 0.5 < np.sqrt(np.mean(np.square(local))) < 1.6


@pytest.mark.rng("frames that say nothing")
def test_frames_that_say_nothing_say_how_many_would(rng: np.random.Generator) -> None:
    found = fitted(0.02, rng, contrast=0.02, frames=2)
    assert found.chance_unmoved > 0.1
    assert found.frames_for(0.01, 2) > 50


def test_what_all_frames_have_beyond_the_model_makes_a_shift_uncertain() -> None:
    known, less = (fitted(0.02, np.random.default_rng(7), unknown=unknown) for unknown in (0.0, 0.003))
    assert np.median(less.sigma_um) > 1.3 * np.median(known.sigma_um)


def test_a_model_with_another_envelope_moves_the_map_less_than_it_says() -> None:
    """Fringes whose phase turns with the thickness by up to a radian beyond the model: a map that is right stays."""
    turned = 0.004
    found = fitted(0.0, np.random.default_rng(7), turned=turned)
    assert found.model_error >= 0.1
    assert (np.abs(found.shift_um) < 3.0 * found.sigma_um).all()
    assert fitted(0.0, np.random.default_rng(7)).model_error <= 0.03


def test_frames_of_another_shape_are_refused() -> None:
    with pytest.raises(InputError, match="shape of a sky frame"):
        fit_sky_shift([np.ones((4, 5))], [np.ones((4, 5))], MAP_UM, predict, ORDER_UM)
    with pytest.raises(InputError, match="sky frames"):
        fit_sky_shift([], [], MAP_UM, predict, ORDER_UM)
