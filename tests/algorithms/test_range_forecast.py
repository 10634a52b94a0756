"""Frames that would tell a map from a range, where the answer follows by hand or by trial."""

import math
from typing import Any

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.range_forecast import RangeForecast, forecast_of_range
from lsst.fringe_sim.errors import InputError, OutOfRangeError

ORDER_UM, AMPLITUDE, SIDE = 0.32, 2e-3, 1024


def two_lines(thickness_um: np.ndarray) -> np.ndarray:
    """Fringes of two lines that are out of step after sixteen orders."""
    phase = 2.0 * np.pi * np.asarray(thickness_um) / ORDER_UM
    return 5.0 * (1.0 + 0.5 * AMPLITUDE * (np.cos(phase) + np.cos(phase * (1.0 + 1.0 / 16.0))))


def one_line(thickness_um: np.ndarray) -> np.ndarray:
    return 1.0 + AMPLITUDE * np.cos(2.0 * np.pi * np.asarray(thickness_um) / ORDER_UM)


def forecast(predict: Any = one_line, **changed: Any) -> RangeForecast:
    given: dict[str, Any] = {
        "range_um": (13.0, 13.0 + 8.0 * ORDER_UM),
        "order_um": ORDER_UM,
        "shape": (SIDE, SIDE),
        "pixels": SIDE**2,
        "noise": 0.02,
    } | changed
    return forecast_of_range(predict, **given)


def test_fringes_of_one_line_are_seen_but_have_no_order() -> None:
    found = forecast()
    assert found.fringe_rms == pytest.approx(AMPLITUDE / math.sqrt(2.0), rel=0.02)
    assert found.orders == pytest.approx(8.0)
    # An eighth of an order is left in the middle of a part: the range falls with the square of its side.
    assert found.part_px == 128
    per_pixel = 0.02 * ORDER_UM / (2.0 * math.pi) / (AMPLITUDE / math.sqrt(2.0))
    assert found.sigma_um == pytest.approx(per_pixel / 128, rel=0.03)
    assert found.to_see < 5
    assert found.to_tell_order > 10**9
    assert found.frames == found.to_tell_order


def test_noise_and_pixels_count_as_they_should() -> None:
    one, noisier, fewer = (
        forecast(two_lines, **changed)
        for changed in ({"noise": 0.2}, {"noise": 0.8}, {"noise": 0.2, "pixels": SIDE**2 // 4})
    )
    for name, least in (("to_see", 20), ("to_tell_order", 10)):
        assert getattr(one, name) >= least
        assert getattr(noisier, name) == pytest.approx(16 * getattr(one, name), rel=0.2)
        assert getattr(fewer, name) == pytest.approx(4 * getattr(one, name), rel=0.2)


@pytest.mark.rng("orders are told as often as stated")
def test_orders_are_told_with_the_frames_that_are_stated(rng: np.random.Generator) -> None:
    """Mean of so many frames of a wedge, against the orders on both sides, of any strength; and with an eighth."""
    pixels, noise = 20_000, 0.02
    found = forecast(two_lines, pixels=pixels, noise=noise)
    layer = np.linspace(13.0, 13.0 + 8.0 * ORDER_UM, pixels)
    light = {k: two_lines(layer + k * ORDER_UM) / 5.0 - 1.0 for k in (-1, 0, 1)}

    def right(frames: int) -> float:
        told = 0
        for _ in range(200):
            seen = light[0] + noise / math.sqrt(frames) * rng.standard_normal(pixels)
            gain = {k: (seen @ each) ** 2 / (each @ each) for k, each in light.items()}
            told += max(gain, key=lambda k: gain[k]) == 0
        return told / 200.0

    assert right(found.to_tell_order) > 0.975
    assert right(found.to_tell_order // 8) < 0.97


def test_what_is_no_range_is_refused() -> None:
    with pytest.raises(OutOfRangeError, match="range of the thickness"):
        forecast(range_um=(14.0, 13.0))
    with pytest.raises(OutOfRangeError, match="noise"):
        forecast(noise=0.0)
    with pytest.raises(InputError, match="good pixels"):
        forecast(pixels=0)
