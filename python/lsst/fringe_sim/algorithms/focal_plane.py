"""Forecast of fringes over a focal plane: how strong they are, beside the shot noise, before and after a correction.

Whatever a night does, the fringe of a sensor is a sum of the patterns of the components of the sky (OH bands and
continua). Their mean products, in cells of the sensor and after averaging over apertures, decide every rms that a
forecast asks for, so that nights and templates cost nothing beyond one pass over the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

from ..array_types import FloatArray
from ..blocks import block_means
from ..errors import InputError, OutOfRangeError
from ..instrument.bandpass import Bandpass
from ..instrument.detector import Detector
from ..instrument.night import NightHistory
from ..instrument.readout import electrons_to_microjansky, zero_point
from ..instrument.sky import SkySpectrum
from ..model import FringeModel
from .field_response import SensorPlacement, SensorResponse
from .fringe_amplitudes import FringeAmplitudes, fringe_amplitudes
from .sky_frame import component_electrons

DES_CRITERION = 0.1
"""Residual fringe over shot noise, at scales up to 20 arcsec, that the Dark Energy Survey asks for."""

_BLOCK_ARCSEC = 1.0
"""Pixels are averaged over squares of this side first; the fringes of a sensor are ten times as wide or more."""

_HIGH_PERCENTILE = 90.0


@dataclass(frozen=True)
class ForecastOptions:
    """How a sensor is summed up."""

    cells: int = 8  # cells along each side of the sensor, for the map of the focal plane
    # Sides of the square apertures over which fringe and noise are compared [arcsec], whole numbers
    apertures_arcsec: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0, 20.0)
    templates: int = 3  # largest number of templates of a correction

    def __post_init__(self) -> None:
        if self.cells < 1 or self.templates < 1:
            raise OutOfRangeError("cells and templates", (self.cells, self.templates), "1 or more")
        if not self.apertures_arcsec or any(
            each < 1.0 or each != round(each) for each in self.apertures_arcsec
        ):
            raise OutOfRangeError("apertures [arcsec]", self.apertures_arcsec, "whole numbers from 1 on")


@dataclass(frozen=True, eq=False)
class SkyLevel:
    """Electrons of the sky in one pixel, component by component, with every band at its reference level."""

    # (C,): through the measured quantum efficiency of the throughput tables [e⁻ per pixel and exposure]
    electrons: FloatArray
    read_noise_e: float  # read noise [e⁻ rms]
    pixel_scale_arcsec: float  # side of a pixel [arcsec]
    # Surface brightness above the air of a source as bright as the whole sky [µJy arcsec⁻²]
    microjansky: float

    @classmethod
    def of(
        cls,
        sky: SkySpectrum,
        model: FringeModel,
        read_noise_e: float,
        relative_illumination: float = 1.0,
        exposure_s: float | None = None,
    ) -> SkyLevel:
        """Level of a sky on the sensor of a set-up.

        ``model``: where area, pixel scale, bandpass and exposure time come from. ``read_noise_e``: read noise
        [e⁻ rms]. ``relative_illumination``: light at the place of the sensor relative to the axis (vignetting).
        ``exposure_s``: exposure time; by default that of the set-up.
        """
        setup = model.setup
        band = Bandpass.from_name(setup.bandpass)
        exposure = setup.exposure_s if exposure_s is None else exposure_s
        electrons = np.array(list(component_electrons(sky, band, model, exposure).values()))
        # What fringes are compared with, a source above the air, has passed it.
        zero = zero_point(band, setup.effective_area_m2, setup.airmass)
        brightness = electrons_to_microjansky(electrons.sum(), zero, exposure, setup.pixel_scale_arcsec)
        return cls(
            electrons * relative_illumination, read_noise_e, setup.pixel_scale_arcsec, float(brightness)
        )

    def noise(self, factors: ArrayLike, aperture_arcsec: float) -> FloatArray:
        """Noise of the mean of an aperture, relative to the sky; broadcasts over the leading axes of ``factors``."""
        sky = np.asarray(factors, dtype=float) @ self.electrons
        pixels = (aperture_arcsec / self.pixel_scale_arcsec) ** 2
        return np.asarray(np.sqrt((sky + self.read_noise_e**2) / pixels) / sky)


@dataclass(frozen=True, eq=False)
class PatternMoments:
    """Mean products of the fringe patterns of the components of the sky."""

    # Sides of the apertures over which patterns were averaged, A of them [arcsec]
    apertures_arcsec: tuple[float, ...]
    # (A, n, n, C, C): mean over the apertures in each of n × n cells of the product of two patterns, each
    # in units of the mean sky at its reference level, less its mean over the sensor; NaN in a cell
    # without thickness
    product: FloatArray
    share: FloatArray  # (C,): share of each component in the mean sky that the sensor detects
    amplitudes: FringeAmplitudes  # of the frame at the reference level

    @property
    def whole(self) -> FloatArray:
        """Mean products over the whole sensor, shape ``(A, C, C)``."""
        return np.asarray(np.nanmean(self.product, axis=(1, 2)))

    def rms(self, vectors: ArrayLike, factors: ArrayLike) -> FloatArray:
        """Rms of sums of patterns as fractions of the sky of their time.

        ``vectors`` (T, C). ``factors`` (T, C). Returns (A, T).
        """
        wanted = np.asarray(vectors, dtype=float)
        square = np.einsum("tc,acd,td->at", wanted, self.whole, wanted)
        return np.sqrt(np.maximum(square, 0.0)) / (np.asarray(factors, dtype=float) @ self.share)


@dataclass(frozen=True, eq=False)
class SensorForecast:
    """Fringes of one sensor."""

    detector: str
    vendor: str
    stand_in: bool  # whether its thickness is a random field in place of a measured map
    # field_radius_deg, relative_illumination: distance of its centre from the axis [deg], and the light
    # there relative to the axis
    field_radius_deg: float
    relative_illumination: float
    amplitudes: FringeAmplitudes  # of the frame with every band at its reference level
    # mean_electrons, microjansky: sky per pixel [e⁻] and per square arcsecond [µJy]
    mean_electrons: float
    microjansky: float
    apertures_arcsec: tuple[float, ...]  # sides of the apertures, A of them [arcsec]
    over_noise: FloatArray  # (A,): rms fringe over the noise of the sky, both averaged over the aperture
    # (K, A): the same after correction with 1 to K templates; the level that 90 % of the exposures of
    # other nights stay below
    residual_over_noise: FloatArray
    # cell_x_mm, cell_y_mm (n, n): centres of the cells in the focal plane
    cell_x_mm: FloatArray
    cell_y_mm: FloatArray
    # cell_rms, cell_over_noise, cell_residual (n, n): rms fringe (fraction of the sky), largest ratio to
    # the noise over the apertures, and that ratio after correction with K templates
    cell_rms: FloatArray
    cell_over_noise: FloatArray
    cell_residual: FloatArray

    @property
    def templates_needed(self) -> int:
        """Fewest templates that meet the criterion of the Dark Energy Survey at every scale; -1 if K are too few.

        0 where the fringe is too faint to need a correction.
        """
        if self.over_noise.max() < DES_CRITERION:
            return 0
        enough = np.flatnonzero(self.residual_over_noise.max(axis=1) < DES_CRITERION)
        return int(enough[0]) + 1 if enough.size else -1

    def summary(self) -> dict[str, Any]:
        """One row of the table of the focal plane."""
        return {
            "detector": self.detector,
            "vendor": self.vendor,
            "stand_in": self.stand_in,
            "field_radius": self.field_radius_deg,
            "illumination": self.relative_illumination,
            "rms": 100.0 * self.amplitudes.rms,
            "half_peak_to_peak": 100.0 * self.amplitudes.half_peak_to_peak,
            "half_range_1_99": 100.0 * self.amplitudes.half_range_1_99,
            "rms_brightness": self.amplitudes.rms * self.microjansky,
            "sky": self.mean_electrons,
            "over_noise": float(self.over_noise.max()),
            "over_noise_scale": self.apertures_arcsec[int(self.over_noise.argmax())],
            **{
                f"residual_{number + 1}": float(row.max())
                for number, row in enumerate(self.residual_over_noise)
            },
            "templates_needed": self.templates_needed,
        }

    def to_table(self) -> Table:
        """Cells as rows; what concerns the whole sensor is in ``meta``."""
        table = Table(
            {
                "x": self.cell_x_mm.ravel(),
                "y": self.cell_y_mm.ravel(),
                "rms": 100.0 * self.cell_rms.ravel(),
                "rms_brightness": self.microjansky * self.cell_rms.ravel(),
                "over_noise": self.cell_over_noise.ravel(),
                "residual_over_noise": self.cell_residual.ravel(),
            },
            units={"x": "mm", "y": "mm", "rms": "%", "rms_brightness": "uJy / arcsec2"},
            descriptions={
                "x": "centre of the cell in the focal plane",
                "y": "centre of the cell in the focal plane",
                "rms": "rms fringe, per cent of the sky",
                "rms_brightness": "rms fringe as a surface brightness",
                "over_noise": "rms fringe over noise of the sky, largest over the apertures",
                "residual_over_noise": "the same after correction with all templates",
            },
        )
        table.meta.update(self.summary())
        return table


UNITS = {
    "field_radius": "deg",
    "rms": "%",
    "half_peak_to_peak": "%",
    "half_range_1_99": "%",
    "rms_brightness": "uJy / arcsec2",
    "sky": "electron",
    "over_noise_scale": "arcsec",
}
"""Units of the columns of the table of a focal plane (`SensorForecast.summary`)."""


def summary_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Table of a focal plane, one row per sensor, from `SensorForecast.summary` or the ``meta`` of its table."""
    if not rows:
        raise InputError("sensors of the focal plane", 0, "one or more")
    names = [name for name in rows[0] if all(name in row for row in rows)]
    return Table({name: [row[name] for row in rows] for name in names}, units=UNITS)


