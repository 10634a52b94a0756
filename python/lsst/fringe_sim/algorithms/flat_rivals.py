"""Thicknesses that a list of flats could mistake for the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from ..array_types import FloatArray
from ..errors import OutOfRangeError
from ..model import FringeModel

NODES_PER_ORDER = 24
"""Nodes in one order; between them cubic interpolation with exact slopes is good to 1e-5 of the swing."""

SEARCH_STRIDE = 6
"""One node in so many is a possible true thickness while candidates are compared; every node in a forecast."""

SAME_SOLUTION = 0.25
"""What lies within this many orders of the truth is an error of measurement, not another solution."""

_NEGLIGIBLE = 1e-3
"""Share of the wanted slip probability below which it does not matter any more, but the uncertainty does."""

_WORTH_REFINING = 200.0
"""Δχ² of a region above which a rival wins with less than 1e-11, and need not be known better than from nodes."""

_REFINEMENTS = 4


@dataclass(frozen=True)
class PlannedFlat:
    """A flat that has been or could be taken."""

    wavelength_nm: float
    electrons: float = 20_000.0  # mean level [electrons per pixel]
    bandwidth_fwhm_nm: float | None = None  # width of the line; as in the model if `None`

    def __post_init__(self) -> None:
        if not 0.0 < self.wavelength_nm < math.inf:
            raise OutOfRangeError("wavelength of a flat [nm]", self.wavelength_nm, "a positive number")
        if not 0.0 < self.electrons < math.inf:
            raise OutOfRangeError("level of a flat [electrons]", self.electrons, "a positive number")
        if self.bandwidth_fwhm_nm is not None and not 0.0 < self.bandwidth_fwhm_nm < math.inf:
            raise OutOfRangeError("bandwidth of a flat [nm]", self.bandwidth_fwhm_nm, "a positive number")


@dataclass(frozen=True)
class RankedFlat:
    """A further flat, and what a forecast becomes with it."""

    flat: PlannedFlat
    separation: float  # least Δχ² of a single pixel over all thicknesses
    # pixel_slip, region_slip: mean over all thicknesses of the slip probability of a pixel; largest slip
    # probability of a region
    pixel_slip: float
    region_slip: float
    sigma_um: float  # root of the mean square uncertainty of a pixel


@dataclass(frozen=True, eq=False)
class Curves:
    """Amplitudes of flats over the searched thicknesses, and their weights at the possible true ones.

    ``amplitude``, ``slope`` [per node] and ``node_weight`` have the shape ``(flats, nodes)``; ``truth`` holds nodes.
    """

    flats: tuple[PlannedFlat, ...]
    thickness_um: FloatArray
    truth: NDArray[np.intp]
    amplitude: FloatArray
    slope: FloatArray
    node_weight: FloatArray
    order_um: float

    @classmethod
    def of_model(
        cls,
        model: FringeModel,
        flats: Sequence[PlannedFlat],
        range_um: tuple[float, float],
        search_um: tuple[float, float] | None,
        read_noise_e: float,
        stride: int = 1,
    ) -> Curves:
        """Curves of a model over the thicknesses that are searched."""
        low, high = _checked_range("thickness range [um]", range_um)
        if search_um is None:
            own = model.setup.thickness_range_um
            search_um = (min(own[0], low), max(own[1], high))
        first, last = _checked_range("searched thicknesses [um]", search_um)
        if first > low or last < high:
            raise OutOfRangeError("searched thicknesses [um]", search_um, f"at least {low:g} to {high:g}")
        if not 0.0 <= read_noise_e < math.inf:
            raise OutOfRangeError("read noise [electrons]", read_noise_e, "0 or more")
        wavelength = np.array([flat.wavelength_nm for flat in flats])
        order = float(np.mean(model.fringe_order_um(wavelength)))
        step = order / NODES_PER_ORDER
        count = max(int(np.ceil((last - first) / step)), 2) + 1
        thickness = np.asarray(first + step * np.arange(count), dtype=float)
        seen = np.flatnonzero((thickness >= low) & (thickness <= high))
        if seen.size < NODES_PER_ORDER // 2:
            raise OutOfRangeError("thickness range [um]", range_um, "half a fringe order or more")
        response, slope = _responses(model, flats, first, step, count)
        mean = response[:, seen].mean(axis=1, keepdims=True)
        relative, truth = response / mean, np.union1d(seen[::stride], seen[-1:])
        electrons = np.array([flat.electrons for flat in flats])[:, None]
        noise = electrons * relative + read_noise_e**2
        return cls(
            tuple(flats), thickness, truth, relative - 1.0, step * slope / mean, electrons**2 / noise, order
        )

    def with_truths(self, nodes: NDArray[np.intp]) -> Curves:
        """With more possible true thicknesses."""
        return replace(self, truth=np.asarray(np.union1d(self.truth, nodes), dtype=np.intp))

    def only(self, rows: Sequence[int]) -> Curves:
        """Some of the flats, at every node in the range of true thicknesses."""
        return replace(
            self,
            flats=tuple(self.flats[row] for row in rows),
            truth=np.arange(self.truth[0], self.truth[-1] + 1),
            amplitude=self.amplitude[rows],
            slope=self.slope[rows],
            node_weight=self.node_weight[rows],
        )

    @property
    def weight(self) -> FloatArray:
        """Inverse variance of the amplitudes at each possible truth, shape ``(flats, truths)``."""
        return self.node_weight[:, self.truth]

    @property
    def step_um(self) -> float:
        """Distance of two nodes [µm]."""
        return float(self.thickness_um[1] - self.thickness_um[0])

    def distance(self, which: Sequence[int]) -> FloatArray:
        """Δχ² of every node for every truth from some of the flats, shape ``(truths, nodes)``."""
        rows = list(which)
        weight, every = self.weight[rows], self.amplitude[rows]
        own = every[:, self.truth]
        cross = (weight * own).T @ every
        return np.asarray(
            (weight * own**2).sum(axis=0)[:, None] - 2.0 * cross + weight.T @ every**2, dtype=float
        )

    def information(self, which: Sequence[int]) -> FloatArray:
        """Fisher information on the thickness of a pixel [1/µm²], shape ``(truths,)``."""
        rows = list(which)
        slope = self.slope[rows][:, self.truth] / self.step_um
        return np.asarray((self.weight[rows] * slope**2).sum(axis=0), dtype=float)

    def at(self, rows: Sequence[int], place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Amplitude and slope [per node] between nodes, shape ``(len(rows), *place.shape)`` (cubic Hermite)."""
        below = np.clip(place.astype(int), 0, self.amplitude.shape[1] - 2)
        t = place - below
        pick = np.asarray(rows, dtype=int)[:, None]
        low, high = self.amplitude[pick, below], self.amplitude[pick, below + 1]
        leave, arrive = self.slope[pick, below], self.slope[pick, below + 1]
        rise = high - low
        bend, twist = 3.0 * rise - 2.0 * leave - arrive, leave + arrive - 2.0 * rise
        return low + t * (leave + t * (bend + t * twist)), leave + t * (2.0 * bend + 3.0 * t * twist)


