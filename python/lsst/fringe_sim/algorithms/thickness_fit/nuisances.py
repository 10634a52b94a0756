"""What flats hold besides fringes, and what of the model they do not share: which of it a fit leaves free.

The flats over their mean are modelled as ``light(x, y) (1 + c f(d))`` for each wavelength. The light is the
exponential of known patterns: levels of zones and low polynomials. The contrast ``c`` has a factor for each
wavelength, and may fade with the thickness. The wavelength of each flat may be another than its label says.

How they are found stands in `learning`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...array_types import FloatArray
from ...errors import InputError, OutOfRangeError, UnknownNameError
from ..thickness_fit_options import CONTRASTS, ZONES
from .cells import Cells
from .templates import FlatTemplates

_ROWS = 16  # Rows of cells whose light is made at a time
OVERTONES = 4  # Numbers that describe the overtones at one wavelength
GAIN_ACCURACY = 0.005
"""How well gains of amplifiers are known: a few 1e-3 from iron-55, or from the variance of pairs of flats."""
LSST_GRID = (2, 8)  # Rows and columns of the amplifiers of an LSST sensor
LEAST_ZONE_PX = 16  # Pixels along a side of an amplifier below which its level is not told from its fringes
_GAIN_BY_WAVELENGTH = 0.2
"""Standard deviation of the level of a zone at one wavelength, over that of its mean: levels are mostly gains."""
_LIGHT, _LIGHT_BY_WAVELENGTH = 0.1, 0.02
"""Standard deviations of each term of a slow illumination: what wavelengths share, and what each has of its own."""


@dataclass(frozen=True)
class Nuisances:
    """Which of them a fit leaves free.

    Parameters
    ----------
    level : `bool`, optional
        A free level at each wavelength in each zone.
    zones : {"sensor", "halves", "amplifiers"}, optional
        Zones with a level of their own; other than ``sensor`` implies ``level``.
    illumination_degree : `int`, optional
        Degree of a polynomial in x and y, free at each wavelength, and the level with it; 0 for none.
    contrast : {"fixed", "common", "wavelength"}, optional
        Factor on the fringe amplitude of the model.
    gain_accuracy : `float`, optional
        Standard deviation of the levels of zones relative to that of the sensor, if they are known to some accuracy;
        infinite by default.
    wavelength_accuracy_nm : `float`, optional
        Standard deviation of the wavelengths about their labels [nm]; 0 if they are taken as they are.
    grid : `tuple` [`int`, `int`], optional
        Rows and columns of amplifiers.

    Raises
    ------
    UnknownNameError, OutOfRangeError
        A choice that does not exist, a degree outside 0 to 8, or an accuracy that is negative.
    """

    level: bool = False
    zones: str = "sensor"
    illumination_degree: int = 0
    contrast: str = "fixed"
    gain_accuracy: float = np.inf
    wavelength_accuracy_nm: float = 0.0
    grid: tuple[int, int] = LSST_GRID

    def __post_init__(self) -> None:
        if self.zones not in ZONES:
            raise UnknownNameError("zones", self.zones, ZONES)
        if self.contrast not in CONTRASTS:
            raise UnknownNameError("contrast", self.contrast, CONTRASTS)
        if not 0 <= self.illumination_degree <= 8:
            raise OutOfRangeError("illumination degree", self.illumination_degree, "0 to 8")
        if not self.gain_accuracy > 0.0:
            raise OutOfRangeError("accuracy of gains", self.gain_accuracy, "above 0")
        if not 0.0 <= self.wavelength_accuracy_nm <= 20.0:
            raise OutOfRangeError("accuracy of wavelengths [nm]", self.wavelength_accuracy_nm, "0 to 20")

    @classmethod
    def automatic(
        cls,
        contrast: str = "wavelength",
        wavelength_accuracy_nm: float = 0.0,
        grid: tuple[int, int] = LSST_GRID,
    ) -> Nuisances:
        """What is free unless somebody asks otherwise."""
        return cls(True, "amplifiers", 2, contrast, GAIN_ACCURACY, wavelength_accuracy_nm, grid)

    @property
    def any(self) -> bool:
        """Whether anything is left free."""
        return self.patterned or self.contrast != "fixed" or self.wavelength_accuracy_nm > 0.0

    @property
    def patterned(self) -> bool:
        """Whether light or level are free."""
        return self.level or self.zones != "sensor" or self.illumination_degree > 0

    def fitting(self, ny: int, nx: int) -> Nuisances:
        """Levels of amplifiers only where a sensor is large enough for them."""
        rows, columns = self.grid
        small = ny < LEAST_ZONE_PX * rows or nx < LEAST_ZONE_PX * columns
        small = small and self.zones == "amplifiers" and bool(np.isfinite(self.gain_accuracy))
        return replace(self, zones="sensor") if small else self

    def breaks(self, ny: int, nx: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Rows and columns at which a zone begins.

        Raises
        ------
        InputError
            A sensor too small for its zones.
        """
        if self.zones == "sensor":
            return (), ()
        rows, columns = self.grid if self.zones == "amplifiers" else (2, 1)
        if ny < rows or nx < columns:
            raise InputError("zones", self.zones, f"zones that a sensor of {ny} rows and {nx} columns has")
        return _borders(ny, rows), _borders(nx, columns)