def pattern_moments(
    thickness_um: ArrayLike, response: SensorResponse, options: ForecastOptions | None = None
) -> PatternMoments:
    """Mean products of the fringe patterns of a sensor.

    ``thickness_um`` (ny, nx): thickness, on pixels of any size that cover what is placed, the sensor or a part of it;
    NaN where it is not known.
    """
    chosen = ForecastOptions() if options is None else options
    thickness = np.asarray(thickness_um)
    if thickness.ndim != 2 or not np.isfinite(thickness).any():
        raise InputError("thickness map", thickness.shape, "two axes, some finite values")
    block = _block_of(thickness.shape, response, chosen)
    total = np.zeros(thickness.shape, dtype=np.float32)
    patterns = []
    for table in response.component_tables():
        frame = table.frame(thickness)
        total += frame
        patterns.append(block_means(frame, block))
    stack = np.stack(patterns)
    known = np.isfinite(stack[0])
    means = stack[:, known].mean(axis=1, dtype=np.float64)
    stack = (stack - means[:, None, None]) / means.sum()  # now in double precision
    products = [
        _cell_products(block_means(stack, round(side / _BLOCK_ARCSEC)), chosen.cells)
        for side in chosen.apertures_arcsec
    ]
    amplitudes = fringe_amplitudes(total, ~np.isfinite(thickness))
    return PatternMoments(chosen.apertures_arcsec, np.stack(products), means / means.sum(), amplitudes)


