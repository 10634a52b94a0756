"""A first thickness field without any belief in the contrast of the model."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...array_types import Float32Array, FloatArray
from ...compiled import contiguous, kernel, run_shares
from ...model import FringeModel
from .cells import CellData
from .comparison import chi2_with_free_fringes
from .growing import grown
from .mending import (
    FEWEST_ROWS,
    HALF_WINDOW_UM,
    SEARCH_STEP_UM,
    SURFACE_SPACINGS,
    mended,
    near_surface,
)

CELLS_AT_ONCE = 256  # Cells that are worth a thread

LEVEL_ROUNDS, LEVEL_CELLS = 2, 1000
"""How often levels and thickness follow from each other, and about how many cells are followed for them."""

WINDOW_ORDERS = (0.15, 0.3, 0.5, 0.75, 1.0, 1.5)
GUESS_STEP, GUESS_APART = 0.1, 0.3
GUESSES_FOLLOWED, GUESS_CELLS = 6, 100
"""Ranges of thickness that a sensor of few fringes may hold [orders], the step and the least distance of their
middles [orders], how many are followed, and with how many cells they are compared."""

HOPELESS, AS_GOOD = 2.0, 1.2
"""χ², levels and contrasts free: of the best guess over that of the first thickness, from which on no other is
followed, and of one over the least of all, up to which a contrast common to all wavelengths decides."""


def starting_thickness(model: FringeModel, cells: CellData) -> FloatArray:
    """Thickness of every cell, with the fringe order decided by all cells together.

    Each cell is compared with the model's fringes at every thickness of the set-up's range by correlation, in which
    the contrast is free; once with the colour of the contrast as in the model, once as in the data. The field grows
    from the clearest cell to its neighbours, each within less than half a fringe order of what they predict; then the
    whole field is moved by whole orders to where the sum of all correlations is best. Cells without data take the
    value of a neighbour.

    Flats are relative to their mean. On a sensor of few fringes that is not the mean of a fringe: levels are guessed
    for every mean thickness there, and those with which the fringes lie best on the data are kept.

    Returns (ny, nx).
    """
    low, template = search_template(model, cells)
    order = order_steps(model, cells)
    templates = [template]
    if min(cells.shape[1:]) >= FEWEST_ROWS:
        templates.append(template * _contrast(template, cells))
    best, _ = max((_follow(each, cells, order) for each in templates), key=lambda item: item[1])
    if len(templates) > 1:
        best = _of_few_fringes(best, template, cells, order)
    return low + SEARCH_STEP_UM * best.reshape(cells.shape[1:]).astype(float)


def _of_few_fringes(
    first: NDArray[np.int64], template: FloatArray, cells: CellData, order: float
) -> NDArray[np.int64]:
    """Steps of all cells with levels at which the fringes lie on the data, or the first ones if they lie better."""
    stride = max(1, math.isqrt(first.size // LEVEL_CELLS))
    few = cells.window(slice(None, None, stride), slice(None, None, stride))
    if min(few.shape[1:]) < FEWEST_ROWS:
        stride, few = 1, cells
    found = [(_misfit(template, first.reshape(cells.shape[1:])[::stride, ::stride].ravel(), few), np.ones(0))]
    for levels in _guessed_levels(template, few, order):
        for _ in range(LEVEL_ROUNDS):
            steps = _follow(template, _over(few, levels), order)[0]
            levels = _levels(template, steps, few)
        found.append((_misfit(template, steps, few), levels))
        if found[1][0][0] > HOPELESS * found[0][0][0]:
            break  # the sensor has many fringes
    # A third of a fringe can be made of any thickness by contrasts of many colours.
    least = min(misfit for (misfit, _), _ in found)
    likely = [(even, levels) for (misfit, even), levels in found if misfit <= AS_GOOD * least]
    levels = min(likely, key=lambda item: item[0])[1]
    return _follow(template, _over(cells, levels), order)[0] if levels.size else first


def _guessed_levels(template: FloatArray, cells: CellData, order: float) -> list[FloatArray]:
    """Levels of sensors of few fringes whose thicknesses explain most of the data, best first.

    A sensor that holds all thicknesses of a window evenly has the mean of the fringes there for its own; each of some
    cells is then compared with the fringes about that mean at all of them, its contrast free.
    """
    used = np.flatnonzero((cells.weight > 0.0).all(axis=0))
    if not used.size:
        return []
    stride = max(1, used.size // GUESS_CELLS)
    value = (cells.value - 1.0).reshape(len(template), -1)[:, used[::stride]].T
    guesses = []
    for width in {max(2, round(part * order)) for part in WINDOW_ORDERS}:
        for start in range(0, template.shape[1] - width, max(1, int(GUESS_STEP * max(order, width)))):
            window = template[:, start : start + width]
            mean = window.mean(axis=1)
            about = window - mean[:, np.newaxis]
            cross = np.maximum(value @ about, 0.0)
            square = (about**2).sum(axis=0)
            power = np.divide(cross**2, square, out=np.zeros_like(cross), where=square > 0.0)
            best = power.argmax(axis=1)
            strength = cross[np.arange(len(best)), best].sum() / max(square[best].sum(), 1e-300)
            explained = float(power.max(axis=1).sum())
            guesses.append((explained, start + 0.5 * width, 1.0 + strength * mean))
    guesses.sort(key=lambda item: -item[0])
    return [levels for _, _, levels in _far_apart(guesses, GUESS_APART * order)]


def _far_apart(
    guesses: list[tuple[float, float, FloatArray]], distance: float
) -> list[tuple[float, float, FloatArray]]:
    """The first of those near one another."""
    kept: list[tuple[float, float, FloatArray]] = []
    for guess in guesses:
        if all(abs(guess[1] - other[1]) > distance for other in kept):
            kept.append(guess)
        if len(kept) == GUESSES_FOLLOWED:
            break
    return kept


def _levels(template: FloatArray, steps: NDArray[np.int64], cells: CellData) -> FloatArray:
    """Mean of a fringe over that of the flat at each wavelength, for fringes that all have the same strength."""
    level = _strength(_at(template, steps), cells)[1].ravel()
    return np.divide(1.0, level, out=np.ones_like(level), where=level > 0.0)


def _strength(fringes: FloatArray, cells: CellData) -> tuple[float, FloatArray]:
    """Common strength of fringes ``(W, cells)`` in the data, and the level of each wavelength ``(W, 1)``."""
    value, weight = (part.reshape(len(fringes), -1) for part in (cells.value, cells.weight))
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    apart = fringes - (weight * fringes).sum(axis=1, keepdims=True) / total
    strength = max(float((weight * apart * value).sum() / max((weight * apart**2).sum(), 1e-300)), 0.0)
    light = 1.0 + strength * fringes
    product, square = ((weight * light * part).sum(axis=1, keepdims=True) for part in (value, light))
    return strength, np.asarray(product / np.maximum(square, 1e-300))


def _over(cells: CellData, levels: FloatArray) -> CellData:
    """Flats relative to the mean of a fringe."""
    return replace(cells, value=cells.value * levels[:, np.newaxis, np.newaxis])


def _misfit(template: FloatArray, steps: NDArray[np.int64], cells: CellData) -> tuple[float, float]:
    """χ² of the fringes at some steps with free levels, each wavelength with its own contrast and all with one."""
    fringes = _at(template, steps)
    free = chi2_with_free_fringes(
        fringes.reshape(len(template), 1, *cells.shape[1:]), cells.value, cells.weight
    )
    strength, level = _strength(fringes, cells)
    value, weight = (part.reshape(len(template), -1) for part in (cells.value, cells.weight))
    return float(free[0]), float((weight * (value - level * (1.0 + strength * fringes)) ** 2).sum())


def _at(template: FloatArray, steps: NDArray[np.int64]) -> FloatArray:
    return template[:, np.clip(steps, 0, template.shape[1] - 1)]


def search_template(model: FringeModel, cells: CellData) -> tuple[float, FloatArray]:
    """First thickness [µm] and fringes on the grid of the search, ``(W, D)``, in steps of `SEARCH_STEP_UM`."""
    low, high = model.setup.thickness_range_um
    count = round((high - low) / SEARCH_STEP_UM) + 1
    response = model.response_on_grid(cells.wavelength_nm, low, SEARCH_STEP_UM, count)
    return low, response / _running_mean(response, model, cells) - 1.0


def _follow(template: FloatArray, cells: CellData, order: float) -> tuple[NDArray[np.int64], float]:
    """Steps of all cells, and the mean square of their correlations."""
    score = _correlate(template, cells)
    count = template.shape[1]
    best = grown(score, cells.shape[1], cells.shape[2], int(HALF_WINDOW_UM / SEARCH_STEP_UM))
    found = [np.clip(best + _common_shift(score, best, order, count), 0, count - 1)]
    if min(cells.shape[1:]) >= FEWEST_ROWS:
        found.append(_each_alone(score, cells, order))
    places = np.arange(len(best))

    def clarity(steps: NDArray[np.int64]) -> float:
        return float((score[places, np.clip(steps, 0, count - 1)].astype(float) ** 2).mean())

    ends = [mended(score, steps, cells, order) for steps in found]
    return max(((steps, clarity(steps)) for steps in ends), key=lambda item: item[1])


def _each_alone(score: Float32Array, cells: CellData, order: float) -> NDArray[np.int64]:
    """Steps of all cells, near a smooth surface through where each by itself is clearest.

    Where fringes are less than four cells wide, a field that grows may go down where it should go up; many
    wavelengths tell most cells their order without any neighbour.
    """
    current = score.argmax(axis=1).astype(np.int64)
    for spacing in SURFACE_SPACINGS:
        current = near_surface(score, current, cells, spacing, order)[0]
    return current


def _contrast(template: FloatArray, cells: CellData) -> FloatArray:
    """Strength of the fringes over that of the model, from the variances alone: a column of mean 1."""
    used = cells.weight > 0
    number = np.maximum(used.sum(axis=(1, 2)), 1)
    amplitude = np.where(used, cells.value - 1.0, 0.0)
    # What all wavelengths share is no fringe: pixel response, illumination.
    common = amplitude.sum(axis=0) / np.maximum(used.sum(axis=0), 1)
    amplitude = np.where(used, amplitude - common, 0.0)
    noise = np.divide(1.0, cells.weight, out=np.zeros_like(amplitude), where=used).sum(axis=(1, 2)) / number
    power = (amplitude**2).sum(axis=(1, 2)) / number
    signal = np.maximum(power - noise, 0.1 * power)
    contrast = np.sqrt(signal) / np.maximum((template - template.mean(axis=0)).std(axis=1), 1e-12)
    return np.asarray(contrast / contrast.mean())[:, np.newaxis]


def _running_mean(response: FloatArray, model: FringeModel, cells: CellData) -> FloatArray:
    """Mean of the response over a fringe order around each thickness."""
    width = max(3, 2 * int(order_steps(model, cells) / 2) + 1)
    padded = np.pad(response, ((0, 0), (width // 2, width // 2)), mode="reflect")
    total = np.cumsum(np.pad(padded, ((0, 0), (1, 0))), axis=1)
    mean: FloatArray = (total[:, width:] - total[:, :-width]) / width
    return mean


def order_steps(model: FringeModel, cells: CellData) -> float:
    """Fringe order at the middle wavelength in search steps."""
    return float(model.fringe_order_um(np.median(cells.wavelength_nm))) / SEARCH_STEP_UM


def _correlate(template: FloatArray, cells: CellData) -> Float32Array:
    """Correlation of every cell with the fringes, of the best positive contrast, ``(cells, thickness)``."""
    waves = cells.shape[0]
    amplitude = np.ascontiguousarray((cells.value - 1.0).reshape(waves, -1).T)
    weight = np.ascontiguousarray(cells.weight.reshape(waves, -1).T)
    template = contiguous(template)
    square = template**2
    score = np.empty((len(amplitude), template.shape[1]), np.float32)
    run_shares(
        lambda first, last: _correlations(amplitude, weight, template, square, first, last, score),
        len(score),
        CELLS_AT_ONCE,
    )
    return score


@kernel
def _correlations(
    amplitude: FloatArray,
    weight: FloatArray,
    template: FloatArray,
    square: FloatArray,
    first_cell: int,
    last_cell: int,
    score: Float32Array,
) -> None:  # pragma: no cover - compiled
    """Of cells ``(N, W)`` with fringes ``(W, D)`` and their squares.

    An offset common to all wavelengths of a cell is free as well: pixel response, illumination.
    """
    waves, steps = template.shape
    cross, first, second = np.empty(steps), np.empty(steps), np.empty(steps)
    for i in range(first_cell, last_cell):
        total, mean = 1e-30, 0.0  # a cell without data scores nothing
        for w in range(waves):
            total += weight[i, w]
            mean += weight[i, w] * amplitude[i, w]
        mean /= total
        cross[:], first[:], second[:] = 0.0, 0.0, 0.0
        power = 1e-300
        for w in range(waves):
            own = weight[i, w]
            signal = own * (amplitude[i, w] - mean)
            power += signal * (amplitude[i, w] - mean)
            for d in range(steps):
                cross[d] += signal * template[w, d]
                first[d] += own * template[w, d]
                second[d] += own * square[w, d]
        root = math.sqrt(power)
        for d in range(steps):
            spread = max(second[d] - first[d] * first[d] / total, 1e-30 * total)
            score[i, d] = max(cross[d], 0.0) / math.sqrt(spread) / root


def _common_shift(score: Float32Array, best: NDArray[np.int64], order: float, count: int) -> int:
    """Number of steps by which all cells are moved, a whole number of orders give or take a quarter."""
    reach = int(12 * order)
    totals, inside = _powers_of_shifts(score, np.ascontiguousarray(best), reach)
    totals[inside <= 0.98 * len(best)] = -np.inf
    return int(np.argmax(totals)) - reach


@kernel
def _powers_of_shifts(
    score: Float32Array, best: NDArray[np.int64], reach: int
) -> tuple[FloatArray, FloatArray]:  # pragma: no cover - compiled
    """Sum of the squared correlations with all cells moved by so many steps, and how many cells have any there."""
    totals, inside = np.zeros(2 * reach + 1), np.zeros(2 * reach + 1)
    for i in range(len(best)):
        for number in range(max(0, reach - best[i]), min(2 * reach + 1, reach - best[i] + score.shape[1])):
            value = float(score[i, best[i] + number - reach])
            totals[number] += value * value
            inside[number] += 1.0
    return totals, inside