def _borders(size: int, count: int) -> tuple[int, ...]:
    """First pixels of all but the first of so many equal parts."""
    return tuple(size * k // count for k in range(1, count))


@dataclass(frozen=True, eq=False)
class NuisanceFit:
    """Light, contrast and wavelengths that a fit found."""

    # logarithm of the light on the patterns of `light_patterns`, ``(n_wavelengths, n_patterns)``
    coefficients: FloatArray
    # contrast, contrast_sigma: factor on the fringe amplitude at the middle thickness of the sensor, and its
    # standard uncertainty, ``(n_wavelengths,)``
    contrast: FloatArray
    contrast_sigma: FloatArray
    # shift_nm, shift_sigma_nm: wavelength of each flat minus that of its label [nm], ``(n_wavelengths,)``
    shift_nm: FloatArray
    shift_sigma_nm: FloatArray
    fading: float = 0.0  # logarithmic loss of contrast per thickness [1/µm]
    # what is added of the overtones of the model, as factors on `FlatTemplates.overtones`, ``(n_wavelengths, 4)``
    overtones: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    middle_um: float = 0.0  # thickness at which ``contrast`` holds [µm]
    scale_sigma: float = 0.0  # standard uncertainty of the scale of the thickness, which all pixels share
    # typical squared residual of the cells over their variance, at each wavelength, ``(n_wavelengths,)``
    misfit: FloatArray = field(default_factory=lambda: np.ones(0))
    # mean response over the sensor to which level and contrast belong; empty if it is not known,
    # ``(n_wavelengths,)``
    mean_response: FloatArray = field(default_factory=lambda: np.empty(0))
    # chi2, prior: twice the negative logarithm of the probability of the cells looked at, and of the prior of the
    # nuisances
    chi2: float = np.inf
    prior: float = 0.0
    shared: float = 1.0  # variance of sums over cells relative to that of cells which err each by itself
    # of all that was learned, in the order of `learning.moves_of`; empty if nobody asked, ``(n, n)``
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    @classmethod
    def none(cls, wavelengths: int, patterns: int = 0) -> NuisanceFit:
        """Even light, the contrast of the model, wavelengths as labelled."""
        zero = np.zeros(wavelengths)
        return cls(
            np.zeros((wavelengths, patterns)), np.ones(wavelengths), zero, zero, zero,
            overtones=np.zeros((wavelengths, OVERTONES)),
        )  # fmt: skip

    def cost(self, shared: float = 1.0) -> float:
        """Improbability of all that was found, where the cells err alike as far as ``shared`` says."""
        return self.chi2 / shared + self.prior

    def light(self, cells: Cells, free: Nuisances) -> NDArray[np.float32]:
        """Light on all cells, less one, shape ``(n_wavelengths, ncy, ncx)``; no wavelengths if it is even."""
        if not np.any(self.coefficients):
            return np.zeros((0, *cells.shape), np.float32)
        out = np.empty((len(self.coefficients), *cells.shape), np.float32)
        lines, columns = cells.shape
        # Patterns of all cells at once would need more memory than the cells.
        for first in range(0, lines, _ROWS):
            rows, place = (part.ravel() for part in np.mgrid[first : min(first + _ROWS, lines), 0:columns])
            pattern, _ = patterns_of_cells(cells, free, rows, place)
            out[:, first : first + _ROWS] = np.expm1(self.coefficients @ pattern.T).reshape(
                len(out), -1, columns
            )
        return out

    def applied_to(self, base: FlatTemplates) -> FlatTemplates:
        """Templates of a sensor with this contrast and these wavelengths."""
        found = base.as_found(self.contrast, self.shift_nm, self.fading, self.overtones, self.middle_um)
        return replace(found, mean_response=self.mean_response) if self.mean_response.size else found


def subtract_offset(cells: Cells, light: NDArray[np.float32]) -> Cells:
    """Cells under even light; ``light`` is that of `NuisanceFit.light`."""
    return _under_light(cells, 1.0 / (1.0 + light))


def add_offset(cells: Cells, light: NDArray[np.float32]) -> Cells:
    """Cells under the light that was taken from them."""
    return _under_light(cells, 1.0 + light)


def _under_light(cells: Cells, light: NDArray[np.float32]) -> Cells:
    """Cells whose counts are multiplied by a light of shape ``(n_wavelengths, ncy, ncx)``."""
    if light.size == 0:
        return cells
    value = cells.value.copy()
    seen = value[..., : len(light)]
    seen += (1.0 + seen) * (np.moveaxis(light, 0, -1) - np.float32(1))
    return replace(cells, value=value)


def patterns_of_cells(
    cells: Cells, free: Nuisances, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> tuple[FloatArray, int]:
    """Patterns of the light at the centres of some cells, as for `light_patterns`."""
    shape = (int(cells.y_edges[-1]), int(cells.x_edges[-1]))
    return light_patterns(free, shape, cells.y_centre[rows], cells.x_centre[columns])


def light_patterns(
    free: Nuisances, shape: tuple[int, int], y_px: FloatArray, x_px: FloatArray
) -> tuple[FloatArray, int]:
    """Known patterns at some places of a sensor, shape ``(n, n_patterns)``: level, zones, polynomials.

    Also the number of zones. The mean of a flat is that of light times fringe: where the light is free, so is the
    level.
    """
    ny, nx = shape
    if not free.patterned:
        return np.zeros((y_px.size, 0)), 0
    parts = [np.ones((y_px.size, 1))]
    rows_at, columns_at = free.breaks(ny, nx)
    zones = 0
    if rows_at:
        across = len(columns_at) + 1
        zones = (len(rows_at) + 1) * across
        zone = np.searchsorted(rows_at, y_px, side="right") * across
        zone = zone + np.searchsorted(columns_at, x_px, side="right")
        parts.append((zone[:, None] == np.arange(zones)).astype(float))
    if free.illumination_degree:
        degree = free.illumination_degree
        y = 2.0 * y_px / max(ny - 1, 1) - 1.0
        x = 2.0 * x_px / max(nx - 1, 1) - 1.0
        along, beside = (np.polynomial.legendre.legvander(part, degree) for part in (y, x))
        terms = [(k, total - k) for total in range(1, degree + 1) for k in range(total + 1)]
        parts.append(np.stack([along[:, a] * beside[:, b] for a, b in terms], axis=1))
    return np.concatenate(parts, axis=1), zones


def light_widths(free: Nuisances, zones: int, count: int, shared: bool) -> FloatArray:
    """Standard deviations of the coefficients of the light: what wavelengths share, or what each has besides."""
    known = np.isfinite(free.gain_accuracy)
    width = np.full(count, (_LIGHT if shared else _LIGHT_BY_WAVELENGTH) if known else 1.0)
    width[0] = 1.0
    gain = free.gain_accuracy * (1.0 if shared else _GAIN_BY_WAVELENGTH) if known else 1.0
    width[1 : 1 + zones] = gain
    return width
