"""Charge behind what was counted."""

from __future__ import annotations

import numpy as np
import pytest

from lsst.fringe_sim.effects import EFFECTS, ImageGeometry, activate_effects, apply_to_image
from lsst.fringe_sim.model import FringeModel

SYSTEM = FringeModel.from_setup("ts8_e2v").base_system


def image_with(quadratic: float, image: np.ndarray, counted_e: float) -> np.ndarray:
    geometry = ImageGeometry.of_pixels(image.shape[1:], np.array([960.0]), counted_e)
    active = activate_effects({"non_linearity.quadratic": quadratic}, EFFECTS)
    return apply_to_image(active, SYSTEM, image, geometry)


@pytest.mark.parametrize("quadratic", [-0.1, 0.05, 0.1])
def test_the_level_is_what_was_counted(quadratic: float) -> None:
    light = 1.0 + 0.05 * np.sin(np.arange(64.0)).reshape(1, 8, 8)
    light /= light.mean()
    charge = 60_000.0 * light
    counted = charge * (1.0 - quadratic * charge / 1e5)
    found = image_with(quadratic, light, float(counted.mean()))
    np.testing.assert_allclose(found / found.mean(), counted / counted.mean(), atol=2e-6)


def test_more_than_can_be_counted_is_finite() -> None:
    assert np.isfinite(image_with(0.2, np.ones((1, 4, 4)), 200_000.0)).all()
