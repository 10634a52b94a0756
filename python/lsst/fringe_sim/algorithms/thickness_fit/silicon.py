"""Silicon and adhesive together: thickness of the detection layer from flats with a narrow line.

The silicon in front of the adhesive has fringes of its own, 1.2 nm apart for 100 µm. A line of 2 nm washes them out;
in a line of a few tenths of a nanometre they show, and with them the thickness of the silicon, which the paper
takes as known. It is nearly the same everywhere, while the adhesive varies from pixel to pixel: so it is modelled
as a low polynomial over the sensor, ``s(x, y) = Σ c_k b_k(x, y)``, beside one adhesive thickness per pixel.

Only a few thousand pixels are asked. The adhesive of each is eliminated (variable projection, Golub & Pereyra 1973),
which leaves normal equations for the coefficients. A scan over ``s`` finds the order of the silicon, whose
likelihood has a minimum every 0.13 µm; the best few are refined, and their chi-squares say how sure the choice is.

Before that, the Fisher information of the same pixels tells whether the flats can decide at all. It counts the
fringes of the silicon alone: that thicker silicon absorbs more is true as well, but many other things change
the level of a flat.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ...array_types import BoolArray, FloatArray
from ...compiled import kernel
from ...errors import InputError
from .amplitudes import Amplitudes
from .bands import gather_pixels
from .newton import gauss_newton
from .silicon_result import SiliconFit, SiliconForecast, SiliconSearch, pixel_places
from .silicon_tables import NODES_PER_ORDER, SCAN_PER_ORDER, SiliconModel, SiliconTables
from .templates import pad_wavelengths

STEPS_PER_SILICON_ORDER = 20
"""Tables in one order of the silicon between which cubic interpolation is good to 2e-4 of its fringes."""
_TILES = 16
_PER_TILE = 16
_CANDIDATES = 4
_ROUNDS = 12
_RESOLVED = 1.0 / 12.0
"""Uncertainty of the silicon, in its orders, below which its fringes are said to be seen."""
_RIVALS = (-3, -2, -1, 1, 2, 3)
_TILTS = 13
_CAP = 25.0  # Largest chi-square per wavelength of a pixel in the scan: one bad pixel must not decide


@dataclass(frozen=True, eq=False)
class _Sample:
    """Pixels that are asked: amplitudes, weights, thickness of the adhesive, place on the sensor and tile."""

    value: FloatArray
    weight: FloatArray
    thickness_um: FloatArray
    terms: FloatArray
    place: FloatArray
    tile: NDArray[np.intp]

    @property
    def freedom(self) -> int:
        """Amplitudes less one thickness for each pixel."""
        return int(np.count_nonzero(self.weight)) - len(self.value)


@dataclass(frozen=True, eq=False)
class _Solution:
    coefficients: FloatArray
    information: FloatArray
    chi2: float


def find_silicon(
    data: Amplitudes,
    thickness_um: NDArray[np.floating],
    model: SiliconModel,
    search: SiliconSearch,
    order_um: float,
) -> SiliconFit:
    """Fit the thickness of the silicon beside that of the adhesive.

    ``thickness_um``: thickness of the adhesive from a first fit, right to a quarter of an order [µm]; NaN where a
    pixel is not to be asked, ``(ny, nx)``; ``model``: the model, at any silicon; its own is where the search
    begins; ``order_um``: thickness of one fringe order of the adhesive [µm]. The result is not
    `SiliconFit.decided` where the flats cannot tell.
    """
    sample = _sample(data, thickness_um, search)
    forecast = _forecast(model, sample, search, order_um)
    terms = sample.terms.shape[1]
    if not forecast.decided:
        return SiliconFit(search, np.zeros(terms), np.zeros((terms, terms)), np.nan, 1.0, forecast)
    starts = _scan(model, sample, search, order_um)
    solutions = [_refine(model, sample, start, order_um) for start in starts]
    solutions.sort(key=lambda one: one.chi2)
    best = solutions[0]
    misfit = best.chi2 / max(sample.freedom - terms, 1)
    scale = max(misfit, 1.0)
    odds = sum(
        np.exp(-0.5 * (other.chi2 - best.chi2) / scale)
        for other in solutions[1:]
        if abs(other.coefficients[0] - best.coefficients[0]) > 0.5 * forecast.order_um
    )
    slip = max(float(odds / (1.0 + odds)), forecast.slip_probability)
    return SiliconFit(
        search, best.coefficients, scale * np.linalg.inv(best.information), misfit, slip, forecast
    )


def _sample(data: Amplitudes, thickness_um: NDArray[np.floating], search: SiliconSearch) -> _Sample:
    """A few pixels of every tile of the sensor, spread evenly over those that have a thickness."""
    ny, nx = thickness_um.shape
    tiles = [np.minimum(np.arange(size) * _TILES // size, _TILES - 1) for size in (ny, nx)]
    rows, columns = np.nonzero(np.isfinite(thickness_um))
    tile = tiles[0][rows] * _TILES + tiles[1][columns]
    order = np.argsort(tile, kind="stable")
    rows, columns, tile = rows[order], columns[order], tile[order]
    begin = np.searchsorted(tile, np.arange(_TILES**2 + 1))
    chosen = np.concatenate(
        [
            np.unique(np.linspace(low, high - 1, _PER_TILE).astype(int))
            for low, high in itertools.pairwise(begin)
            if high > low
        ]
        or [np.zeros(0, int)]
    )
    if chosen.size < _PER_TILE:
        raise InputError("pixels with a thickness", int(chosen.size), f"{_PER_TILE} or more, for a joint fit")
    rows, columns, tile = rows[chosen], columns[chosen], tile[chosen]
    bands = data.shape[0]
    value, weight = (array[:, :bands].astype(float) for array in gather_pixels(data, rows, columns))
    # Flats and model are compared over their means over these very pixels.
    seen = weight > 0.0
    level = np.where(seen, 1.0 + value, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    value = (1.0 + value) / np.where(level > 0.0, level, 1.0) - 1.0
    place = np.stack([pixel_places(ny)[rows], pixel_places(nx)[columns]], axis=-1)
    return _Sample(
        value,
        weight,
        thickness_um[rows, columns].astype(float),
        search.terms(place[:, 0], place[:, 1]),
        place,
        tile,
    )


def _range_of(sample: _Sample, order_um: float) -> tuple[float, float]:
    low, high = float(sample.thickness_um.min()), float(sample.thickness_um.max())
    return max(low - order_um, 1e-3), high + order_um


def _forecast(
    flats: SiliconModel, sample: _Sample, search: SiliconSearch, order_um: float
) -> SiliconForecast:
    order = flats.order_um
    reach = (max(_RIVALS) + 0.5) * order
    tables = flats.tables((-reach, reach), SCAN_PER_ORDER, _range_of(sample, order_um), order_um)
    shifts = order * (np.arange(SCAN_PER_ORDER) / SCAN_PER_ORDER - 0.5)
    amplitude, by_silicon, by_thickness = [], [], []
    everywhere = np.ones(len(sample.value))
    for shift in shifts:
        response, silicon, thickness = tables.at(shift * everywhere, sample.thickness_um)
        mean = response.mean(axis=0)
        amplitude.append(response / mean - 1.0)
        by_silicon.append(silicon / mean - response * silicon.mean(axis=0) / mean**2)
        by_thickness.append(thickness / mean)
    curves = np.array(amplitude)
    fringe = 0.5 * np.ptp(curves - curves.mean(axis=0), axis=0).max(axis=0)
    # What does not come back after an order is absorption, which other things change as well.
    waves = np.array(by_silicon) - np.mean(by_silicon, axis=0)
    across = np.array(by_thickness)
    each = np.mean([_projected(w, a, sample.weight) for w, a in zip(waves, across, strict=True)], axis=0)
    information = np.einsum("n,ni,nj->ij", each, sample.terms, sample.terms)
    sigma = _largest_sigma(information, search)
    slip = 0.0
    for rival in _RIVALS:
        apart = []
        for shift, own in zip(shifts, curves, strict=True):
            response, _, _ = tables.at((shift + rival * order) * everywhere, sample.thickness_um)
            apart.append(response / response.mean(axis=0) - 1.0 - own)
        waves = np.array(apart) - np.mean(apart, axis=0)
        excess = np.mean([_projected(w, a, sample.weight).sum() for w, a in zip(waves, across, strict=True)])
        slip += float(ndtr(-0.5 * np.sqrt(excess)))
    slip = min(slip, 1.0)
    decided = sigma < _RESOLVED * order and slip <= search.slip_limit
    if sigma >= _RESOLVED * order:
        reason = f"fringes of the silicon not seen: sigma {sigma:.2g} um"
    elif not decided:
        reason = f"order of the silicon ambiguous: {100 * slip:.1f} per cent"
    else:
        reason = f"expected sigma {sigma:.2g} um"
    return SiliconForecast(sigma, slip, order, fringe, decided, reason)


def _projected(wave: FloatArray, across: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted square of ``wave`` without its part along ``across``, for each pixel."""
    own = (weight * across**2).sum(axis=1)
    mixed = (weight * wave * across).sum(axis=1)
    along = np.divide(mixed**2, own, out=np.zeros_like(own), where=own > 0.0)
    return np.maximum((weight * wave**2).sum(axis=1) - along, 0.0)


