"""Signal of a flat field, computed without the fitting model.

A second, separate implementation of thin-film optics: characteristic (admittance) matrices of the films, the
tangential fields at the two faces of the detection layer, and the difference of the Poynting flux through them.
The fitting model follows wave amplitudes and a closed form in the thickness instead. The two share the tables of
the materials and the YAML files of stacks and set-ups, nothing else, so that an error in either shows.

References: Macleod, Thin-Film Optical Filters (characteristic matrix, tilted admittance); Guo,
Walter, Lage & Lupton 2022, section 2.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import ComplexArray, FloatArray
from ..errors import ConvergenceError, OutOfRangeError, StackError, UnknownNameError
from .film_fields import add_mode, light_in
from .line_shapes import LINE_SHAPES, LINE_STEP_NM
from .materials import material_index
from .signal_table import SignalTable

DISPERSION_PIVOT_NM = 960.0  # Wavelength at which added dispersion leaves the index as it is [nm]
SCALE_PIVOT_NM = 935.0  # Wavelength at which an error of the wavelength scale vanishes [nm]
TABLE_STEP_UM = 0.003  # Spacing of the thickness grid [µm]: a hundred points per fringe order

HEIGHT_STEP_NM = 25.0
"""Largest spacing of the thicknesses inside a pixel [nm]: a fifth of a fringe in silicon."""

HEIGHT_REACH = 5.0  # Largest departure of the thickness inside a pixel in standard deviations

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
        Name of its material in ``data/media/media.yaml``, or in ``media``.
    thickness_um : `float`
        Thickness [µm]; infinite at the two ends.
    index_shift : `float`
        Added to the tabulated index.
    cauchy_um2 : `float`
        Added dispersion: coefficient of 1 / wavelength², zero at 960 nm [µm²].
    extinction_scale, extinction_shift : `float`
        Factor on the tabulated extinction coefficient, and what is added to it after that.
    media : `str`
        File with further materials, laid out like that one; none if empty.
    """

    name: str
    medium: str
    thickness_um: float
    index_shift: float = 0.0
    cauchy_um2: float = 0.0
    extinction_scale: float = 1.0
    extinction_shift: float = 0.0
    media: str = ""

    def index(self, wavelength_nm: FloatArray, temperature_k: float) -> ComplexArray:
        """Complex index at some wavelengths in vacuum [nm] and one temperature [K]."""
        table = material_index(self.medium, wavelength_nm, temperature_k, self.media)
        tilt = (1e3 / wavelength_nm) ** 2 - (1e3 / DISPERSION_PIVOT_NM) ** 2
        n = table.real + self.index_shift + self.cauchy_um2 * tilt
        return n + 1j * (table.imag * self.extinction_scale + self.extinction_shift)


PHASES = 16  # Thicknesses within a fringe over which the part that all phases have in common is averaged


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
        # A sensor need not have the layer that is rough by default.
        if self.rough_face == self.films[0].name or (
            self.roughness_nm > 0.0 and self.position(self.rough_face) == 0
        ):
            raise UnknownNameError("rough face", self.rough_face, [film.name for film in self.films[1:]])
        for shape, part in ((self.line_shape, 1.0), *self.other_lines):
            if shape not in LINE_SHAPES:
                raise UnknownNameError("line shape", shape, LINE_SHAPES)
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
            add_mode(total, light_in(self, wavelength, weight, theta, s_wave, 0.0), thickness)
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
        mean = self._coherent(self.one_order_um(float(wavelength_nm)), float(wavelength_nm)).mean()
        return np.asarray(mean + self.coherent_part * (signal - mean))

    def one_order_um(self, nominal_nm: float) -> FloatArray:
        """Thicknesses of the varying layer that go evenly through one fringe [µm]."""
        wavelength, film = self.true_wavelength(nominal_nm), self.films[self.position(self.varying)]
        index = film.index(np.array([wavelength]), self.temperature_k)[0].real
        order = 1e-3 * wavelength / (2.0 * index)
        return np.asarray(film.thickness_um + order * np.arange(PHASES) / PHASES)

    def _coherent(self, thickness: FloatArray, nominal_nm: float) -> FloatArray:
        """Detected fraction where all light comes back coherently."""
        wavelength, line_weight = self._line(nominal_nm)
        total = np.zeros(thickness.shape)
        for support_um, part in heights_and_weights(self.support_spread_um, 1e-3 * self.height_step_nm):
            for weight, theta, s_wave, height_um in self._modes():
                light = light_in(
                    self, wavelength, part * weight * line_weight, theta, s_wave, height_um, support_um
                )
                add_mode(total, light, thickness)
        return total

    def _line(self, nominal_nm: float) -> tuple[FloatArray, FloatArray]:
        """Wavelengths [nm] and weights of one flat."""
        offset, weight = LINE_SHAPES[self.line_shape](self.bandwidth_fwhm_nm, self.line_step_nm)
        for shape, part in self.other_lines:
            if part > 0.0:
                more, its_weight = LINE_SHAPES[shape](self.bandwidth_fwhm_nm, self.line_step_nm)
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

    def _measure_error(self, table: SignalTable) -> float:
        rng = np.random.default_rng(len(table.grid_um))
        between = np.sort(rng.uniform(table.grid_um[1], table.grid_um[-2], 24))
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
        for height_um, height_weight in heights_and_weights(
            1e-3 * self.spread_nm, 1e-3 * self.height_step_nm
        ):
            for theta, theta_weight in zip(self.theta, self.theta_weight, strict=True):
                weight = float(height_weight * theta_weight)
                if theta == 0.0:  # s and p are the same there
                    yield weight, 0.0, True, float(height_um)
                else:
                    yield 0.5 * weight, theta, True, float(height_um)
                    yield 0.5 * weight, theta, False, float(height_um)


def heights_and_weights(rms_um: float, step_um: float) -> list[tuple[float, float]]:
    """Departures [µm] and weights of a thickness that varies; equidistant nodes converge fast under a Gaussian."""
    if rms_um == 0.0:
        return [(0.0, 1.0)]
    count = max(12, math.ceil(HEIGHT_REACH * rms_um / step_um))
    node = np.linspace(-HEIGHT_REACH, HEIGHT_REACH, 2 * count + 1)
    weight = np.exp(-0.5 * node * node)
    return list(zip((rms_um * node).tolist(), (weight / weight.sum()).tolist(), strict=True))


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
