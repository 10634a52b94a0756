"""Which flats a thickness fit needs: uncertainty, order ambiguity and chance of a slip before a flat is taken.

Flats of a pixel of thickness ``d`` are a point on a curve ``a(d)`` in as many dimensions as there are wavelengths,
and the fit looks for the nearest point of that curve. Two things follow from the curve alone:

- its speed, measured in standard deviations, is the inverse of the uncertainty (Cramér–Rao):
  ``1 / sigma² = Σ w (da/dd)²``;
- where it comes back close to itself, another order competes. The expected excess of the rival's chi-square is the
  square of the distance, ``Δχ² = Σ w (a(d) - a(d'))²``, and the rival wins with the probability
  ``Q(sqrt(Δχ²) / 2)``, the tail of a normal distribution: noise has to carry the point half way. The chance of a
  slip is that of any rival, each taken by itself.

Rivals are looked for over the whole range that a fit would search, so that steps of wavelength below the Nyquist
rate (``Δλ > λ² / 4 n d``), at which a thickness and its mirror image look alike, show up by themselves.

References
----------
Proakis & Salehi 2008, Digital Communications, section 4.2 (nearest point, pairwise error).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from ..errors import InputError, OutOfRangeError
from ..model import FringeModel

__all__ = [
    "FlatForecast",
    "PlannedFlat",
    "RankedFlat",
    "forecast_flats",
    "nyquist_thickness_um",
    "rank_flats",
    "recommend_flats",
]

FloatArray = NDArray[np.float64]

NODES_PER_ORDER = 24
"""Nodes in one order; between them cubic interpolation with exact slopes is good to 1e-5 of the swing."""
SEARCH_STRIDE = 6
"""One node in so many is a possible true thickness while candidates are compared; every node in a forecast."""
SAME_SOLUTION = 0.25
"""What lies within this many orders of the truth is an error of measurement, not another solution."""
FEWEST_FLATS = 4
"""A fit of fewer wavelengths is flagged."""
MOST_FLATS = 24
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


@dataclass(frozen=True, eq=False)
class FlatForecast:
    """What a set of flats will tell."""

    flats: tuple[PlannedFlat, ...]
    thickness_um: FloatArray  # (n,): true thickness
    # (n,): uncertainty of the thickness of a single pixel; infinite where the flats do not depend on it
    sigma_um: FloatArray
    rival_um: FloatArray  # (n,): thickness that competes most; NaN where none does
    # (n,): expected Δχ² between the two for a single pixel; infinite where there is no rival
    separation: FloatArray
    # pixel_slip, region_slip (n,): probability that the order is wrong, for a single pixel and for a
    # region
    pixel_slip: FloatArray
    region_slip: FloatArray
    region_px: int  # number of independent pixels of a region, whose evidence is added
    order_um: float  # thickness of one fringe order, mean over the flats

    @property
    def worst(self) -> int:
        """Place of the thickness with the closest rival."""
        return int(np.argmin(self.separation))

    def safe(self, slip_limit: float) -> bool:
        """Whether no region, at any thickness, slips with more than some probability."""
        return bool(self.region_slip.max() <= slip_limit)


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


def forecast_flats(
    model: FringeModel,
    flats: Sequence[PlannedFlat],
    range_um: tuple[float, float],
    *,
    search_um: tuple[float, float] | None = None,
    read_noise_e: float = 7.0,
    region_px: int = 64,
) -> FlatForecast:
    """Uncertainty and ambiguity of a set of flats.

    Parameters
    ----------
    model : `FringeModel`
        The sensor and the light; its effects (contrast above all) are part of the forecast.
    flats : sequence of `PlannedFlat`
        The flats; equal ones count as often as they are given.
    range_um : `tuple` [`float`, `float`]
        Thicknesses that the sensor may have [µm]; flats are over their mean, which is taken over this range.
    search_um : `tuple` [`float`, `float`], optional
        Thicknesses among which a fit would search [µm]; at least ``range_um``. If not given, the range of the
        set-up, which is what `fit_thickness` does.
    read_noise_e : `float`, optional
        Read noise [electrons].
    region_px : `int`, optional
        Number of independent pixels whose evidence on the order is added.

    Returns
    -------
    forecast : `FlatForecast`

    Raises
    ------
    InputError, OutOfRangeError
        No flat, a range that is not increasing, a wavelength beyond what is known of the media.
    """
    if not flats:
        raise InputError("flats", 0, "one or more")
    curves = _Curves.of_model(model, flats, range_um, search_um, read_noise_e)
    return _forecast(curves, _checked_region(region_px))


def nyquist_thickness_um(model: FringeModel, wavelength_nm: Sequence[float]) -> FloatArray:
    """Thickness at which the fringe turns by half a period from one flat to the next.

    A thicker layer is sampled below the Nyquist rate there: only the chirp of the fringe over all flats tells it from
    its mirror image.

    ``wavelength_nm``: wavelengths, in any order; equal ones count once. Returns (n_different - 1,): ``1 / (4 |n
    / lambda - n' / lambda'|)`` for each pair of neighbours, from short to long wavelengths.
    """
    wavelength = np.unique(np.asarray(wavelength_nm, dtype=float))
    # One order is half a wavelength in the layer.
    orders_per_um = 1.0 / np.asarray(model.fringe_order_um(wavelength), dtype=float)
    return np.asarray(0.5 / np.abs(np.diff(orders_per_um)))


def rank_flats(
    model: FringeModel,
    flats: Sequence[PlannedFlat],
    candidates: Sequence[PlannedFlat],
    range_um: tuple[float, float],
    *,
    search_um: tuple[float, float] | None = None,
    read_noise_e: float = 7.0,
    region_px: int = 64,
    slip_limit: float = 1e-5,
) -> tuple[RankedFlat, ...]:
    """Further flats, the most useful first.

    As long as orders are ambiguous, the one that leaves least slips is best; after that, the one that leaves the
    smallest uncertainty.

    Parameters
    ----------
    model, range_um, search_um, read_noise_e, region_px
        As for `forecast_flats`.
    flats : sequence of `PlannedFlat`
        Flats that there are.
    candidates : sequence of `PlannedFlat`
        Flats that could be taken in addition.
    slip_limit : `float`, optional
        Slip probability of a region that is small enough.
    """
    if not candidates:
        raise InputError("candidate flats", 0, "one or more")
    region = _checked_region(region_px)
    curves = _Curves.of_model(model, [*flats, *candidates], range_um, search_um, read_noise_e, SEARCH_STRIDE)
    present = _State.of(curves, range(len(flats)))
    found = []
    for number in range(len(flats), len(flats) + len(candidates)):
        state = present.plus(number)
        found.append((state.price(region, slip_limit), state.ranked(region)))
    return tuple(ranked for _, ranked in sorted(found, key=lambda item: item[0]))


def recommend_flats(
    model: FringeModel,
    candidates: Sequence[PlannedFlat],
    range_um: tuple[float, float],
    *,
    search_um: tuple[float, float] | None = None,
    read_noise_e: float = 7.0,
    region_px: int = 64,
    slip_limit: float = 1e-5,
    sigma_um: float = math.inf,
) -> FlatForecast:
    """A short list of flats with which no order is ambiguous, and its forecast.

    The most useful flat is added until the goal is reached; then flats that have become superfluous are dropped.

    Parameters
    ----------
    model, range_um, search_um, read_noise_e, region_px
        As for `forecast_flats`.
    candidates : sequence of `PlannedFlat`
        Flats that could be taken; each may be taken once.
    slip_limit : `float`, optional
        Largest slip probability of a region, at any thickness.
    sigma_um : `float`, optional
        Largest root mean square uncertainty of a pixel [µm].

    Returns
    -------
    forecast : `FlatForecast`
        At least `FEWEST_FLATS` flats, in ascending order of wavelength. If the candidates cannot reach the goal
        (`FlatForecast.safe`), the best `MOST_FLATS` of them.
    """
    if len(candidates) < FEWEST_FLATS:
        raise InputError("number of candidate flats", len(candidates), f"{FEWEST_FLATS} or more")
    region = _checked_region(region_px)
    curves = _Curves.of_model(model, candidates, range_um, search_um, read_noise_e, SEARCH_STRIDE)
    chosen: tuple[int, ...] = ()
    while True:
        chosen = _choose(curves, chosen, region, slip_limit, sigma_um)
        fine = curves.only(sorted(chosen, key=lambda number: _wavelength_and_width(candidates[number])))
        forecast = _forecast(fine, region)
        missed = np.setdiff1d(fine.truth[forecast.region_slip > slip_limit], curves.truth)
        if missed.size == 0 or len(chosen) >= min(MOST_FLATS, len(candidates)):
            return forecast
        curves = curves.with_truths(missed)


def _choose(
    curves: _Curves, chosen: tuple[int, ...], region_px: int, slip_limit: float, sigma_um: float
) -> tuple[int, ...]:
    """Add flats until the goal is reached, then drop those that have become superfluous."""
    state = _State.of(curves, chosen)
    while len(state.rows) < min(MOST_FLATS, len(curves.flats)):
        if len(state.rows) >= FEWEST_FLATS and state.reached(region_px, slip_limit, sigma_um):
            break
        trials = [state.plus(number) for number in range(len(curves.flats)) if number not in state.rows]
        state = min(trials, key=lambda trial: trial.price(region_px, slip_limit))
    chosen = state.rows
    for number in state.rows[:-1]:
        rest = tuple(other for other in chosen if other != number)
        if len(rest) >= FEWEST_FLATS and _State.of(curves, rest).reached(region_px, slip_limit, sigma_um):
            chosen = rest
    return chosen


def _wavelength_and_width(flat: PlannedFlat) -> tuple[float, float]:
    return flat.wavelength_nm, flat.bandwidth_fwhm_nm or 0.0


@dataclass(frozen=True, eq=False)
class _Curves:
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
    ) -> _Curves:
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
            tuple(flats),
            thickness,
            truth,
            relative - 1.0,
            step * slope / mean,
            electrons**2 / noise,
            order,
        )

    def with_truths(self, nodes: NDArray[np.intp]) -> _Curves:
        """With more possible true thicknesses."""
        return replace(self, truth=np.asarray(np.union1d(self.truth, nodes), dtype=np.intp))

    def only(self, rows: Sequence[int]) -> _Curves:
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
class _State:
    """Some of the flats: distances and information that they bring together."""

    curves: _Curves
    rows: tuple[int, ...]
    distance: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, curves: _Curves, rows: Sequence[int]) -> _State:
        return cls(curves, tuple(rows), curves.distance(rows), curves.information(rows))

    def plus(self, row: int) -> _State:
        """With one flat more."""
        return _State(
            self.curves,
            (*self.rows, row),
            self.distance + self.curves.distance([row]),
            self.information + self.curves.information([row]),
        )

    def price(self, region_px: int, slip_limit: float) -> tuple[float, float]:
        """Ranks sets of flats: mean number of wrong orders of a region, then mean square uncertainty."""
        wrong = float(_Rivals.find(self, region_px).expected_wins(region_px).mean())
        return max(wrong, _NEGLIGIBLE * slip_limit), self.variance

    def reached(self, region_px: int, slip_limit: float, sigma_um: float) -> bool:
        """Whether the goals are met."""
        slip = _Rivals.find(self, region_px).slip(region_px).max()
        return bool(slip <= slip_limit and self.variance <= sigma_um**2)

    def ranked(self, region_px: int) -> RankedFlat:
        """What the last of the flats has led to."""
        rivals = _Rivals.find(self, 1)
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
class _Rivals:
    """Minima of Δχ² away from the truth: for which truth, at which place in nodes, how deep."""

    truths: int
    truth: NDArray[np.intp]
    place: FloatArray
    separation: FloatArray

    @classmethod
    def find(cls, state: _State, pixels: int) -> _Rivals:
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
    curves: _Curves, rows: Sequence[int], truth: NDArray[np.intp], place: FloatArray
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


def _forecast(curves: _Curves, region_px: int) -> FlatForecast:
    state = _State.of(curves, range(len(curves.flats)))
    rivals = _Rivals.find(state, 1)
    separation, place = rivals.nearest()
    with np.errstate(divide="ignore"):
        sigma = 1.0 / np.sqrt(state.information)
    return FlatForecast(
        curves.flats,
        curves.thickness_um[curves.truth],
        sigma,
        curves.thickness_um[0] + curves.step_um * place,
        separation,
        rivals.slip(1),
        rivals.slip(region_px),
        region_px,
        curves.order_um,
    )


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


def _checked_region(region_px: int) -> int:
    if region_px < 1:
        raise OutOfRangeError("pixels of a region", region_px, "1 or more")
    return region_px
