"""Fringe amplitude as a function of thickness, normalised as flats are, on a uniform fine grid."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...array_types import Float32Array, FloatArray
from ...errors import InputError, OutOfRangeError

LANES = 8  # Wavelength axes are padded to a multiple of this, so that inner loops fill the vector registers


class Grid(NamedTuple):
    """Templates as compiled loops take them."""

    table: Float32Array  # `FlatTemplates.table`
    # start, step: first thickness and spacing [µm]
    start: float
    step: float


@dataclass(frozen=True, eq=False)
class FlatTemplates:
    """Response of a stack against thickness, and the amplitudes a flat of that stack would show.

    A prepared flat is ``counts / mean - 1`` with the mean over the sensor, so the model is
    ``response / mean response - 1`` with the mean over the thicknesses that the sensor has. That
    distribution is known only after a fit: start from the whole range, then call `normalised_to`.

    Parameters
    ----------
    response : `numpy.ndarray`, shape ``(n_thickness, n_wavelengths)``
        Response (absorbed fraction) on the grid; positive.
    start_um, step_um : `float`
        First thickness and spacing of the grid [µm].
    wavelength_nm : `numpy.ndarray`, shape ``(n_wavelengths,)``
        Wavelengths, in any order [nm].
    mean_response : `numpy.ndarray`, shape ``(n_wavelengths,)``, optional
        Mean over the sensor; by default the mean over the grid.
    contrast : `numpy.ndarray`, shape ``(n_wavelengths,)``, optional
        Factor on the amplitude of each wavelength; 1 by default.
    group : `numpy.ndarray`, shape ``(n_wavelengths,)``, optional
        Group index of the layer over its index; 1 by default.
    beside_um : `numpy.ndarray`, shape ``(n_wavelengths,)``, optional
        By how much thicker the layer seems where the wavelength changes, because the phase of the thin layers beside
        it turns too [µm]; 0 by default.
    fading, middle_um : `float`, optional
        Logarithmic loss of contrast per thickness [1/µm], and the thickness [µm] at which there is none.

    Raises
    ------
    InputError
        Shapes that do not fit together, fewer than 16 thicknesses, a response that is not positive.
    """

    response: FloatArray
    start_um: float
    step_um: float
    wavelength_nm: FloatArray
    mean_response: FloatArray = field(default_factory=lambda: np.empty(0))
    contrast: FloatArray = field(default_factory=lambda: np.empty(0))
    group: FloatArray = field(default_factory=lambda: np.empty(0))
    beside_um: FloatArray = field(default_factory=lambda: np.empty(0))
    fading: float = 0.0
    middle_um: float = 0.0

    def __post_init__(self) -> None:
        response = np.ascontiguousarray(self.response, dtype=float)
        wavelength = np.asarray(self.wavelength_nm, dtype=float)
        if response.ndim != 2 or response.shape[1] != wavelength.size or wavelength.ndim != 1:
            raise InputError(
                "shape of the template response", response.shape, f"(thicknesses, {wavelength.size})"
            )
        if len(response) < 16:
            raise InputError("number of template thicknesses", len(response), "16 or more")
        if not (self.step_um > 0 and self.start_um > 0):
            raise OutOfRangeError(
                "template grid (start, step) [um]", (self.start_um, self.step_um), "positive"
            )
        if not np.all(response > 0) or not np.all(np.isfinite(response)):
            raise OutOfRangeError("template response", float(np.nanmin(response)), "positive and finite")
        mean = np.asarray(self.mean_response, dtype=float)
        contrast = np.asarray(self.contrast, dtype=float)
        mean = response.mean(axis=0) if mean.size == 0 else mean
        contrast = np.ones(wavelength.size) if contrast.size == 0 else contrast
        group = np.asarray(self.group, dtype=float)
        group = np.ones(wavelength.size) if group.size == 0 else group
        beside = np.asarray(self.beside_um, dtype=float)
        beside = np.zeros(wavelength.size) if beside.size == 0 else beside
        for name, value in (("mean response", mean), ("contrast", contrast), ("group index", group)):
            if value.shape != wavelength.shape or not np.all(value > 0):
                raise InputError(f"template {name}", value.tolist(), f"{wavelength.size} positive numbers")
        for name, array in (
            ("response", response),
            ("wavelength_nm", wavelength),
            ("mean_response", mean),
            ("contrast", contrast),
            ("group", group),
            ("beside_um", beside),
        ):
            object.__setattr__(self, name, array)

    @property
    def stop_um(self) -> float:
        """Last thickness of the grid [µm]."""
        return self.start_um + self.step_um * (len(self.response) - 1)

    @property
    def thickness_um(self) -> FloatArray:
        """Grid [µm], shape ``(n_thickness,)``."""
        return np.asarray(self.start_um + self.step_um * np.arange(len(self.response)), dtype=float)

    @property
    def n_wavelengths(self) -> int:
        """Number of wavelengths, without padding."""
        return self.wavelength_nm.size

    def amplitude(self) -> FloatArray:
        """Fringe amplitude ``contrast * (response / mean - 1)``, shape ``(n_thickness, n_wavelengths)``."""
        factor = self.contrast
        if self.fading:
            factor = factor * np.exp(-self.fading * (self.thickness_um - self.middle_um))[:, None]
        return np.asarray(factor * (self.response / self.mean_response - 1.0))

    def table(self) -> Float32Array:
        """`amplitude` as float32 with the wavelength axis padded by zeros to a multiple of `LANES`."""
        return pad_wavelengths(self.amplitude())

    def grid(self) -> Grid:
        """`table` and the thicknesses of its rows."""
        return Grid(self.table(), self.start_um, self.step_um)

    def amplitude_at(self, thickness_um: ArrayLike) -> FloatArray:
        """Amplitude at any thickness inside the grid, shape ``(n_wavelengths, *thickness.shape)``."""
        thickness = np.asarray(thickness_um, dtype=float)
        place = (thickness - self.start_um) / self.step_um
        below = np.clip(np.floor(place).astype(int), 0, len(self.response) - 2)
        table = self.amplitude()
        share = (place - below)[..., None]
        return np.moveaxis(table[below] * (1.0 - share) + table[below + 1] * share, -1, 0)

    def normalised_to(self, thickness_um: ArrayLike) -> Self:
        """Copy whose mean is that over a sample of thicknesses.

        Parameters
        ----------
        thickness_um : array_like
            Thicknesses that represent the sensor [µm]; what is not finite or outside the grid is left out.
            An empty sample leaves the templates as they are.
        """
        sample = np.asarray(thickness_um, dtype=float).ravel()
        sample = sample[np.isfinite(sample)]
        place = np.rint((sample - self.start_um) / self.step_um)
        place = place[(place >= 0) & (place < len(self.response))].astype(int)
        if place.size == 0:
            return self
        weight = np.bincount(place, minlength=len(self.response)) / place.size
        return replace(self, mean_response=weight @ self.response)

    def with_contrast(self, contrast: ArrayLike) -> Self:
        """Copy with other contrast factors, one for each wavelength (or one for all)."""
        values = np.broadcast_to(np.asarray(contrast, dtype=float), self.wavelength_nm.shape)
        return replace(self, contrast=np.array(values))

    def as_found(
        self,
        contrast: ArrayLike,
        shift_nm: FloatArray,
        fading: float,
        overtones: FloatArray,
        middle_um: float,
        waves: FloatArray | None = None,
    ) -> Self:
        """Copy for flats whose contrast, wavelengths and waveform are a little different.

        Parameters
        ----------
        contrast : array_like
            Factor on the amplitude of each wavelength.
        shift_nm : `numpy.ndarray`, shape ``(n_wavelengths,)``
            What is added to each wavelength [nm]. The phase of a fringe is that of the thickness over the wavelength.
        fading, middle_um : `float`
            See the class.
        overtones : `numpy.ndarray`, shape ``(n_wavelengths, 4)``
            Factors on the functions of `overtones`, which are added.
        waves : `numpy.ndarray`, optional
            These functions, if they are known.
        """
        response = self.response
        if np.any(overtones):
            response = response + np.einsum(
                "wq,nwq->nw", overtones, self.overtones if waves is None else waves
            )
        if np.any(shift_nm):
            grid = self.thickness_um
            move = self.turn_um(grid[:, None]) * shift_nm
            response = np.stack(
                [np.interp(grid + m, grid, column) for m, column in zip(move.T, response.T, strict=True)],
                axis=1,
            )
        found = replace(self, response=response, fading=fading, middle_um=middle_um)
        return found.with_contrast(contrast)

    def part(self, low_um: float, high_um: float) -> tuple[Self, slice]:
        """Copy that holds a part of the range, and the rows of it; the mean response stays."""
        first = int(np.clip((low_um - self.start_um) / self.step_um, 0, len(self.response) - 17))
        last = int(np.clip((high_um - self.start_um) / self.step_um + 2, first + 16, len(self.response)))
        rows = slice(first, last)
        return replace(
            self, response=self.response[rows], start_um=self.start_um + first * self.step_um
        ), rows

    def turn_um(self, thickness_um: ArrayLike) -> FloatArray:
        """Change of thickness that changes the fringe as 1 nm of wavelength does, along the last axis [µm/nm]."""
        thickness = np.asarray(thickness_um, dtype=float)
        return np.asarray(-(thickness * self.group + self.beside_um) / self.wavelength_nm)

    @cached_property
    def overtones(self) -> FloatArray:
        """Second and third overtone of the response, each followed by its quadrature, along a last axis of length 4.

        What repeats after half an order are the even overtones, and what repeats after a third those of 3, 6, ...
        """
        grid, step = self.thickness_um, self.step_um
        out = np.empty((*self.response.shape, 4))
        for band, column in enumerate(self.response.T):
            order = self.order_um(np.arange(self.n_wavelengths) == band)
            level = column.mean()
            for k, number in enumerate((2, 3)):
                moves = order * np.arange(number) / number
                moves = np.where(moves > 0.5 * order, moves - order, moves)
                both = np.concatenate([moves, -moves])
                wave = sum(np.interp(grid + move, grid, column) for move in both) / both.size - level
                out[:, band, 2 * k] = wave
                out[:, band, 2 * k + 1] = np.gradient(wave, step) * order / (2.0 * np.pi * number)
        return out

    def order_um(self, weight: ArrayLike | None = None) -> float:
        """Thickness of one fringe order [µm]: the shift at which all wavelengths together repeat best.

        Parameters
        ----------
        weight : array_like, shape ``(n_wavelengths,)``, optional
            Weight of each wavelength (inverse variance); equal by default.

        Raises
        ------
        InputError
            The grid is too short to hold two orders, or the response does not oscillate.
        """
        weights = np.ones(self.n_wavelengths) if weight is None else np.asarray(weight, dtype=float)
        curve = self.amplitude()[:, weights > 0.0]
        curve = curve - curve.mean(axis=0)
        count = len(curve)
        size = 1 << (2 * count - 1).bit_length()
        power = (np.abs(np.fft.rfft(curve, size, axis=0)) ** 2) @ weights[weights > 0.0]
        correlation = np.fft.irfft(power, size)[:count] / np.arange(count, 0, -1)
        falling = np.flatnonzero(correlation < 0.0)
        if falling.size == 0:
            raise InputError(
                "thickness range [um]", (self.start_um, self.stop_um), "two fringe orders or more"
            )
        first = falling[0]
        # The first peak after the first dip; 4.5 x the first zero lies between the first and the second peak.
        window = correlation[first : min(int(6.5 * first) + 2, (3 * count) // 4)]
        if window.size < 3:
            raise InputError(
                "thickness range [um]", (self.start_um, self.stop_um), "two fringe orders or more"
            )
        peak = first + int(np.argmax(window))
        if not 0 < peak < count - 1 or correlation[peak] <= 0.0:
            raise InputError(
                "thickness range [um]", (self.start_um, self.stop_um), "two fringe orders or more"
            )
        left, middle, right = correlation[peak - 1 : peak + 2]
        offset = 0.5 * (left - right) / (left - 2.0 * middle + right)
        return float((peak + offset) * self.step_um)


def pad_wavelengths(values: NDArray[np.floating]) -> Float32Array:
    """Copy to float32 with zeros appended to the last axis up to a multiple of `LANES`."""
    width = values.shape[-1]
    padded = -(-width // LANES) * LANES
    out = np.zeros((*values.shape[:-1], padded), dtype=np.float32)
    out[..., :width] = values
    return out


def arc_length_nodes(amplitude: FloatArray, weight: ArrayLike, nodes: int) -> NDArray[np.intp]:
    """Rows of a template table that lie at equal distances along its curve.

    Uniform thickness steps crowd where the curve turns slowly and leap where it turns fast (the sharp side
    of an Airy fringe), and a leap can step over an order.

    ``amplitude``: the curve, ``(n_thickness, n_wavelengths)``; ``weight``: inverse variance of the data: distances
    are counted in standard deviations, ``(n_wavelengths,)``; ``nodes``: number of rows wanted.
    """
    step = np.sqrt((np.diff(amplitude, axis=0) ** 2) @ np.asarray(weight, dtype=float))
    # A floor keeps the thickness steps bounded where nothing changes.
    step = np.maximum(step, 0.25 * step.mean())
    length = np.concatenate([[0.0], np.cumsum(step)])
    rows = np.searchsorted(length, np.linspace(0.0, length[-1], max(nodes, 2)))
    return np.unique(np.clip(rows, 0, len(amplitude) - 1))
