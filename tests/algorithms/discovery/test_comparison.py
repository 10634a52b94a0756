"""Quick comparison of models with data, beside least squares plane by plane."""

import numpy as np
import pytest
from scipy.optimize import nnls

from lsst.fringe_sim.algorithms.discovery.comparison import chi2_with_free_fringes


@pytest.mark.rng("level and contrast of every wavelength are free")
def test_level_and_contrast_of_every_wavelength_are_free(rng: np.random.Generator) -> None:
    """The contrast is not negative: fringes upside down do not fit; faint fringes keep their digits."""
    waves, number, shape = 5, 4, (7, 9)
    models = 1.0 + 0.05 * rng.standard_normal((waves, number, *shape))
    models[:, 3] = 1.0 + 2e-6 * rng.standard_normal((waves, *shape))
    value = 1.1 * models[:, 0] + 0.01 * rng.standard_normal((waves, *shape))
    value[2] = 3.0 - models[2, 1]
    value[4] += 400.0 * (models[4, 3] - 1.0)
    weight = rng.uniform(1.0, 2.0, (waves, *shape)) * 1e4 * (rng.random((waves, *shape)) < 0.8)
    expected = np.zeros(number)
    for plane in range(waves):
        root = np.sqrt(weight[plane]).ravel()
        for k in range(number):
            fringe = (models[plane, k] - models[plane, k].mean()).ravel()
            scale = np.abs(fringe).max()
            columns = np.stack([root, -root, root * fringe / scale], axis=1)
            expected[k] += nnls(columns, root * value[plane].ravel())[1] ** 2
    np.testing.assert_allclose(chi2_with_free_fringes(models, value, weight), expected, rtol=1e-7)
    assert expected.argmin() == 0


def test_a_wavelength_without_data_or_without_fringes_says_nothing() -> None:
    models, value = np.ones((2, 3, 4, 5)), np.full((2, 4, 5), 1.2)
    weight = np.zeros((2, 4, 5))
    weight[0] = 1.0
    np.testing.assert_allclose(chi2_with_free_fringes(models, value, weight), 0.0, atol=1e-12)
