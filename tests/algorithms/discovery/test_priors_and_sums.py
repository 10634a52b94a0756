"""Sums over pixels, priors, and curves through errors, against calculations of each entry."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from flat_cubes import relative_flats
from scipy.stats import f as f_distribution

from lsst.fringe_sim.algorithms.discovery.cells import BAD_PLANES, _pixels_of
from lsst.fringe_sim.algorithms.discovery.learned_columns import LENGTHS_NM, _of_light
from lsst.fringe_sim.algorithms.discovery.trends import trend_channel
from lsst.fringe_sim.algorithms.thickness_fit import Nuisances
from lsst.fringe_sim.algorithms.thickness_fit.learning import _Problem
from lsst.fringe_sim.effects import ImageGeometry
from lsst.fringe_sim.model import FringeModel


@pytest.mark.parametrize("size", [0.03, 20.0])
def test_a_curve_through_errors_is_that_of_generalised_least_squares(size: float) -> None:
    rng = np.random.default_rng(4)
    wavelength = np.sort(rng.uniform(900.0, 1000.0, 9))
    mixed = rng.normal(size=(9, 9)) * size / 6.0
    covariance = mixed @ mixed.T + np.eye(9) * (0.1 * size) ** 2
    error = size * (rng.standard_normal(9) + 0.002 * (wavelength - 930.0) ** 2)
    shapes = np.stack([((wavelength - 950.0) / 50.0) ** power for power in range(4)], axis=1)
    scale = np.sqrt(np.mean(error**2))
    found = []
    for width in 10.0 ** (np.arange(-60, 61) / 20.0):
        whole = covariance + (width * scale) ** 2 * np.eye(9)
        inverse = np.linalg.inv(whole)
        left = []
        for columns in (shapes[:, :1], shapes):
            normal = columns.T @ inverse @ columns
            rest = error - columns @ np.linalg.solve(normal, columns.T @ inverse @ error)
            left.append(float(rest @ inverse @ rest))
        log = np.linalg.slogdet(whole)[1] + np.linalg.slogdet(shapes.T @ inverse @ shapes)[1]
        found.append((-0.5 * (left[1] + log), *left))
    _, flat, smooth = max(found)
    statistic = (flat - smooth) / 3 / (smooth / 5)
    channel = trend_channel("a trend", wavelength, error, covariance)
    assert (channel.name, channel.degrees) == ("a trend", 3.0)
    assert channel.statistic == pytest.approx(3 * statistic, rel=1e-6)
    assert channel.probability == pytest.approx(f_distribution.sf(statistic, 3, 5), rel=1e-6)


def test_sums_of_cells_are_those_of_good_pixels() -> None:
    rng = np.random.default_rng(4)
    model = FringeModel.from_setup("ts8_e2v")
    cube = relative_flats(14.0 + 0.01 * np.arange(16.0) * np.ones((16, 1)), model, rng, 0.007)
    image = np.array(cube.image)
    mask = np.array(cube.mask)
    dead = rng.random((16, 16)) < 0.2
    image[0, dead], mask[0, dead] = np.nan, BAD_PLANES
    sums, good, mean = _pixels_of(replace(cube, image=image, mask=mask), 0)
    assert mean == 1.0
    np.testing.assert_array_equal(good, np.isfinite(image[0]))
    assert 20 < np.count_nonzero(~good) < 80
    number, total, spread = sums.summed(4)
    for y in range(4):
        for x in range(4):
            part = np.s_[0, 4 * y : 4 * y + 4, 4 * x : 4 * x + 4]
            known = np.isfinite(image[part])
            assert number[y, x] == known.sum()
            assert total[y, x] == pytest.approx(image[part][known].sum(dtype=float), rel=1e-6)
            assert spread[y, x] == pytest.approx(cube.variance[part][known].sum(dtype=float), rel=1e-6)


def test_light_that_is_learned_is_smooth_over_wavelength_and_sensor() -> None:
    place, wavelength = np.arange(24.0), np.linspace(900.0, 985.0, 8)
    geometry = ImageGeometry((24, 24), place, place, wavelength, np.full(8, 20_000.0))
    state = SimpleNamespace(value=np.ones((8, 24, 24)), whiten=lambda values: values)
    family = _of_light(geometry, cast(Any, state))
    names = [key.split("at_")[1].split("_y") for key in family.keys]
    nodes = np.array([float(node) for node, _ in names])
    size2 = np.array([sum(int(part) ** 2 for part in term.split("x")) for _, term in names])
    expected = [
        np.exp(-0.5 * (np.subtract.outer(nodes, nodes) / length) ** 2)
        * np.equal.outer([term for _, term in names], [term for _, term in names])
        * np.exp(-0.5 * size2 / width**2)
        for length in LENGTHS_NM
        for width in (1.5, 4.0)
    ]
    assert len(family.priors) == len(expected)
    for (_, root), whole in zip(family.priors, expected, strict=True):
        np.testing.assert_allclose(root @ root.T, whole, atol=1e-3)


@pytest.mark.parametrize(("contrast", "number"), [("fixed", 2), ("common", 2), ("wavelength", 7)])
@pytest.mark.parametrize("accuracy_nm", [0.0, 0.2])
def test_parameters_of_a_wavelength_are_light_contrast_with_overtones_and_wavelength(
    contrast: Any, number: int, accuracy_nm: float
) -> None:
    cells = SimpleNamespace(pattern=np.zeros((30, 2)))
    free = Nuisances(contrast=contrast, wavelength_accuracy_nm=accuracy_nm)
    problem = _Problem(cast(Any, cells), cast(Any, None), free, None)
    assert problem.own == number + (accuracy_nm > 0.0)
    assert problem.shared == (contrast != "fixed")