@dataclass(frozen=True, eq=False)
class ChosenFlats:
    """Some of the flats: distances and information that they bring together."""

    curves: Curves
    rows: tuple[int, ...]
    distance: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, curves: Curves, rows: Sequence[int]) -> ChosenFlats:
        """Flats by their rows."""
        return cls(curves, tuple(rows), curves.distance(rows), curves.information(rows))

    def plus(self, row: int) -> ChosenFlats:
        """With one flat more."""
        return ChosenFlats(
            self.curves,
            (*self.rows, row),
            self.distance + self.curves.distance([row]),
            self.information + self.curves.information([row]),
        )

    def price(self, region_px: int, slip_limit: float) -> tuple[float, float]:
        """Ranks sets of flats: mean number of wrong orders of a region, then mean square uncertainty."""
        wrong = float(Rivals.find(self, region_px).expected_wins(region_px).mean())
        return max(wrong, _NEGLIGIBLE * slip_limit), self.variance

    def reached(self, region_px: int, slip_limit: float, sigma_um: float) -> bool:
        """Whether the goals are met."""
        slip = Rivals.find(self, region_px).slip(region_px).max()
        return bool(slip <= slip_limit and self.variance <= sigma_um**2)

    def ranked(self, region_px: int) -> RankedFlat:
        """What the last of the flats has led to."""
        rivals = Rivals.find(self, 1)
        return RankedFlat(
            self.curves.flats[self.rows[-1]],
            float(rivals.nearest()[0].min()),
            float(rivals.slip(1).mean()),
            float(rivals.slip(region_px).max()),
            math.sqrt(self.variance),
        )

    @property
    def variance(self) -> float:
        """Mean variance of the thickness of a pixel [µm²]."""
        return float(np.mean(1.0 / self.information)) if self.information.all() else math.inf