def _largest_sigma(information: FloatArray, search: SiliconSearch) -> float:
    """Largest uncertainty on the sensor [µm]; infinite for a singular matrix."""
    y, x = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)))
    terms = search.terms(y, x)
    if np.linalg.matrix_rank(information) < len(information):
        return float("inf")
    return float(np.sqrt(np.einsum("ij,jk,ik->i", terms, np.linalg.inv(information), terms).max()))


def _scan(flats: SiliconModel, sample: _Sample, search: SiliconSearch, order_um: float) -> list[FloatArray]:
    """Coefficients of the best few minima on a coarse grid."""
    span = search.span_um + (search.tilt_um if search.degree else 0.0)
    tables = flats.tables((-span, span), SCAN_PER_ORDER, _range_of(sample, order_um), order_um)
    steps = np.arange(len(tables.response), dtype=np.float64)
    offsets = tables.silicon_start_um + tables.silicon_step_um * steps
    everywhere = np.ones(len(sample.value))
    means = np.array(
        [tables.at(offset * everywhere, sample.thickness_um)[0].mean(axis=0) for offset in offsets]
    )
    if search.degree:
        # Over a sensor that spans orders of silicon its fringes average out.
        window = np.ones(SCAN_PER_ORDER) / SCAN_PER_ORDER
        means = np.stack([np.convolve(column, window, "same") for column in means.T], axis=-1)
        half = SCAN_PER_ORDER // 2
        means[:half], means[-half:] = means[half], means[-half - 1]
    curves = np.zeros((_TILES**2, len(offsets)))
    places = (sample.thickness_um - tables.start_um) / tables.step_um
    for number, mean in enumerate(means):
        chi2 = np.empty(len(places))
        _scan_pixels(
            tables.response[number], places, pad_wavelengths((1.0 + sample.value) * mean),
            pad_wavelengths(sample.weight / mean**2), 0.1 * NODES_PER_ORDER, chi2,
        )  # fmt: skip
        np.minimum(chi2, _CAP * flats.wavelength_nm.size, out=chi2)
        curves[:, number] = np.bincount(sample.tile, chi2, _TILES**2)
    usable = np.abs(offsets) <= search.span_um + 0.5 * tables.silicon_step_um
    if search.degree == 0:
        return _minima([(curves.sum(axis=0), np.zeros(0))], offsets, usable, 1)
    weight = np.bincount(sample.tile, minlength=_TILES**2)
    middle = np.stack(
        [np.bincount(sample.tile, sample.place[:, k], _TILES**2) / np.maximum(weight, 1) for k in (1, 0)],
        axis=-1,
    )
    tilts = np.linspace(-search.tilt_um, search.tilt_um, _tilt_count(search, flats.order_um))
    shifted = [
        (_shifted_sum(curves, middle @ np.array([a, b]) / tables.silicon_step_um), np.array([a, b]))
        for a in tilts
        for b in tilts
    ]
    return _minima(shifted, offsets, usable, sample.terms.shape[1])


