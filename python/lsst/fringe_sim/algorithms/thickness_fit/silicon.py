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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ...array_types import BoolArray, FloatArray
from ...compiled import kernel
from ...effects.geometry import unit_place
from ...errors import InputError, OutOfRangeError
from ...model import FringeModel
from ...products import ThicknessMap, mask_bits
from ..thickness_fit_options import SILICON_FIELDS
from .amplitudes import Amplitudes
from .bands import gather_pixels
from .newton import gauss_newton
from .templates import FringeTemplates, pad_wavelengths

__all__ = [
    "SILICON_FIELDS",
    "SiliconFit",
    "SiliconForecast",
    "SiliconModel",
    "SiliconSearch",
    "SiliconTables",
    "find_silicon",
    "silicon_free",
    "silicon_map",
]

OFFSET = "silicon_thickness.offset"
_SCAN_PER_ORDER = 12
STEPS_PER_SILICON_ORDER = 20
"""Tables in one order of the silicon between which cubic interpolation is good to 2e-4 of its fringes."""
_NODES_PER_ORDER = 100
"""Thicknesses in one order of the adhesive; linear interpolation is good to 5e-4 of its fringes."""
_TILES = 16
_PER_TILE = 16
_CANDIDATES = 4
_ROUNDS = 12
_RESOLVED = 1.0 / 12.0
"""Uncertainty of the silicon, in its orders, below which its fringes are said to be seen."""
_RIVALS = (-3, -2, -1, 1, 2, 3)
_TILTS = 13
_CAP = 25.0  # Largest chi-square per wavelength of a pixel in the scan: one bad pixel must not decide


@dataclass(frozen=True)
class SiliconSearch:
    """What of the silicon is free.

    Raises `OutOfRangeError`: a degree beyond 2, or a length or probability that is not positive.
    """

    degree: int = 0  # 0 for one thickness of the whole sensor, 1 for a plane, 2 for a paraboloid
    span_um: float = 1.0  # how far the mean may lie from the thickness in the model, on both sides [µm]
    tilt_um: float = (
        0.2  # largest difference between middle and edge of the sensor, for a degree above 0 [µm]
    )
    slip_limit: float = (
        0.01  # the silicon is held fixed if its order would be wrong with a larger probability
    )

    def __post_init__(self) -> None:
        if self.degree not in (0, 1, 2):
            raise OutOfRangeError("degree of the silicon", self.degree, "0, 1 or 2")
        if not 0.0 < self.span_um <= 20.0:
            raise OutOfRangeError("span of the silicon [um]", self.span_um, "above 0, at most 20")
        if not 0.0 < self.tilt_um <= 2.0:
            raise OutOfRangeError("tilt of the silicon [um]", self.tilt_um, "above 0, at most 2")
        if not 0.0 < self.slip_limit <= 1.0:
            raise OutOfRangeError("slip limit", self.slip_limit, "above 0, at most 1")

    def terms(self, y: FloatArray, x: FloatArray) -> FloatArray:
        """Monomials 1, x, y, x², xy, y² at places of pixels, shape ``(n, n_terms)``.

        A place is -1 in the first and 1 in the last row or column: a wedge is twice its term from edge to edge.
        """
        columns = [np.ones_like(x), x, y, x * x, x * y, y * y]
        return np.stack(columns[: (1, 3, 6)[self.degree]], axis=-1)


@dataclass(frozen=True, eq=False)
class SiliconForecast:
    """What the flats can tell about the silicon."""

    sigma_um: float  # largest uncertainty of the thickness of the silicon on the sensor, from its fringes alone [µm]
    slip_probability: float  # probability that its order is wrong
    order_um: float  # thickness of one fringe order of the silicon [µm]
    # half peak to peak of its fringes in each flat, as a fraction of the level, ``(n_wavelengths,)``
    fringe: FloatArray
    decided: bool  # whether the flats decide
    reason: str  # why, or why not


