"""Derivatives that concern one wavelength, and products of patterns, against the same ones written out."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.columns import PlaneColumns
from lsst.fringe_sim.algorithms.discovery.learned_columns import LocalColumns

SHAPE = (5, 7, 6)


def random_columns(rng: np.random.Generator, number: int, free: int) -> PlaneColumns:
    plane = rng.integers(0, SHAPE[0], number)
    return PlaneColumns(rng.normal(size=(number, *SHAPE[1:])), plane, rng.normal(size=(number, free)))


def written_out(columns: PlaneColumns) -> np.ndarray:
    each = np.zeros((len(columns.plane), *SHAPE))
    each[np.arange(len(each)), columns.plane] = columns.amplitude
    return np.tensordot(columns.basis.T, each, axes=1)


def products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.tensordot(first, second, axes=[(-3, -2, -1), (-3, -2, -1)])


@pytest.mark.rng("products are those of the columns written out")
def test_products_are_those_of_the_columns_written_out(rng: np.random.Generator) -> None:
    columns, levels = random_columns(rng, 9, 4), random_columns(rng, 6, 6)
    full = written_out(columns)
    values = rng.normal(size=(3, *SHAPE))
    np.testing.assert_allclose(columns.dot(values), products(values, full), atol=1e-10)
    np.testing.assert_allclose(columns.along(values[0]), (full * values[0]).sum(axis=1), atol=1e-10)
    np.testing.assert_allclose(columns.gram, products(full, full), atol=1e-10)
    np.testing.assert_allclose(columns.against(levels), products(full, written_out(levels)), atol=1e-10)


@pytest.mark.rng("local columns")
def test_columns_that_are_products_are_those_written_out(rng: np.random.Generator) -> None:
    local = LocalColumns(rng.standard_normal((2, *SHAPE[1:])), rng.standard_normal((2, *SHAPE)))
    full = (local.terms[:, np.newaxis] * local.patterns[np.newaxis, :, np.newaxis]).reshape(-1, *SHAPE)
    levels = random_columns(rng, 3, 2)
    values = rng.standard_normal((6, *SHAPE))
    np.testing.assert_allclose(local.dot(values), products(values, full), atol=1e-10)
    np.testing.assert_allclose(local.along(values[0]), (full * values[0]).sum(axis=1), atol=1e-10)
    np.testing.assert_allclose(local.gram, products(full, full), atol=1e-10)
    np.testing.assert_allclose(local.against(levels), products(full, written_out(levels)), atol=1e-10)