def _tilt_count(search: SiliconSearch, order_um: float) -> int:
    """Steps of a fifth of an order between middle and edge, and an odd number of them."""
    return max(_TILTS, 2 * int(np.ceil(search.tilt_um / (0.2 * order_um))) + 1)


def _shifted_sum(curves: FloatArray, shift: FloatArray) -> FloatArray:
    """Sum of curves, each read ``shift`` nodes further on; beyond an end its value there."""
    nodes = np.arange(curves.shape[1]) + shift[:, None]
    nodes = np.clip(nodes, 0.0, curves.shape[1] - 1.001)
    below = nodes.astype(int)
    share = nodes - below
    lines = np.arange(len(curves))[:, None]
    return np.asarray((curves[lines, below] * (1.0 - share) + curves[lines, below + 1] * share).sum(axis=0))


def _minima(
    scans: list[tuple[FloatArray, FloatArray]], offsets: FloatArray, usable: BoolArray, terms: int
) -> list[FloatArray]:
    """Best local minima over the mean offset, each with its best tilt."""
    totals = np.array([total for total, _ in scans])
    least = totals.min(axis=0)
    least[~usable] = np.inf
    inner = (
        np.flatnonzero((least[1:-1] <= least[:-2]) & (least[1:-1] <= least[2:]) & np.isfinite(least[1:-1]))
        + 1
    )
    if inner.size == 0:
        inner = np.array([int(np.argmin(least))])
    found = []
    for node in inner[np.argsort(least[inner])][:_CANDIDATES]:
        start = np.zeros(terms)
        tilt = scans[int(np.argmin(totals[:, node]))][1]
        start[0], start[1 : 1 + tilt.size] = offsets[node], tilt
        found.append(start)
    return found