def correction_residuals(
    moments: PatternMoments, training: ArrayLike, observed: ArrayLike, templates: int
) -> list[FloatArray]:
    """What corrections with templates from one night leave of the fringes of others.

    ``training``, ``observed`` (T, C) and (S, C): factors on the components of the sky, of the exposures
    that make the templates and of those to be corrected. ``templates``: largest number of templates: the
    mean fringe of the training exposures, then their principal components beside it. Returns (S, C) for 1,
    2, ... templates: the coefficients of the patterns that are left, with the scales of the templates
    fitted to noiseless exposures.
    """
    basis_of = np.asarray(training, dtype=float)
    wanted = np.asarray(observed, dtype=float)
    metric = moments.whole[0]
    basis = [basis_of.mean(axis=0)]
    beside = _less(basis_of, basis, metric)
    # Principal components in the metric of the patterns; S S^T is the Gram matrix of the exposures.
    values, vectors = np.linalg.eigh(beside @ metric @ beside.T)
    order = np.argsort(values)[::-1]
    basis += [
        vectors[:, k] @ beside for k in order[: max(templates - 1, 0)] if values[k] > 1e-12 * values.max()
    ]
    return [_less(wanted, basis[: min(count, len(basis))], metric) for count in range(1, templates + 1)]


def forecast_sensor(
    thickness_um: ArrayLike,
    response: SensorResponse,
    detector: Detector,
    level: SkyLevel,
    training: NightHistory,
    observed: NightHistory,
    *,
    stand_in: bool = False,
    options: ForecastOptions | None = None,
) -> SensorForecast:
    """Forecast the fringes of one sensor.

    ``training``, ``observed``: the night from which the templates come, and other times that are corrected with
    them. ``stand_in``: whether the thickness stands for a map that is not measured.
    """
    chosen = ForecastOptions() if options is None else options
    if level.electrons.shape != (len(response.component),):
        raise InputError("components of the level", level.electrons.shape, f"({len(response.component)},)")
    moments = pattern_moments(thickness_um, response, chosen)
    reference = np.ones((1, level.electrons.size))
    noise = np.array([level.noise(reference, side)[0] for side in chosen.apertures_arcsec])
    over = moments.rms(reference, reference)[:, 0] / noise
    times = [
        np.stack([response.factors(night.band_scale(time, response.bands)) for time in range(len(night))])
        for night in (training, observed)
    ]
    left = correction_residuals(moments, times[0], times[1], chosen.templates)
    noises = np.stack([level.noise(times[1], side) for side in chosen.apertures_arcsec])
    ratios = [np.percentile(moments.rms(each, times[1]) / noises, _HIGH_PERCENTILE, axis=1) for each in left]
    cell_rms = _cell_rms(moments, reference, reference)
    cell_left = _cell_residual(moments, left[-1], times[1])
    typical = np.sqrt((noises**2).mean(axis=1))[:, None, None]
    x_mm, y_mm = _cell_centres(detector, response.placement, level.pixel_scale_arcsec, chosen.cells)
    radius_deg = math.hypot(response.placement.field_x_deg, response.placement.field_y_deg)
    return SensorForecast(
        detector=detector.name,
        vendor=detector.vendor,
        stand_in=stand_in,
        field_radius_deg=radius_deg,
        relative_illumination=float(response.field.relative_illumination(radius_deg)),
        amplitudes=moments.amplitudes,
        mean_electrons=float(level.electrons.sum()),
        microjansky=level.microjansky,
        apertures_arcsec=chosen.apertures_arcsec,
        over_noise=over,
        residual_over_noise=np.stack(ratios),
        cell_x_mm=x_mm,
        cell_y_mm=y_mm,
        cell_rms=cell_rms[0],
        cell_over_noise=(cell_rms / noise[:, None, None]).max(axis=0),
        cell_residual=(cell_left / typical).max(axis=0),
    )