@dataclass(frozen=True, eq=False)
class Rivals:
    """Minima of Δχ² away from the truth: for which truth, at which place in nodes, how deep."""

    truths: int
    truth: NDArray[np.intp]
    place: FloatArray
    separation: FloatArray

    @classmethod
    def find(cls, state: ChosenFlats, pixels: int) -> Rivals:
        """Rivals; those that matter to a region of so many pixels are refined between the nodes."""
        curves, distance = state.curves, state.distance
        low = np.ones(distance.shape, bool)
        falls = distance[:, 1:] < distance[:, :-1]
        low[:, 1:] &= falls
        low[:, :-1] &= ~falls
        truth, node = np.nonzero(low)
        apart = np.abs(curves.thickness_um[node] - curves.thickness_um[curves.truth[truth]])
        other = apart > SAME_SOLUTION * curves.order_um
        truth, node = truth[other], node[other]
        place, separation, slack = _vertex(distance, truth, node)
        near = pixels * (separation - slack) < _WORTH_REFINING
        place[near], separation[near] = _refine(curves, state.rows, truth[near], place[near])
        return cls(len(distance), truth, place, separation)

    def expected_wins(self, pixels: int) -> FloatArray:
        """Sum over rivals of the probability to be preferred to the truth, shape ``(truths,)``."""
        wins = ndtr(-0.5 * np.sqrt(pixels * self.separation))
        return np.asarray(np.bincount(self.truth, wins, self.truths), dtype=float)

    def slip(self, pixels: int) -> FloatArray:
        """Probability that some rival is preferred, each taken by itself."""
        loses = log_ndtr(0.5 * np.sqrt(pixels * self.separation))
        return np.abs(np.expm1(np.bincount(self.truth, loses, self.truths)))

    def nearest(self) -> tuple[FloatArray, FloatArray]:
        """Least separation for each truth, and the place of that rival in nodes (NaN where there is none)."""
        ranked = np.lexsort((self.separation, self.truth))
        truth, first = np.unique(self.truth[ranked], return_index=True)
        least, place = np.full(self.truths, np.inf), np.full(self.truths, np.nan)
        least[truth] = self.separation[ranked[first]]
        place[truth] = self.place[ranked[first]]
        return least, place


def _vertex(
    distance: FloatArray, truth: NDArray[np.intp], node: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Place and depth of minima from parabolas, and by how much the depth may be wrong."""
    last = distance.shape[1] - 1
    left, middle, right = (distance[truth, np.clip(node + shift, 0, last)] for shift in (-1, 0, 1))
    bend = left - 2.0 * middle + right
    inside = (node > 0) & (node < last) & (bend > 0.0)
    safe = np.where(inside, bend, 1.0)
    move = np.where(inside, 0.5 * (left - right) / safe, 0.0)
    dip = np.where(inside, (left - right) ** 2 / (8.0 * safe), 0.0)
    place = np.asarray(node + move, dtype=float)
    return place, np.maximum(middle - dip, 0.0), np.where(inside, bend, 0.0)


def _refine(
    curves: Curves, rows: Sequence[int], truth: NDArray[np.intp], place: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton steps to the least Δχ² near a place, at most one node away."""
    last = curves.amplitude.shape[1] - 1.0
    pick = np.asarray(rows, dtype=int)[:, None]
    weight, own = curves.weight[pick, truth], curves.amplitude[pick, curves.truth[truth]]
    low, high = np.clip(place - 1.0, 0.0, last), np.clip(place + 1.0, 0.0, last)
    best, least = np.array(place), np.full(place.shape, np.inf)
    for _ in range(_REFINEMENTS):
        value, slope = curves.at(rows, place)
        miss = own - value
        chi2 = (weight * miss**2).sum(axis=0)
        better = chi2 < least
        best, least = np.where(better, place, best), np.where(better, chi2, least)
        information = (weight * slope**2).sum(axis=0)
        step = (weight * slope * miss).sum(axis=0) / np.maximum(information, 1e-300)
        place = np.clip(place + np.clip(step, -0.5, 0.5), low, high)
    return best, least


def _responses(
    model: FringeModel, flats: Sequence[PlannedFlat], start_um: float, step_um: float, count: int
) -> tuple[FloatArray, FloatArray]:
    """Response of every flat on a grid and its exact derivative [1/µm], shapes ``(flats, count)``."""
    response, slope = np.empty((len(flats), count)), np.empty((len(flats), count))
    for width in dict.fromkeys(flat.bandwidth_fwhm_nm for flat in flats):
        rows = [k for k, flat in enumerate(flats) if flat.bandwidth_fwhm_nm == width]
        chosen = model
        if width is not None:
            chosen = model.with_effects({**model.effect_settings, "bandwidth.fwhm": width})
        wavelength = np.array([flats[k].wavelength_nm for k in rows])
        response[rows], slope[rows] = _response_and_slope(chosen, wavelength, start_um, step_um, count)
    return response, slope


def _response_and_slope(
    model: FringeModel, wavelength_nm: FloatArray, start_um: float, step_um: float, count: int
) -> tuple[FloatArray, FloatArray]:
    """Response and derivative, effects on the response included: they are linear in it."""
    light = model.system.flat_fields(wavelength_nm)
    reduced = model.system.reduce(light)
    bare = reduced.averaged_on_grid(light.weight, start_um, step_um, count)
    bare_slope = reduced.averaged_derivative_on_grid(light.weight, start_um, step_um, count)
    response = model.finish(reduced, light, bare, wavelength_nm)
    moved = model.finish(reduced, light, bare + bare_slope, wavelength_nm)
    return response, moved - response


def _checked_range(name: str, value: tuple[float, float]) -> tuple[float, float]:
    low, high = value
    if not 0.0 < low < high < math.inf:
        raise OutOfRangeError(name, value, "two increasing, positive numbers")
    return low, high