def _refine(flats: SiliconModel, sample: _Sample, start: FloatArray, order_um: float) -> _Solution:
    """Gauss-Newton steps of the coefficients, the adhesive of every pixel following."""
    coefficients, thickness = start.copy(), sample.thickness_um.copy()
    order = flats.order_um
    silicon = sample.terms @ coefficients
    reach = (float(silicon.min()) - 0.5 * order, float(silicon.max()) + 0.5 * order)
    tables = flats.tables(reach, STEPS_PER_SILICON_ORDER, _range_of(sample, order_um), order_um)
    for _ in range(_ROUNDS):
        gradient, information, chi2, move = _normal_equations(tables, sample, coefficients, thickness)
        change = np.linalg.solve(information, gradient)
        longest = float(np.abs(sample.terms @ change).max())
        change *= min(1.0, 0.1 * order / max(longest, 1e-12))
        coefficients += change
        thickness += np.clip(move, -0.1 * order_um, 0.1 * order_um)
        if longest < 1e-3 / np.sqrt(np.linalg.eigvalsh(information).max()):
            break
    _, information, chi2, _ = _normal_equations(tables, sample, coefficients, thickness)
    return _Solution(coefficients, information, chi2)


def _normal_equations(
    tables: SiliconTables, sample: _Sample, coefficients: FloatArray, thickness_um: FloatArray
) -> tuple[FloatArray, FloatArray, float, FloatArray]:
    """Gradient and information of the coefficients, chi-square, and step of the adhesive of each pixel [µm].

    The flats are over their mean, and so is the model, over the same pixels: its mean moves with the silicon.
    """
    response, by_silicon, by_thickness = tables.at(sample.terms @ coefficients, thickness_um)
    seen = sample.weight > 0.0
    number = np.maximum(seen.sum(axis=0), 1)
    mean = np.where(seen, response, 0.0).sum(axis=0) / number
    weight = sample.weight / mean**2
    rest = (1.0 + sample.value) * mean - response
    own = (weight * by_thickness**2).sum(axis=1)
    own = np.where(own > 0.0, own, np.inf)
    move = (weight * by_thickness * rest).sum(axis=1) / own
    left = rest - move[:, None] * by_thickness
    columns = []
    for term in sample.terms.T:
        wave = by_silicon * term[:, None]
        drift = np.where(seen, wave, 0.0).sum(axis=0) / number
        wave = wave - (1.0 + sample.value) * drift
        columns.append(wave - ((weight * by_thickness * wave).sum(axis=1) / own)[:, None] * by_thickness)
    gradient = np.array([(weight * wave * left).sum() for wave in columns])
    information = np.array([[(weight * one * two).sum() for two in columns] for one in columns])
    return gradient, information, float((weight * left**2).sum()), move


@kernel
def _scan_pixels(table, places, value, weight, longest, chi2):  # type: ignore[no-untyped-def]
    for k in range(places.shape[0]):
        _, _, chi2[k] = gauss_newton(table, places[k], value, weight, k, np.int64(4), longest)
