"""Surfaces of second degree through cells: what they say of the pixels in their middle.

A cell at a crest may be taken for its mirror image on the other side, and all along a crest at that. So each cell is
asked on the surface that its neighbours show and not where it was found: there it says how far it would move the
surface, and how surely. Surfaces and cells are settled in turn.

A step or a ridge is no surface of second degree: there all cells about a place leave over more than their noise,
though hardly one of them does by itself. How much more is weighed against what other windows leave over.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.special import gammaincinv

from ...array_types import BoolArray, Float32Array, FloatArray
from ...compiled import kernel
from .cells import Cells
from .leaning import most_likely_shares, responsibility
from .newton import score
from .pixels import LONE_CELL_PENALTY, SAME_SURFACE, CellSurface
from .posterior import REACH
from .templates import FlatTemplates

_SIDE = np.arange(-2, 3)  # Cells about one that show its surface
_FAR = 2  # Cells that are so many away have others between them and the one in the middle
_TAIL = 4.0
"""Degrees of freedom of Student's distribution of cells about a surface (Lange, Little & Taylor 1989, J. Am. Stat.
Assoc. 84, 881)."""
_TURNS = 12  # Steps by which a chain of cells on the wrong side of a crest comes back
_ROUNDS = 3
_LONGEST_STEP = 0.1  # Longest way, in orders, by which a cell asks to move a surface at once
_AT_ONCE = 4096
_FREEDOM = 25.0 - 6.0  # Cells of a window, less the terms of its surface
_MEDIAN = 2.0 * float(gammaincinv(0.5 * _FREEDOM, 0.5))  # Median of the chi-square of a window
_FACTORS = np.concatenate([[1.0], 1.2 * np.geomspace(1.0, 100.0, 12)])
"""Factors on the variance of cells about their surface; a window tells a variance to a third."""
_MOST_WINDOWS = 4096  # Windows that show how far surfaces do not fit


@dataclass(frozen=True, eq=False)
class LocalSurface:
    """Surface about each cell."""

    # of 1, y, x, y², xy, x², with y and x in pixels from the centre of the cell [µm], float32, ``(ncy, ncx, 6)``
    terms: Float32Array
    # standard uncertainty of the first [µm]: the noise of the cells, and what they leave over beyond that of most;
    # infinite where nobody asked, float32, ``(ncy, ncx)``
    sigma_um: Float32Array
    # whether the cell and its eight neighbours lie on their surfaces, and more cells show it than it has terms,
    # bool, ``(ncy, ncx)``
    holds: BoolArray


def local_surface(
    surface: CellSurface, cells: Cells, templates: FlatTemplates, asked: BoolArray, order_um: float
) -> LocalSurface:
    """The most likely surfaces about the cells that are asked.

    ``asked``: cells whose surface is wanted, bool, ``(ncy, ncx)``.
    """
    terms, sigma = np.zeros((*asked.shape, 6), np.float32), np.full(asked.shape, np.inf, np.float32)
    found = LocalSurface(terms, sigma, np.zeros(asked.shape, bool))
    found.terms[..., 0] = surface.thickness_um
    step = templates.step_um
    value, weight = (part.reshape(-1, part.shape[-1]) for part in (cells.value, cells.weight))
    gain, known, chi2, own = np.empty((4, *asked.shape))

    def ask(chi2: FloatArray) -> None:
        place = (found.terms[..., 0].astype(float).ravel() - templates.start_um) / step
        _scores_at(value, weight, templates.table(), place, gain.ravel(), known.ravel(), chi2.ravel())

    ask(own)
    seen, usable = surface.thickness_um.astype(float), surface.known
    for _ in range(_TURNS):
        misfit = _fit(surface, seen, np.where(usable, known, 0.0) / step**2, asked, order_um, found)
        ask(chi2)
        # A cell is not on a surface that is half an order away, nor if it likes its own place so much better.
        away = np.abs(found.terms[..., 0] - surface.thickness_um)
        usable = surface.known & (away < REACH * order_um) & (chi2 - own < LONE_CELL_PENALTY)
        move = np.clip(
            step * gain / np.maximum(known, 1e-30), *(order_um * _LONGEST_STEP * np.array([-1, 1]))
        )
        seen = found.terms[..., 0] + move
    _allow_for_misfit(found, asked, misfit)
    found.holds[:] &= surface.known & ~binary_dilation(surface.known & ~usable, np.ones((3, 3), bool))
    return found


def _fit(
    surface: CellSurface,
    seen: FloatArray,
    precision: FloatArray,
    asked: BoolArray,
    order_um: float,
    found: LocalSurface,
) -> FloatArray:
    """Surfaces through what was ``seen`` of the cells [µm], known to a ``precision`` [1/µm²], in place.

    Returns two rows: what the cells about each that is asked leave over, as the chi-square of a whole window, and
    their mean precision.
    """
    every, misfit = np.nonzero(asked), []
    for part in np.array_split(np.arange(every[0].size), max(-(-every[0].size // _AT_ONCE), 1)):
        y, x = (index[part] for index in every)
        b, a, known, design, scale = _window(surface, precision, y, x)
        prior = _prior(order_um)
        away, trust = seen[b, a] - seen[y, x][:, None], np.ones_like(known)
        for _ in range(_ROUNDS):
            turned = (design * (known * trust)[..., None]).swapaxes(1, 2)
            terms = np.linalg.solve(turned @ design + prior, turned @ away[..., None])
            trust = (_TAIL + 1.0) / (_TAIL + known * (away - (design @ terms)[..., 0]) ** 2)
        rest = (known * (away - (design @ terms)[..., 0]) ** 2).sum(axis=1)
        number = np.count_nonzero(known, axis=1)
        whole = rest * _FREEDOM / np.maximum(number - scale.size, 1)
        misfit.append(np.stack([whole, known.sum(axis=1) / np.maximum(number, 1)]))
        terms[:, 0, 0] += seen[y, x]
        found.terms[y, x] = terms[..., 0] / scale
        normal = (design * known[..., None]).swapaxes(1, 2) @ design + prior
        found.sigma_um[y, x] = np.sqrt(np.linalg.inv(normal)[:, 0, 0])
        found.holds[y, x] = number > scale.size
    return np.concatenate(misfit, axis=1)


def _allow_for_misfit(found: LocalSurface, asked: BoolArray, misfit: FloatArray) -> None:
    """Make the uncertainty larger where a layer steps, in place: cells about a place leave over more than elsewhere.

    A place lies off its surface as the cells about it do, and the surface by what that makes of it.
    """
    chi2, precision = misfit
    if chi2.size == 0:
        return
    common = max(float(np.median(chi2)) / _MEDIAN, 1.0)  # of all cells, pixels tell how far they lie off
    chi2 = chi2 / common
    log = -0.5 * (_FREEDOM * np.log(_FACTORS) + chi2[:, None] / _FACTORS)
    likely = np.exp(log - log.max(axis=1, keepdims=True))
    some = likely[:: -(-chi2.size // _MOST_WINDOWS)]
    factor = responsibility(likely, most_likely_shares(some, np.ones(_FACTORS.size))) @ _FACTORS
    variance = factor * found.sigma_um[asked].astype(float) ** 2 + (factor - 1.0) / np.maximum(
        precision, 1e-30
    )
    found.sigma_um[asked] = np.sqrt(common * variance)


def shares_of_middle(
    surface: CellSurface, precision: FloatArray, y: NDArray[np.intp], x: NDArray[np.intp], order_um: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Rows and columns of the cells about some, and the share of each in the surface of the one in the middle."""
    b, a, known, design, _ = _window(surface, precision, y, x)
    turned = (design * known[..., None]).swapaxes(1, 2)
    # Fewer cells than terms, each known exactly, are a singular matrix.
    share = (np.linalg.pinv(turned @ design + _prior(order_um), hermitian=True) @ turned)[:, 0]
    return b, a, np.asarray(share, float)


