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
from dataclasses import dataclass

import numpy as np

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError, named_units
from ..model import FringeModel
from .flat_rivals import SEARCH_STRIDE, ChosenFlats, Curves, PlannedFlat, RankedFlat, Rivals

FEWEST_FLATS = 4  # A fit of fewer wavelengths is flagged
MOST_FLATS = 24


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


@named_units
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
    curves = Curves.of_model(model, flats, range_um, search_um, read_noise_e)
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


@named_units
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
    curves = Curves.of_model(model, [*flats, *candidates], range_um, search_um, read_noise_e, SEARCH_STRIDE)
    present = ChosenFlats.of(curves, range(len(flats)))
    found = []
    for number in range(len(flats), len(flats) + len(candidates)):
        state = present.plus(number)
        found.append((state.price(region, slip_limit), state.ranked(region)))
    return tuple(ranked for _, ranked in sorted(found, key=lambda item: item[0]))


@named_units
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
    curves = Curves.of_model(model, candidates, range_um, search_um, read_noise_e, SEARCH_STRIDE)
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
    curves: Curves, chosen: tuple[int, ...], region_px: int, slip_limit: float, sigma_um: float
) -> tuple[int, ...]:
    """Add flats until the goal is reached, then drop those that have become superfluous."""
    state = ChosenFlats.of(curves, chosen)
    while len(state.rows) < min(MOST_FLATS, len(curves.flats)):
        if len(state.rows) >= FEWEST_FLATS and state.reached(region_px, slip_limit, sigma_um):
            break
        trials = [state.plus(number) for number in range(len(curves.flats)) if number not in state.rows]
        state = min(trials, key=lambda trial: trial.price(region_px, slip_limit))
    chosen = state.rows
    for number in state.rows[:-1]:
        rest = tuple(other for other in chosen if other != number)
        if len(rest) >= FEWEST_FLATS and ChosenFlats.of(curves, rest).reached(
            region_px, slip_limit, sigma_um
        ):
            chosen = rest
    return chosen


def _wavelength_and_width(flat: PlannedFlat) -> tuple[float, float]:
    return flat.wavelength_nm, flat.bandwidth_fwhm_nm or 0.0


def _forecast(curves: Curves, region_px: int) -> FlatForecast:
    state = ChosenFlats.of(curves, range(len(curves.flats)))
    rivals = Rivals.find(state, 1)
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


def _checked_region(region_px: int) -> int:
    if region_px < 1:
        raise OutOfRangeError("pixels of a region", region_px, "1 or more")
    return region_px
