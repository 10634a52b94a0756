"""Derivatives that concern one wavelength, against the same ones written out with all their zeros."""

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.basis import CellBasis
from lsst.fringe_sim.algorithms.discovery.fit import Design, FullColumns, PlaneColumns, Whitener

SHAPE = (5, 7, 6)


def random_whitener(rng: np.random.Generator, scatter: float) -> Whitener:
    root = rng.uniform(0.5, 2.0, SHAPE)
    root[:, 2, 3] = 0.0  # a cell without data
    direction = root * rng.uniform(0.9, 1.1, SHAPE)
    square = (direction**2).sum(axis=0)
    share = square * scatter**2 / (1.0 + square * scatter**2)
    gamma = np.divide(1.0 - np.sqrt(1.0 - share), square, out=np.zeros(SHAPE[1:]), where=square > 0.0)
    return Whitener(root, direction, gamma)


def random_columns(rng: np.random.Generator, whiten: Whitener, number: int, free: int) -> PlaneColumns:
    plane = rng.integers(0, SHAPE[0], number)
    amplitude = whiten.root[plane] * rng.normal(size=(number, *SHAPE[1:]))
    return PlaneColumns(amplitude, plane, rng.normal(size=(number, free)), whiten)


def written_out(columns: PlaneColumns) -> FullColumns:
    each = np.zeros((len(columns.plane), *SHAPE))
    each[np.arange(len(each)), columns.plane] = columns.amplitude
    return FullColumns(np.tensordot(columns.basis.T, columns.whiten.decorrelate(each), axes=1))


@pytest.mark.parametrize("scatter", [0.0, 0.7])
@pytest.mark.rng("products are those of the columns written out")
def test_products_are_those_of_the_columns_written_out(rng: np.random.Generator, scatter: float) -> None:
    whiten = random_whitener(rng, scatter)
    columns, levels = random_columns(rng, whiten, 9, 4), random_columns(rng, whiten, 6, 6)
    full = written_out(columns)
    values = rng.normal(size=(3, *SHAPE))
    np.testing.assert_allclose(columns.dot(values), full.dot(values), atol=1e-10)
    np.testing.assert_allclose(columns.along(values[0]), full.along(values[0]), atol=1e-10)
    np.testing.assert_allclose(columns.gram, full.gram, atol=1e-10)
    np.testing.assert_allclose(columns.against(levels), full.against(levels), atol=1e-10)


@pytest.mark.parametrize("scatter", [0.0, 0.7])
@pytest.mark.rng("what is left of columns is the fit with all nuisances taken out")
def test_what_is_left_of_columns_is_the_fit_with_all_nuisances_taken_out(
    rng: np.random.Generator, scatter: float
) -> None:
    """Score and information, against a least-squares fit of field, levels and effects that knows no block."""
    whiten = random_whitener(rng, scatter)
    levels = random_columns(rng, whiten, 5, 5)
    slope = whiten.decorrelate(whiten.root * rng.normal(size=SHAPE))
    effects = FullColumns(whiten.decorrelate(whiten.root * rng.normal(size=(2, *SHAPE))))
    basis = CellBasis(SHAPE[1:])
    design = Design.build(basis, slope, levels, effects, 0.0, np.zeros(basis.size))
    features = FullColumns(whiten.decorrelate(whiten.root * rng.normal(size=(3, *SHAPE))))

    cells = np.arange(basis.size)
    field = np.zeros((basis.size, SHAPE[0], basis.size))
    field[cells, :, cells] = slope.reshape(SHAPE[0], -1).T
    nuisances = np.concatenate([field.reshape(basis.size, -1), written_out(levels).flat, effects.flat])

    def rest(values: np.ndarray) -> np.ndarray:
        return values - nuisances.T @ np.linalg.lstsq(nuisances.T, values, rcond=None)[0]

    residual = rng.normal(size=SHAPE)
    score, information = design.project(features, residual)
    left = rest(features.flat.T)
    np.testing.assert_allclose(information, left.T @ left, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(score, left.T @ residual.ravel(), rtol=1e-5, atol=1e-6)
