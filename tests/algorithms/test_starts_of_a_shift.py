"""Common shifts from which a map is moved to the frames of a night, against a solution of all pixels at once."""

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.night_levels import thinned
from lsst.fringe_sim.algorithms.sky_shift import fit_sky_shift

ORDER_UM, NOISE, SHAPE = 0.32, 0.02, (24, 28)
Y, X = np.indices(SHAPE)
MAP_UM = 14.0 + 0.5 * X / SHAPE[1] + 0.3 * (Y / SHAPE[0]) ** 2
STEPS_PER_ORDER = 24


def predict(thickness_um: np.ndarray) -> np.ndarray:
    phase = 2.0 * np.pi * np.asarray(thickness_um) / ORDER_UM
    return np.stack([0.3 + 0.02 * np.cos(phase), 0.2 + 0.01 * np.cos(1.06 * phase)])


def frames(shift_um: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    rng = np.random.default_rng(3)
    values = []
    for scale in (0.8, 1.3):
        bands = predict(MAP_UM + shift_um)
        values.append(
            scale * (bands - bands.mean(axis=(1, 2), keepdims=True)).sum(axis=0) + 0.02 * X / SHAPE[1]
        )
        values[-1] += NOISE * rng.standard_normal(SHAPE)
    return values, [np.where(rng.random(SHAPE) < 0.1, 0.0, NOISE**-2.0) for _ in values]


def misfit(value: np.ndarray, weight: np.ndarray, step_um: float) -> float:
    """Least half χ² of a frame: strengths of the bands 1 ± 1 and not negative, a background of second degree."""
    bands = predict(MAP_UM + step_um)
    y, x = (axis.ravel() / (0.5 * (size - 1)) - 1.0 for axis, size in zip((Y, X), SHAPE, strict=True))
    columns = [*(band.ravel() - band.mean() for band in bands), y * 0 + 1, x, x * x, y, y * x, y * y]
    root = np.sqrt(weight).ravel()
    left = []
    for there in ((0, 1), (0,), (1,), ()):
        kept = [*there, *range(2, 8)]
        rows = np.vstack(
            [root[:, None] * np.stack(columns, axis=1)[:, kept], np.eye(8)[list(there)][:, kept]]
        )
        right = np.append(root * value.ravel(), np.ones(len(there)))
        level = np.linalg.lstsq(rows, right, rcond=None)[0]
        if (level[: len(there)] >= 0.0).all():
            left.append(0.5 * float(((right - rows @ level) ** 2).sum()) + 0.5 * (2 - len(there)))
    return left[0]


@pytest.mark.parametrize(("shift", "sigma"), [(0.42, 0.2), (0.42, 0.6)])
def test_a_map_is_moved_from_all_shifts_that_are_likelier_than_those_beside(
    shift: float, sigma: float, recorded: Record
) -> None:
    """Here the order is open, and what is known of the map before decides which shifts are near enough."""
    values, weights = frames(shift * ORDER_UM)
    asked: list[float] = []

    def seen(thickness_um: np.ndarray) -> np.ndarray:
        away = thickness_um - MAP_UM
        asked.append(float(away.mean()) if np.ptp(away) < 1e-12 else np.nan)
        return predict(thickness_um)

    found = fit_sky_shift(values, weights, MAP_UM, seen, ORDER_UM, map_sigma_um=sigma * ORDER_UM)
    half = max(STEPS_PER_ORDER, int(np.ceil(3.0 * STEPS_PER_ORDER * sigma)))
    steps = np.arange(-half, half + 1) * ORDER_UM / STEPS_PER_ORDER
    np.testing.assert_allclose(asked[: len(steps)], steps, atol=1e-12)
    log = [
        -sum(misfit(*frame, step) for frame in zip(values, weights, strict=True))
        - 0.5 * (step / (sigma * ORDER_UM)) ** 2
        for step in steps
    ]
    assert asked[len(steps)] == pytest.approx(steps[int(np.argmax(log))], abs=1e-12)
    recorded({"found": found, "asked": [round(each, 6) for each in asked if not np.isnan(each)]})


def test_predictions_of_some_pixels_are_those_of_the_whole_image() -> None:
    """A response that depends on the place of a pixel."""
    layer = np.zeros((7, 10))
    place = np.indices(layer.shape)
    some = thinned(lambda thickness: np.stack([thickness * place[0], thickness + place[1]]), layer, 3)
    thickness = np.arange(12.0).reshape(3, 4)
    y, x = np.indices((3, 4))
    np.testing.assert_array_equal(some(thickness), [thickness * 3 * y, thickness + 3 * x])
