"""Rings of the silicon: the pattern, and how it is found in what a model leaves."""

import numpy as np
import pytest

from lsst.fringe_sim.effects import ImageGeometry, Residuals
from lsst.fringe_sim.effects.tree_rings import TreeRings

WAVELENGTHS = np.array([900.0, 950.0, 980.0])


def geometry_of(shape: tuple[int, int]) -> ImageGeometry:
    return ImageGeometry.of_pixels(shape, WAVELENGTHS, 20_000.0)


def noise_and_weight(shape: tuple[int, int], rms: float, rng) -> tuple[np.ndarray, np.ndarray]:
    """Independent noise of every plane, with a tenth of the sensor missing."""
    weight = np.full((len(WAVELENGTHS), *shape), rms**-2)
    weight[:, :, : shape[1] // 10] = 0.0
    return np.where(weight > 0.0, rng.normal(0.0, rms, weight.shape), 0.0), weight


def rings(values: dict[str, float], geometry: ImageGeometry) -> np.ndarray:
    flat = np.ones((len(WAVELENGTHS), *geometry.sample_shape))
    return TreeRings().change_image(flat, values, geometry) - 1.0


def test_the_pattern_is_a_wave_in_the_radius() -> None:
    """Half a period farther out the sign is the other one; along a ring nothing changes."""
    geometry = geometry_of((200, 200))
    values = {"cosine": 0.01, "sine": 0.0, "centre_x": -300.0, "centre_y": 99.5, "period": 40.0}
    pattern = rings(values, geometry)[0]
    y, x = np.indices(geometry.shape)
    radius = np.hypot(y - 99.5, x + 300.0)
    expected = 0.01 * np.cos(2.0 * np.pi * (radius - 399.5) / 40.0)
    np.testing.assert_allclose(pattern - pattern.mean(), expected - expected.mean(), atol=2e-4)


def test_pixels_and_cells_average_over_their_area() -> None:
    """Cells of 4 px see the mean of the pixels in them."""
    fine = geometry_of((160, 160))
    middle = 4.0 * np.arange(40) + 1.5
    coarse = ImageGeometry((160, 160), middle, middle, WAVELENGTHS, fine.level_e)
    values = {"cosine": 0.01, "sine": -0.02, "centre_x": -70.0, "centre_y": -40.0, "period": 11.0}
    pixels = rings(values, fine)[0].reshape(40, 4, 40, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(rings(values, coarse)[0], pixels, atol=4e-4)


@pytest.mark.parametrize("number", range(6))
def test_rings_are_found_in_noise(number: int) -> None:
    """Wherever the centre is: a wave of a seventh of the noise of a pixel shows in 8000 of them."""
    rng = np.random.default_rng([7, number])
    geometry = geometry_of((90, 110))
    residual, weight = noise_and_weight(geometry.shape, 0.01, rng)
    phase = float(rng.uniform(0.0, 2.0 * np.pi))
    true = {
        "cosine": 1.5e-3 * np.cos(phase), "sine": 1.5e-3 * np.sin(phase),
        "centre_x": float(rng.uniform(-150.0, 250.0)), "centre_y": float(rng.uniform(-150.0, 250.0)),
        "period": float(rng.uniform(5.0, 20.0)),
    }  # fmt: skip
    residual = np.where(weight > 0.0, residual + rings(true, geometry), 0.0)
    (found,) = TreeRings().propose(Residuals(residual, weight, geometry))
    assert found["period"] == pytest.approx(true["period"], rel=0.05)
    pattern, expected = rings(found, geometry)[0], rings(true, geometry)[0]
    assert np.corrcoef(pattern.ravel(), expected.ravel())[0, 1] > 0.8


@pytest.mark.parametrize("centre", [(115.0, 178.0), (-60.0, 48.0)])
@pytest.mark.rng("rings hardly wider than two cells are found")
def test_rings_hardly_wider_than_two_cells_are_found(centre: tuple[float, float], rng) -> None:
    """5.5 px in cells of two, which average a third of the wave away."""
    middle = 2.0 * np.arange(48) + 0.5
    geometry = ImageGeometry((96, 96), middle, middle, WAVELENGTHS, np.full(len(WAVELENGTHS), 20_000.0))
    residual, weight = noise_and_weight(geometry.sample_shape, 0.005, rng)
    true = {"cosine": 0.0016, "sine": 0.0, "centre_x": centre[0], "centre_y": centre[1], "period": 5.51}
    residual = np.where(weight > 0.0, residual + rings(true, geometry), 0.0)
    (found,) = TreeRings().propose(Residuals(residual, weight, geometry))
    pattern, expected = rings(found, geometry)[0], rings(true, geometry)[0]
    assert np.corrcoef(pattern.ravel(), expected.ravel())[0, 1] > 0.8


@pytest.mark.parametrize("number", range(4))
def test_noise_has_no_rings(number: int) -> None:
    residual, weight = noise_and_weight((90, 110), 0.01, np.random.default_rng([8, number]))
    assert TreeRings().propose(Residuals(residual, weight, geometry_of((90, 110)))) == ()


def test_straight_stripes_are_no_rings() -> None:
    rng = np.random.default_rng(9)
    residual, weight = noise_and_weight((90, 110), 0.01, rng)
    y, x = np.indices((90, 110))
    stripes = 2e-3 * np.cos(2.0 * np.pi * (0.6 * x + 0.8 * y) / 9.0)
    left = np.where(weight > 0.0, residual + stripes, 0.0)
    assert TreeRings().propose(Residuals(left, weight, geometry_of((90, 110)))) == ()


def test_a_perfect_model_leaves_no_rings() -> None:
    nothing = np.zeros((len(WAVELENGTHS), 90, 110))
    assert TreeRings().propose(Residuals(nothing, nothing + 1.0, geometry_of((90, 110)))) == ()


def test_too_few_pixels_show_nothing() -> None:
    residual, weight = noise_and_weight((12, 20), 0.01, np.random.default_rng(1))
    assert TreeRings().propose(Residuals(residual, weight, geometry_of((12, 20)))) == ()


@pytest.mark.parametrize(("rows", "longest"), [(401, 280.0), (101, 70.0), (31, 50.5), (2001, 500.0)])
def test_the_longest_period_is_a_part_of_the_sensor(rows: int, longest: float) -> None:
    """0.7 of the longer side between middles of pixels, within the 500 px of the catalogue, and beyond the null."""
    middle = {size: np.arange(float(size)) for size in (rows, 21)}
    effect, beside = TreeRings(), geometry_of((rows, 21))
    period = next(item for item in effect.parameters if item.name == "period")
    assert effect.bounds_on(period, beside) == pytest.approx((2.0, longest))
    turned = ImageGeometry((21, rows), middle[21], middle[rows], WAVELENGTHS, beside.level_e)
    assert effect.bounds_on(period, turned) == pytest.approx((2.0, longest))
