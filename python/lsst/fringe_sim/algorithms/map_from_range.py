"""A thickness map from frames of the night sky, where nothing but a range of the thickness is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, stdtr

from ..array_types import BoolArray, FloatArray
from ..deprecation import deprecated
from ..errors import InputError, OutOfRangeError, UndeterminedError, named_units
from ..products import ThicknessMap, mask_bits
from .night_levels import BAND_SIGMA
from .range_cells import PARTS, FittedMap, Polynomial, RangeCells, Seed, across_degrees, down_degrees

__all__ = ["MODEL_ACCURACY", "ORDER_ERROR", "RangeMap", "map_from_range"]

STEPS_PER_ORDER = 12  # Thicknesses in an order that planes are tried at

CELL_ORDERS = 0.3
"""What a layer of mean slope may change over a cell [orders]: its mean has 0.86 of the fringes of its middle."""

FOLLOWED_ORDERS = 0.1
"""Uncertainty up to which a cell is one of those that a map is fitted to [orders]: 0.6 rad, over which a fringe is
linear to 6 %."""

LEAST_STRENGTH = 0.1
"""Fringes over those of the dark sky below which they are not made, or a map would lose its hold."""

CENTRES = (-0.5, 0.0, 0.5)
"""Centres of the windows in which maps begin, along either side, of which the middle is 0 and the ends ±1."""

ROUNDS, STEPS, FINISHED_ORDERS = 20, 3, 1e-3
"""Most rounds in which cells are added, steps in each, and the change at which they end [orders]."""

COMPARED_PARTS = 8  # Parts along a side by which maps are compared

ORDER_ERROR = 0.17
"""What the fringes of an independent simulator have beyond those of the model, over the fringes, along the difference
between neighbouring orders: lines of the ESO sky model, silicon at its own temperature, f/2.25, ranges of 0.9 µm
between 12.9 and 16.2 µm. Of the neighbours, half were likelier than the order that was right."""

MODEL_ACCURACY = ORDER_ERROR
"""The former name of `ORDER_ERROR`, until version 1.2."""

SHIFTS = 4
"""Shifts of a part of the sensor up to half an order, above and below, that must not be likelier than none."""


@named_units
@dataclass(frozen=True, eq=False)
class RangeMap:
    """What frames say of a layer of which a range was known.

    Attributes
    ----------
    thickness_um, sigma_um : `numpy.ndarray`, shape ``(ny, nx)``
        Likeliest map and its uncertainty within its order [µm].
    known : `numpy.ndarray` of `bool`, shape ``(ny, nx)``
        Pixels that the frames decide but for the order of all.
    order_probability : `float`
        Probability of this map among those of other orders and directions within the range.
    apart : `float`
        What the likeliest map of another order or direction leaves of the fringes of this one; 1 if there is none.
    strength : `float`
        Fringes over those of the dark sky.
    misfit : `float`
        Mean squared residual over its variance.
    model_error : `float`
        What the map leaves beyond the noise, over the fringes; with a third or more, as lines or films that are
        wrong leave, the map may be wrong whatever the probability says.
    """

    thickness_um: FloatArray
    sigma_um: FloatArray
    known: BoolArray
    order_probability: float
    apart: float
    strength: float
    misfit: float
    model_error: float

    def thickness_map(self, layer: str, detector: str = "") -> ThicknessMap:
        """The same as a product; what is not known is masked."""
        blank = np.zeros(self.known.shape, dtype=np.float32)
        return ThicknessMap(
            value=np.where(self.known, self.thickness_um, np.nan).astype(np.float32),
            sigma=np.where(self.known, self.sigma_um, np.nan).astype(np.float32),
            chi2=blank + np.float32(self.misfit),
            slip_probability=blank + np.float32(1.0 - self.order_probability),
            mask=np.where(self.known, 0, mask_bits("NO_DATA")).astype(np.int32),
            layer=layer,
            detector=detector,
        )


@deprecated("1.1", "order_error", removed_in="1.2", argument="model_accuracy")
@named_units
def map_from_range(
    values: Sequence[ArrayLike],
    weights: Sequence[ArrayLike],
    range_um: tuple[float, float],
    predict: Callable[[FloatArray], ArrayLike],
    order_um: float,
    order_error: float = ORDER_ERROR,
) -> RangeMap:
    """Find the thickness map of a layer that is smooth.

    Parameters
    ----------
    values, weights : sequence of array_like, F of shape ``(ny, nx)``
        Frames over their mean, minus one, and inverse variances; 0 leaves a pixel out.
    range_um : `tuple` [`float`, `float`]
        Smallest and largest thickness [µm].
    predict : callable
        ``thickness_um -> light`` of the dark sky, up to two orders beyond the range; any unit.
    order_um : `float`
        Thickness of one fringe order [µm].
    order_error : `float`
        Part of the fringes by which the model may be wrong along the difference between neighbouring orders; 0 for a
        model without error.

    Raises
    ------
    InputError
        No frames, or frames of several shapes.
    OutOfRangeError
        A range of no extent, or a negative error.
    UndeterminedError
        No window of the frames shows the fringes of a plane, or no map has those of all parts.

    Notes
    -----
    Frames are one image, weighed by the strength of their fringes. In windows in which a layer that goes through
    its range once is a plane, planes are compared with it; from the likeliest plane of each window, and its
    mirror image, a polynomial is fitted (Gauss and Newton), to more and more cells: to those that the ones before
    tell to a tenth of an order. What is found is tried in all orders of the range. Two maps are compared by their
    chi-square, and by the scatter of its difference between parts of the sensor (Vuong 1989, Econometrica 57, 307),
    which is what tells where the model misses something; the less certain of both counts. A smooth map of another
    order has the same phases, and its fringes differ by their contrast alone, 5 to 16 % from one order to the next.
    Errors of the model are of the same size and do not average out, so that they have a probability of their own: an
    error of normal size that is more than half the difference reverses the comparison.
    """
    low, high = range_um
    if not 0.0 < low < high:
        raise OutOfRangeError("range of the thickness [um]", range_um, "two increasing, positive numbers")
    if not 0.0 <= order_error < math.inf:
        raise OutOfRangeError("error between orders", order_error, "0 or more")
    image, weight = _one_image(values, weights)
    cell = _cell_px(image.shape, (high - low) / order_um)
    problem = RangeCells.of(image, weight, cell, range_um, predict, order_um)
    begun = _beginnings(problem)
    if not begun:
        raise UndeterminedError("planes that windows of the frames show", 0, "one or more: more frames")
    tried = [each for first in begun for each in _other_orders(problem, first)]
    best = min([*begun, *tried], key=lambda each: each.cost)
    known = best.followed & _seen(problem, best)
    if not known.any() or _shifts(problem, best).sum() > 0.0:
        share = float(np.mean(known))
        raise UndeterminedError(
            "part of the frames that shows the fringes of one map", share,
            "so much that no shifts of single parts are likelier: more frames, or the lines and films of the sensor",
        )  # fmt: skip
    others = _distinct(problem, best, [*begun, *tried])
    odds = 1.0 + sum(_odds(problem, each, best, order_error) for each in others)
    across = Polynomial.of(image.shape)
    whole = np.zeros(image.shape, dtype=bool)
    wide = known.reshape(problem.shape).repeat(cell, axis=0).repeat(cell, axis=1)
    whole[: wide.shape[0], : wide.shape[1]] = wide
    return RangeMap(
        across.value(best.coefficient),
        across.sigma(best.covariance),
        whole & np.isfinite(image),
        1.0 / odds,
        min((_apart(problem, each, best) for each in others), default=1.0),
        float(best.level[0]),
        best.misfit,
        math.sqrt(max(best.misfit - 1.0, 0.0) / max(_structure(problem, best), 1e-300)),
    )


def _one_image(values: Sequence[ArrayLike], weights: Sequence[ArrayLike]) -> tuple[FloatArray, FloatArray]:
    """Mean of all frames, weighed by their noise and the strength of their fringes, and its inverse variance."""
    frames = [np.asarray(each, dtype=float) for each in values]
    inverse = [np.asarray(each, dtype=float) for each in weights]
    if not frames:
        raise InputError("frames", 0, "one or more")
    for each in (*frames, *inverse):
        if each.shape != frames[0].shape or each.ndim != 2:
            raise InputError("shape of a frame", each.shape, f"{frames[0].shape}, as of the first")
    strength = np.ones(len(frames))
    for _ in range(2):
        total = sum(a * a * w for a, w in zip(strength, inverse, strict=True))
        moment = sum(
            a * w * np.where(w > 0.0, v, 0.0) for a, v, w in zip(strength, frames, inverse, strict=True)
        )
        image = np.divide(moment, total, out=np.full(frames[0].shape, np.nan), where=np.asarray(total) > 0.0)
        mean = np.nan_to_num(image)
        found = [
            float((w * mean * np.where(w > 0.0, v, 0.0)).sum() / max(float((w * mean**2).sum()), 1e-300))
            for v, w in zip(frames, inverse, strict=True)
        ]
        # Their common size is that of the image.
        strength = np.maximum(np.array(found) / max(float(np.mean(found)), 1e-300), 0.0)
    return image, np.asarray(total)


def _cell_px(shape: tuple[int, ...], orders: float) -> int:
    """Pixels along a side of a cell: as many as leave the fringes of a layer that goes through its range once."""
    cell = 1
    while 8.0 * orders * cell / min(shape) < CELL_ORDERS:
        cell *= 2
    return cell


def _seeds(problem: RangeCells) -> list[list[Seed]]:
    """Likeliest planes of all windows, in both directions."""
    found: list[list[Seed]] = []
    for centre in [(y, x) for y in CENTRES for x in CENTRES]:
        mine = sorted(_planes(problem, centre), reverse=True)
        if mine:
            turned = [each for each in mine if np.dot(each.slope, mine[0].slope) < 0.0]
            found.append([mine[0], *turned[:1]])
    return sorted(found, reverse=True)


def _beginnings(problem: RangeCells) -> list[FittedMap]:
    """The two best maps that begin in the windows, up to one that all parts show."""
    found: list[FittedMap] = []
    for pair in _seeds(problem):
        grown = [each for each in (_grown(problem, seed) for seed in pair) if each is not None]
        found.extend(grown)
        if any(_seen(problem, each).all() for each in grown):
            break
    return sorted(found, key=lambda each: each.cost)[:2]


def _planes(problem: RangeCells, centre: tuple[float, float]) -> list[Seed]:
    low, high = problem.range_um
    away = problem.place - np.array(centre)
    window = (np.square(away).sum(axis=1) < (2.0 * problem.radius) ** 2) & (problem.weight > 0.0)
    if np.count_nonzero(window) < 4 * problem.background.shape[1]:
        return []
    y, x = away[window].T
    weight = problem.weight[window] * np.exp(-0.5 * (y**2 + x**2) / problem.radius**2)
    value = problem.value[window] - np.average(problem.value[window], weights=weight)
    step = 0.225 * problem.order_um / problem.radius
    thickness = np.arange(low, high, problem.order_um / STEPS_PER_ORDER)
    found = []
    for size in np.arange(1.5 * step, 2.0 * (high - low), step):
        for turn in np.arange(0.0, 2.0 * math.pi, step / size):
            down, along = size * math.sin(turn), size * math.cos(turn)
            light = problem.fringes(thickness[:, None] + down * y + along * x)
            light -= (light @ weight)[:, None] / weight.sum()
            product, power = light @ (weight * value), np.square(light) @ weight
            gain = np.where(product > 0.0, product**2 / np.maximum(power, 1e-300), 0.0)
            best = int(np.argmax(gain))
            found.append(Seed(float(gain[best]), centre, float(thickness[best]), (down, along)))
    return found


def _grown(problem: RangeCells, seed: Seed) -> FittedMap | None:
    """A map that begins at a plane; `None` if it leaves the table of the sky."""
    start = np.zeros(problem.middle.size)
    down, across = down_degrees(), across_degrees()
    start[(down == 0) & (across == 0)] = seed.thickness_um - float(np.dot(seed.slope, seed.centre))
    start[(down == 1) & (across == 0)], start[(down == 0) & (across == 1)] = seed.slope
    near = np.square(problem.place - np.array(seed.centre)).sum(axis=1) < (1.5 * problem.radius) ** 2
    return _followed(problem, start, near & (problem.weight > 0.0))


def _followed(problem: RangeCells, start: FloatArray, used: BoolArray) -> FittedMap | None:
    """Fit cells, and then those that they tell."""
    coefficient = start
    limit = FOLLOWED_ORDERS * problem.order_um
    for _ in range(ROUNDS):
        for _ in range(STEPS):
            step, covariance = _step(problem, coefficient, used)
            coefficient = coefficient + step
        sigma = np.sqrt(np.einsum("pi,ij,pj->p", problem.terms, covariance, problem.terms))
        wider = (problem.weight > 0.0) & ((sigma < limit) | (used & (sigma < 2.0 * limit)))
        if not wider.any():
            return None
        if (
            np.array_equal(wider, used)
            and np.abs(problem.terms @ step).max() < FINISHED_ORDERS * problem.order_um
        ):
            break
        used = wider
    thickness = problem.terms @ coefficient
    margin = 0.5 * problem.order_um
    middle = float(np.median(thickness[used]))
    if not problem.range_um[0] - margin < middle < problem.range_um[1] + margin:
        return None
    residual2, level = _left(problem, thickness, used)
    wide = _widened(problem, covariance, thickness, used, level)
    return FittedMap(coefficient, wide, thickness, residual2, used, level)


def _widened(
    problem: RangeCells, covariance: FloatArray, thickness: FloatArray, used: BoolArray, level: FloatArray
) -> FloatArray:
    """Covariance with what the residuals of parts have in common (Liang & Zeger 1986, Biometrika 73, 13)."""
    left = problem.value - _beside(problem, thickness) @ level
    score = np.where(used, problem.weight * left * level[0] * problem.slopes(thickness), 0.0)
    part = problem.parts()
    by_part = np.stack([np.bincount(part, score * term, PARTS**2) for term in problem.terms.T])
    noise = max(1.0, float(np.mean((problem.weight * left**2)[used])))
    sandwich = covariance @ (by_part @ by_part.T) @ covariance / noise**2
    # At least what the noise of the pixels and the smoothness say.
    return np.asarray(covariance + sandwich)


def _step(problem: RangeCells, coefficient: FloatArray, used: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Step of Gauss and Newton, and covariance of the map; strength of the fringes and background are free."""
    terms, weight = problem.terms[used], problem.weight[used]
    thickness = terms @ coefficient
    light = problem.fringes(thickness)
    beside = np.column_stack([light, problem.background[used]])
    normal = (beside.T * weight) @ beside
    normal[np.diag_indices_from(normal)] *= 1.0 + 1e-9
    moment = (beside.T * weight) @ problem.value[used]
    # The strength of the bands is one, give or take one.
    normal[0, 0] += 1.0 / BAND_SIGMA**2
    moment[0] += 1.0 / BAND_SIGMA**2
    level = np.linalg.solve(normal, moment)
    strength = max(float(level[0]), LEAST_STRENGTH)
    left = problem.value[used] - beside @ np.append(strength, level[1:])
    noise = max(1.0, float(np.mean(weight * left**2)))
    rise = (strength * problem.slopes(thickness))[:, None] * terms
    mixed = (beside.T * weight) @ rise
    hessian = (rise.T * weight) @ rise - mixed.T @ np.linalg.solve(normal, mixed)
    gradient = (rise.T * weight) @ left - mixed.T @ np.linalg.solve(normal, (beside.T * weight) @ left)
    covariance = np.linalg.inv(hessian / noise + np.diag(problem.prior))
    step = covariance @ (gradient / noise - problem.prior * (coefficient - problem.middle))
    return np.asarray(step, dtype=np.float64), np.asarray(covariance, dtype=np.float64)