def _prior(order_um: float) -> FloatArray:
    """Neighbours that turn by an order from cell to cell, or bend by what breaks a surface, are not on one."""
    return np.diag((order_um * np.array([1.0, 1.0, 1.0, *(SAME_SURFACE,) * 3])) ** -2.0)


def _window(
    surface: CellSurface, precision: FloatArray, y: NDArray[np.intp], x: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray, FloatArray, FloatArray]:
    """The cells of `_around`, terms of the second degree at each in units of a cell, and these units in pixels."""
    centres = (surface.y_centre, surface.x_centre)
    size = [max(float(np.diff(each).mean()) if len(each) > 1 else 1.0, 1.0) for each in centres]
    b, a, known = _around(precision, y, x)
    up, over = (
        (each[at] - each[own][:, None]) / one
        for each, at, own, one in zip(centres, (b, a), (y, x), size, strict=True)
    )
    design = np.stack([np.ones_like(up), up, over, up * up, up * over, over * over], axis=-1)
    scale = np.array([1.0, size[0], size[1], size[0] ** 2, size[0] * size[1], size[1] ** 2])
    return b, a, known, design, scale


def _around(
    precision: FloatArray, y: NDArray[np.intp], x: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Rows and columns of the cells around some, one row each, and to which precision they show their surface."""
    b, a = np.repeat(y[:, None] + _SIDE, _SIDE.size, axis=1), np.tile(x[:, None] + _SIDE, (1, _SIDE.size))
    inside = (b >= 0) & (b < precision.shape[0]) & (a >= 0) & (a < precision.shape[1])
    b, a = np.where(inside, b, y[:, None]), np.where(inside, a, x[:, None])
    # What lies behind a cell that shows no surface does not show this one.
    between = [own[:, None] + np.fix(0.5 * (at - own[:, None])).astype(int) for at, own in ((b, y), (a, x))]
    beside = (np.abs(b - y[:, None]) < _FAR) & (np.abs(a - x[:, None]) < _FAR)
    return b, a, np.where(inside & (beside | (precision[tuple(between)] > 0.0)), precision[b, a], 0.0)


@kernel(relaxed=True)
def _scores_at(value, weight, table, place, gain, information, chi2):  # type: ignore[no-untyped-def]
    """Score, information and chi-square of each row at its place of the table."""
    top = table.shape[0] - 1.0
    for item in range(place.shape[0]):
        at = min(max(place[item], 0.0), top)
        gain[item], information[item], chi2[item] = score(table, at, value, weight, item)
