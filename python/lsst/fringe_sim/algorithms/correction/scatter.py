"""Covariance of scales, from the scatter between blocks of pixels and what is alike in several blocks."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from ...array_types import FloatArray
from .sums import RIDGE, FrameSums, Solution

__all__ = ["scale_covariance"]

LEAST_FREE = 1e-6
"""Part of the noise of a block that the fit leaves, below which rounding is all that is left."""


def scale_covariance(sums: FrameSums, solution: Solution) -> FloatArray:
    """Covariance of the scales of a solution, shape ``(K, K)``.

    Notes
    -----
    The sum over blocks of the squares of what each adds to the scales holds for noise that is correlated within one
    (Liang & Zeger 1986, Biometrika 73, 13). The fit has taken a part of the noise of each block, most of it where
    templates, like the background, change slowly; the residual is widened by as much (Bell & McCaffrey 2002, Survey
    Methodology 28, 169). Halos of stars are correlated from block to block (Conley 1999, J. Econometrics 92, 1).
    Products of pairs of blocks would be too few to tell how much: the correlation of the means of the residual over
    blocks, as a function of their distance alone, is taken between the sums of the templates over blocks. A fitted
    background makes distant blocks opposite, and what would narrow the errors is left out.
    """
    if not solution.scale.size:
        return np.zeros((0, 0))
    changes = _changes(sums, solution)
    within: FloatArray = np.asarray(changes.T @ changes, dtype=np.float64)
    weight, residual, *patterns = (sums.by_block(each) for each in sums.totals(solution))
    along = _correlated(residual, weight)
    pairs = np.array([[float((along * _lagged(a, b)).sum()) for b in patterns] for a in patterns])
    half = np.linalg.solve(solution.schur, 0.5 * (pairs + pairs.T))
    between = np.asarray(np.linalg.solve(solution.schur, half.T), dtype=np.float64)
    return np.asarray(within + _widening(between, within))


def _changes(sums: FrameSums, solution: Solution) -> FloatArray:
    """What the noise of each block, and the level of each amplifier, add to the scales; K columns."""
    terms, (normal, score, term) = len(sums.background), sums.by_cell(solution)
    whole = np.zeros((terms + solution.scale.size,) * 2)
    np.add.at(whole, (term[..., :, None], term[..., None, :]), normal)
    splines = np.arange(terms)
    whole[splines, splines] += RIDGE * np.trace(whole[:terms, :terms]) / terms
    sums.spread.add_to(whole, sums.background.levels)
    inverse = scipy.linalg.cho_solve(scipy.linalg.cho_factor(whole), np.eye(len(whole)))
    cells = _cells_of_blocks(sums)
    here = [np.unique(term[cell]) for cell in cells]
    # Blocks have different numbers of terms: where one has fewer its sums are 0, of whichever term.
    most = max(each.size for each in here)
    places = np.zeros((len(cells), most), dtype=np.int64)
    own, along = np.zeros((len(cells), most, most)), np.zeros((len(cells), most))
    for block, (cell, mine) in enumerate(zip(cells, here, strict=True)):
        places[block, : mine.size] = mine
        place = np.searchsorted(mine, term[cell])
        np.add.at(own[block], (place[..., :, None], place[..., None, :]), normal[cell])
        np.add.at(along[block], place, score[cell])
    widened = _without_leverage(own, along, inverse[places[:, :, None], places[:, None, :]])
    blocks = (inverse[terms:, places] * widened).sum(axis=2).T
    levels = sums.spread.scatter * inverse[sums.background.levels, terms:]
    return np.concatenate([blocks, levels])


def _cells_of_blocks(sums: FrameSums) -> list[tuple[NDArray[np.int64], ...]]:
    """Cells with pixels, block by block."""
    rows, columns = sums.background.rows.block, sums.background.columns.block
    block = np.where(sums.pixels > 0, rows[:, None] * (columns[-1] + 1) + columns, -1)
    return [np.nonzero(block == number) for number in np.unique(block[block >= 0])]


def _without_leverage(own: FloatArray, score: FloatArray, inverse: FloatArray) -> FloatArray:
    """Scores of blocks, as wide as those of their noise before the fit took a part."""
    diagonal = np.diagonal(own, axis1=1, axis2=2)
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(own / (size[:, :, None] * size[:, None, :]))
    known = values > own.shape[1] * np.finfo(float).eps * values[:, -1:]
    width = np.sqrt(np.where(known, values, 0.0))
    root = size[:, :, None] * vectors * width[:, None, :]
    narrow = np.divide(1.0, width, out=np.zeros_like(width), where=known)
    left = narrow * np.einsum("bpq,bp->bq", vectors, score / size)
    leverage, turn = np.linalg.eigh(root.swapaxes(1, 2) @ inverse @ root)
    free = 1.0 - leverage
    factor = np.divide(1.0, np.sqrt(np.abs(free)), out=np.zeros_like(free), where=free > LEAST_FREE)
    turned = (turn @ (factor * np.einsum("bpq,bp->bq", turn, left))[..., None])[..., 0]
    return np.asarray(np.einsum("bpq,bq->bp", root, turned))


def _correlated(residual: FloatArray, weight: FloatArray) -> FloatArray:
    """Covariance of the means of two blocks, by the lag between them; 0 for a block and itself."""
    products, pairs = _lagged(residual, residual), _lagged(weight, weight)
    rows, columns = (np.fft.fftfreq(size, 1.0 / size) for size in products.shape)
    distance = np.rint(np.hypot(rows[:, np.newaxis], columns)).astype(int)
    flat = distance.ravel()
    total, number = np.bincount(flat, products.ravel()), np.bincount(flat, np.maximum(pairs, 0.0).ravel())
    # Lags that no pair of blocks has are rounding of the transforms.
    rounding = np.finfo(float).eps * products.size * float(number[0])
    mean = np.divide(total, number, out=np.zeros_like(total), where=number > rounding)[distance]
    mean[0, 0] = 0.0
    return np.asarray(mean)


def _lagged(one: FloatArray, other: FloatArray) -> FloatArray:
    """Sum over all pairs of blocks of a product, by the lag between them."""
    size = 2 * one.shape[0], 2 * one.shape[1]
    return np.asarray(irfft2(rfft2(one, size).conj() * rfft2(other, size), size))


def _widening(between: FloatArray, within: FloatArray) -> FloatArray:
    """The part of a covariance that widens another one."""
    values, vectors = np.linalg.eigh(within)
    known = values > np.finfo(float).eps * len(values) * values[-1]
    root = vectors[:, known] * np.sqrt(values[known])
    inverse = vectors[:, known] / np.sqrt(values[known])
    more, turn = np.linalg.eigh(inverse.T @ between @ inverse)
    wider = root @ turn
    return np.asarray((wider * np.maximum(more, 0.0)) @ wider.T)