def _left(
    problem: RangeCells, thickness: FloatArray | None, used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Squared pulls of all cells, and what some cells tell: the strength of the fringes, if any, and a background."""
    beside = _beside(problem, thickness)
    normal = (beside[used].T * problem.weight[used]) @ beside[used]
    normal[np.diag_indices_from(normal)] *= 1.0 + 1e-9
    level = np.linalg.solve(normal, (beside[used].T * problem.weight[used]) @ problem.value[used])
    residual2 = problem.weight * np.square(problem.value - beside @ level)
    return residual2, np.asarray(level, dtype=np.float64)


def _beside(problem: RangeCells, thickness: FloatArray | None) -> FloatArray:
    """Fringes of a map, if any, and terms of the background."""
    light = np.zeros((problem.value.size, 0)) if thickness is None else problem.fringes(thickness)[:, None]
    return np.column_stack([light, problem.background])


def _other_orders(problem: RangeCells, first: FittedMap) -> list[FittedMap]:
    """The same map in other orders of the range, and turned upside down."""
    low, high = problem.range_um
    middle = float(np.median(first.thickness_um))
    found = []
    for turned in (1.0, -1.0):
        centres = np.arange(low, high, problem.order_um / STEPS_PER_ORDER)
        maps = [centre + turned * (first.thickness_um - middle) for centre in centres]
        costs = [float(_left(problem, each, first.followed)[0].sum()) for each in maps]
        for start in range(0, centres.size, STEPS_PER_ORDER):
            centre = centres[start + int(np.argmin(costs[start : start + STEPS_PER_ORDER]))]
            if turned < 0.0 or abs(centre - middle) > 0.5 * problem.order_um:
                moved = turned * first.coefficient
                moved[0] = centre + turned * (first.coefficient[0] - middle)
                found.append(_followed(problem, moved, first.followed))
    return [each for each in found if each is not None]


def _seen(problem: RangeCells, best: FittedMap) -> BoolArray:
    """Cells of parts that are likelier with the fringes of a map than without them or with shifted ones."""
    part = problem.parts()
    without, _ = _left(problem, None, best.followed)
    gain = np.bincount(part, without - best.residual2, PARTS**2)
    # Strength of the fringes, or a shift, is one number that the cells of a part tell.
    return np.asarray(((gain > _price(problem, best)) & (_shifts(problem, best) < 0.0))[part])


def _structure(problem: RangeCells, best: FittedMap) -> float:
    """Mean squared pull beyond the noise, of cells less their background."""
    without, _ = _left(problem, None, best.followed)
    return max(float(np.mean(without[best.followed])) - 1.0, 0.0)


def _shifts(problem: RangeCells, best: FittedMap) -> FloatArray:
    """What a shift of its own gains in each part, less its price; below 0 the map is likelier as it is."""
    part = problem.parts()
    left = np.bincount(part, best.residual2, PARTS**2)
    shifted = []
    for shift in np.arange(-SHIFTS, SHIFTS + 1) / (2.0 * SHIFTS):
        if abs(shift) > FOLLOWED_ORDERS:
            moved = _beside(problem, best.thickness_um + shift * problem.order_um) @ best.level
            shifted.append(np.bincount(part, problem.weight * np.square(problem.value - moved), PARTS**2))
    return np.asarray(np.maximum(left - np.min(shifted, axis=0), 0.0) - _price(problem, best))


def _price(problem: RangeCells, best: FittedMap) -> FloatArray:
    """Of a free number in each part (Schwarz 1978, Annals of Statistics 6, 461)."""
    cells = np.bincount(problem.parts(), problem.weight > 0.0, PARTS**2)
    return np.asarray(np.log(np.maximum(cells, 2.0)) * max(best.misfit, 1.0))


def _distinct(problem: RangeCells, best: FittedMap, maps: list[FittedMap]) -> list[FittedMap]:
    """Maps that differ from the best and from one another, the likeliest first."""
    found: list[FittedMap] = []
    for each in sorted(maps, key=lambda one: one.cost):
        if all(problem.differ(each, other) for other in (best, *found)):
            found.append(each)
    return found


def _apart(problem: RangeCells, other: FittedMap, best: FittedMap) -> float:
    """What another map leaves of the fringes, over the fringes."""
    power = _structure(problem, best) * np.count_nonzero(best.followed)
    return min(math.sqrt(max(other.cost - best.cost, 0.0) / max(power, 1e-300)), 1.0)


def _odds(problem: RangeCells, other: FittedMap, best: FittedMap, order_error: float) -> float:
    """Of another map against the best."""
    rise = other.residual2 - best.residual2
    by_part = np.bincount(problem.parts(COMPARED_PARTS), rise, COMPARED_PARTS**2)
    number = by_part.size
    by_chi2 = math.exp(-0.5 * max(float(by_part.sum()), 0.0) / max(best.misfit, 1.0))
    spread = float(by_part.std(ddof=1)) * math.sqrt(number)
    chance = float(stdtr(number - 1, -float(by_part.sum()) / spread)) if spread > 0.0 else 0.5
    if order_error > 0.0:
        chance = max(chance, float(ndtr(-0.5 * _apart(problem, other, best) / order_error)))
    return max(by_chi2, chance / (1.0 - min(chance, 0.999)))
