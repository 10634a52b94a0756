"""Signal of a flat field, computed without the fitting model.

A second, separate implementation of thin-film optics: characteristic (admittance) matrices of the films, the
tangential fields at the two faces of the detection layer, and the difference of the Poynting flux through them.
The fitting model follows wave amplitudes and a closed form in the thickness instead. The two share the tables of
the materials and the YAML files of stacks and set-ups, nothing else, so that an error in either shows.

References: Macleod, Thin-Film Optical Filters (characteristic matrix, tilted admittance); Green 2008, Franta et al.
2017 (silicon and its temperature dependence); Guo, Walter, Lage & Lupton 2022, section 2.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from ..errors import ConvergenceError, OutOfRangeError, StackError, UnknownNameError
from ..resources import read_table, read_yaml

__all__ = ["Film", "FlatFieldOptics", "SignalTable", "material_index"]

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

GREEN_TEMPERATURE_K = 300.0
EXTINCTION_FLOOR = 1e-12

COLD_RANGE_NM = (300.0, 1200.0)
"""Wavelengths at which silicon was measured cold (Franta et al. 2017) [nm]."""

DISPERSION_PIVOT_NM = 960.0
"""Wavelength at which added dispersion leaves the index as it is [nm]."""

SCALE_PIVOT_NM = 935.0
"""Wavelength at which an error of the wavelength scale vanishes [nm]."""

TABLE_STEP_UM = 0.003
"""Spacing of the thickness grid [µm]: a hundred points per fringe order."""

LINE_STEP_NM = 0.03
"""Spacing of wavelength nodes [nm]: fifteen per fringe of detection layer and support together."""

LINE_REACH = 6.0
"""Half width of the sampled Gaussian line in standard deviations; 2e-9 of the light is left out."""

LORENTZIAN_REACH = 10.0
"""Full widths at half maximum after which a Lorentzian line is cut off: 3 % of an endless one lie beyond."""

HEIGHT_STEP_NM = 25.0
"""Largest spacing of the thicknesses inside a pixel [nm]: a fifth of a fringe in silicon."""

HEIGHT_REACH = 5.0
"""Largest departure of the thickness inside a pixel in standard deviations."""

RELATIVE_TOLERANCE = 1e-5
"""Largest error of a table that is accepted, relative to its mean: 1/700 of the noise of a 20 000 e⁻ pixel."""


@dataclass(frozen=True)
class Film:
    """One plane layer.

    Attributes
    ----------
    name : `str`
        Name in the stack: ``detection``, ``adhesive``...
    medium : `str`
        Name of its material in ``data/media/media.yaml``.
    thickness_um : `float`
        Thickness [µm]; infinite at the two ends.
    index_shift : `float`
        Added to the tabulated index.
    cauchy_um2 : `float`
        Added dispersion: coefficient of 1 / wavelength², zero at 960 nm [µm²].
    extinction_scale, extinction_shift : `float`
        Factor on the tabulated extinction coefficient, and what is added to it after that.
    """

    name: str
    medium: str
    thickness_um: float
    index_shift: float = 0.0
    cauchy_um2: float = 0.0
    extinction_scale: float = 1.0
    extinction_shift: float = 0.0

    def index(self, wavelength_nm: FloatArray, temperature_k: float) -> ComplexArray:
        """Complex index at some wavelengths in vacuum [nm] and one temperature [K]."""
        table = material_index(self.medium, wavelength_nm, temperature_k)
        tilt = (1e3 / wavelength_nm) ** 2 - (1e3 / DISPERSION_PIVOT_NM) ** 2
        n = table.real + self.index_shift + self.cauchy_um2 * tilt
        return n + 1j * (table.imag * self.extinction_scale + self.extinction_shift)


PHASES = 16
"""Thicknesses within a fringe over which the part that all phases have in common is averaged."""


@dataclass(frozen=True)
class FlatFieldOptics:
    """Sensor and light of a monochromatic flat field.

    Attributes
    ----------
    films : `tuple` [`Film`, ...]
        From the ambient medium to the substrate.
    temperature_k : `float`
        Temperature of the sensor [K].
    bandwidth_fwhm_nm : `float`
        Full width at half maximum of the line [nm].
    line_shape : `str`
        ``"gaussian"``, ``"triangular"`` or ``"lorentzian"``.
    wavelength_offset_nm : `float`
        True minus nominal wavelength [nm].
    wavelength_stretch : `float`
        Further error per nm of distance from 935 nm.
    wavelength_errors_nm : `tuple` [`tuple` [`float`, `float`], ...]
        Nominal wavelengths, increasing, and the errors there [nm]; those between are interpolated.
    theta, theta_weight : `tuple` [`float`, ...]
        Angles of incidence [rad] and their weights, which sum to 1.
    varying, detection : `str`
        Layer whose thickness varies over the sensor; layer whose absorption is the signal.
    rough_face : `str`
        Layer whose upper face is rough.
    roughness_nm : `float`
        Rms height of that face [nm], on a lateral scale so short that light which is not specular is lost.
    spread_nm : `float`
        Rms variation of the varying layer inside a pixel [nm], slow enough for every part to be plane.
    support_spread_um : `float`
        The same of the layer called ``support`` [µm].
    other_lines : `tuple` [`tuple` [`str`, `float`], ...]
        Shapes of the same width, ``"lorentzian"`` too, each with the part that it takes of the light before it.
    lamp_lines : `tuple` [`tuple` [`float`, `float`, `float`], ...]
        Lines of the lamp: centre [nm], peak over the continuum, full width at half maximum [nm].
    coherent_part : `float`
        Part of the fringes that is left where only so much of the light comes back coherently; what all phases of
        the varying layer have in common stays.
    line_step_nm, height_step_nm : `float`
        Largest spacing of the nodes over wavelength and over the thicknesses inside a pixel [nm].

    Raises
    ------
    StackError
        Fewer than three films, a finite end, an infinite or negative thickness inside.
    OutOfRangeError
        A bandwidth or a step that is not positive, a negative roughness, weights that do not sum to one.
    UnknownNameError
        A layer that is not in the stack, or a line shape that is not known.
    """

    films: tuple[Film, ...]
    temperature_k: float
    bandwidth_fwhm_nm: float
    line_shape: str = "gaussian"
    wavelength_offset_nm: float = 0.0
    wavelength_stretch: float = 0.0
    wavelength_errors_nm: tuple[tuple[float, float], ...] = ()
    theta: tuple[float, ...] = (0.0,)
    theta_weight: tuple[float, ...] = (1.0,)
    varying: str = "adhesive"
    detection: str = "detection"
    rough_face: str = "support"
    roughness_nm: float = 0.0
    spread_nm: float = 0.0
    support_spread_um: float = 0.0
    other_lines: tuple[tuple[str, float], ...] = ()
    lamp_lines: tuple[tuple[float, float, float], ...] = ()
    coherent_part: float = 1.0
    line_step_nm: float = LINE_STEP_NM
    height_step_nm: float = HEIGHT_STEP_NM

    def __post_init__(self) -> None:
        _check_films(self.films)
        self.position(self.varying)
        self.position(self.detection)
        if not self.bandwidth_fwhm_nm > 0:
            raise OutOfRangeError("bandwidth FWHM [nm]", self.bandwidth_fwhm_nm, "a positive number")
        for name in ("line_step_nm", "height_step_nm"):
            if not getattr(self, name) > 0:
                raise OutOfRangeError(name, getattr(self, name), "a positive number")
        for name in ("roughness_nm", "spread_nm", "support_spread_um"):
            if not getattr(self, name) >= 0:
                raise OutOfRangeError(name, getattr(self, name), "zero or a positive number")
        if self.position(self.rough_face) == 0:
            raise UnknownNameError("rough face", self.rough_face, [film.name for film in self.films[1:]])
        for shape, part in ((self.line_shape, 1.0), *self.other_lines):
            if shape not in _LINE_SHAPES:
                raise UnknownNameError("line shape", shape, _LINE_SHAPES)
            if not 0.0 <= part <= 1.0:
                raise OutOfRangeError(f"part of the light in the {shape} line", part, "0 to 1")
        if len(self.theta) != len(self.theta_weight) or not math.isclose(sum(self.theta_weight), 1.0):
            raise OutOfRangeError("angle weights", self.theta_weight, "one per angle, with sum 1")

    def position(self, name: str) -> int:
        """Place of a film in the stack.

        Raises
        ------
        UnknownNameError
            There is no such film.
        """
        names = [film.name for film in self.films]
        if name not in names:
            raise UnknownNameError("layer", name, names)
        return names.index(name)

    def with_film(self, name: str, **changes: float) -> FlatFieldOptics:
        """Return the same optics with some attributes of one film changed."""
        place = self.position(name)
        film = replace(self.films[place], **changes)  # type: ignore[arg-type]
        return replace(self, films=(*self.films[:place], film, *self.films[place + 1 :]))

    def true_wavelength(self, nominal_nm: float) -> float:
        """Wavelength that the monochromator delivers when it is set to ``nominal_nm`` [nm]."""
        error = self.wavelength_offset_nm + self.wavelength_stretch * (nominal_nm - SCALE_PIVOT_NM)
        return nominal_nm + error + self._single_error(nominal_nm)

    def _single_error(self, nominal_nm: float) -> float:
        """Error of this exposure alone [nm]."""
        if not self.wavelength_errors_nm:
            return 0.0
        return float(np.interp(nominal_nm, *np.transpose(self.wavelength_errors_nm)))

    def absorbed_fraction(
        self, thickness_um: ArrayLike, wavelength_nm: float, theta: float = 0.0, polarization: str = "mixed"
    ) -> FloatArray:
        """Fraction of strictly monochromatic light absorbed in the detection layer where it is plane.

        Parameters
        ----------
        thickness_um : array_like, shape ``(D,)``
            Thickness of the varying layer [µm].
        wavelength_nm : `float`
            Wavelength in vacuum [nm].
        theta : `float`, optional
            Angle of incidence [rad].
        polarization : `str`, optional
            ``"s"``, ``"p"`` or ``"mixed"``.

        Returns
        -------
        fraction : `numpy.ndarray`, shape ``(D,)``
            Absorbed over incident power.
        """
        modes = {"s": (True,), "p": (False,), "mixed": (True, False)}
        if polarization not in modes:
            raise UnknownNameError("polarization", polarization, modes)
        thickness = np.atleast_1d(np.asarray(thickness_um, dtype=float))
        wavelength = np.array([float(wavelength_nm)])
        total = np.zeros(thickness.shape)
        for s_wave in modes[polarization]:
            weight = np.full(1, 1.0 / len(modes[polarization]))
            _add_mode(total, _light(self, wavelength, weight, theta, s_wave, 0.0), thickness)
        return total

    def flat_field(self, thickness_um: ArrayLike, wavelength_nm: float) -> FloatArray:
        """Detected fraction of the light of one flat: averaged over line, angles, polarisation and pixel.

        Parameters
        ----------
        thickness_um : array_like, shape ``(D,)``
            Thickness of the varying layer [µm].
        wavelength_nm : `float`
            Nominal wavelength of the flat [nm].

        Returns
        -------
        fraction : `numpy.ndarray`, shape ``(D,)``
            Detected over incident photons.
        """
        thickness = np.atleast_1d(np.asarray(thickness_um, dtype=float))
        signal = self._coherent(thickness, float(wavelength_nm))
        if self.coherent_part == 1.0:
            return signal
        mean = self._coherent(self._one_order_um(float(wavelength_nm)), float(wavelength_nm)).mean()
        return np.asarray(mean + self.coherent_part * (signal - mean))

    def _one_order_um(self, nominal_nm: float) -> FloatArray:
        """Thicknesses of the varying layer that go evenly through one fringe [µm]."""
        wavelength, film = self.true_wavelength(nominal_nm), self.films[self.position(self.varying)]
        index = film.index(np.array([wavelength]), self.temperature_k)[0].real
        order = 1e-3 * wavelength / (2.0 * index)
        return np.asarray(film.thickness_um + order * np.arange(PHASES) / PHASES)

    def _coherent(self, thickness: FloatArray, nominal_nm: float) -> FloatArray:
        """Detected fraction where all light comes back coherently."""
        wavelength, line_weight = self._line(nominal_nm)
        total = np.zeros(thickness.shape)
        for support_um, part in _heights(self.support_spread_um, 1e-3 * self.height_step_nm):
            for weight, theta, s_wave, height_um in self._modes():
                light = _light(
                    self, wavelength, part * weight * line_weight, theta, s_wave, height_um, support_um
                )
                _add_mode(total, light, thickness)
        return total

    def _line(self, nominal_nm: float) -> tuple[FloatArray, FloatArray]:
        """Wavelengths [nm] and weights of one flat."""
        offset, weight = _LINE_SHAPES[self.line_shape](self.bandwidth_fwhm_nm, self.line_step_nm)
        for shape, part in self.other_lines:
            if part > 0.0:
                more, its_weight = _LINE_SHAPES[shape](self.bandwidth_fwhm_nm, self.line_step_nm)
                offset = np.concatenate([offset, more])
                weight = np.concatenate([(1.0 - part) * weight, part * its_weight])
        wavelength = self.true_wavelength(nominal_nm) + offset
        lamp = np.ones(wavelength.size)
        for centre, peak, fwhm in self.lamp_lines:
            lamp += peak / (1.0 + ((wavelength - centre) / (0.5 * fwhm)) ** 2)
        return wavelength, weight * lamp / (weight * lamp).sum()

    def table(self, thickness_range_um: tuple[float, float], wavelengths_nm: Sequence[float]) -> SignalTable:
        """Tabulate the signal over thickness, one row per flat.

        The error is measured, not assumed: at random thicknesses between the grid points the interpolated value is
        compared with a direct calculation on a grid of wavelengths twice as fine.

        Parameters
        ----------
        thickness_range_um : `tuple` [`float`, `float`]
            Thinnest and thickest pixel [µm].
        wavelengths_nm : sequence of `float`
            Nominal wavelengths [nm].

        Returns
        -------
        table : `SignalTable`
            The table with its error.

        Raises
        ------
        OutOfRangeError
            The range is empty, or the layer would have a negative thickness.
        ConvergenceError
            The error exceeds 1e-5 of the mean signal.
        """
        low, high = thickness_range_um
        if not 0.0 < low <= high < math.inf:
            raise OutOfRangeError(
                f"range of the {self.varying} [um]", (low, high), "positive, finite, ordered"
            )
        margin = 4.0 * TABLE_STEP_UM
        points = math.ceil((high - low + 2.0 * margin) / TABLE_STEP_UM) + 1
        grid: FloatArray = max(low - margin, 0.0) + TABLE_STEP_UM * np.arange(points, dtype=float)
        signal = np.stack([self.flat_field(grid, wavelength) for wavelength in wavelengths_nm])
        table = SignalTable(grid, signal, tuple(float(value) for value in wavelengths_nm))
        return replace(table, relative_error=self._measure_error(table))

    def _measure_error(self, table: SignalTable, samples: int = 24) -> float:
        rng = np.random.default_rng(len(table.grid_um))
        between = np.sort(rng.uniform(table.grid_um[1], table.grid_um[-2], samples))
        finer = replace(self, line_step_nm=0.5 * self.line_step_nm, height_step_nm=0.5 * self.height_step_nm)
        worst = 0.0
        for row, wavelength in enumerate(table.wavelengths_nm):
            direct = finer.flat_field(between, wavelength)
            worst = max(worst, float(np.max(np.abs(table.evaluate(row, between) / direct - 1.0))))
        if not worst < RELATIVE_TOLERANCE:
            raise ConvergenceError(
                f"signal table is off by {worst:.1e} of its value; allowed: {RELATIVE_TOLERANCE:g}"
            )
        return worst

    def _modes(self) -> Iterator[tuple[float, float, bool, float]]:
        """Weight, angle [rad], s-wave or not, and departure of the varying layer from its mean [µm]."""
        for height_um, height_weight in _heights(1e-3 * self.spread_nm, 1e-3 * self.height_step_nm):
            for theta, theta_weight in zip(self.theta, self.theta_weight, strict=True):
                weight = float(height_weight * theta_weight)
                if theta == 0.0:  # s and p are the same there
                    yield weight, 0.0, True, float(height_um)
                else:
                    yield 0.5 * weight, theta, True, float(height_um)
                    yield 0.5 * weight, theta, False, float(height_um)


@dataclass(frozen=True, eq=False)
class SignalTable:
    """Signal as a function of thickness, on a uniform grid.

    Attributes
    ----------
    grid_um : `numpy.ndarray`, shape ``(D,)``
        Thickness of the varying layer [µm].
    signal : `numpy.ndarray`, shape ``(W, D)``
        Detected over incident photons of each flat.
    wavelengths_nm : `tuple` [`float`, ...]
        Nominal wavelength of each flat [nm].
    relative_error : `float`
        Largest relative difference found to a direct calculation with finer wavelength nodes.
    """

    grid_um: FloatArray
    signal: FloatArray
    wavelengths_nm: tuple[float, ...]
    relative_error: float = math.nan

    def evaluate(self, row: int, thickness_um: NDArray[np.floating]) -> FloatArray:
        """Signal of flat number ``row`` at any thickness within the grid, by cubic spline.

        Raises
        ------
        OutOfRangeError
            A thickness that is not on the grid (or not a number).
        """
        thickness = np.asarray(thickness_um)
        low, high = float(self.grid_um[0]), float(self.grid_um[-1])
        smallest, largest = float(np.min(thickness)), float(np.max(thickness))
        if not (smallest >= low and largest <= high):
            raise OutOfRangeError("thickness [um]", (smallest, largest), f"{low:g} to {high:g}")
        pieces = np.ascontiguousarray(CubicSpline(self.grid_um, self.signal[row]).c.T)
        step = (high - low) / (len(self.grid_um) - 1)
        return _evaluate_pieces(pieces, low, step, thickness.ravel()).reshape(thickness.shape)


def material_index(medium: str, wavelength_nm: FloatArray, temperature_k: float) -> ComplexArray:
    """Complex index of a shipped material; ``n`` by cubic spline, ``log k`` by monotone cubic.

    Parameters
    ----------
    medium : `str`
        Name in ``data/media/media.yaml``.
    wavelength_nm : `numpy.ndarray`
        Wavelength in vacuum [nm].
    temperature_k : `float`
        Temperature [K].

    Raises
    ------
    UnknownNameError
        There is no such material.
    OutOfRangeError
        A wavelength at which it is not tabulated.
    """
    curve, low, high = _material(medium)
    if not (np.min(wavelength_nm) >= low and np.max(wavelength_nm) <= high):
        found = (float(np.min(wavelength_nm)), float(np.max(wavelength_nm)))
        raise OutOfRangeError(f"wavelength [nm] in {medium}", found, f"{low:g} to {high:g}")
    return curve(wavelength_nm, temperature_k)


_Curve = Callable[[FloatArray, float], ComplexArray]


@functools.lru_cache(maxsize=64)
def _material(medium: str) -> tuple[_Curve, float, float]:
    entries = read_yaml("media", "media.yaml")
    if medium not in entries:
        raise UnknownNameError("medium", medium, entries)
    entry = entries[medium]
    if "constant" in entry:
        constant = complex(*entry["constant"])
        low, high = entry["range_nm"]
        return lambda wavelength, _: np.full(wavelength.shape, constant), float(low), float(high)
    table = read_table("media", entry["table"])
    nodes = table["wavelength"].quantity.to_value("nm")
    first, second = entry.get("columns", ("n", "k"))
    n_curve = CubicSpline(nodes, table[first])
    extinction = np.asarray(table[second], dtype=float)
    log_k = PchipInterpolator(nodes, np.log(np.maximum(extinction, EXTINCTION_FLOOR)))
    transparent = not np.any(extinction > 0.0)
    kind = entry.get("temperature", "")
    measured_k = float(entry.get("measured_at_k", GREEN_TEMPERATURE_K))

    def curve(wavelength: FloatArray, temperature_k: float) -> ComplexArray:
        n = n_curve(wavelength)
        k = np.zeros(wavelength.shape) if transparent else np.exp(log_k(wavelength))
        if kind == "franta2017":
            cold_k = min(temperature_k, GREEN_TEMPERATURE_K)
            now, then = (_cold_silicon(wavelength, each) for each in (cold_k, measured_k))
            n, k = n + now[0] - then[0], k * now[1] / then[1]
        if kind == "green2008" or (kind and temperature_k > GREEN_TEMPERATURE_K):
            exponent = _green_exponents(wavelength)
            n, k = (
                each * (temperature_k / GREEN_TEMPERATURE_K) ** power
                for each, power in zip((n, k), exponent, strict=True)
            )
        return n + 1j * k

    ends = nodes if kind != "franta2017" else np.clip(nodes, *COLD_RANGE_NM)
    return curve, float(ends[0]), float(ends[-1])


def _green_exponents(wavelength_nm: FloatArray) -> list[FloatArray]:
    """Exponents of T / 300 K in n and k of silicon."""
    table = read_table("media", "nk_Si_green2008.ecsv")
    nodes = table["wavelength"].quantity.to_value("nm")
    return [
        PchipInterpolator(nodes, table[name])(wavelength_nm) * 1e-4 * GREEN_TEMPERATURE_K
        for name in ("C_n", "C_k")
    ]


def _cold_silicon(wavelength_nm: FloatArray, temperature_k: float) -> tuple[FloatArray, FloatArray]:
    """Index and extinction of silicon that was measured cold: polynomials in temperature through the nodes."""
    table = read_table("media", "nk_Si_franta2017_T.ecsv")
    nodes = table["wavelength"].quantity.to_value("nm")
    kelvin = np.arange(100.0, 301.0, 50.0)
    columns = {part: [np.asarray(table[f"{part}_{t:.0f}K"], dtype=float) for t in kelvin] for part in "nk"}
    n = np.stack([CubicSpline(nodes, each)(wavelength_nm) for each in columns["n"]])
    log_k = np.stack([PchipInterpolator(nodes, np.log(each))(wavelength_nm) for each in columns["k"]])
    at = 0.02 * (temperature_k - 200.0)
    powers = np.linalg.solve(np.vander(0.02 * (kelvin - 200.0)).T, at ** np.arange(4, -1, -1))
    return np.asarray(powers @ n), np.exp(powers @ log_k)


def _gaussian_line(fwhm_nm: float, step_nm: float) -> tuple[FloatArray, FloatArray]:
    """Offsets [nm] and weights; equidistant nodes, exponentially convergent for a Gaussian."""
    sigma = fwhm_nm / math.sqrt(8.0 * math.log(2.0))
    count = max(40, math.ceil(LINE_REACH * sigma / step_nm))
    offset: FloatArray = np.arange(-count, count + 1, dtype=float) * (LINE_REACH * sigma / count)
    weight = np.exp(-0.5 * (offset / sigma) ** 2)
    return offset, weight / weight.sum()


def _triangular_line(fwhm_nm: float, step_nm: float) -> tuple[FloatArray, FloatArray]:
    """Offsets [nm] and weights; Gauss–Legendre on either flank."""
    count = max(20, math.ceil(fwhm_nm / step_nm))
    x, w = np.polynomial.legendre.leggauss(count)
    flank = 0.5 * (x + 1.0)
    offset = fwhm_nm * np.concatenate([flank - 1.0, flank])
    weight = np.concatenate([w * flank, w * (1.0 - flank)])
    return offset, weight / weight.sum()


def _lorentzian_line(fwhm_nm: float, step_nm: float) -> tuple[FloatArray, FloatArray]:
    """Offsets [nm] and weights; equal parts of the light, up to ten times the width."""
    reach = math.atan(2.0 * LORENTZIAN_REACH)
    count = math.ceil(2.0 * reach * LORENTZIAN_REACH * fwhm_nm / step_nm)
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * fwhm_nm * np.tan(reach * x), 0.5 * w


def _heights(rms_um: float, step_um: float) -> list[tuple[float, float]]:
    """Departures [µm] and weights of a thickness that varies; equidistant nodes converge fast under a Gaussian."""
    if rms_um == 0.0:
        return [(0.0, 1.0)]
    count = max(12, math.ceil(HEIGHT_REACH * rms_um / step_um))
    node = np.linspace(-HEIGHT_REACH, HEIGHT_REACH, 2 * count + 1)
    weight = np.exp(-0.5 * node * node)
    return list(zip((rms_um * node).tolist(), (weight / weight.sum()).tolist(), strict=True))


_LINE_SHAPES: Mapping[str, Callable[[float, float], tuple[FloatArray, FloatArray]]] = MappingProxyType(
    {"gaussian": _gaussian_line, "triangular": _triangular_line, "lorentzian": _lorentzian_line}
)


@dataclass(frozen=True, eq=False)
class _Light:
    """All that one angle and polarisation need apart from the thickness; Q wavelengths.

    Fields ``(E, H)`` stand at the lower face of the varying film as ``bottom`` and are carried by the film's own
    matrix to its upper face. ``incident`` carries them on from there to the ambient medium. ``top_above`` and
    ``top_below`` give the fields at the upper face of the detection film, from those above and below the varying
    film; ``low_above`` and ``low_below`` at its lower face.
    """

    weight: FloatArray  # (Q,) includes 1 / incident power
    phase: ComplexArray  # (Q,) phase thickness per µm of the varying film
    admittance: ComplexArray  # (Q,) of the varying film
    ambient: FloatArray  # (Q,) admittance of the ambient medium
    bottom: ComplexArray  # (Q, 2)
    incident: ComplexArray  # (Q, 2, 2)
    top_above: ComplexArray  # (Q, 2, 2)
    top_below: ComplexArray  # (Q, 2)
    low_above: ComplexArray  # (Q, 2, 2)
    low_below: ComplexArray  # (Q, 2)
    extra_um: float  # departure of the varying film from its mean thickness


def _light(
    optics: FlatFieldOptics,
    wavelength_nm: FloatArray,
    weight: FloatArray,
    theta: float,
    s_wave: bool,
    height_um: float,
    support_um: float = 0.0,
) -> _Light:
    thickness = [film.thickness_um for film in optics.films]
    if support_um:
        thickness[optics.position("support")] += support_um
    wave_number = 2.0 * np.pi / (1e-3 * wavelength_nm)  # rad/µm
    index = np.stack([film.index(wavelength_nm, optics.temperature_k) for film in optics.films])
    along = index[0].real * math.sin(theta)
    normal = np.sqrt(index * index - along * along)  # n cos(theta); the principal root decays downwards
    admittance = normal if s_wave else index * index / normal
    last = len(optics.films) - 1
    v, d = optics.position(optics.varying), optics.position(optics.detection)

    smooth = np.broadcast_to(np.eye(2, dtype=complex), (len(wavelength_nm), 2, 2))
    rough = optics.position(optics.rough_face) if optics.roughness_nm > 0.0 else -1

    def into(film: int) -> ComplexArray:
        """Matrix from the upper face of a film, inside it, to the lower face of the film above it."""
        if film != rough:
            return smooth  # tangential fields are continuous
        height = 1e-3 * optics.roughness_nm * wave_number
        return _rough_face(admittance[[film - 1, film]], normal[[film - 1, film]] * height)

    def through(first: int, stop: int) -> ComplexArray:
        """Matrix from the upper face of film ``stop`` to the upper face of film ``first``, scaled."""
        product = smooth
        for j in range(first, stop):
            film = _film_matrix(admittance[j], wave_number * normal[j] * thickness[j])
            product = product @ film @ into(j + 1)
        return product

    def decay(first: int, stop: int) -> ComplexArray:
        """The factor that the scaled matrices of the films first … stop - 1 leave out."""
        exponent = np.zeros(len(wavelength_nm), dtype=complex)
        for j in range(first, stop):
            exponent += 1j * wave_number * normal[j] * thickness[j]
        return np.exp(exponent)

    substrate = np.stack([np.ones(len(wavelength_nm)), admittance[last]], axis=1)
    none_matrix = np.zeros((len(wavelength_nm), 2, 2), dtype=complex)
    none_vector = np.zeros((len(wavelength_nm), 2), dtype=complex)

    def face(film: int) -> tuple[ComplexArray, ComplexArray]:
        """Fields at the upper face of a film, from those at the upper and at the lower face of the varying one."""
        if film <= v:
            scale = decay(1, film)[:, np.newaxis, np.newaxis]
            return scale * through(film, v), none_vector
        below = np.einsum("qij,qj->qi", through(film, last), substrate)
        return none_matrix, below * (decay(1, v) * decay(v + 1, film))[:, np.newaxis]

    top_above, top_below = face(d)
    low_above, low_below = face(d + 1)
    low_above, low_below = into(d + 1) @ low_above, np.einsum("qij,qj->qi", into(d + 1), low_below)
    return _Light(
        weight=weight,
        phase=wave_number * normal[v],
        admittance=admittance[v],
        ambient=admittance[0].real.copy(),
        bottom=np.einsum("qij,qj->qi", into(v + 1) @ through(v + 1, last), substrate),
        incident=np.ascontiguousarray(into(1) @ through(1, v)),
        top_above=np.ascontiguousarray(top_above),
        top_below=np.ascontiguousarray(top_below),
        low_above=np.ascontiguousarray(low_above),
        low_below=np.ascontiguousarray(low_below),
        extra_um=height_um,
    )


def _film_matrix(admittance: ComplexArray, phase: ComplexArray) -> ComplexArray:
    """Characteristic matrix times ``exp(i phase)``, which keeps opaque films finite; shape ``(Q, 2, 2)``."""
    round_trip = np.exp(2j * phase)
    matrix = np.empty((*phase.shape, 2, 2), dtype=complex)
    matrix[..., 0, 0] = matrix[..., 1, 1] = 0.5 * (1.0 + round_trip)
    matrix[..., 0, 1] = 0.5 * (1.0 - round_trip) / admittance
    matrix[..., 1, 0] = 0.5 * (1.0 - round_trip) * admittance
    return matrix


def _rough_face(admittance: ComplexArray, phase: ComplexArray) -> ComplexArray:
    """Matrix of a face whose height is normally distributed, for the mean (specular) field.

    Raised by h, a face changes the phase of the wave that it reflects upwards by 2 q1 h, downwards by -2 q2 h, and of
    what it lets through by (q1 - q2) h, with q the normal wave number on either side. The mean of exp(i a h) is
    exp(-a² σ² / 2).

    ``admittance`` (2, Q). ``phase`` (2, Q): normal wave number above and below times the rms height.
    """
    above, below = admittance
    reflected = (above - below) / (above + below)
    from_above = reflected * np.exp(-2.0 * phase[0] ** 2)
    from_below = -reflected * np.exp(-2.0 * phase[1] ** 2)
    passed = np.exp(-0.5 * (phase[0] - phase[1]) ** 2) / (above + below)
    down, up = 2.0 * above * passed, 2.0 * below * passed
    # Waves (down, up) above the face from those below it.
    waves = np.empty((admittance.shape[1], 2, 2), dtype=complex)
    waves[:, 0, 0] = 1.0 / down
    waves[:, 0, 1] = -from_below / down
    waves[:, 1, 0] = from_above / down
    waves[:, 1, 1] = up - from_above * from_below / down
    to_fields, to_waves = np.empty_like(waves), np.empty_like(waves)
    to_fields[:, 0, :] = 1.0
    to_fields[:, 1, 0], to_fields[:, 1, 1] = above, -above
    to_waves[:, :, 0] = 0.5
    to_waves[:, 0, 1], to_waves[:, 1, 1] = 0.5 / below, -0.5 / below
    return to_fields @ waves @ to_waves


def _add_mode(total: FloatArray, light: _Light, thickness_um: FloatArray) -> None:
    """Add the weighted absorbed fraction of one angle and polarisation to ``total``."""
    _add_absorption(
        total,
        thickness_um + light.extra_um,
        light.weight,
        light.phase,
        light.admittance,
        light.ambient,
        light.bottom,
        light.incident,
        light.top_above,
        light.top_below,
        light.low_above,
        light.low_below,
    )


@numba.njit(cache=True)
def _add_absorption(
    total: FloatArray,
    thickness: FloatArray,
    weight: FloatArray,
    phase: ComplexArray,
    admittance: ComplexArray,
    ambient: FloatArray,
    bottom: ComplexArray,
    incident: ComplexArray,
    top_above: ComplexArray,
    top_below: ComplexArray,
    low_above: ComplexArray,
    low_below: ComplexArray,
) -> None:  # pragma: no cover - compiled
    for q in range(weight.size):
        y, e_bottom, h_bottom = admittance[q], bottom[q, 0], bottom[q, 1]
        c, t, low = incident[q], top_above[q], low_above[q]
        for i in range(thickness.size):
            once = np.exp(1j * phase[q] * thickness[i])
            even, odd = 0.5 * (1.0 + once * once), 0.5 * (1.0 - once * once)
            e = even * e_bottom + odd * h_bottom / y
            h = odd * y * e_bottom + even * h_bottom
            e_top = t[0, 0] * e + t[0, 1] * h + once * top_below[q, 0]
            h_top = t[1, 0] * e + t[1, 1] * h + once * top_below[q, 1]
            e_low = low[0, 0] * e + low[0, 1] * h + once * low_below[q, 0]
            h_low = low[1, 0] * e + low[1, 1] * h + once * low_below[q, 1]
            flux = (
                e_top.real * h_top.real
                + e_top.imag * h_top.imag
                - e_low.real * h_low.real
                - e_low.imag * h_low.imag
            )
            e_front = c[0, 0] * e + c[0, 1] * h
            h_front = c[1, 0] * e + c[1, 1] * h
            forward = 0.5 * (e_front + h_front / ambient[q])
            total[i] += weight[q] * flux / (ambient[q] * (forward.real**2 + forward.imag**2))


@numba.njit(cache=True)
def _evaluate_pieces(
    pieces: FloatArray, low: float, step: float, position: NDArray[np.floating]
) -> FloatArray:  # pragma: no cover - compiled
    result = np.empty(position.size)
    last = pieces.shape[0] - 1
    for i in range(position.size):
        where = (position[i] - low) / step
        piece = min(int(where), last)
        x = position[i] - (low + piece * step)
        c = pieces[piece]
        result[i] = ((c[0] * x + c[1]) * x + c[2]) * x + c[3]
    return result


def _check_films(films: tuple[Film, ...]) -> None:
    if len(films) < 3:
        raise StackError("number of layers", len(films), "three or more")
    for end in (films[0], films[-1]):
        if end.thickness_um != math.inf:
            raise StackError(f"thickness [um] of end layer {end.name}", end.thickness_um, "infinite")
    for film in films[1:-1]:
        if not 0.0 <= film.thickness_um < math.inf:
            raise StackError(
                f"thickness [um] of layer {film.name}", film.thickness_um, "finite, not negative"
            )