def _less(vectors: FloatArray, basis: Sequence[FloatArray], metric: FloatArray) -> FloatArray:
    """Vectors less their least-squares approximation by a basis."""
    rows = np.stack(basis)
    normal = rows @ metric @ rows.T
    scale = np.linalg.lstsq(normal, rows @ metric @ vectors.T, rcond=1e-12)[0]
    return np.asarray(vectors - scale.T @ rows)


def _cell_rms(moments: PatternMoments, vector: FloatArray, factors: FloatArray) -> FloatArray:
    square = np.einsum("tc,ayxcd,td->ayx", vector, moments.product, vector)
    return np.sqrt(np.maximum(square, 0.0)) / float((factors @ moments.share)[0])


def _cell_residual(moments: PatternMoments, left: FloatArray, factors: FloatArray) -> FloatArray:
    """Rms over exposures, which stands for the single ones, of what is left in each cell."""
    sky = factors @ moments.share
    relative = left / sky[:, None]
    square = np.einsum("tc,ayxcd,td->ayx", relative, moments.product, relative) / len(sky)
    return np.sqrt(np.maximum(square, 0.0))


def _block_of(shape: tuple[int, ...], response: SensorResponse, options: ForecastOptions) -> int:
    """Pixels of the map along a side of a block."""
    pixel_arcsec = 3600.0 * abs(response.placement.width_deg) / shape[1]
    block = max(1, round(_BLOCK_ARCSEC / pixel_arcsec))
    least = options.cells * round(max(options.apertures_arcsec))
    if min(shape) // block < least or pixel_arcsec > 1.5 * _BLOCK_ARCSEC:
        raise InputError(
            "shape of the thickness map",
            tuple(shape),
            f"pixels of at most 1 arcsec, {least} of them on a side for {options.cells} cells",
        )
    return block


def _cell_products(patterns: NDArray[Any], cells: int) -> FloatArray:
    """Mean products of patterns ``[C, y, x]`` in cells, shape ``(n, n, C, C)``."""
    edges = [np.linspace(0, size, cells + 1).round().astype(int) for size in patterns.shape[1:]]
    out = np.full((cells, cells, len(patterns), len(patterns)), np.nan)
    for y in range(cells):
        for x in range(cells):
            part = patterns[:, edges[0][y] : edges[0][y + 1], edges[1][x] : edges[1][x + 1]]
            good = part[:, np.isfinite(part[0])].astype(float)
            if good.shape[1]:
                out[y, x] = good @ good.T / good.shape[1]
    return out


def _cell_centres(
    detector: Detector, placement: SensorPlacement, pixel_scale_arcsec: float, cells: int
) -> tuple[FloatArray, FloatArray]:
    """Places of the cells in the focal plane [mm]."""
    column, row = np.meshgrid(np.arange(cells), np.arange(cells))
    x, y = (start + along * column + across * row for start, along, across in placement.plane((cells, cells)))
    whole = SensorPlacement.of(detector, pixel_scale_arcsec)
    mm = 1e-3 * detector.pixel_um * 3600.0 / pixel_scale_arcsec
    return detector.x_mm + mm * (x - whole.field_x_deg), detector.y_mm + mm * (y - whole.field_y_deg)