@dataclass(frozen=True, eq=False)
class SiliconFit:
    """Thickness of the silicon over a sensor."""

    search: SiliconSearch  # what was free
    # of the terms of `SiliconSearch.terms`, relative to the thickness in the model [µm]; zeros if not decided,
    # ``(n_terms,)``
    coefficients: FloatArray
    # their covariance [µm²], larger by the misfit of the flats if that is above one, ``(n_terms, n_terms)``
    covariance: FloatArray
    chi2: float  # chi-square per degree of freedom of the pixels that were asked
    slip_probability: float  # probability that another order of the silicon is the right one
    forecast: SiliconForecast  # what was to be expected

    @property
    def decided(self) -> bool:
        """Whether the thickness was fitted; otherwise it is that of the model."""
        return self.forecast.decided and self.slip_probability <= self.search.slip_limit

    def offset_um(self, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Thickness minus that of the model at every pixel, and its uncertainty [µm]; arrays of ``shape``."""
        y, x = np.meshgrid(*(_places(size) for size in shape), indexing="ij")
        terms = self.search.terms(y.ravel(), x.ravel())
        variance = np.einsum("ij,jk,ik->i", terms, self.covariance, terms)
        return (terms @ self.coefficients).reshape(shape), np.sqrt(variance).reshape(shape)

    def cards(self) -> dict[str, Any]:
        """Keywords for the header of a thickness map."""
        found: dict[str, Any] = {
            "SIFIT": self.decided,
            "SISLIP": round(self.slip_probability, 9),
            "SIORDER": round(self.forecast.order_um, 6),
            "SIWHY": self.forecast.reason[:60],
        }
        if self.decided:
            spread = np.sqrt(np.diag(self.covariance))
            for number, (value, sigma) in enumerate(zip(self.coefficients, spread, strict=True)):
                found[f"SICOEF{number}"] = round(float(value), 7)
                found[f"SISIGM{number}"] = round(float(sigma), 8)
            correlation = self.covariance / np.outer(spread, spread)
            for first, second in itertools.combinations(range(spread.size), 2):
                found[f"SICORR{first}{second}"] = round(float(correlation[first, second]), 6)
        return found


def silicon_map(fitted: ThicknessMap, model: FringeModel) -> ThicknessMap | None:
    """Thickness of the silicon on the pixels of a map that was fitted together with it; `None` if it was not decided.

    ``fitted``: map of the other layer, with the keywords of `SiliconFit.cards`.
    """
    header = fitted.metadata
    if not header.get("SIFIT"):
        return None
    count = sum(key.startswith("SICOEF") for key in header)
    coefficients, spread = (
        np.array([float(header[f"{word}{number}"]) for number in range(count)])
        for word in ("SICOEF", "SISIGM")
    )
    covariance = np.diag(spread**2)
    for first, second in itertools.combinations(range(count), 2):
        shared = float(header[f"SICORR{first}{second}"]) * spread[first] * spread[second]
        covariance[first, second] = covariance[second, first] = shared
    search = SiliconSearch({1: 0, 3: 1, 6: 2}[count])
    system, slip = model.system, float(header["SISLIP"])
    shape = (fitted.value.shape[0], fitted.value.shape[1])
    forecast = SiliconForecast(0.0, slip, float(header["SIORDER"]), np.zeros(0), True, str(header["SIWHY"]))
    found = SiliconFit(search, coefficients, covariance, 1.0, slip, forecast)
    offset, sigma = found.offset_um(shape)
    nominal = system.stack.layers[system.stack.position(system.detection)].thickness_um
    return ThicknessMap(
        value=(nominal + offset).astype(np.float32),
        sigma=sigma.astype(np.float32),
        chi2=np.zeros(shape, np.float32),
        slip_probability=np.full(shape, slip, np.float32),
        mask=fitted.mask & mask_bits("NO_DATA"),
        layer=system.detection,
        metadata={key: value for key, value in header.items() if key.startswith("SI")},
        detector=fitted.detector,
    )


@dataclass(frozen=True, eq=False)
class SiliconTables:
    """Response against the adhesive for several thicknesses of the silicon."""

    # response; 0 in the padding, float32, ``(n_silicon, n_thickness, padded wavelengths)``
    response: NDArray[np.float32]
    # silicon_start_um, silicon_step_um: first silicon, relative to that of the model, and spacing [µm]
    silicon_start_um: float
    silicon_step_um: float
    # start_um, step_um: first thickness of the adhesive and spacing [µm]
    start_um: float
    step_um: float
    wavelengths: int  # number of wavelengths, without padding

    def at(
        self, silicon_um: FloatArray, thickness_um: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Response and its derivatives [1/µm] by the silicon and by the adhesive, each ``(n, wavelengths)``."""
        place = (silicon_um - self.silicon_start_um) / self.silicon_step_um
        first = np.clip(np.floor(place).astype(int) - 1, 0, len(self.response) - 4)
        value, slope = _lagrange(place - first)
        row = (thickness_um - self.start_um) / self.step_um
        below = np.clip(np.floor(row).astype(int), 0, self.response.shape[1] - 2)
        share = (row - below)[:, None]
        found, by_silicon, by_thickness = (np.zeros((len(row), self.wavelengths)) for _ in range(3))
        for k in range(4):
            low = self.response[first + k, below, : self.wavelengths]
            rise = self.response[first + k, below + 1, : self.wavelengths] - low
            here = low + share * rise
            found += value[k][:, None] * here
            by_silicon += slope[k][:, None] * here
            by_thickness += value[k][:, None] * rise
        return found, by_silicon / self.silicon_step_um, by_thickness / self.step_um


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


@dataclass(frozen=True, eq=False)
class SiliconModel:
    """The response of the flats of a cube, each with its own width of the line, for any silicon.

    Raises `InputError`: the layer that varies is the silicon itself.
    """

    model: FringeModel  # the model
    # wavelength_nm, bandwidth_nm: wavelengths and widths of the lines [nm]. A width as in the set-up, or 0, is that
    # of the model, ``(n_wavelengths,)``
    wavelength_nm: FloatArray
    bandwidth_nm: FloatArray

    def __post_init__(self) -> None:
        system = self.model.base_system
        if system.varying == system.detection:
            raise InputError("varying layer", system.varying, "another than the silicon, for a joint fit")

    def templates(self, like: FringeTemplates, offset_um: float) -> FloatArray:
        """Response on the grid of templates at a thickness of the silicon, ``(n_thickness, n_wavelengths)``."""
        return self.on_grid(offset_um, like.start_um, like.step_um, len(like.response))

    def on_grid(self, offset_um: float, start_um: float, step_um: float, count: int) -> FloatArray:
        """Response on a grid of the adhesive, shape ``(count, n_wavelengths)``."""
        settings = dict(self.model.effect_settings)
        settings[OFFSET] = settings.get(OFFSET, 0.0) + offset_um
        response = np.empty((count, self.wavelength_nm.size))
        usual = self.model.setup.bandwidth_fwhm_nm
        for width in np.unique(self.bandwidth_nm):
            rows = np.flatnonzero(self.bandwidth_nm == width)
            own = {} if abs(width - usual) < 1e-6 or width == 0.0 else {"bandwidth.fwhm": float(width)}
            chosen = self.model.with_effects({**settings, **own})
            response[:, rows] = chosen.response_on_grid(self.wavelength_nm[rows], start_um, step_um, count).T
        return response

    @property
    def order_um(self) -> float:
        """Thickness of one order of the silicon, mean over the flats [µm]."""
        system = self.model.system
        index = system.stack.indices(self.wavelength_nm, system.temperature_k)
        silicon = index[system.stack.position(system.detection)].real
        return float(np.mean(1e-3 * self.wavelength_nm / (2.0 * silicon)))

    def tables(
        self,
        silicon_um: tuple[float, float],
        per_order: int,
        thickness_um: tuple[float, float],
        order_um: float,
    ) -> SiliconTables:
        """Tables that cover ranges of both thicknesses, with two nodes of the silicon beyond each end."""
        step = self.order_um / per_order
        count = int(np.ceil((silicon_um[1] - silicon_um[0]) / step)) + 5
        first = silicon_um[0] - 2.0 * step
        fine = order_um / _NODES_PER_ORDER
        rows = int(np.ceil((thickness_um[1] - thickness_um[0]) / fine)) + 2
        padded = [
            pad_wavelengths(self.on_grid(first + step * k, thickness_um[0], fine, rows)) for k in range(count)
        ]
        return SiliconTables(np.stack(padded), first, step, thickness_um[0], fine, self.wavelength_nm.size)


def silicon_free(
    data: Amplitudes, templates: FringeTemplates, model: SiliconModel
) -> tuple[Amplitudes, FringeTemplates]:
    """Flats and model for a first fit that does not know the silicon.

    The model is averaged over one order of the silicon, and what its fringes do to a flat counts as noise.
    """
    flats = model
    shifts = flats.order_um * (np.arange(_SCAN_PER_ORDER) + 0.5 - 0.5 * _SCAN_PER_ORDER) / _SCAN_PER_ORDER
    total = np.zeros(templates.response.shape)
    square = np.zeros(templates.response.shape)
    for shift in shifts:
        response = flats.templates(templates, float(shift))
        total += response
        square += response**2
    mean = total / len(shifts)
    scatter = np.sqrt(np.maximum(square / len(shifts) - mean**2, 0.0)).mean(axis=0) / mean.mean(axis=0)
    extra = (scatter / data.scale) ** 2
    variance = data.variance + np.asarray(extra, np.float32)[:, None, None]
    return replace(data, variance=variance), replace(
        templates, response=mean, mean_response=mean.mean(axis=0)
    )


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


def _places(size: int) -> FloatArray:
    """Places of pixels, as effects of a sensor have them."""
    return unit_place(np.arange(size, dtype=float), size)


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
    place = np.stack([_places(ny)[rows], _places(nx)[columns]], axis=-1)
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
    tables = flats.tables((-reach, reach), _SCAN_PER_ORDER, _range_of(sample, order_um), order_um)
    shifts = order * (np.arange(_SCAN_PER_ORDER) / _SCAN_PER_ORDER - 0.5)
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
    tables = flats.tables((-span, span), _SCAN_PER_ORDER, _range_of(sample, order_um), order_um)
    steps = np.arange(len(tables.response), dtype=np.float64)
    offsets = tables.silicon_start_um + tables.silicon_step_um * steps
    everywhere = np.ones(len(sample.value))
    means = np.array(
        [tables.at(offset * everywhere, sample.thickness_um)[0].mean(axis=0) for offset in offsets]
    )
    if search.degree:
        # Over a sensor that spans orders of silicon its fringes average out.
        window = np.ones(_SCAN_PER_ORDER) / _SCAN_PER_ORDER
        means = np.stack([np.convolve(column, window, "same") for column in means.T], axis=-1)
        half = _SCAN_PER_ORDER // 2
        means[:half], means[-half:] = means[half], means[-half - 1]
    curves = np.zeros((_TILES**2, len(offsets)))
    places = (sample.thickness_um - tables.start_um) / tables.step_um
    for number, mean in enumerate(means):
        chi2 = np.empty(len(places))
        _scan_pixels(
            tables.response[number], places, pad_wavelengths((1.0 + sample.value) * mean),
            pad_wavelengths(sample.weight / mean**2), 0.1 * _NODES_PER_ORDER, chi2,
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
    scans: list[tuple[FloatArray, FloatArray]],
    offsets: FloatArray,
    usable: BoolArray,
    terms: int,
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


def _lagrange(place: Any) -> tuple[list[FloatArray], list[FloatArray]]:
    """Weights of nodes 0 to 3 for the value and the derivative of a cubic at a place between them."""
    nodes = range(4)
    values, slopes = [], []
    for k in nodes:
        others = [j for j in nodes if j != k]
        scale = float(np.prod([k - j for j in others]))
        a, b, c = (place - j for j in others)
        values.append(a * b * c / scale)
        slopes.append((a * b + a * c + b * c) / scale)
    return values, slopes


@kernel
def _scan_pixels(table, places, value, weight, longest, chi2):  # type: ignore[no-untyped-def]
    for k in range(places.shape[0]):
        _, _, chi2[k] = gauss_newton(table, places[k], value, weight, k, np.int64(4), longest)
