"""Minimum of sampled curves."""

import numpy as np

from lsst.fringe_sim.algorithms.parabola import parabolic_minimum


def test_parabolas_are_exact_and_ends_are_ends() -> None:
    x = np.arange(9.0)[:, np.newaxis]
    middles = np.array([3.2, 4.0, 6.9, -2.0, 11.0])
    curves = 0.5 * (x - middles) ** 2 + 1.0
    before = curves.copy()
    found = parabolic_minimum(curves)
    np.testing.assert_array_equal(curves, before)
    np.testing.assert_allclose(found.place, [3.2, 4.0, 6.9, 0.0, 8.0], atol=1e-12)
    np.testing.assert_allclose(found.value, [1.0, 1.0, 1.0, 3.0, 5.5], atol=1e-12)
    np.testing.assert_allclose(found.bend, 1.0, atol=1e-12)


def test_flat_curves_have_a_minimum_somewhere() -> None:
    found = parabolic_minimum(np.ones((5, 3)))
    assert np.all((found.place >= 0.0) & (found.place <= 4.0))
    np.testing.assert_array_equal(found.value, 1.0)
